"""A bank and photographs from one drawn pupil, area-sampled by itself: none of the code under test draws here."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from calibration.bank import Bank
from calibration.image import FrameInfo, LinearImage
from calibration.lens_fit import fit_lens
from calibration.mosaic import Mosaic, superpixels
from calibration.template import Spot, fit_spots

FOCUS_MM, SCALE_PX, HALF = 1600.0, 13.0, 20
OUTLINE = np.array([[-4.7, -5.2], [4.7, -5.2], [4.7, -2.9], [0.2, 5.2], [-2.7, 5.2], [1.7, -2.9], [-4.7, -2.9]]) / 7.0
"""A numeral 7 (x right, y down), in radii of its circle."""


def radius_px(depth_mm: float) -> float:
    return SCALE_PX * (1.0 - FOCUS_MM / depth_mm)


def draw_psf(depth_mm: float, finer: int = 16, *, per_superpixel: int = 1, half: int = HALF) -> NDArray[np.float64]:
    """PSF (2 half + 1, 2 half + 1) on superpixels, or on the photosites that are so many a superpixel."""
    side = 2 * half + 1
    canvas = np.zeros((side * finer, side * finer), np.uint8)
    # a spot of 0.4 px at least, as every real lens makes
    size = radius_px(depth_mm)
    size = (size if abs(size) > 0.4 else 0.4) * per_superpixel
    corners = ((OUTLINE * size + half + 0.5) * finer - 0.5) * 256
    cv2.fillPoly(canvas, [np.rint(corners).astype(np.int32)], 255, shift=8)
    psf = canvas.reshape(side, finer, side, finer).mean(axis=(1, 3)).astype(np.float64)
    return psf / psf.sum()


def make_bank(step_mm: float = 100.0, depths_mm: NDArray[np.float64] | None = None, *, half: int = HALF) -> Bank:
    """Planes every so many mm from 70 to 350 cm, or at the depths given."""
    depths = np.arange(700.0, 3501.0, step_mm) if depths_mm is None else depths_mm
    psf = np.array([draw_psf(z, half=half) for z in depths])
    se = np.maximum(1e-3 * psf, 1e-6)
    noisy = psf + se * np.random.default_rng(0).standard_normal(psf.shape)
    noisy /= noisy.sum(axis=(1, 2), keepdims=True)
    radii = np.array([radius_px(z) for z in depths])
    lens = fit_lens(depths, radii, np.full(depths.size, 0.02), apply_zero=False)
    return Bank(
        depths, noisy[np.newaxis].astype(np.float32), se[np.newaxis].astype(np.float32), np.zeros((1, 2)), lens,
        "superpixel", 0.0086,
    )  # fmt: skip


def with_pupil(bank: Bank) -> Bank:
    """The same bank, holding the aperture's picture and the chief rays that its PSFs show, as a calibration stores."""
    spots = [Spot(p, s) for p, s in zip(bank.psf[0].astype(np.float64), bank.psf_se[0].astype(np.float64), strict=True)]
    fit = fit_spots(spots, 1.0 / bank.depths_mm)
    half = bank.psf.shape[2] // 2
    chief = np.array([[(spot.centre_y - half, spot.centre_x - half) for spot in fit.spots]])
    radii = np.array([spot.radius_px for spot in fit.spots])  # in radii of the circle about the picture's outline
    lens = fit_lens(bank.depths_mm, radii, np.full(radii.size, 0.02), apply_zero=False)
    manifest = {**bank.manifest, "aperture": {"core_px": [fit.core.sigma_px], "core_wings": [fit.core.wings]}}
    return replace(bank, lens=lens, manifest=manifest, extras={"aperture": fit.template, "chief_yx": chief})


def leaves(side: int, seed: int) -> NDArray[np.float64]:
    generator = np.random.default_rng(seed)
    canvas = np.full((2 * side, 2 * side), 0.4, np.float32)
    for _ in range(side * side // 20):
        x, y = generator.uniform(0, 2 * side, 2)
        radius = min(4.0 * generator.random() ** -0.5, side / 3)
        cv2.circle(canvas, (int(x), int(y)), int(radius), float(generator.uniform(0.1, 0.8)), -1, cv2.LINE_8)
    return cv2.resize(canvas, (side, side), interpolation=cv2.INTER_AREA).astype(np.float64)


def photograph(
    texture: NDArray[np.float64], depth_mm: float, *, noise: float = 0.003, seed: int = 1, half: int = HALF
) -> LinearImage:
    """Blur, cut off what the border spoils, add noise; three equal channels.

    The texture is one of superpixels, smooth between them: light has all frequencies before the pixels see it.
    """
    smooth = cv2.resize(texture, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
    light = blurred(smooth, draw_psf(depth_mm, per_superpixel=2, half=2 * half))
    inner = light.reshape(light.shape[0] // 2, 2, light.shape[1] // 2, 2).mean(axis=(1, 3))
    generator = np.random.default_rng(seed)
    planes = inner[..., np.newaxis] + noise * generator.standard_normal((*inner.shape, 3))
    return as_image(planes.astype(np.float32))


def photograph_mosaic(texture: NDArray[np.float64], depth_mm: float, *, seed: int = 1) -> LinearImage:
    """The same of a texture that is drawn for photosites, grey light on an RGGB mosaic."""
    light = blurred(texture, draw_psf(depth_mm, per_superpixel=2))
    light = light[: light.shape[0] & ~1, : light.shape[1] & ~1]
    noisy = light + 0.006 * np.random.default_rng(seed).standard_normal(light.shape)
    mosaic = Mosaic(np.rint(512 + noisy * 15000).clip(0, 16000).astype(np.uint16), (0, 1, 3, 2), (512.0,) * 4, 15512.0)
    return replace(as_image(superpixels(mosaic)[0]), mosaic=mosaic)


def blurred(texture: NDArray[np.float64], psf: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convolution without what the border spoils."""
    edge = psf.shape[0] - 1
    size = fft.next_fast_len(max(texture.shape) + edge, real=True)
    whole = fft.irfft2(fft.rfft2(texture, s=(size, size)) * fft.rfft2(psf, s=(size, size)))
    return np.asarray(whole[edge : texture.shape[0], edge : texture.shape[1]])


def as_image(planes: NDArray[np.float32]) -> LinearImage:
    info = FrameInfo(path="made.dng", sha256="0" * 64)
    return LinearImage(planes, planes.max(axis=2) >= 0.99, "superpixel", 0.0086, info)
