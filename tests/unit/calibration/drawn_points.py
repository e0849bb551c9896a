"""A minimal uncompressed DNG, and a point's image drawn by brute force, for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from calibration.image import FrameInfo, LinearImage

BLACK, WHITE = 512, 15000

SEVEN = np.array(
    [
        [-0.669, -0.743],
        [0.669, -0.743],
        [0.669, -0.414],
        [0.029, 0.743],
        [-0.386, 0.743],
        [0.25, -0.414],
        [-0.669, -0.414],
    ]
)
"""Outline (x right, y down) in units of the circle about it, as the PSF beyond focus shows it."""


def write_dng(
    path: Path,
    mosaic: NDArray[np.uint16],
    *,
    model: str = "Test Body",
    cfa: bytes = b"\x00\x01\x01\x02",
    exposure: tuple[int, int] = (1, 50),
    black: int | tuple[int, ...] = BLACK,
    focal_plane: tuple[int, int] | None = None,
) -> Path:
    """Write a 16-bit CFA image that LibRaw decodes to exactly these values."""
    blacks = (black,) * 4 if isinstance(black, int) else black
    matrix = [v for x in (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0) for v in (int(x * 10000), 10000)]
    extra: list[tuple[Any, ...]] = [
        (271, 2, 0, "Test", True),
        (272, 2, 0, model, True),
        (33421, 3, 2, (2, 2), True),
        (33422, 1, 4, cfa, True),
        (33434, 5, 1, exposure, True),
        (34855, 3, 1, 100, True),
        (37386, 5, 1, (50, 1), True),
        (50706, 1, 4, b"\x01\x04\x00\x00", True),
        (50707, 1, 4, b"\x01\x01\x00\x00", True),
        (50708, 2, 0, f"Test {model}", True),
        (50713, 3, 2, (2, 2), True),
        (50714, 3, 4, blacks, True),
        (50717, 3, 1, WHITE, True),
        (50721, 10, 9, tuple(matrix), True),
        (50778, 3, 1, 21, True),
    ]
    if focal_plane:
        extra += [(41486, 5, 1, focal_plane, True), (41488, 3, 1, 4, True)]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=extra, metadata=None)
    return path


def draw_psf(
    radius: float,
    shape: tuple[int, int],
    centre: tuple[float, float],
    core: float = 0.0,
    samples: int = 400_000,
    dot: float = 0.0,
) -> NDArray[np.float64]:
    """Image of unit flux of the seven: random points of pupil, core and dot (a disc), counted pixel by pixel."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (3 * samples, 2))
    points = points[Outline(SEVEN).contains_points(points)][:samples]
    angle, reach = rng.uniform(0, 2 * np.pi, len(points)), dot * np.sqrt(rng.uniform(0, 1, len(points)))
    place = points[:, ::-1] * radius + core * rng.standard_normal(points.shape) + np.array(centre)
    place += np.stack([reach * np.sin(angle), reach * np.cos(angle)], axis=1)
    image, _, _ = np.histogram2d(
        place[:, 0], place[:, 1], bins=shape, range=[[-0.5, shape[0] - 0.5], [-0.5, shape[1] - 0.5]]
    )
    return np.asarray(image / len(points), np.float64)


FOCUS_MM, SCALE_PX = 1600.0, 13.0
DEPTHS_MM = (600.0, 800.0, 1000.0, 1300.0, 1500.0, 1800.0, 2200.0, 2800.0, 3500.0)


def point_image(
    depth_mm: float,
    *,
    zero_mm: float = 0.0,
    core: float = 0.4,
    peak: float = 0.6,
    centre: tuple[float, float] = (48.2, 47.9),
    size: int = 96,
    dot_radius_px: float = 0.0,
    seed: int = 0,
) -> LinearImage:
    """A white point through the seven, drawn ray by ray, with noise; a superpixel image of 8.6 um pixels."""
    radius = SCALE_PX * (1 - FOCUS_MM / (depth_mm + zero_mm))
    drawn = draw_psf(radius, (size, size), centre, core, samples=60_000, dot=dot_radius_px)
    return as_frame(drawn / drawn.max() * peak, name=f"psf_{depth_mm / 10:03.0f}cm.dng", seed=seed + int(depth_mm))


def as_frame(light: NDArray[np.float64], *, name: str = "frame.dng", seed: int = 0) -> LinearImage:
    """Coloured, noisy frame of a luminance picture (fractions of white)."""
    rng = np.random.default_rng(seed)
    planes = np.stack([light * gain for gain in (0.6, 1.0, 0.7)], axis=-1)
    planes += rng.standard_normal(planes.shape) * np.sqrt(1e-7 + 4e-5 * planes)
    size = (2 * light.shape[0], 2 * light.shape[1])
    info = FrameInfo(name, f"{name}-{seed}", model="Body", raw_size=size, cfa="RGGB", focal_length_mm=50.0)
    return LinearImage(planes.astype(np.float32), planes.max(axis=2) >= 0.99, "superpixel", 0.0086, info)
