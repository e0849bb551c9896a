"""Where on the panel the dots of a field calibration are, depth by depth.

The dots are placed so that their images fall at the same places of the frame at every depth. Far away the panel's
image is smaller than the frame; there the whole grid shrinks to what the panel reaches, and the bank records where
each point was imaged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from calibration.exif import KNOWN_CAMERAS
from rigs.simulated.world import PRESET_SHAPES
from workbench.config import RigConfig
from workbench.errors import InputError

REACH = 0.6
"""Part of the half frame that the outermost images are meant to lie at: the most blurred ones must fit in beyond it."""
MARGIN = 0.03
"""Part of the half panel kept free at its edges, for a panel that isn't quite centred."""
CENTRING = 0.08
"""Part of the half frame by which the panel's middle may be off the axis."""
SPREAD = 1.15
"""Room for a blur, relative to its radius by the thin lens."""


@dataclass(frozen=True, slots=True)
class GridAt:
    """The grid at one depth.

    Attributes
    ----------
    points_px
        (x, y) on the panel, origin at its centre, y down; rows from top to bottom.
    reach
        Part of the half frame at which the outermost images lie.
    """

    points_px: tuple[tuple[float, float], ...]
    reach: float


def grid_at(config: RigConfig, across: int, down: int, depth_mm: float) -> GridAt:
    """Place a grid of dots for one depth.

    Raises
    ------
    InputError
        The size of the camera's frame isn't known, or the blur leaves no room in it.
    """
    width_mm, height_mm = frame_mm(config)
    focal = config.optics.focal_length_mm
    focus = config.optics.focus_mm
    image_distance = focal * focus / (focus - focal) if focus else focal
    pixels_per_mm = depth_mm / image_distance / config.panel.pixel_pitch_mm  # of the image
    reach = REACH
    for count, half_mm, panel in (
        (across, width_mm / 2, config.panel.pixels[0]),
        (down, height_mm / 2, config.panel.pixels[1]),
    ):
        if count > 1:
            reach = min(reach, (1.0 - MARGIN) * panel / 2 / (half_mm * pixels_per_mm))
            reach = min(reach, 1.0 - CENTRING - SPREAD * _blur_mm(config, depth_mm) / half_mm)
    if reach <= 0:
        raise InputError(
            f"calibration.field: at {depth_mm / 10:g} cm the blur alone fills the frame; leave out such near depths, "
            "or set field: [1, 1]"
        )
    columns = [round(f * reach * width_mm / 2 * pixels_per_mm) for f in _even(across)]
    rows = [round(f * reach * height_mm / 2 * pixels_per_mm) for f in _even(down)]
    return GridAt(tuple((float(x), float(y)) for y in rows for x in columns), reach)


def _blur_mm(config: RigConfig, depth_mm: float) -> float:
    """Largest radius of the blur on the sensor at a depth, for the focus known, or for any within the range planned."""
    wishes, focal = config.calibration, config.optics.focal_length_mm
    known = config.optics.focus_mm
    scale = config.optics.aperture_radius_mm * focal
    return max(
        scale / (focus - focal) * abs(1.0 - focus / depth_mm)
        for focus in ((known,) if known else (wishes.from_mm, wishes.to_mm))
    )


def frame_mm(config: RigConfig) -> tuple[float, float]:
    """Width and height of the camera's frame on the sensor.

    Raises
    ------
    InputError
        Neither a simulated camera nor a known model.
    """
    if config.camera.kind == "simulated":
        height, width = PRESET_SHAPES[config.simulation.preset]
        pitch = config.camera.pixel_pitch_mm or 0.0043
        return width * pitch, height * pitch
    wanted = config.camera.model.casefold()
    for name, facts in KNOWN_CAMERAS.items():
        if wanted and wanted in name:
            pitch = config.camera.pixel_pitch_mm or facts.pitch_mm
            return facts.full_frame[1] * pitch, facts.full_frame[0] * pitch
    raise InputError(
        "calibration.field: the size of the camera's frame isn't known; write its model in camera.model "
        f"(known are {', '.join(KNOWN_CAMERAS)}), or set field: [1, 1]"
    )


def _even(count: int) -> list[float]:
    return [0.0] if count == 1 else [2.0 * i / (count - 1) - 1.0 for i in range(count)]


def shape_of(points_px: tuple[tuple[float, float], ...]) -> tuple[int, int]:
    """Columns and rows of a grid's points; (1, 1) for a single dot, which lists none."""
    across, down = len({x for x, _ in points_px}), len({y for _, y in points_px})
    return max(across, 1), max(down, 1) if points_px else 1


def reach_text(config: RigConfig, points_px: tuple[tuple[float, float], ...], depth_mm: float) -> str:
    """How far off axis a grid's images reach, in words; empty for a single dot."""
    if not points_px:
        return ""
    across, down = shape_of(points_px)
    return f"{math.floor(100 * grid_at(config, across, down, depth_mm).reach + 0.5)} %"
