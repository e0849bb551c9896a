"""Exact areas: how much of each pixel a polygon covers, and how much of each target pixel a source pixel covers.

Coordinates are pixels, x right and y down; pixel (row, column) is the square [column, column + 1] x [row, row + 1].
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def signed_area(loop: FloatArray) -> float:
    """Area of a closed loop (N, 2) of (x, y); positive or negative with its sense of rotation (shoelace formula)."""
    x, y = loop[:, 0], loop[:, 1]
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def polygon_coverage(loops: Sequence[FloatArray], shape: tuple[int, int]) -> FloatArray:
    """Fraction of each pixel that a polygon covers, exact up to rounding.

    Every edge is cut where it crosses a pixel border. A piece inside one pixel adds, by Green's theorem, its height
    times the mean distance to the pixel's right border to that pixel, and its height to all pixels to the right; the
    latter is left to a cumulative sum along the row.

    Parameters
    ----------
    loops
        Closed loops (N, 2) of (x, y) in pixels; those that turn against the largest are holes.
    shape
        (height, width) of the grid; what lies outside is cut off.

    Returns
    -------
    FloatArray
        float64 (height, width), 0 to 1.
    """
    height, width = shape
    added = np.zeros((height, width + 2))
    for loop in loops:
        for start, end in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            _add_edge(added, start, end, height, width)
    covered = np.cumsum(added, axis=1)[:, :width]
    return -covered if covered.sum() < 0 else covered


def _add_edge(added: FloatArray, start: FloatArray, end: FloatArray, height: int, width: int) -> None:
    (x0, y0), (x1, y1) = start, end
    if y0 == y1:
        return
    cuts = np.concatenate([[0.0, 1.0], _crossings(x0, x1, width), _crossings(y0, y1, height)])
    cuts.sort()
    x, y = x0 + cuts * (x1 - x0), y0 + cuts * (y1 - y0)
    middle_x, middle_y = np.clip(0.5 * (x[1:] + x[:-1]), 0.0, width), 0.5 * (y[1:] + y[:-1])
    rise = np.diff(y)
    row = np.floor(middle_y).astype(np.intp)
    inside = (row >= 0) & (row < height)
    row, middle_x, rise = row[inside], middle_x[inside], rise[inside]
    column = np.floor(middle_x).astype(np.intp)
    right = middle_x - column
    np.add.at(added, (row, column), rise * (1.0 - right))
    np.add.at(added, (row, column + 1), rise * right)


def _crossings(start: float, end: float, limit: int) -> FloatArray:
    """Where along the edge (0 to 1) a coordinate passes a whole number from 0 to ``limit``."""
    if start == end:
        return np.empty(0)
    low, high = max(min(start, end), 0.0), min(max(start, end), float(limit))
    lines = np.arange(np.ceil(low), np.floor(high) + 1.0)
    return np.clip((lines - start) / (end - start), 0.0, 1.0)


def box_overlap(edges: FloatArray, count: int) -> FloatArray:
    """Length that source interval j = [edges[j], edges[j + 1]] shares with target pixel i = [i, i + 1].

    Parameters
    ----------
    edges
        float64 (N + 1,), ascending or descending (a mirrored source).
    count
        Number of target pixels.

    Returns
    -------
    FloatArray
        float64 (count, N): ``target = overlap_y @ source @ overlap_x.T`` conserves density times area.
    """
    low, high = np.minimum(edges[:-1], edges[1:]), np.maximum(edges[:-1], edges[1:])
    pixel = np.arange(count)[:, None]
    overlap = np.maximum(np.minimum(pixel + 1.0, high) - np.maximum(pixel, low), 0.0)
    return np.asarray(overlap, np.float64)


def clip_to_convex(loop: FloatArray, window: FloatArray) -> FloatArray:
    """Part of a loop (N, 2) inside a convex loop (M, 2) (Sutherland and Hodgman 1974); may be empty (0, 2).

    A loop that falls apart is joined by edges that run to and fro and so cover nothing.
    """
    if signed_area(window) < 0:
        window = window[::-1]
    for a, b in zip(window, np.roll(window, -1, axis=0), strict=True):
        if len(loop) == 0:
            break
        side = (b[0] - a[0]) * (loop[:, 1] - a[1]) - (b[1] - a[1]) * (loop[:, 0] - a[0])
        if (side >= 0).all():
            continue
        kept: list[FloatArray] = []
        for k in range(len(loop)):
            here, there, s, t = loop[k - 1], loop[k], side[k - 1], side[k]
            if (s >= 0) != (t >= 0):
                kept.append(here + (there - here) * (s / (s - t)))
            if t >= 0:
                kept.append(there)
        loop = np.array(kept) if kept else np.empty((0, 2))
    return loop
