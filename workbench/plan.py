"""A capture plan is data: which shots, at which depth, of which pattern. Making one touches nothing.

A plan iterates into shots in the order in which they are taken: depth by depth, ascending, so that the stage
always approaches from the same side (backlash), and at each depth metering, the repeats, the panel-off frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

from pydantic import BaseModel, ConfigDict

from rigs.protocols import Pattern
from workbench.errors import InputError
from workbench.files import sha256_json

ShotKind = Literal["point", "off"]


class PatternSpec(BaseModel):
    """What the panel shows for a shot, as JSON; see :class:`rigs.protocols.Pattern`."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["black", "dot", "grid"]
    size_px: float = 1.0
    colour: str = "#ffffff"
    points_px: tuple[tuple[float, float], ...] = ()

    def pattern(self) -> Pattern:
        """The panel's value type."""
        return Pattern(kind=self.kind, size_px=self.size_px, colour=self.colour, points_px=self.points_px)


class Shot(BaseModel):
    """One exposure at a known position, pattern and setting."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    id: str
    kind: ShotKind
    depth_mm: float
    """Nominal depth."""
    repeat: int
    pattern: PatternSpec
    exposure_of: str
    """Shots with the same key share one metered exposure (one metering per depth)."""


class Plan(BaseModel):
    """All shots of a calibration, with what is needed to take them."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["calibrate"] = "calibrate"
    depths_mm: tuple[float, ...]
    repeats: int
    off_frames: int
    dots: tuple[PatternSpec, ...]
    """What the panel shows, one per depth: the dot may grow with distance as its image shrinks."""
    iso: int = 100
    max_meter_shots: int = 8

    @property
    def widest(self) -> PatternSpec:
        """Of the patterns the one that reaches farthest from the panel's middle."""
        return max(self.dots, key=lambda dot: max((max(abs(x), abs(y)) for x, y in dot.points_px), default=0.0))

    def shots(self) -> Iterator[Shot]:
        """Shots in the order of their taking."""
        black = PatternSpec(kind="black")
        for depth, dot in zip(self.depths_mm, self.dots, strict=True):
            key = f"{round(depth * 10):05d}"
            for repeat in range(self.repeats):
                yield Shot(
                    id=f"point-{key}-{repeat + 1}", kind="point", depth_mm=depth, repeat=repeat, pattern=dot,
                    exposure_of=key,
                )  # fmt: skip
            for repeat in range(self.off_frames):
                yield Shot(
                    id=f"off-{key}-{repeat + 1}", kind="off", depth_mm=depth, repeat=repeat, pattern=black,
                    exposure_of=key,
                )  # fmt: skip

    @property
    def hash(self) -> str:
        """SHA-256 of the plan's content."""
        return sha256_json(self.model_dump(mode="json"))


def depth_grid_mm(from_mm: float, to_mm: float, step_mm: float) -> tuple[float, ...]:
    """Ascending depths from ``from_mm`` to ``to_mm`` inclusive.

    Raises
    ------
    InputError
        Fewer than three depths, reversed ends, a step that is not positive, or lengths that can't be centimetres.
    """
    if not step_mm > 0:
        raise InputError(f"--step {step_mm / 10:g}cm: a step is longer than 0")
    if not 0 < from_mm < to_mm:
        raise InputError(f"--from {from_mm / 10:g}cm --to {to_mm / 10:g}cm: the depths must be ascending and above 0")
    if from_mm < 50 or to_mm > 100_000:
        raise InputError(
            f"--from {from_mm / 10:g}cm --to {to_mm / 10:g}cm: outside 5 cm to 100 m; is the unit right (60cm, 0.6m)?"
        )
    count = math.floor((to_mm - from_mm) / step_mm + 1e-9) + 1
    if count < 3:
        raise InputError(f"{count} depths are too few for a lens fit: at least 3; use a smaller --step")
    if count > 2000:
        raise InputError(f"{count} depths are more than a session can take: use a larger --step")
    return tuple(round(from_mm + index * step_mm, 6) for index in range(count))
