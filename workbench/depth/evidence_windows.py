"""Tapered windows that cover a region of any shape, its outline and its holes fading out under a soft edge."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.depth.regions import bounding_box, edge_distance

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FULL = 0.97
"""Share of a Hann window's energy inside the region from which on it counts as unhindered."""


@dataclass(frozen=True, slots=True)
class Window:
    """One square of the image: its top left corner (row, column; may lie outside) and its taper, float32 (N, N)."""

    row: int
    column: int
    taper: NDArray[np.float32]
    weight: float
    """Energy of the taper relative to an unhindered one."""


def hann(size: int) -> FloatArray:
    """Hann taper float64 (N,), its zeros half a pixel outside."""
    return np.asarray(np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2, np.float64)


def place_windows(mask: Mask, soft: NDArray[np.float32], size: int, *, least_weight: float) -> list[Window]:
    """Cover a region with half-overlapping windows.

    Parameters
    ----------
    mask
        bool (H, W): usable pixels of the region.
    soft
        float32 (H, W): the same with a soft edge (:func:`soft_mask`), which the tapers are cut by.
    size
        Side N of a window.
    least_weight
        Windows with less of a full Hann taper's energy are left out.

    Returns
    -------
    list of Window
        By decreasing weight; empty if nothing fits.
    """
    if not mask.any():
        return []
    rows, columns = bounding_box(mask)
    corners = [
        (y, x)
        for y in _starts(rows.start, rows.stop, size, mask.shape[0])
        for x in _starts(columns.start, columns.stop, size, mask.shape[1])
    ]
    return [window for window in _cut_windows(soft, corners, size) if window.weight >= least_weight]


def _cut_windows(soft: NDArray[np.float32], corners: Iterable[tuple[int, int]], size: int) -> list[Window]:
    """Windows at these corners, their tapers cut by the region's soft edge; by decreasing weight."""
    full = np.outer(hann(size), hann(size)).astype(np.float32)
    energy = float((full**2).sum())
    windows = []
    for y, x in corners:
        inside = soft[max(y, 0) : max(y + size, 0), max(x, 0) : max(x + size, 0)]
        if inside.shape == full.shape and inside.min() == 1.0:
            windows.append(Window(y, x, full, 1.0))
            continue
        cut = np.zeros((size, size), np.float32)
        cut[max(-y, 0) : max(-y, 0) + inside.shape[0], max(-x, 0) : max(-x, 0) + inside.shape[1]] = inside
        taper = full * cut
        weight = float((taper**2).sum()) / energy
        if weight >= _FULL and not _holes(cut):
            taper, weight = full, 1.0
        windows.append(Window(y, x, taper, weight))
    return sorted(windows, key=lambda w: -w.weight)


def thinned(windows: Sequence[Window], most: int) -> list[Window]:
    """At most so many of a region's windows, spread over it: from the middle on, always the farthest from the others.

    Light windows count as nearer. The order is that of :func:`place_windows`.
    """
    if len(windows) <= most:
        return list(windows)
    places = np.array([(w.row, w.column) for w in windows], np.float64)
    weight = np.array([w.weight for w in windows])
    distance = np.full(len(windows), np.inf)
    chosen = [int(np.hypot(*(places - places.mean(axis=0)).T).argmin())]
    while len(chosen) < most:
        distance = np.minimum(distance, np.hypot(*(places - places[chosen[-1]]).T))
        chosen.append(int((distance * weight).argmax()))
    return [windows[index] for index in sorted(chosen)]


def finer_windows(
    windows: Sequence[Window], soft: NDArray[np.float32], finer: int, corner: tuple[int, int]
) -> list[Window]:
    """The same windows on pixels ``finer`` times as fine.

    Parameters
    ----------
    windows
        In pixels of the whole image.
    soft
        float32 (h, w): the region with a soft edge, on the fine pixels of a part of the image.
    finer
        Fine pixels a pixel is wide.
    corner
        Row and column of that part's first pixel, in pixels of the whole image.

    Returns
    -------
    list of Window
        In fine pixels of the part, by decreasing weight.
    """
    corners = (((w.row - corner[0]) * finer, (w.column - corner[1]) * finer) for w in windows)
    return _cut_windows(soft, corners, finer * windows[0].taper.shape[0])


