"""Two frames under each other's depth: told by the lens, since each then has the size that the other should have."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calibration.errors import FitError
from calibration.lens_fit import LensFit, fit_lens

FloatArray = NDArray[np.float64]

_LEAST_PX = 0.2
"""Radii that differ by less than this may as well be exchanged."""
_BETTER = 8.0
"""The exchange must divide the sum of squared residuals by this, and by half of it against the next best exchange."""
_TRIED = 4
_FEWEST = 4


def swapped_pair(
    nominal_mm: FloatArray, radius_px: FloatArray, radius_se_px: FloatArray, *, apply_zero: bool
) -> tuple[int, int] | None:
    """The two depths whose frames were exchanged, if exchanging them back makes a lens of what was none.

    Parameters
    ----------
    nominal_mm, radius_px, radius_se_px
        float64 (D,): nominal depth, signed radius and its standard error.
    apply_zero
        As for :func:`calibration.lens_fit.fit_lens`.

    Returns
    -------
    tuple of int or None
        None where nothing is wrong, where no one exchange mends it, or where several would.
    """
    if nominal_mm.size < _FEWEST:
        return None
    plain = _squares(nominal_mm, radius_px, radius_se_px, apply_zero=apply_zero)[0]
    # every pair by a straight line in 1/z first, which leaves a few to fit in full
    design = np.stack([np.ones_like(nominal_mm), 1.0 / nominal_mm], axis=1)
    left_over = np.eye(nominal_mm.size) - design @ np.linalg.pinv(design)
    pairs = [p for p in combinations(range(nominal_mm.size), 2) if abs(radius_px[p[0]] - radius_px[p[1]]) > _LEAST_PX]
    pairs.sort(key=lambda pair: float(np.sum((left_over @ _exchanged(radius_px, pair)) ** 2)))
    tried = []
    for pair in pairs[:_TRIED]:
        radii, errors = _exchanged(radius_px, pair), _exchanged(radius_se_px, pair)
        squares, lens = _squares(nominal_mm, radii, errors, apply_zero=apply_zero)
        tried.append((squares, pair, lens is not None and not any(lens.suspect[k] for k in pair)))
    tried.sort(key=lambda one: one[0])
    if not tried:
        return None
    best, pair, sound = tried[0]
    next_best = tried[1][0] if len(tried) > 1 else np.inf
    return pair if sound and _BETTER * best < plain and 0.5 * _BETTER * best < next_best else None


def _exchanged(values: FloatArray, pair: tuple[int, int]) -> FloatArray:
    result = values.copy()
    result[list(pair)] = values[list(pair[::-1])]
    return result


def _squares(
    nominal_mm: FloatArray, radius_px: FloatArray, se_px: FloatArray, *, apply_zero: bool
) -> tuple[float, LensFit | None]:
    try:
        lens = fit_lens(nominal_mm, radius_px, se_px, apply_zero=apply_zero)
    except FitError:
        return float("inf"), None
    return float((lens.residual_px**2).sum()), lens
