"""Ridges in a spectrum: straight edges, strokes and grain hold their power on lines through the origin.

The strokes of letters, the joints of bricks, the edges of shelves: every direction that edges share is a line, narrow
and as long as the edges are sharp. The aperture has straight edges too, and a large blur's transfer function has their
lines: a texture model that knows none takes sharp letters for points that were blurred by a large aperture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

FloatArray = NDArray[np.float64]

_LOWEST, _HIGHEST = 0.15, 0.48
"""Cycles per pixel between which lines are sought: nearer to the origin they can't be told apart."""
_HALF_WIDTH = 1.5
"""Of a line, in cycles per window: the main lobe of a Hann taper's power."""
_APART = 8.0
"""Degrees between two lines; nearer ones are one."""
MOST_RIDGES = 6


@dataclass(frozen=True)
class Threshold:
    """How high a line must stand above the spectrum beside it: log power on average, and in standard errors."""

    height: float
    score: float


UNEXPLAINED = Threshold(0.7, 6.0)
"""Of a line in what a blur leaves unexplained: that it is there at all decides whether the texture has edges."""
VISIBLE = Threshold(1.0, 4.0)
"""Of a line in the spectrum itself, once it is known that the texture has edges."""


def ridge_directions(log_power: FloatArray, known: Sequence[float], threshold: Threshold) -> tuple[float, ...]:
    """Directions (rad) of a spectrum's ridges, the highest first.

    Parameters
    ----------
    log_power
        float64 (N, N // 2 + 1): log of an average periodogram, or of its ratio to a model.
    known
        Ridges that are known already, in radians; others are at least 8 degrees away from them.
    threshold
        What is high enough.

    Returns
    -------
    tuple of float
        New ones, at most :data:`MOST_RIDGES` together with the known ones.
    """
    fan = _fan(log_power.shape[0])
    level = log_power.ravel()[fan.index]
    above = level - _ring_medians(level, fan.ring)[fan.ring]
    profile = fan.mean @ above
    height = profile - np.median(profile)
    high = (height >= threshold.height) & (height * np.sqrt(fan.count) >= threshold.score * above.std())
    found: list[float] = []
    for k in np.argsort(-height, kind="stable"):
        taken = [*known, *found]
        if not high[k] or len(taken) >= MOST_RIDGES:
            break
        if _is_apart(fan.direction[k], taken):
            found.append(float(fan.direction[k]))
    return tuple(found)


def with_perpendiculars(directions: Sequence[float], first: int | None = None) -> tuple[float, ...]:
    """Directions (rad) and those at right angles to the first so many of them (all by default), as stripes and joints
    mostly cross; no more than ridges may be."""
    result = list(directions)
    for direction in directions[:first]:
        if _is_apart(direction + np.pi / 2, result):
            result.append(direction + np.pi / 2)
    return tuple(result[:MOST_RIDGES])


def _is_apart(direction: float, others: Sequence[float]) -> bool:
    return all(abs(np.sin(direction - other)) > np.sin(np.radians(_APART)) for other in others)


@dataclass(frozen=True)
class _Fan:
    """Lines through the origin on the half plane of an N x N spectrum.

    ``index`` flat indices (F,) of the frequencies between the limits, ``ring`` each one's whole number of cycles per
    window, ``mean`` sparse (N, F): averages along each direction, ``count`` frequencies on each, ``direction`` in rad.
    """

    index: NDArray[np.intp]
    ring: NDArray[np.intp]
    mean: sparse.csr_matrix
    count: FloatArray
    direction: FloatArray


@lru_cache(maxsize=8)
def _fan(size: int) -> _Fan:
    fy, fx = np.fft.fftfreq(size)[:, np.newaxis], np.fft.rfftfreq(size)[np.newaxis, :]
    modulus = np.hypot(fy, fx)
    between = (modulus > _LOWEST) & (modulus < _HIGHEST) & ~((fx == 0) & (fy < 0))
    y, x = (np.broadcast_to(f, modulus.shape)[between] for f in (fy, fx))
    direction = (np.arange(size) + 0.5) / size * np.pi - np.pi / 2
    lines = [np.flatnonzero(np.abs(np.sin(turn) * x - np.cos(turn) * y) * size < _HALF_WIDTH) for turn in direction]
    count = np.array([line.size for line in lines], np.float64)
    ends = np.concatenate([[0], np.cumsum(count)]).astype(np.intp)
    mean = sparse.csr_matrix((np.repeat(1.0 / count, count.astype(np.intp)), np.concatenate(lines), ends),
                             shape=(size, x.size))  # fmt: skip
    ring = np.rint(modulus[between] * size).astype(np.intp)
    return _Fan(np.flatnonzero(between), ring - ring.min(), mean, count, direction)


def _ring_medians(level: FloatArray, ring: NDArray[np.intp]) -> FloatArray:
    """Median (the lower one) of each ring's values, float64 (rings,)."""
    order = np.lexsort((level, ring))
    starts = np.searchsorted(ring[order], np.arange(ring.max() + 2))
    return np.asarray(level[order][(starts[:-1] + starts[1:] - 1) // 2], np.float64)