def soft_mask(mask: Mask, *, margin_px: float, ramp_px: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A region with a soft edge, and how far inside it each pixel lies.

    Parameters
    ----------
    mask
        bool (H, W).
    margin_px, ramp_px
        0 up to the margin from the region's edge (the frame's border is none), then a smooth step to 1.

    Returns
    -------
    soft, clear
        float32 (H, W) each: 0 to 1; and the distance (px) to the region's edge or the frame's border, 0 outside.
    """
    soft, clear = np.zeros(mask.shape, np.float32), np.zeros(mask.shape, np.float32)
    if mask.any():
        # with a ring of one pixel about the region: nothing outside is nearer than what lies on it
        box = bounding_box(mask, 1)
        distance = np.where(mask[box], edge_distance(mask[box]), np.float32(0.0))
        share = np.clip((distance - np.float32(margin_px)) / np.float32(max(ramp_px, 1e-6)), np.float32(0.0), 1.0)
        soft[box] = share * share * (3.0 - 2.0 * share)
        to_border = [
            np.minimum(np.arange(length)[part] + 1, length - np.arange(length)[part]).astype(np.float32)
            for length, part in zip(mask.shape, box, strict=True)
        ]
        clear[box] = np.minimum(distance, np.minimum(to_border[0][:, np.newaxis], to_border[1]))
    return soft, clear


def clear_share(clear: NDArray[np.float32], windows: Sequence[Window], reach_px: float) -> float:
    """Share of the windows' squared tapers that lies farther inside than ``reach_px`` (:func:`soft_mask`)."""
    inside = total = 0.0
    for window in windows:
        weight = window.taper.astype(np.float64) ** 2
        size = weight.shape[0]
        inside += float(weight[cut_out(clear, window.row, window.column, size, size) > reach_px].sum())
        total += float(weight.sum())
    return inside / total


def covered_pixels(mask: Mask, windows: Sequence[Window]) -> int:
    """How many of a region's pixels lie in at least one window and count there."""
    covered = np.zeros(mask.shape, np.bool_)
    for window in windows:
        size = window.taper.shape[0]
        top, left = max(window.row, 0), max(window.column, 0)
        part = covered[top : window.row + size, left : window.column + size]
        inside = window.taper[top - window.row :, left - window.column :] > 0
        part |= inside[: part.shape[0], : part.shape[1]]
    return int((covered & mask).sum())


def _holes(cut: NDArray[np.float32]) -> bool:
    return bool((cut[2:-2, 2:-2] <= 0).any())


def _starts(first: int, last: int, size: int, limit: int) -> list[int]:
    """Starts of windows that cover first..last with at least half overlap, inside the frame where it is large."""
    length = last - first
    if length <= size:
        centred = first + (length - size) // 2
        return [int(np.clip(centred, 0, max(limit - size, 0))) if limit >= size else centred]
    count = int(np.ceil((length - size) / (size / 2))) + 1
    return sorted({round(s) for s in np.linspace(first, last - size, count)})


def cut_out(plane: NDArray[np.float32], row: int, column: int, height: int, width: int) -> NDArray[np.float32]:
    """Rectangle of a plane, mirrored beyond its borders; float32 (height, width), a view where it can be."""
    if row >= 0 and column >= 0 and row + height <= plane.shape[0] and column + width <= plane.shape[1]:
        return plane[row : row + height, column : column + width]
    rows = _mirrored(np.arange(row, row + height), plane.shape[0])
    columns = _mirrored(np.arange(column, column + width), plane.shape[1])
    return plane[np.ix_(rows, columns)]


def _mirrored(index: NDArray[np.intp], length: int) -> NDArray[np.intp]:
    period = 2 * length
    folded = np.mod(index, period)
    return np.asarray(np.where(folded < length, folded, period - 1 - folded), np.intp)
