"""A flat texture seen in perspective: every pixel is the mean of the texture over the pixel's own footprint.

Where a plane is seen at a grazing angle the footprint is long and narrow. Smaller copies of the texture (mipmaps,
Williams 1983) alone would blur it by its length in every direction; so a pixel is the mean of several samples along its
footprint, each from the copy that suits the footprint's width.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
Coordinates = Callable[[FloatImage, FloatImage], tuple[FloatImage, FloatImage]]

_SAMPLES_Y, _SAMPLES_X = 6, 6
_STRIP_ROWS = 64
_LEVELS = 6


def in_perspective(texture: FloatImage, shape: tuple[int, int], coordinates: Coordinates) -> FloatImage:
    """Map a texture onto pixels.

    Parameters
    ----------
    texture
        float32 (S, S); continued by its mirror images.
    shape
        Pixels (height, width) of the result.
    coordinates
        From rows and columns of points (float32, in pixels from the upper left corner) to their place in the texture,
        in its pixels.

    Returns
    -------
    float32 (height, width).
    """
    copies = [texture]
    for _ in range(_LEVELS):
        copies.append(np.asarray(cv2.resize(copies[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)))
    height, width = shape
    x = (np.arange(width * _SAMPLES_X, dtype=np.float32) + np.float32(0.5)) / np.float32(_SAMPLES_X)
    strips = []
    for top in range(0, height, _STRIP_ROWS):
        rows = min(_STRIP_ROWS, height - top)
        y = top + (np.arange(rows * _SAMPLES_Y, dtype=np.float32) + np.float32(0.5)) / np.float32(_SAMPLES_Y)
        fine = _sampled(copies, *coordinates(y[:, None], x[None, :]))
        strips.append(cv2.resize(fine, (width, rows), interpolation=cv2.INTER_AREA))
    return np.concatenate(strips).astype(np.float32)


def _sampled(copies: list[FloatImage], u: FloatImage, v: FloatImage) -> FloatImage:
    """One sample per point, each from the copy whose pixels are about as large as the points' spacing."""
    spacing = np.maximum.reduce([np.abs(g) for w in (u, v) for g in np.gradient(w)])
    level_of = np.clip(np.rint(np.log2(np.maximum(spacing, 1.0))), 0, len(copies) - 1).astype(np.uint8)
    result = np.zeros(u.shape, np.float32)
    for level in np.unique(level_of):
        here, image = level_of == level, copies[level]
        size = image.shape[0]
        # mirrored about the middles of the outermost pixels
        scaled = (w / np.float32(2.0**level) - np.float32(0.5) for w in (u, v))
        folded = [(size - 1 - np.abs(w % (2 * size - 2) - (size - 1))).astype(np.float32) for w in scaled]
        mapped = cv2.remap(image, folded[0], folded[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        result[here] = mapped[here]
    return result
