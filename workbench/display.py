"""Linear images made viewable: exposure, the sRGB transfer and PNG, in one place."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

WHITE_PERCENTILE = 99.5
"""What becomes display white: a few highlights may clip, hot pixels don't darken the rest."""


def exposure_gain(linear: NDArray[np.floating], percentile: float = WHITE_PERCENTILE) -> float:
    """Factor that brings a percentile of a linear image to display white.

    Parameters
    ----------
    linear
        (H, W) or (H, W, C) linear intensities in any unit; NaN and infinity are ignored.
    percentile
        Percentile (0 to 100) of the brightest channel of each pixel.

    Returns
    -------
    float
        Positive factor; 1 for an image without any light.
    """
    values = np.asarray(linear)
    brightest = values.max(axis=2) if values.ndim == 3 else values
    brightest = brightest[np.isfinite(brightest)]
    white = float(np.percentile(brightest, percentile)) if brightest.size else 0.0
    if white <= 0 and brightest.size:  # a point on black: its own peak is the only light there is
        white = float(brightest.max())
    return 1.0 / white if white > 0 else 1.0


def srgb_transfer(linear: ArrayLike) -> NDArray[np.float32]:
    """sRGB opto-electronic transfer (IEC 61966-2-1): linear 0 to 1 -> encoded 0 to 1, clipped; NaN becomes 0."""
    x = np.nan_to_num(np.asarray(linear, dtype=np.float32), nan=0.0, posinf=1.0, neginf=0.0).clip(0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, np.float32(1 / 2.4)) - 0.055).astype(np.float32)


def to_srgb8(linear: NDArray[np.floating], gain: float | None = None) -> NDArray[np.uint8]:
    """Tone-map a linear image for display.

    Parameters
    ----------
    linear
        (H, W) or (H, W, C) linear intensities, any C.
    gain
        Factor from linear value to fraction of display white; None: :func:`exposure_gain` of this image. Give the
        same gain to images that are to be compared.

    Returns
    -------
    ndarray
        uint8 of the same shape.
    """
    values = np.asarray(linear, dtype=np.float32)
    factor = exposure_gain(values) if gain is None else gain
    encoded: NDArray[np.uint8] = np.rint(srgb_transfer(values * np.float32(factor)) * 255.0).astype(np.uint8)
    return encoded


def png_bytes(pixels: NDArray[Any]) -> bytes:
    """PNG of uint8 or uint16 pixels, (H, W), (H, W, 1) or R, G, B (H, W, 3)."""
    if pixels.ndim == 3:
        pixels = pixels[:, :, ::-1] if pixels.shape[2] == 3 else pixels[:, :, 0]  # OpenCV takes B, G, R
    good, data = cv2.imencode(".png", np.ascontiguousarray(pixels))
    if not good:
        raise ValueError(f"no PNG holds {pixels.dtype} pixels of shape {pixels.shape}")
    return data.tobytes()
