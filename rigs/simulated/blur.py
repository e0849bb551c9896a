"""Blurs planes of light as the lens does, with the point image of one depth, over the whole field."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from rigs.simulated.lens import Lens, point_image, point_image_at_centre, transmission
from rigs.simulated.sensor import FloatImage

_NODE_SPACING_MM = 6.0
"""Where the point image depends on the field, it is computed at most so far apart and interpolated between."""


def blur(plane: FloatImage, kernel: FloatImage) -> FloatImage:
    """Convolve a float32 plane (H, W) with a kernel (K, K); dark outside, same size."""
    return np.asarray(cv2.filter2D(plane, -1, kernel[::-1, ::-1], borderType=cv2.BORDER_CONSTANT), np.float32)


def reach_px(lens: Lens, depth_mm: float, pitch_mm: float) -> int:
    """Farthest that light of a point at this depth is spread anywhere in the field (pixels)."""
    plain = point_image_at_centre(lens, depth_mm, pitch_mm).shape[0] // 2
    return int(plain) + math.ceil(4.5e-3 * abs(lens.coma_um) / pitch_mm)


def blur_through(
    lens: Lens,
    depth_mm: float,
    pitch_mm: float,
    planes: Sequence[FloatImage],
    corner_yx: tuple[int, int],
    frame_shape: tuple[int, int],
) -> list[FloatImage]:
    """Blur planes that lie at one depth.

    Parameters
    ----------
    lens, depth_mm, pitch_mm
        Lens, depth of the planes, pixel pitch.
    planes
        float32 (H, W) each, all of one size.
    corner_yx
        Row and column in the frame of the planes' first pixel (negative outside the frame).
    frame_shape
        (height, width) of the frame, whose middle is the optical axis.

    Returns
    -------
    list[FloatImage]
        Same sizes. The sum of light is kept; loss by vignetting is :func:`transmission_map`.
    """
    if not lens.varies_over_field:
        kernel = point_image_at_centre(lens, depth_mm, pitch_mm)
        return [blur(plane, kernel) for plane in planes]
    result = [np.zeros_like(plane) for plane in planes]
    height, width = planes[0].shape
    row_shares = _shares(corner_yx[0] + np.arange(height), frame_shape[0], pitch_mm)
    column_shares = _shares(corner_yx[1] + np.arange(width), frame_shape[1], pitch_mm)
    for i, rows in enumerate(row_shares):
        for j, columns in enumerate(column_shares):
            if not rows.any() or not columns.any():
                continue
            y = (i / (len(row_shares) - 1) - 0.5) * frame_shape[0] * pitch_mm
            x = (j / (len(column_shares) - 1) - 0.5) * frame_shape[1] * pitch_mm
            kernel = point_image(lens, depth_mm, pitch_mm, field_mm=(x, -y)).astype(np.float32)
            for plane, total in zip(planes, result, strict=True):
                total += blur(plane * rows[:, None] * columns[None, :], kernel)
    return result


def transmission_map(lens: Lens, pitch_mm: float, frame_shape: tuple[int, int]) -> FloatImage | None:
    """Relative illumination (height, width) by vignetting, or None where there is none."""
    if not lens.vignetting:
        return None
    nodes = 17
    grid = np.empty((nodes, nodes), np.float32)
    half_y, half_x = (0.5 * n * pitch_mm for n in frame_shape)
    # Samples at the centres of 17 x 17 equal parts of the frame, as cv2.resize understands them.
    position = (np.arange(nodes) + 0.5) / nodes * 2.0 - 1.0
    for i in range(nodes):
        for j in range(nodes):
            grid[i, j] = transmission(lens, (position[j] * half_x, -position[i] * half_y))
    height, width = frame_shape
    return np.asarray(cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)


def _shares(position: NDArray[np.int_], length: int, pitch_mm: float) -> list[FloatImage]:
    """Weight of each node at pixel positions along one axis: linear between nodes, constant outside; they sum to 1."""
    nodes = 1 + max(2, math.ceil(length * pitch_mm / _NODE_SPACING_MM))
    along = np.clip((position + 0.5) / length, 0.0, 1.0) * (nodes - 1)
    return [np.maximum(1.0 - np.abs(along - node), 0.0).astype(np.float32) for node in range(nodes)]
