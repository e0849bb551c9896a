"""Depth by evidence: the posterior over signed blur radius from a region's spectrum and its sparseness.

1. The region is covered with tapered windows (:mod:`~workbench.depth.evidence_windows`); their periodograms are pooled
   (:mod:`~workbench.depth.evidence_periodogram`).
2. For every |radius| on a fine grid, texture and noise are fitted and the likelihood of the spectrum is taken
   (:mod:`~workbench.depth.evidence_spectrum`). It can't tell the side of focus.
   Next to focus the photosites themselves refine it (:mod:`~workbench.depth.evidence_view`).
3. At each of the likelihood's modes, restorations with both sides' PSFs are judged by how sparse they are, and by how
   much of their light is negative (:mod:`~workbench.depth.evidence_side`): the true blur, on its true side, gives the
   sparsest, and needs none.
4. Both join in one posterior over the signed radius, which is linear in 1/depth. The likelihood is weighed by the
   texture's ridges and by what was learned from the bank, the posterior widened by errors that it doesn't know of. How
   wide it is about each mode follows what a mixture of blurs loses (:mod:`~workbench.depth.evidence_uniform`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate, Status
from workbench.depth.evidence_colour import informative_mixture
from workbench.depth.evidence_doubt import (
    uneven,
    unless_another_blur_fits,
    unless_beyond_reach,
    unless_few_lines,
    unless_halves_disagree,
    unless_negative,
    unless_on_either_side,
)
from workbench.depth.evidence_expected import smeared_power
from workbench.depth.evidence_model import DepthModel, EvidenceOptions, Learned, learned_of, prepare
from workbench.depth.evidence_periodogram import pooled_periodogram
from workbench.depth.evidence_posterior import (
    Refined,
    find_modes,
    half_odds,
    least_error_px,
    mode_scores,
    negative_cost,
    side_odds,
    signed_posterior,
    summarise,
)
from workbench.depth.evidence_spectrum import SpectralFit, fit_spectra, frequencies
from workbench.depth.evidence_uniform import Part, fit_parts, mixture_gain, parts_loss, read_parts, trust_in_one_blur
from workbench.depth.evidence_view import (
    View,
    compare_sides,
    joined_likelihood,
    refine,
    view_of,
    view_photosites,
)
from workbench.depth.evidence_windows import covered_pixels, place_windows, soft_mask, thinned
from workbench.processors import each

__all__ = [
    "DepthModel",
    "EvidenceOptions",
    "estimate_evidence",
    "measure_region",
    "observe",
    "prepare",
]

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RAMP_PX = 12.0
_MOST_WINDOWS = 100
"""Of a large region; averages of more are not trusted more."""
_REFINED_WITHIN, _NARROW = 30.0, 5.0
"""Modes within so much log-likelihood of the best, unweighted as in all that comes before the posterior, are looked at
more finely where it falls by so much to the next rows."""
_NATIVE_WITHIN = 70.0
"""Photosites are looked at where superpixels leave a blur next to focus within so much log-likelihood of the best."""
_ENOUGH = 0.7
"""Full windows' worth of region below which smaller windows are tried."""
_LOW_CYCLES = 6.0
_LEAST_LOW_SHARE, _MOST_LINE_SHARE = 0.25, 0.9
_LOW_SHARE_WITH_LINES, _LINES = 0.85, 0.48
"""A strict pattern by either share alone, or by both together: few lines hold nearly half of the power, and between
them low frequencies are empty."""


def estimate_evidence(
    image: LinearImage,
    bank: Bank,
    labels: NDArray[np.int32],
    options: EvidenceOptions | None = None,
    *,
    workers: int = 1,
    outlines_found: bool = False,
) -> dict[int, DepthEstimate]:
    """Depth of each region of an image.

    Parameters
    ----------
    image
        Developed like the bank.
    bank
        PSFs and lens fit.
    labels
        int32 (H, W): region of each pixel, 0 = none.
    options
        Defaults as described there.
    workers
        Regions that are measured at once, in threads; no answer depends on their number.
    outlines_found
        Whether the regions' outlines were found in the photograph, so that neighbours may leak in.

    Returns
    -------
    dict
        :class:`DepthEstimate` by label; its ``score`` is the posterior's probability per grid depth.
    """
    options = options or EvidenceOptions()
    model, learned = prepare(bank, options), learned_of(bank)
    luminance = image.luminance

    def of_region(label: int) -> DepthEstimate:
        mask = labels == label
        mixture = informative_mixture(image, mask & ~image.saturated, options.colour_gain)
        plane = luminance if mixture is None else np.asarray(image.planes @ mixture.astype(np.float32))
        photosites = image if mixture is None else None  # a colour by itself is sampled too coarsely
        is_light = mixture is None or bool((mixture >= 0).all())
        return measure_region(
            plane,
            image.saturated,
            mask,
            model,
            learned,
            options,
            photosites,
            is_light=is_light,
            outlines_found=outlines_found,
        )

    numbers = [int(label) for label in np.unique(labels[labels > 0])]
    return dict(zip(numbers, each(of_region, numbers, workers), strict=True))


