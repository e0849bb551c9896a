"""Is the blur the same all over a region? A slanted surface or several depths in one region have no single answer.

Two tests, since either alone is blind: a mixture of blurs must not explain the pooled spectrum better than one blur
does, and the region's parts, each with a texture of its own, must not lose by sharing one blur.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from workbench.depth.evidence_expected import mixed_power, smeared_power
from workbench.depth.evidence_model import DepthModel, EvidenceOptions
from workbench.depth.evidence_periodogram import Pooled, pooled_periodogram
from workbench.depth.evidence_spectrum import fit_spectra
from workbench.depth.evidence_windows import Window

Mask = NDArray[np.bool_]

_LEAST_WINDOWS, _MOST_WINDOWS = 9, 80
"""Three by three half-overlapping windows: fewer are no four parts. More than so many say nothing new."""
_CHANCE = 1.0
"""Log-likelihood that a part may lose by chance."""
_FOCUS_PX, _FOCUS_TRUST = 1.0, 0.1
"""A part that holds little but one strong edge near its border is put in focus by what the taper's slope makes of it:
parts that claim to be in focus count for less."""
_EVERY_ROW = 3
_MOST_AVERAGES = 12.0
"""Parts count for no more than this: a tolerance for what differs over the field, not a test of the lens."""
_SAME_PX, _SAME_SHARE = 2.0, 0.05


def mixture_gain(
    pooled: Pooled, expected: NDArray[np.float32], best: float, model: DepthModel, options: EvidenceOptions
) -> float:
    """Log-likelihood that a mixture of neighbouring blurs gains over the best single one.

    Parameters
    ----------
    pooled, expected
        The region's periodogram, and what each blur makes one expect (float32 (D, N, N // 2 + 1)).
    best
        Log-likelihood of the best single blur.
    model, options
        Radii of the blurs; how far they mix.
    """
    mixtures = mixed_power(expected, model.row_radius_px, options.varied_px)
    if not len(mixtures):  # the bank holds no such range of radii
        return 0.0
    fit = fit_spectra(pooled.power, pooled.trusted, mixtures, factor=options.factor)
    return float(fit.log_likelihood.max()) - best


def parts_loss(
    plane: NDArray[np.float32], windows: Sequence[Window], model: DepthModel, options: EvidenceOptions
) -> float:
    """Log-likelihood that a region's quarters lose when they share one blur, to two pixels and 5 % of its radius.

    Parameters
    ----------
    plane
        float32 (H, W).
    windows
        That cover the region. They are best half as wide as those that its depth is read from: more of them fit in.
    model, options
        Radii of the blurs; the texture's distribution.

    Returns
    -------
    float
        0 where the windows are too few for four parts.
    """
    if len(windows) < _LEAST_WINDOWS:
        return 0.0
    rows = slice(None, None, _EVERY_ROW)
    radius = np.abs(model.row_radius_px[rows])
    curves = []
    for part in _quarters(windows):
        pooled = pooled_periodogram(plane, part, model.kernel_lags.shape[1] // 2)
        expected = smeared_power(model.kernel_lags[rows], pooled.taper_lags, pooled.power.shape[0])
        fit = fit_spectra(pooled.power, min(_MOST_AVERAGES, pooled.trusted), expected, factor=options.factor)
        curves.append(fit.log_likelihood)
    each = np.stack(curves)
    shared = float(radius[each.sum(axis=0).argmax()])
    alike = np.abs(radius - shared) <= _SAME_PX + _SAME_SHARE * shared
    lost = np.maximum(each.max(axis=1) - each[:, alike].max(axis=1) - _CHANCE, 0.0)
    return float(np.where(radius[each.argmax(axis=1)] < _FOCUS_PX, _FOCUS_TRUST, 1.0) @ lost)


def quarters_of(mask: Mask) -> list[Mask]:
    """The region's upper and lower half, each cut into a left and a right one of as many pixels; bool (H, W) each."""
    quarters = []
    rows, columns = np.nonzero(mask)
    for half in np.array_split(np.arange(rows.size), 2):  # in the order of the rows
        for part in np.array_split(half[np.argsort(columns[half], kind="stable")], 2):
            quarter = np.zeros_like(mask)
            quarter[rows[part], columns[part]] = True
            quarters.append(quarter)
    return quarters


def _quarters(windows: Sequence[Window]) -> list[list[Window]]:
    """Upper and lower half of the windows, each in a left and a right one, thinned out evenly."""
    by_row = sorted(windows, key=lambda w: (w.row, w.column))
    middle = (len(by_row) + 1) // 2
    parts = []
    for half in (by_row[:middle], by_row[middle:]):
        by_column = sorted(half, key=lambda w: (w.column, w.row))
        middle = (len(by_column) + 1) // 2
        parts += [by_column[:middle], by_column[middle:]]
    every = -(-len(windows) // _MOST_WINDOWS)
    return [part[::every] for part in parts]
