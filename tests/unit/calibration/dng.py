"""A minimal uncompressed DNG, and a point's image drawn by brute force, for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

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
    radius: float, shape: tuple[int, int], centre: tuple[float, float], core: float = 0.0, samples: int = 400_000
) -> NDArray[np.float64]:
    """Image of unit flux of the seven: random points of the pupil, traced to pixels one by one."""
    from matplotlib.path import Path as Outline

    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (3 * samples, 2))
    points = points[Outline(SEVEN).contains_points(points)][:samples]
    place = points[:, ::-1] * radius + core * rng.standard_normal(points.shape) + np.array(centre)
    image, _, _ = np.histogram2d(
        place[:, 0], place[:, 1], bins=shape, range=[[-0.5, shape[0] - 0.5], [-0.5, shape[1] - 0.5]]
    )
    return np.asarray(image / len(points), np.float64)


def mosaic_of(
    linear: NDArray[np.float64], *, gains: tuple[float, float, float] = (0.6, 1.0, 0.7), seed: int | None = 0
) -> NDArray[np.uint16]:
    """RGGB mosaic of a luminance image of superpixels (fractions of white), with shot and read noise if seeded."""
    height, width = linear.shape
    mosaic = np.zeros((2 * height, 2 * width))
    for (y, x), gain in zip(((0, 0), (0, 1), (1, 0), (1, 1)), (gains[0], gains[1], gains[1], gains[2]), strict=True):
        mosaic[y::2, x::2] = linear * gain
    counts = mosaic * (WHITE - BLACK)
    if seed is not None:
        rng = np.random.default_rng(seed)
        electrons = 2.0  # per count
        counts = rng.poisson(np.maximum(counts, 0) * electrons) / electrons + 2.0 * rng.standard_normal(counts.shape)
    return np.clip(np.round(counts + BLACK), 0, 16383).astype(np.uint16)
