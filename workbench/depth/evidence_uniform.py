"""Is the blur the same all over a region? A slanted surface or several depths in one region have no single answer.

Two tests, since either alone is blind: a mixture of blurs must not explain the pooled spectrum better than one blur
does, and the region's parts, each with a texture of its own, must not lose by sharing one blur. Where one of them
fails, the parts are read one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from workbench.depth.evidence_expected import mixed_power, smeared_power
from workbench.depth.evidence_model import DepthModel, EvidenceOptions, Learned
from workbench.depth.evidence_periodogram import Pooled, pooled_periodogram
from workbench.depth.evidence_posterior import open_sides, peak_of, side_odds
from workbench.depth.evidence_restoration import cut_patches
from workbench.depth.evidence_spectrum import SpectralFit, fit_spectra
from workbench.depth.evidence_view import View, compare_windows
from workbench.depth.evidence_windows import Window, thinned

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MOST_WINDOWS, _SIDE_WINDOWS = 20, 9
"""Of a part, for its blur and for its side. More say little new."""
_OWN = 0.8
"""Least share of a window's taper within the part that it counts for; windows across a cut are left out."""
_CHANCE = 1.0
"""Log-likelihood that a part may lose by chance."""
_FOCUS_PX, _FOCUS_TRUST = 1.0, 0.1
"""A part that holds little but one strong edge near its border is put in focus by what the taper's slope makes of it:
parts that claim to be in focus count for less."""
PARTS_ROWS = slice(None, None, 3)
"""Of the model: the blurs that parts are fitted with."""
_MOST_AVERAGES = 12.0
"""Parts count for no more than this: a tolerance for what differs over the field, not a test of the lens."""
_SAME_PX, _SAME_SHARE = 2.0, 0.05
_TRUST, _TRUST_POWER = 0.69, 0.29
"""The power fitted to 942 regions of four sizes by the simulated rig (seeds 77 to 79 and 90), the factor chosen with
6414 (all depths of seeds 77 to 79), of whose unmarked ones 95 % lie in their intervals; 0.78, which took all answers to
95 %, was left once the full form had shown charts and less light to hold less."""
_HELD = 1.92
"""Log-likelihood below the best within which a blur stays possible: half of chi-squared's 95 % at one freedom."""


def mixture_gain(
    pooled: Pooled, expected: NDArray[np.float32], single: SpectralFit, model: DepthModel, options: EvidenceOptions
) -> float:
    """Log-likelihood (nats) that a mixture of neighbouring blurs gains over the best single one.

    NaN where the bank holds no such range of radii.

    Parameters
    ----------
    pooled, expected
        The region's periodogram, and what each blur makes one expect (float32 (D, N, N // 2 + 1)).
    single
        The fit of single blurs; mixtures are given the same ridges of the texture.
    model, options
        Radii of the blurs; how far they mix.
    """
    mixtures = mixed_power(expected, model.row_radius_px, options.varied_px)
    if not len(mixtures):
        return float("nan")
    fit = fit_spectra(pooled.power, pooled.trusted, mixtures, independent_share=pooled.independent_share,
                      factor=options.factor, ridges=single.ridges)  # fmt: skip
    return float(fit.log_likelihood.max() - single.log_likelihood.max())


