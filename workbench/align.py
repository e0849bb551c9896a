"""Centring the point and finding focus: one frame after the other, measured and shown live."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from calibration.errors import CalibrationError, FrameError
from calibration.exposure import choose_exposure
from calibration.exposure import meter as meter_image
from calibration.image import LinearImage
from rigs.align_feed import AlignFeed, AlignSample, Finding
from rigs.errors import CaptureError
from rigs.protocols import Camera, Exposure, Panel, Pattern
from workbench.alignment import look, only_show, preview_image
from workbench.metering import FIRST_TIME_S, HIGHEST_ISO
from workbench.plan import PatternSpec

PATTERNS = ("dot", "cross-hair", "white", "black")
TRIES = 3
"""A camera that fails so often in a row is in trouble that waiting won't end."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One frame: what it says, what is judged of it, and what the panel showed."""

    sample: AlignSample
    findings: tuple[Finding, ...]
    pattern: str


class Aligner:
    """Looks again and again; the panel's pattern may be changed from another thread meanwhile.

    Parameters
    ----------
    camera, panel
        Open devices.
    dot
        The dot as a calibration would show it.
    feed
        Where samples go.
    read
        Develops a frame.
    scratch
        Directory for the frame at hand; emptied after each.
    exposure_s, iso
        Fixed exposure time, or None to have it follow the point; and the ISO.
    live_view
        Take the camera's live view instead of frames.
    panel_scale
        Pixel pitch of a frame (mm) -> what a pixel covers on the panel (mm); None: the panel's depth isn't known.
    """

    def __init__(
        self,
        camera: Camera,
        panel: Panel,
        dot: PatternSpec,
        feed: AlignFeed,
        read: Callable[[Path], LinearImage],
        scratch: Path,
        *,
        exposure_s: float | None,
        iso: int,
        live_view: bool,
        panel_scale: Callable[[float], float] | None = None,
    ) -> None:
        self._camera, self._panel, self._feed, self._read = camera, panel, feed, read
        self._dot, self._scratch, self._live_view = dot, scratch, live_view
        self._times, self._isos = camera.exposure_times_s(), camera.isos()
        wanted = FIRST_TIME_S if exposure_s is None else exposure_s
        nearest = min(self._times, key=lambda offered: abs(offered - wanted))
        self._exposure, self._follow, self._base_iso = Exposure(nearest, iso), exposure_s is None, iso
        self._panel_scale = panel_scale
        self._frame_px = (0, 0)
        self._painting = threading.Lock()
        self._pattern = ""

    @property
    def exposure_s(self) -> float:
        """Exposure time of the next frame: the nearest to the one that was asked for that the camera offers."""
        return self._exposure.time_s

    def actions(self) -> dict[str, Callable[[], None]]:
        """What the page's buttons do: label -> show that pattern."""

        def shower(name: str) -> Callable[[], None]:
            return lambda: self.show(name)

        return {name.capitalize(): shower(name) for name in PATTERNS}

    def show(self, pattern: str) -> None:
        """Paint a pattern of :data:`PATTERNS`.

        Raises
        ------
        RigError
            The panel doesn't acknowledge it.
        """
        patterns = {
            "dot": self._dot.pattern(),
            "cross-hair": Pattern("crosshair"),
            "white": Pattern("white"),
            "black": Pattern("black"),
        }
        with self._painting:
            self._panel.show(patterns[pattern])
            self._pattern = pattern

    def looks(self, frames: int | None) -> Iterator[Seen]:
        """Take, measure and show so many frames, or frames without end.

        Raises
        ------
        RigError
            The camera is in trouble.
        """
        taken = troubles = 0
        while frames is None or taken < frames:
            try:
                sample, shown = self._look()
                troubles = 0
            except (CaptureError, FrameError) as error:
                troubles += 1
                if troubles == TRIES:
                    raise
                # Where the frame would have lain is of no interest to anybody.
                note = str(error).replace(f"{self._scratch}/", "")
                sample, shown = AlignSample(*self._frame_px, note=note, failed=True), self._pattern
            self._frame_px = sample.frame_width_px, sample.frame_height_px
            taken += 1
            yield Seen(sample, self._feed.push(sample), shown)

    def _look(self) -> tuple[AlignSample, str]:
        """One frame, and the pattern that the panel showed at its beginning."""
        shown, exposure = self._pattern, self._exposure
        if self._live_view:
            image = preview_image(self._camera.preview())
            if image is None:
                raise CaptureError("camera: its live view is no JPEG; leave out --live-view")
            return self._judge(image, shown, None), shown
        path: Path | None = None
        try:
            path = self._camera.capture(exposure, self._scratch / "align.dng").path
            image = self._read(path)
        finally:
            if path is not None:
                path.unlink(missing_ok=True)
        if self._follow and shown == self._pattern != "black":
            self._adjust(image)
        return self._judge(image, shown, exposure), shown

    def _judge(self, image: LinearImage, shown: str, exposure: Exposure | None) -> AlignSample:
        """Measure a frame of the dot; one during which the panel was switched shows neither pattern."""
        if shown != self._pattern:
            return only_show(image, "", exposure)
        if shown != "dot":
            return only_show(image, shown, exposure)
        sample = look(image, exposure)
        if exposure is not None:
            sample = replace(sample, longest=exposure.time_s >= max(self._times))
        if self._panel_scale is None or image.pixel_pitch_mm is None:
            return sample
        return replace(sample, panel_mm_per_px=self._panel_scale(image.pixel_pitch_mm))

    def _adjust(self, image: LinearImage) -> None:
        """Expose the next frame so that what the panel shows is bright and nowhere saturated."""
        isos = [iso for iso in self._isos if self._base_iso <= iso <= HIGHEST_ISO] or [self._base_iso]
        try:
            choice = choose_exposure(
                meter_image(image), time_s=self._exposure.time_s, iso=self._exposure.iso, times_s=self._times, isos=isos
            )
        except CalibrationError:
            return
        if not choice.done:
            self._exposure = Exposure(choice.time_s, choice.iso)
