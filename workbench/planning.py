"""From rig.yaml and the command line's wishes to a plan, and what it will cost."""

from __future__ import annotations

import math
from dataclasses import dataclass

from calibration.exif import KNOWN_CAMERAS
from workbench.config import RigConfig
from workbench.errors import InputError
from workbench.field_grid import grid_at
from workbench.plan import PatternSpec, Plan, depth_grid_mm

BYTES_PER_PHOTOSITE = 1.2
"""Of a losslessly compressed 14-bit RAW file."""
BYTES_PER_PHOTOSITE_UNCOMPRESSED = 2.0
PHOTOSITES_OF_UNKNOWN = 24e6
"""Of a camera that isn't known before it is asked."""
METER_SHOTS_PER_DEPTH = 2.5
MOST_POINTS = 49
"""Of a grid: more wouldn't keep apart where they are most blurred."""
SECONDS_PER_SHOT = {"simulated": 0.25, "gphoto2": 3.0}
"""Readout, download and check of one frame, without its exposure; only for the estimate."""
SECONDS_PER_MOVE = {"simulated": 0.0, "manual": 30.0, "grbl": 3.0, "zaber": 3.0}


@dataclass(frozen=True, slots=True)
class PlanCost:
    """What a plan will take, before it is started."""

    shots: int
    seconds: float
    bytes: float


def dot_size_px(config: RigConfig, depth_mm: float) -> float:
    """Diameter of the dot in panel pixels: as large as its image may be (half a developed pixel), at least one."""
    if config.panel.dot.size_px != "auto":
        return config.panel.dot.size_px
    photosite = config.camera.pixel_pitch_mm or 0.0043
    developed = photosite * (2 if config.camera.recipe == "superpixel" else 1)
    image_of_pixel = config.panel.pixel_pitch_mm * config.optics.focal_length_mm / depth_mm
    return float(max(1, math.floor(0.5 * developed / image_of_pixel)))


def make_plan(
    config: RigConfig,
    *,
    from_mm: float | None = None,
    to_mm: float | None = None,
    step_mm: float | None = None,
    repeats: int | None = None,
    field: tuple[int, int] | None = None,
) -> Plan:
    """Plan of a calibration; what isn't given comes from rig.yaml.

    Raises
    ------
    InputError
        The depths can't be (see :func:`workbench.plan.depth_grid_mm`), or there is no grid to be had.
    """
    wishes = config.calibration
    depths = depth_grid_mm(
        wishes.from_mm if from_mm is None else from_mm,
        wishes.to_mm if to_mm is None else to_mm,
        wishes.step_mm if step_mm is None else step_mm,
    )
    across, down = wishes.field if field is None else field
    if min(across, down) < 1 or across * down > MOST_POINTS:
        raise InputError(f"field {across}x{down}: give points across x down, at least 1x1 and {MOST_POINTS} in all")
    return Plan(
        depths_mm=depths,
        repeats=wishes.repeats if repeats is None else repeats,
        off_frames=wishes.off_frames,
        dots=tuple(_dot(config, depth, across, down) for depth in depths),
        iso=config.camera.iso,
    )


def _dot(config: RigConfig, depth_mm: float, across: int, down: int) -> PatternSpec:
    if across * down > 1:
        points = grid_at(config, across, down, depth_mm).points_px
        size, colour = dot_size_px(config, depth_mm), config.panel.dot.colour
        return PatternSpec(kind="grid", size_px=size, colour=colour, points_px=points)
    return PatternSpec(kind="dot", size_px=dot_size_px(config, depth_mm), colour=config.panel.dot.colour)


def cost(plan: Plan, config: RigConfig) -> PlanCost:
    """Shots, time and bytes of a plan (an estimate: exposures are metered on the rig)."""
    shots = sum(1 for _ in plan.shots())
    frames = shots + METER_SHOTS_PER_DEPTH * len(plan.depths_mm)
    photosites, bytes_each = _frame(config)
    seconds = frames * SECONDS_PER_SHOT[config.camera.kind] * max(photosites / 18e6, 0.3)
    seconds += len(plan.depths_mm) * SECONDS_PER_MOVE[config.stage.kind]
    return PlanCost(shots, seconds, frames * photosites * bytes_each)


def _frame(config: RigConfig) -> tuple[float, float]:
    """Photosites of one frame, and bytes for each of them, as far as rig.yaml says."""
    if config.camera.kind == "simulated":
        if config.simulation.preset == "small":
            return 1536 * 1024, BYTES_PER_PHOTOSITE_UNCOMPRESSED
        return 5184 * 3456, BYTES_PER_PHOTOSITE
    wanted = config.camera.model.casefold()
    sizes = [math.prod(facts.full_frame) for name, facts in KNOWN_CAMERAS.items() if wanted and wanted in name]
    return max(sizes, default=PHOTOSITES_OF_UNKNOWN), BYTES_PER_PHOTOSITE