def trust_in_one_blur(gain: float) -> float:
    """Power that a region's likelihood is raised to about its modes, by what a mixture of neighbouring blurs gains.

    A mixture fills the zeros of the transfer function, which no texture can mimic: where a region shows them it loses
    much, and the likelihood is worth more than it claims. Where it loses little, the radius hangs on how steeply the
    spectrum falls, of which textures have their own ways.

    Parameters
    ----------
    gain
        Nats, from :func:`mixture_gain`.

    Returns
    -------
    float
        Below 1 where the mixture fits nearly as well; 1 where nobody knows.
    """
    if np.isnan(gain):
        return 1.0
    return float(_TRUST * (1.0 - min(gain, 0.0)) ** _TRUST_POWER)


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a region: windows that lie in it, all but, and what they say of every third blur of the model."""

    windows: list[Window]
    fit: SpectralFit


@dataclass(frozen=True, slots=True)
class Reading:
    """What a part of a region reads by itself: its likeliest depth, and the range that stays possible."""

    depth_mm: float
    interval_mm: tuple[float, float]


def fit_parts(
    plane: NDArray[np.float32], windows: Sequence[Window], mask: Mask, model: DepthModel, options: EvidenceOptions
) -> list[Part]:
    """Fit every blur to each quarter of a region by itself.

    Parameters
    ----------
    plane
        float32 (H, W).
    windows
        That cover the region. They are best half as wide as those that its depth is read from: more of them fit in.
    mask
        bool (H, W): the region.
    model, options
        Radii of the blurs; the texture's distribution.

    Returns
    -------
    list of Part
        Of the quarters that have windows of their own.
    """
    return [fit_part(plane, own, model, options) for own in _by_quarter(windows, mask)]


def fit_part(plane: NDArray[np.float32], windows: list[Window], model: DepthModel, options: EvidenceOptions) -> Part:
    """Fit every third blur of the model to some windows, at least one, with a texture of their own."""
    pooled = pooled_periodogram(plane, windows, model.kernel_lags.shape[1] // 2)
    expected = smeared_power(model.kernel_lags[PARTS_ROWS], pooled.taper_lags, pooled.power.shape[0])
    averages = min(_MOST_AVERAGES, pooled.trusted)
    fit = fit_spectra(
        pooled.power, averages, expected, independent_share=pooled.independent_share, factor=options.factor
    )
    return Part(windows, fit)


def parts_loss(parts: Sequence[Part], model: DepthModel, radius_px: float | None = None) -> float:
    """Log-likelihood that parts lose when they share one blur, to two pixels and 5 % of its radius.

    Parameters
    ----------
    parts
        As fitted.
    model
        Radii of the blurs.
    radius_px
        |radius| of that blur; the one that suits them best if none is given.
    """
    if len(parts) < 2:
        return 0.0
    radius = np.abs(model.row_radius_px[PARTS_ROWS])
    each = np.stack([part.fit.log_likelihood for part in parts])
    shared = float(radius[each.sum(axis=0).argmax()]) if radius_px is None else radius_px
    alike = same_blur(radius, shared)
    lost = np.maximum(each.max(axis=1) - each[:, alike].max(axis=1) - _CHANCE, 0.0)
    return float(focus_trust(radius[each.argmax(axis=1)]) @ lost)


def same_blur(radius_px: FloatArray, centre_px: float) -> Mask:
    """Which |radii| differ from one of them by less than parts of one surface may, bool like ``radius_px``."""
    return np.asarray(np.abs(radius_px - centre_px) <= _SAME_PX + _SAME_SHARE * centre_px)


def focus_trust(radius_px: FloatArray) -> FloatArray:
    """What parts that like these |radii| best count for, float64 like ``radius_px``: less where they claim focus."""
    return np.where(radius_px < _FOCUS_PX, _FOCUS_TRUST, 1.0)


def read_parts(
    parts: Sequence[Part], view: View, model: DepthModel, learned: Learned, options: EvidenceOptions
) -> list[Reading]:
    """Depth of each part by itself, as far as its few windows tell; parts without texture are left out.

    Parameters
    ----------
    parts
        As fitted.
    view
        The region's superpixels.
    model, learned, options
        The bank, made ready; weights; the least evidence of texture, and the prior.
    """
    readings = []
    for part in parts:
        if part.fit.log_likelihood.max() - part.fit.null >= options.least_evidence:
            readings.append(_read(part, view, model, learned, options))
    return readings


def _read(part: Part, view: View, model: DepthModel, learned: Learned, options: EvidenceOptions) -> Reading:
    radius = np.abs(model.row_radius_px[PARTS_ROWS])
    likelihood = learned.spectral_weight * part.fit.likelihood_weight * part.fit.log_likelihood
    best = int(likelihood.argmax())
    centre = peak_of(likelihood, radius, best)[0]
    centre = float(radius[best]) if np.isnan(centre) else centre
    # another depth's edges next to a part would need negative light on either side: not asked for
    seen = replace(view, is_light=False)
    windows = thinned(part.windows, _SIDE_WINDOWS)
    patches = cut_patches(seen.plane, seen.soft, windows)
    clue = compare_windows(seen, windows, patches, centre, part.fit.texture(best), model)
    odds = float(side_odds([clue], learned)[0])
    sides = open_sides(centre, odds, model.sides_in_reach[PARTS_ROWS][best], model, options)
    held = radius[likelihood > likelihood[best] - _HELD]
    half = 0.5 * PARTS_ROWS.step * options.radius_step_px
    ends = model.depth_within_mm(np.outer(np.sign(sides), (held.min() - half, held.max() + half)))
    return Reading(float(model.depth_within_mm(sides[0])), (float(ends.min()), float(ends.max())))


def _by_quarter(windows: Sequence[Window], mask: Mask) -> list[list[Window]]:
    """Windows that lie in one of the region's quarters, quarter by quarter, spread over it; empty ones left out."""
    row, columns = quarter_cuts(mask)
    parts: list[list[Window]] = [[] for _ in range(4)]
    for window in thinned(windows, 8 * _MOST_WINDOWS):
        energy = window.taper**2
        above = max(row - window.row, 0)
        for half, (rows, column) in enumerate(zip((energy[:above], energy[above:]), columns, strict=True)):
            left = max(column - window.column, 0)
            for side, seen in enumerate((rows[:, :left], rows[:, left:])):
                if seen.sum() >= _OWN * energy.sum():
                    parts[2 * half + side].append(window)
    return [thinned(part, _MOST_WINDOWS) for part in parts if part]


def quarter_cuts(mask: Mask) -> tuple[int, tuple[int, int]]:
    """Where a region's lower half begins, and the right half of its upper and its lower half, to as many pixels each.

    Parameters
    ----------
    mask
        bool (H, W), not empty.
    """
    row = _halfway(mask.sum(axis=1))
    upper, lower = (_halfway(half.sum(axis=0)) for half in (mask[:row], mask[row:]))
    return row, (upper, lower)


def _halfway(counts: NDArray[np.integer]) -> int:
    """First index of the second half of what is counted."""
    return int(np.abs(np.cumsum(counts) - counts.sum() / 2).argmin()) + 1
