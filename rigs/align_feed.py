"""What the align page shows: samples measured elsewhere, compared with what is wanted.

No image science here: centroid, peak and width come with :meth:`AlignFeed.push`.
"""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Literal

_HISTORY = 240

_CENTRE_SHARE, _CENTRE_PX = 0.02, 12.0

Level = Literal["good", "info", "warn", "bad"]


@dataclass(frozen=True, slots=True)
class AlignSample:
    """One look through the camera, measured. Pixels are those of the whole developed image; None: not measured."""

    frame_width_px: int
    frame_height_px: int
    """0 by 0: there was no frame."""
    image: bytes = b""
    """JPEG or PNG of the crop around the point; empty: keep the last one."""
    crop_px: tuple[float, float, float, float] | None = None
    """Left, top, width, height of ``image`` in the frame; None: the whole frame."""
    centroid_px: tuple[float, float] | None = None
    """None: no point was found."""
    target_px: tuple[float, float] | None = None
    """Where the point is wanted; None: the frame's centre."""
    peak: float | None = None
    """Brightest value, fraction of white."""
    saturated_px: int = 0
    width_px: float | None = None
    """Width of the PSF; the same measure from sample to sample is what counts."""
    panel_mm_per_px: float | None = None
    """What a pixel covers on the panel."""
    exposure_s: float | None = None
    iso: int | None = None
    longest: bool = False
    """The camera offers no longer exposure than this frame's."""
    note: str = ""
    """Why something couldn't be measured, for the operator."""
    task: str = ""
    """What to look for in a frame of a pattern that holds no point; empty: of the dot."""
    failed: bool = False
    """No frame came; ``note`` says why."""

    def offset_px(self) -> tuple[float, float] | None:
        """Centroid minus target (x to the right, y down); None without a point."""
        if self.centroid_px is None:
            return None
        target = self.target_px or ((self.frame_width_px - 1) / 2, (self.frame_height_px - 1) / 2)
        return self.centroid_px[0] - target[0], self.centroid_px[1] - target[1]

    def offset_mm(self) -> tuple[float, float] | None:
        """The same on the panel; None without a point, and where the panel's depth isn't known."""
        offset = self.offset_px()
        if offset is None or self.panel_mm_per_px is None:
            return None
        return offset[0] * self.panel_mm_per_px, offset[1] * self.panel_mm_per_px


@dataclass(frozen=True, slots=True)
class AlignTolerance:
    """What counts as aligned."""

    centre_px: float | None = None
    """Largest distance from the target; None: 2 % of the frame's width, over which no lens changes, or 12 px."""
    peak: tuple[float, float] = (0.3, 0.9)
    """Wanted brightest value, fraction of white."""
    width_ratio: float = 1.08
    """Largest width relative to the narrowest seen that still counts as in focus."""

    def centre_px_of(self, sample: AlignSample) -> float:
        """Largest distance from the target in this frame."""
        if self.centre_px is not None:
            return self.centre_px
        return max(_CENTRE_SHARE * sample.frame_width_px, _CENTRE_PX)


@dataclass(frozen=True, slots=True)
class Finding:
    """One judgement: ``aspect`` is frame, pattern, point, centre, exposure or focus."""

    aspect: str
    level: Level
    text: str


def judge(sample: AlignSample, tolerance: AlignTolerance, narrowest_px: float | None = None) -> tuple[Finding, ...]:
    """What is right and wrong with a sample, the most urgent first; each text says what to do.

    Parameters
    ----------
    sample, tolerance
        What was measured, and what is wanted.
    narrowest_px
        Smallest width seen so far, pixels; None: not known.
    """
    if sample.failed:
        return (Finding("frame", "bad", f"no frame: {sample.note}"),)
    if sample.task:
        shown = Finding("pattern", "info", sample.task)
        return (_saturated(sample), shown) if sample.saturated_px else (shown,)
    findings = [_centre(sample, tolerance), _exposure(sample, tolerance), _focus(sample, tolerance, narrowest_px)]
    urgency = {"bad": 0, "warn": 1, "info": 2, "good": 3}
    return tuple(sorted((f for f in findings if f is not None), key=lambda finding: urgency[finding.level]))


def _centre(sample: AlignSample, tolerance: AlignTolerance) -> Finding:
    offset = sample.offset_px()
    if offset is None:
        return Finding("point", "bad", f"no point: {sample.note or 'is the dot on, and the panel in view?'}")
    distance = math.hypot(*offset)
    allowed = tolerance.centre_px_of(sample)
    if distance <= allowed:
        return Finding("centre", "good", f"centred within {allowed:.0f} px")
    sides = ((offset[0], "left", "right"), (offset[1], "up", "down"))
    words = [f"{math.floor(abs(v) + 0.5)} px {low if v < 0 else high}" for v, low, high in sides if abs(v) >= 1]
    level: Level = "warn" if distance <= 5 * allowed else "bad"
    on_panel = sample.offset_mm()
    about = "" if on_panel is None else f" ({math.hypot(*on_panel):.0f} mm on the panel)"
    return Finding("centre", level, f"off centre: {' and '.join(words)}{about}")