@dataclass(frozen=True, slots=True)
class Observation:
    """What a region's pixels say, before anything learned is applied."""

    view: View
    photosites: View | None
    likelihood: FloatArray
    """float64 (R,): log-likelihood of the spectrum for each of the model's rows, by both views."""
    pixels: float
    """Superpixels' worth of information: sum of the squared tapers' weights."""
    covered: int
    """Superpixels that lie in a window."""
    low_share: float
    """Share of the lowest frequencies that stand above the noise."""
    line_share: float
    """Part of the texture's power, relative to its smooth spectrum, in the strongest hundredth of the frequencies."""
    varied: float
    """Log-likelihood that a mixture of neighbouring blurs gains over the best single one."""
    parts: list[Part]
    """Its quarters by themselves; none where they are too small, or nobody asks."""


def observe(
    plane: NDArray[np.float32],
    mask: Mask,
    model: DepthModel,
    options: EvidenceOptions,
    with_photosites: LinearImage | None = None,
    *,
    is_light: bool = True,
    as_one: bool = False,
) -> Observation | None:
    """Pool the region's windows and fit every blur; None where no window fits.

    Photosites are looked at next to focus, where an image is given that has them. ``is_light``: see :class:`View`. With
    ``as_one`` nobody asks whether its quarters have the same blur.
    """
    margin = min(options.margin_px, options.margin * float(np.sqrt(mask.sum())))
    size = options.window_px
    soft, clear = soft_mask(mask, margin_px=margin, ramp_px=_RAMP_PX)
    while True:
        windows = place_windows(mask, soft, size, least_weight=options.least_weight)
        if sum(w.weight for w in windows) >= _ENOUGH:
            break
        size //= 2
        if size < options.smallest_window_px:
            return None
    chosen = thinned(windows, _MOST_WINDOWS)
    pooled = pooled_periodogram(plane, chosen, model.kernel_lags.shape[1] // 2)
    expected = smeared_power(model.kernel_lags, pooled.taper_lags, size)
    fit = fit_spectra(
        pooled.power, pooled.trusted, expected, independent_share=pooled.independent_share, factor=options.factor
    )
    view, photosites = View(plane, soft, clear, chosen, pooled, fit, is_light=is_light), None
    if with_photosites is not None and with_photosites.mosaic is not None and _next_to_focus(fit.log_likelihood, model):
        photosites = view_photosites(with_photosites, mask, view, model, options)
    parts = list[Part]()
    if not as_one and size // 2 >= options.smallest_window_px:
        finer = place_windows(mask, soft, size // 2, least_weight=options.least_weight)
        parts = fit_parts(plane, finer, mask, model, options)
    pixels = sum(w.weight for w in windows) * size * size * 0.25  # half overlap both ways: each pixel counts fourfold
    return Observation(
        view,
        photosites,
        joined_likelihood(view, photosites),
        max(pixels, size * size * windows[0].weight),
        covered_pixels(mask, windows),
        _low_share(pooled.power, fit),
        _line_share(pooled.power, expected, fit),
        mixture_gain(pooled, expected, fit, model, options),
        parts,
    )


def _next_to_focus(likelihood: FloatArray, model: DepthModel) -> bool:
    if model.native is None:
        return False
    near = likelihood[: len(model.native.kernel_lags)]
    return bool(near.max() > likelihood.max() - _NATIVE_WITHIN)


def _narrow(likelihood: FloatArray, row: int) -> bool:
    """Whether the likelihood falls steeply enough from this row to the next ones for them to miss its shape."""
    beside = likelihood[max(row - 1, 0) : row + 2]
    return bool(likelihood[row] - beside.min() > _NARROW)


def _low_share(power: FloatArray, fit: SpectralFit) -> float:
    """Of the frequencies up to a few cycles per window, the share with three times the noise's power.

    Every blur passes them, and every texture but a strict pattern has them: falling spectra reach highest there.
    """
    modulus, _, used = frequencies(power.shape[0])
    lowest = used & (modulus * power.shape[0] <= _LOW_CYCLES)
    noise = np.exp(float(fit.log_noise[int(fit.log_likelihood.argmax())]))
    return float((power[lowest] > 3.0 * noise).mean())


def _line_share(power: FloatArray, expected: NDArray[np.float32], fit: SpectralFit) -> float:
    modulus, direction, used = frequencies(power.shape[0])
    best = int(fit.log_likelihood.argmax())
    texture = np.exp(fit.texture(best).log_power(modulus[used], direction[used]))
    model = texture * np.maximum(expected[best][used], 0.0) + np.exp(float(fit.log_noise[best]))
    ratio = np.sort(power[used] / model)
    return float(ratio[-max(1, ratio.size // 100) :].sum() / max(float(ratio.sum()), 1e-30))


def measure_region(
    plane: NDArray[np.float32],
    saturated: Mask,
    mask: Mask,
    model: DepthModel,
    learned: Learned,
    options: EvidenceOptions,
    with_photosites: LinearImage | None = None,
    *,
    is_light: bool = True,
    outlines_found: bool = False,
) -> DepthEstimate:
    """Depth of one region; see :func:`estimate_evidence`."""
    pixels = int(mask.sum())
    clipped = float((saturated & mask).sum()) / max(pixels, 1)
    if clipped > options.max_saturated:
        return _refused(model, "saturated", pixels, f"{clipped:.0%} of its pixels are saturated; expose less")
    usable = mask & ~saturated if clipped > 0.002 else mask
    seen = observe(plane, usable, model, options, with_photosites, is_light=is_light)
    if seen is None:
        return _refused(
            model, "no-texture", pixels, f"too small or too thin for a window of {options.smallest_window_px} px"
        )
    gain = float(seen.view.fit.log_likelihood.max()) - seen.view.fit.null
    if gain < options.least_evidence:
        return _refused(model, "no-texture", pixels, "no texture above the noise")
    if _is_strict_pattern(seen):
        reason = "only isolated spatial frequencies stand above the noise (a strict pattern): any blur explains them"
        return _refused(model, "no-texture", pixels, reason)
    is_uneven = seen.varied > options.varied_log_likelihood
    is_uneven = is_uneven or parts_loss(seen.parts, model) > options.parts_log_likelihood
    estimate = _conclude(seen, model, learned, options, is_uneven=is_uneven, outlines_found=outlines_found)
    own_px = abs(model.psfs.radius_px(estimate.depth_mm))
    if not is_uneven and parts_loss(seen.parts, model, own_px) <= options.parts_log_likelihood:
        return estimate
    return uneven(estimate, read_parts(seen.parts, seen.view, model, learned, options))


def _is_strict_pattern(seen: Observation) -> bool:
    has_lines = seen.line_share > _LINES and seen.low_share < _LOW_SHARE_WITH_LINES
    return has_lines or seen.low_share < _LEAST_LOW_SHARE or seen.line_share > _MOST_LINE_SHARE


def _refused(model: DepthModel, status: Status, pixels: int, reason: str) -> DepthEstimate:
    nan = float("nan")
    flat = np.full(model.depths_mm.size, 1.0 / model.depths_mm.size)
    return DepthEstimate(nan, (nan, nan), 0.0, nan, nan, status, model.depths_mm, flat, nan, pixels, reason)


def _conclude(
    seen: Observation,
    model: DepthModel,
    learned: Learned,
    options: EvidenceOptions,
    *,
    is_uneven: bool,
    outlines_found: bool,
) -> DepthEstimate:
    """From what was seen to an answer; nothing else is doubted of a region that has no single depth."""
    likelihood, views = seen.likelihood, (seen.view, seen.photosites)
    weight = learned.spectral_weight * seen.view.fit.likelihood_weight
    modes = find_modes(likelihood, model.row_radius_px)
    clues = compare_sides(*views, modes, model, options)
    far, near = mode_scores(clues, np.asarray(model.sides_in_reach[modes].all(axis=1)), seen.pixels, learned)
    best = float(likelihood[modes].max())
    refined = [
        refine(*views, row, model, options)
        for row in modes
        if likelihood[row] > best - _REFINED_WITHIN and _narrow(likelihood, row)
    ]
    weighed = weight * likelihood
    finely = [Refined(part.radius_px, weight * part.log_likelihood) for part in refined]
    trust = trust_in_one_blur(seen.varied)
    sigma, log_post, trusted = signed_posterior(weighed, modes, far, near, model, options, finely, trust)
    diagnostics = {
        "radius_px": model.row_radius_px,
        "log_likelihood": likelihood,
        "log_likelihood_noise": np.array([seen.view.fit.null]),
        "mode_radius_px": model.row_radius_px[modes],
        "mode_sparseness_far_near": np.stack([far, near]),
    }
    best_px = float(sigma[log_post.argmax()])
    finer = view_of(*views, int(np.abs(np.abs(model.row_radius_px) - abs(best_px)).argmin())).finer
    se = least_error_px(best_px, seen.line_share, finer, model, learned, outlines_found=outlines_found)
    estimate = summarise(sigma, log_post, trusted, seen.covered, se, model, learned, options, diagnostics)
    if is_uneven:
        return estimate
    estimate = unless_halves_disagree(estimate, modes, half_odds(clues, learned), model)
    cost = negative_cost(clues)
    estimate = unless_another_blur_fits(estimate, weighed, modes, (far, near), cost, model, options)
    estimate = unless_beyond_reach(estimate, modes, side_odds(clues, learned), model)
    estimate = unless_on_either_side(unless_negative(estimate, modes, cost, model), model)
    return unless_few_lines(estimate, seen.line_share, model)
