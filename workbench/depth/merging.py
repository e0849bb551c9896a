"""Statistical Region Merging over pixels: the published algorithm, compiled.

Nock and Nielsen, "Statistical region merging", IEEE PAMI 26(11), 2004. Pairs of 4-neighbours are visited once, in the
order of their largest channel difference. The regions of a pair merge when in every channel

    |mean(R) - mean(R')| <= sqrt(b(R)^2 + b(R')^2),     b(R)^2 = g^2 / (2 Q |R|) * ln(|R_l| / delta)

with g = 256 levels, delta = 1 / (6 |I|^2) and ``ln |R_l| <= min(g, |R|) ln(|R| + 1)``, the paper's bound on the number
of regions of |R| pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from workbench.compiled import compiled

_LEVELS = 256


def merge_regions(levels: NDArray[np.uint8], q: float) -> NDArray[np.int32]:
    """Segment an image.

    Parameters
    ----------
    levels
        uint8 (H, W, C).
    q
        The paper's Q: number of independent random variables that a pixel's channel is taken for. Larger: more
        and finer regions.

    Returns
    -------
    int32 (H, W), region of each pixel, 0 to n - 1 in the order of their first pixel.
    """
    height, width, channels = levels.shape
    pixels = np.ascontiguousarray(levels).reshape(-1, channels)
    first, down = _sorted_pairs(pixels.astype(np.int16), height, width)
    parent = np.arange(len(pixels), dtype=np.int32)
    _merge(pixels.astype(np.float64), first, down, width, q, parent)
    _resolve(parent)
    return _number(parent).reshape(height, width)


def absorb_small(labels: NDArray[np.int32], levels: NDArray[np.uint8], min_pixels: int) -> NDArray[np.int32]:
    """Give every region of fewer pixels to the neighbour of most similar mean colour, again until none is left.

    Parameters
    ----------
    labels
        int32 (H, W), 0 to n - 1.
    levels
        uint8 (H, W, C).
    min_pixels
        Smallest region that stays. A single region that fills the image stays whatever its size.

    Returns
    -------
    int32 (H, W), numbered as by :func:`merge_regions`.
    """
    current = labels
    while True:
        means, counts = region_means(current, levels)
        small = counts < min_pixels
        if len(counts) == 1 or not small.any():
            return current
        target = _nearest_neighbours(current, means, small)
        parent = np.arange(len(counts), dtype=np.int32)
        _join(parent, target)
        _resolve(parent)
        current = _number(parent[current.ravel()]).reshape(labels.shape)


def region_means(labels: NDArray[np.int32], levels: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Mean (n, C) and number of pixels (n,) of the regions 0 to n - 1."""
    flat = labels.ravel()
    counts = np.bincount(flat)
    sums = [np.bincount(flat, weights=levels[:, :, c].ravel()) for c in range(levels.shape[2])]
    return np.stack(sums, axis=1) / counts[:, None], counts


@compiled
def _sorted_pairs(pixels: NDArray[np.int16], height: int, width: int) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """4-neighbour pairs by rising largest channel difference, ties in raster order (a stable bucket sort)."""
    starts = np.zeros(_LEVELS + 1, np.int64)
    count = height * (width - 1) + (height - 1) * width
    first = np.empty(count, np.int32)
    down = np.empty(count, np.bool_)
    for sweep in range(2):
        for row in range(height):
            for column in range(width):
                here = row * width + column
                for direction in range(2):
                    if (direction == 0 and column == width - 1) or (direction == 1 and row == height - 1):
                        continue
                    there = here + (width if direction == 1 else 1)
                    largest = 0
                    for c in range(pixels.shape[1]):
                        largest = max(largest, int(abs(pixels[here, c] - pixels[there, c])))
                    if sweep == 0:
                        starts[largest + 1] += 1
                    else:
                        first[starts[largest]] = here
                        down[starts[largest]] = direction == 1
                        starts[largest] += 1
        if sweep == 0:
            for level in range(_LEVELS):
                starts[level + 1] += starts[level]
    return first, down


@compiled
def _root(parent: NDArray[np.int32], pixel: int) -> int:
    while parent[pixel] != pixel:
        parent[pixel] = parent[parent[pixel]]
        pixel = parent[pixel]
    return pixel


@compiled
def _merge(
    sums: NDArray[np.float64],
    first: NDArray[np.int32],
    down: NDArray[np.bool_],
    width: int,
    q: float,
    parent: NDArray[np.int32],
) -> None:
    """One pass over the sorted pairs; ``sums`` (colour sums of regions) and ``parent`` change in place."""
    total = len(parent)
    sizes = np.ones(total, np.int32)
    log_inverse_delta = math.log(6.0) + 2.0 * math.log(total)
    scale = _LEVELS * _LEVELS / (2.0 * q)
    for pair in range(len(first)):
        one = _root(parent, first[pair])
        other = _root(parent, first[pair] + (width if down[pair] else 1))
        if one == other:
            continue
        size_one = sizes[one]
        size_other = sizes[other]
        bound = scale / size_one * (
            min(_LEVELS, size_one) * math.log(size_one + 1.0) + log_inverse_delta
        ) + scale / size_other * (min(_LEVELS, size_other) * math.log(size_other + 1.0) + log_inverse_delta)
        alike = True
        for c in range(sums.shape[1]):
            difference = sums[one, c] / size_one - sums[other, c] / size_other
            alike = alike and difference * difference <= bound
        if not alike:
            continue
        if size_one < size_other:
            one, other = other, one
        parent[other] = one
        sizes[one] += sizes[other]
        for c in range(sums.shape[1]):
            sums[one, c] += sums[other, c]


@compiled
def _join(parent: NDArray[np.int32], target: NDArray[np.int32]) -> None:
    """Join every region with its target (-1: none)."""
    for region in range(len(target)):
        if target[region] >= 0:
            one = _root(parent, region)
            other = _root(parent, target[region])
            parent[max(one, other)] = min(one, other)


@compiled
def _nearest_neighbours(
    labels: NDArray[np.int32], means: NDArray[np.float64], wanted: NDArray[np.bool_]
) -> NDArray[np.int32]:
    """For each wanted region the neighbour with the least largest channel difference of means; -1 for the others."""
    best = np.full(len(means), np.inf)
    target = np.full(len(means), -1, np.int32)
    height, width = labels.shape
    for row in range(height):
        for column in range(width):
            one = labels[row, column]
            for direction in range(2):
                if (direction == 0 and column == width - 1) or (direction == 1 and row == height - 1):
                    continue
                other = labels[row + direction, column + 1 - direction]
                if one == other or not (wanted[one] or wanted[other]):
                    continue
                distance = 0.0
                for c in range(means.shape[1]):
                    distance = max(distance, abs(means[one, c] - means[other, c]))
                if wanted[one] and distance < best[one]:
                    best[one] = distance
                    target[one] = other
                if wanted[other] and distance < best[other]:
                    best[other] = distance
                    target[other] = one
    return target


@compiled
def _resolve(parent: NDArray[np.int32]) -> None:
    """Make every entry point at its root."""
    for region in range(len(parent)):
        parent[region] = _root(parent, region)


@compiled
def _number(roots: NDArray[np.int32]) -> NDArray[np.int32]:
    """Number regions 0, 1, 2... in the order of their first pixel."""
    number = np.full(len(roots), -1, np.int32)
    result = np.empty(len(roots), np.int32)
    count = 0
    for pixel in range(len(roots)):
        root = roots[pixel]
        if number[root] < 0:
            number[root] = count
            count += 1
        result[pixel] = number[root]
    return result
