"""Outline of an aperture's picture: its bounding box centre and the circle about it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.errors import FitError

FloatArray = NDArray[np.float64]

_SMOOTHING = 1.5
"""Standard deviation (cells) of the blur before tracing."""
_ROUNDED = 3.0 * _SMOOTHING
"""Cells next to a corner that don't show the direction of its sides."""
_SHORTEST_SIDE = 8.0
"""Sides with fewer cells are left out; with fewer than this between rounded ends they may as well be arcs."""
_STRAIGHT = 0.3
"""A side is straight if the parabola through its points bows by less than this many cells."""


def circumscribed(picture: FloatArray) -> tuple[float, float, float]:
    """Centre (row, column) of the bounding box of the half-level outline, and the radius of the circle about it.

    The outline is traced to a fraction of a cell. The picture's finite sharpness rounds its corners, which would
    make the circle too small: straight sides are therefore prolonged to where they meet.

    Parameters
    ----------
    picture
        float64 (N, N), non-negative, e.g. a template of the aperture.

    Returns
    -------
    tuple of float
        Row and column of the centre and radius, in cells.

    Raises
    ------
    FitError
        It has no outline.
    """
    level = 0.5 * _plateau(picture)
    # a little blur doesn't move straight edges, and averages over the grain of single cells and over-sharpened rims
    smooth = np.asarray(cv2.GaussianBlur(picture, (0, 0), _SMOOTHING, borderType=cv2.BORDER_REFLECT_101), np.float64)
    points = _level_points(smooth, level)
    if not len(points):
        raise FitError(
            "the points have no common outline: a point that moved between repeats, or PSFs that are cut off"
        )
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2.0
    outline = np.concatenate([points, _corners(points)])
    radius = float(np.hypot(*(outline - centre).T).max())
    return float(centre[0]), float(centre[1]), radius


def _plateau(picture: FloatArray) -> float:
    """Typical value inside the aperture: the median of what lies above half of a robust maximum."""
    top = float(np.percentile(picture[picture > 0.1 * picture.max()], 90))
    return float(np.median(picture[picture > 0.5 * top]))


def _level_points(picture: FloatArray, level: float) -> FloatArray:
    """Points (row, column) where the picture crosses ``level`` along rows and columns, linearly interpolated.

    Only crossings of the largest connected area count, so that a speck of noise doesn't stretch the box.
    """
    mask = (picture > level).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    # parts of one aperture may be separate (a mask with bars): keep all that are not specks
    keep = np.isin(labels, 1 + np.flatnonzero(areas > 0.02 * areas.max())) if count > 2 else labels > 0
    clean = np.where(keep | (picture <= level), picture, 0.0)
    above = clean > level
    found = []
    for axis in (0, 1):
        first = [slice(None), slice(None)]
        second = [slice(None), slice(None)]
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        a, b = clean[tuple(first)], clean[tuple(second)]
        crossing = above[tuple(first)] != above[tuple(second)]
        where = np.argwhere(crossing).astype(np.float64)
        where[:, axis] += (level - a[crossing]) / (b[crossing] - a[crossing])
        found.append(where)
    return np.concatenate(found)


def _corners(points: FloatArray) -> FloatArray:
    """Corners of the convex hull restored by prolonging its straight sides; (M, 2), may be empty."""
    hull = cv2.convexHull(points.astype(np.float32))
    polygon = cv2.approxPolyDP(hull, _SMOOTHING, True).reshape(-1, 2).astype(np.float64)
    size = float(np.ptp(points, axis=0).max())
    sides = []
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        if length < _SHORTEST_SIDE:
            continue
        along = (end - start) / length
        offset = points - start
        t, across = offset @ along, offset @ np.array([-along[1], along[0]])
        rounded = min(_ROUNDED, 0.25 * length)
        chosen = points[(np.abs(across) < 1.5 * _SMOOTHING) & (t > rounded) & (t < length - rounded)]
        if len(chosen) >= 5:
            middle, direction, sagitta = _line_through(chosen)
            # a short side may as well be an arc: it only counts beside one that is plainly straight
            if sagitta < _STRAIGHT:
                sides.append((start, end, middle, direction, length > 2 * _ROUNDED + _SHORTEST_SIDE))
    restored = []
    for (_, end, p, d, first), (start, _, q, e, second) in zip(sides, sides[1:] + sides[:1], strict=True):
        cross = d[0] * e[1] - d[1] * e[0]
        # neighbours at a clear angle (arcs yield blunt ones) whose ends nearly touch: a rounded corner
        if (first or second) and abs(cross) > 0.5 and np.hypot(*(start - end)) < 0.12 * size:
            restored.append(p + ((q - p)[0] * e[1] - (q - p)[1] * e[0]) / cross * d)
    return np.array(restored).reshape(-1, 2)


def _line_through(points: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Middle and direction of the line of least squared distance, and how far the points bow away from it (cells)."""
    middle = points.mean(axis=0)
    along, normal = np.linalg.svd(points - middle, full_matrices=False)[2]
    t, across = (points - middle) @ along, (points - middle) @ normal
    curvature = float(np.polyfit(t, across, 2)[0])
    return middle, along, abs(curvature) * (float(np.ptp(t)) / 2) ** 2