def _saturated(sample: AlignSample) -> Finding:
    return Finding("exposure", "bad", f"saturated: shorten the exposure ({sample.saturated_px} px at white)")


def _exposure(sample: AlignSample, tolerance: AlignTolerance) -> Finding | None:
    if sample.saturated_px > 0:
        return _saturated(sample)
    if sample.peak is None:
        return None
    low, high = tolerance.peak
    if sample.peak > high:
        return Finding(
            "exposure", "warn", f"nearly saturated: shorten the exposure ({100 * sample.peak:.0f} % of white)"
        )
    if sample.peak < low:
        what = (
            "dim at the longest exposure: brighten the panel, enlarge the dot, or raise the ISO"
            if sample.longest
            else "dim: lengthen the exposure"
        )
        return Finding("exposure", "warn", f"{what} ({100 * sample.peak:.0f} % of white)")
    return Finding("exposure", "good", "well exposed")


def _focus(sample: AlignSample, tolerance: AlignTolerance, narrowest_px: float | None) -> Finding | None:
    if sample.width_px is None or narrowest_px is None or narrowest_px <= 0:
        return None
    ratio = sample.width_px / narrowest_px
    if ratio <= tolerance.width_ratio:
        return Finding("focus", "good", "as narrow as it has been")
    return Finding("focus", "warn", f"wider: {ratio:.2f} times the narrowest, {narrowest_px:.1f} px")


@dataclass(frozen=True, slots=True)
class Published:
    """The newest sample as pages get it."""

    number: int
    at_s: float
    text: dict[str, Any]
    image: bytes


class AlignFeed:
    """Where samples are pushed and pages look. Every method suits any thread."""

    def __init__(self, tolerance: AlignTolerance | None = None) -> None:
        self._tolerance = tolerance or AlignTolerance()
        self._lock = threading.Lock()
        self._latest: Published | None = None
        self._history: deque[dict[str, Any]] = deque(maxlen=_HISTORY)
        self._narrowest_px: float | None = None
        self._news = ""
        self._listeners: list[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = []

    def push(self, sample: AlignSample) -> tuple[Finding, ...]:
        """Show a sample on every open page; returns its judgement."""
        with self._lock:
            if sample.width_px is not None and self._is_well_exposed(sample):
                known = self._narrowest_px
                self._narrowest_px = sample.width_px if known is None else min(known, sample.width_px)
            findings = judge(sample, self._tolerance, self._narrowest_px)
            offset = sample.offset_px()
            facts = {key: value for key, value in asdict(sample).items() if key != "image"}
            number = 1 if self._latest is None else self._latest.number + 1
            distance = None if offset is None else math.hypot(*offset)
            point = {"number": number, "distance_px": distance}
            point |= {key: facts[key] for key in ("peak", "width_px", "saturated_px")}
            self._history.append(point)
            text = {
                "type": "sample",
                "number": number,
                "sample": {**facts, "offset_px": offset, "distance_px": distance, "offset_mm": sample.offset_mm()},
                "findings": [asdict(finding) for finding in findings],
                "narrowest_px": self._narrowest_px,
                "tolerance": {**asdict(self._tolerance), "centre_px": self._tolerance.centre_px_of(sample)},
            }
            image = sample.image or (b"" if self._latest is None else self._latest.image)
            self._latest = Published(number, time.monotonic(), text, image)
            if not sample.failed:
                self._news = ""
            self._announce()
            return findings

    def _is_well_exposed(self, sample: AlignSample) -> bool:
        """Whether its width can be compared: of a dim point the rim is missing, of a saturated one the middle."""
        low = self._tolerance.peak[0]
        return sample.saturated_px == 0 and (sample.peak is None or sample.peak >= low)

    def forget_narrowest(self) -> None:
        """Start the search for the narrowest width anew: after the stage or the lens was moved on purpose."""
        with self._lock:
            self._narrowest_px = None
            self._history.clear()

    def tell(self, text: str) -> None:
        """Show a line until the next frame comes: what is wrong with a device, and what the operator should do."""
        with self._lock:
            self._news = text
            self._announce()

    def news(self) -> str:
        """The line that is to be shown now; empty: none."""
        with self._lock:
            return self._news

    def latest(self) -> Published | None:
        """The newest sample as pages get it."""
        with self._lock:
            return self._latest

    def history(self) -> list[dict[str, Any]]:
        """The last samples' figures, oldest first."""
        with self._lock:
            return list(self._history)

    def listen(self, loop: asyncio.AbstractEventLoop, event: asyncio.Event) -> Callable[[], None]:
        """Have ``event`` set in ``loop`` at each push; returns what ends it."""
        entry = (loop, event)
        with self._lock:
            self._listeners.append(entry)

        def stop() -> None:
            with self._lock:
                self._listeners.remove(entry)

        return stop

    def _announce(self) -> None:
        for loop, event in self._listeners:
            with suppress(RuntimeError):  # the server has ended
                loop.call_soon_threadsafe(event.set)
