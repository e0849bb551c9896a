"""A bank and images drawn for tests: an aperture without symmetry, scaled by the thin lens."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from calibration.bank import Bank, LensFit
from calibration.image import FrameInfo, LinearImage
from calibration.optics import signed_radius

FOCUS_MM = 1600.0
SCALE_PX = 14.0
PITCH_MM = 0.016
_OUTLINE = np.array(
    [(-0.67, -0.74), (0.67, -0.74), (0.67, -0.41), (0.03, 0.74), (-0.39, 0.74), (0.25, -0.41), (-0.67, -0.41)]
)
"""A numeral 7 in units of the blur radius, x to the right and y down."""


def draw_psf(radius_px: float, size: int) -> NDArray[np.float32]:
    """(size, size) PSF of unit sum; negative radii turn it by 180 degrees."""
    fine = 16
    canvas = np.zeros((size * fine, size * fine), np.float32)
    points = (_OUTLINE * radius_px + size / 2) * fine
    cv2.fillPoly(canvas, [np.rint(points).astype(np.int32)], 1.0)
    psf = cv2.resize(canvas, (size, size), interpolation=cv2.INTER_AREA)
    psf = cv2.GaussianBlur(psf, (0, 0), 0.5)
    return np.asarray(psf / psf.sum(), np.float32)


def draw_bank(depths_mm: list[float], pitch_mm: float | None = PITCH_MM) -> Bank:
    depths = np.array(depths_mm, np.float64)
    radii = signed_radius(depths, focus_mm=FOCUS_MM, scale=SCALE_PX)
    size = 2 * int(np.ceil(np.abs(radii).max() + 2)) + 1
    psf = np.stack([draw_psf(float(radius), size) for radius in radii])[None]
    zeros = np.zeros(len(depths))
    lens = LensFit(FOCUS_MM, 1.0, SCALE_PX, 0.01, 0.0, 1.0, radii, zeros + 0.05, zeros)
    return Bank(depths, psf, np.zeros_like(psf), np.zeros((1, 2)), lens, "superpixel", pitch_mm)


def draw_chart(size: int, seed: int = 0) -> NDArray[np.float32]:
    """(size, size) bars and blocks with hard edges at several scales, 0.1 to 0.8."""
    rng = np.random.default_rng(seed)
    chart = np.full((size, size), 0.8, np.float32)
    for _ in range(size * size // 500):
        height, width = rng.integers(3, 30, 2)
        y, x = rng.integers(0, size, 2)
        chart[y : y + height, x : x + width] = rng.choice([0.1, 0.8, 0.4])
    return chart


def draw_lights(size: int, seed: int = 0) -> NDArray[np.float32]:
    """(size, size) scattered small bright marks on a dark ground."""
    rng = np.random.default_rng(seed)
    scene = np.full((size, size), 0.02, np.float32)
    for y, x in rng.integers(0, size - 2, (size * size // 400, 2)):
        scene[y : y + 2, x : x + 2] = rng.uniform(3, 6)
    return scene


def blur(scene: NDArray[np.float32], psf: NDArray[np.float32]) -> NDArray[np.float32]:
    """What the camera sees of a scene that is larger than the frame by the PSF's reach."""
    return np.asarray(np.maximum(fftconvolve(scene, psf, mode="valid"), 0), np.float32)


def as_image(plane: NDArray[np.float32], saturated: NDArray[np.bool_] | None = None) -> LinearImage:
    """A developed image of three equal channels, or of those given."""
    planes = plane if plane.ndim == 3 else np.repeat(plane[:, :, None], 3, axis=2)
    if saturated is None:
        saturated = np.zeros(planes.shape[:2], np.bool_)
    return LinearImage(np.asarray(planes, np.float32), saturated, "superpixel", PITCH_MM, FrameInfo("drawn", ""))
