"""What rays meet: a camera with a thin lens, and surfaces with pictures on them.

Coordinates in mm: x right, y down, z along the axis, the lens's centre is the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
"""uint8 (H, W, 4): red, green, blue, linear in light, and 255 where the surface is there."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A thin lens with an aperture, and a sensor.

    Attributes
    ----------
    height, width
        Photosites, even; colour pattern RGGB.
    pitch_mm
        Photosite pitch.
    focal_mm, focus_mm
        Focal length; distance in focus, from the lens.
    aperture_mm
        Outline of the opening, (x right, y up) as the photographer behind the camera sees it.
    spot_mm
        Standard deviation of what blurs everything alike: the lens's own spot and the filter before the sensor.
    full_well_e, read_noise_e
        Electrons at white level; noise of reading.
    black, white
        Raw values, 14 bits.
    """

    height: int
    width: int
    pitch_mm: float = 0.0043
    focal_mm: float = 50.0
    focus_mm: float = 1600.0
    aperture_mm: tuple[tuple[float, float], ...] = (
        (-4.7, 5.1), (4.7, 5.1), (4.7, 2.8), (0.1, -5.1), (-2.8, -5.1), (1.7, 2.8), (-4.7, 2.8),
    )  # fmt: skip
    spot_mm: float = 0.0025
    full_well_e: float = 25_000.0
    read_noise_e: float = 3.0
    black: int = 2048
    white: int = 15_000

    @property
    def image_mm(self) -> float:
        """From the lens to the sensor: 1 / f = 1 / focus + 1 / image."""
        return 1.0 / (1.0 / self.focal_mm - 1.0 / self.focus_mm)

    def width_at_mm(self, depth_mm: float) -> float:
        """Width of the field of view at a depth."""
        return self.width * self.pitch_mm * depth_mm / self.image_mm

    def photosite_at_mm(self, depth_mm: float) -> float:
        """What one photosite sees of a plane at a depth."""
        return self.pitch_mm * depth_mm / self.image_mm


@dataclass(frozen=True, slots=True)
class Surface:
    """A flat picture in space, or one that is wound around an upright axis.

    Attributes
    ----------
    name
        Of the object.
    picture
        See :data:`Picture`.
    corner, across, down
        Where the picture's upper left corner is, and from there the vectors to the upper right and the lower left one.
    round_mm
        Not 0: the picture covers the front half of an upright cylinder of this radius, whose axis lies this far
        behind the middle of the flat picture.
    """

    name: str
    picture: Picture
    corner: tuple[float, float, float]
    across: tuple[float, float, float]
    down: tuple[float, float, float]
    round_mm: float = 0.0


def upright(name: str, picture: Picture, centre: tuple[float, float, float], size: tuple[float, float]) -> Surface:
    """A picture that faces the camera: centre (x, y, depth), width and height in mm."""
    corner = (centre[0] - size[0] / 2, centre[1] - size[1] / 2, centre[2])
    return Surface(name, picture, corner, (size[0], 0.0, 0.0), (0.0, size[1], 0.0))
