"""Depth by evidence: the posterior over signed blur radius from a region's spectrum and its sparseness.

1. The region is covered with tapered windows; their periodograms are pooled (:mod:`~workbench.depth.evidence_windows`).
2. For every |radius| on a fine grid, texture and noise are fitted and the likelihood of the spectrum is taken
   (:mod:`~workbench.depth.evidence_spectrum`). It can't tell the side of focus.
3. At each of the likelihood's modes, restorations with both sides' PSFs are judged by how sparse they are
   (:mod:`~workbench.depth.evidence_side`): the true blur, on its true side, gives the sparsest.
4. Both join in one posterior over the signed radius, which is linear in 1/depth. It is tempered and widened by what was
   learned from the bank, by the lens fit's standard errors, and by a share for what no model foresees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate, Status
from workbench.depth.evidence_colour import informative_mixture
from workbench.depth.evidence_doubt import doubted, unless_another_blur_fits, unless_beyond_reach
from workbench.depth.evidence_model import DepthModel, EvidenceOptions, Learned, learned_of, prepare
from workbench.depth.evidence_posterior import (
    Refined,
    find_modes,
    mode_scores,
    side_odds,
    signed_posterior,
    summarise,
)
from workbench.depth.evidence_side import Comparison, compare
from workbench.depth.evidence_spectrum import (
    SpectralFit,
    fit_spectra,
    frequencies,
    smeared_power,
)
from workbench.depth.evidence_uniform import mixture_gain, parts_loss
from workbench.depth.evidence_windows import (
    Pooled,
    Window,
    clear_share,
    covered_pixels,
    place_windows,
    pooled_periodogram,
    soft_mask,
)

__all__ = [
    "DepthModel",
    "EvidenceOptions",
    "compare_sides",
    "estimate_evidence",
    "measure_region",
    "observe",
    "prepare",
]

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RAMP_PX = 12.0
_SHAPELESS_PX = 1.5
_EDGE_TRUST = 0.35
"""What the comparison of the sides counts where all of the region lies within two radii of its edge."""
_REFINED_STEPS, _REFINED_FINER, _REFINED_FISHER_STEPS = 2, 3, 5
_REFINED_WITHIN, _NARROW = 30.0, 5.0
_ENOUGH = 0.7
"""Full windows' worth of region below which smaller windows are tried."""
_LOW_CYCLES = 6.0
_LEAST_LOW_SHARE, _MOST_LINE_SHARE = 0.25, 0.9
_LOW_SHARE_WITH_LINES, _LINES = 0.85, 0.5
"""A strict pattern by either share alone, or by both together: few lines hold half of the power, and between them low
frequencies are empty."""


def estimate_evidence(
    image: LinearImage, bank: Bank, labels: NDArray[np.int32], options: EvidenceOptions | None = None
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

    Returns
    -------
    dict
        :class:`DepthEstimate` by label; its ``score`` is the posterior's probability per grid depth.
    """
    options = options or EvidenceOptions()
    model, learned = prepare(bank, options), learned_of(bank)
    luminance = image.luminance
    found = {}
    for label in np.unique(labels[labels > 0]):
        mask = labels == label
        mixture = informative_mixture(image, mask & ~image.saturated, options.colour_gain)
        plane = luminance if mixture is None else np.asarray(image.planes @ mixture.astype(np.float32))
        found[int(label)] = measure_region(plane, image.saturated, mask, model, learned, options)
    return found


@dataclass(frozen=True, slots=True)
class Observation:
    """What a region's pixels say, before anything learned is applied."""

    windows: list[Window]
    pooled: Pooled
    soft: NDArray[np.float32]
    """The region with a soft edge, 1 inside; float32 (H, W)."""
    clear: NDArray[np.float32]
    """Distance (px) of its pixels from its edge; float32 (H, W)."""
    fit: SpectralFit
    pixels: float
    """Pixels' worth of information: sum of the squared tapers' weights."""
    covered: int
    """Pixels that lie in a window."""
    low_share: float
    """Share of the lowest frequencies that stand above the noise."""
    line_share: float
    """Part of the texture's power, relative to its smooth spectrum, in the strongest hundredth of the frequencies."""
    varied: float
    """Log-likelihood that a mixture of neighbouring blurs gains over the best single one."""
    parted: float
    """Log-likelihood that its parts lose by sharing one blur."""


def observe(plane: NDArray[np.float32], mask: Mask, model: DepthModel, options: EvidenceOptions) -> Observation | None:
    """Pool the region's windows and fit every blur; None where no window fits."""
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
    pooled = pooled_periodogram(plane, windows, model.kernel_lags.shape[1] // 2)
    expected = smeared_power(model.kernel_lags, pooled.taper_lags, size)
    fit = fit_spectra(pooled.power, pooled.trusted, expected, factor=options.factor)
    has_finer = size // 2 >= options.smallest_window_px
    finer = place_windows(mask, soft, size // 2, least_weight=options.least_weight) if has_finer else []
    pixels = sum(w.weight for w in windows) * size * size * 0.25  # half overlap both ways: each pixel counts fourfold
    return Observation(
        windows,
        pooled,
        soft,
        clear,
        fit,
        max(pixels, size * size * windows[0].weight),
        covered_pixels(mask, windows),
        _low_share(pooled.power, fit),
        _line_share(pooled.power, expected, fit),
        mixture_gain(pooled, expected, float(fit.log_likelihood.max()), model, options),
        parts_loss(plane, finer, model, options),
    )


def refine(seen: Observation, row: int, model: DepthModel, options: EvidenceOptions) -> Refined:
    """Likelihood about one row on a fine grid, each blur fitted to convergence.

    A large, rich region tells radii apart that differ by far less than the rows do, and few steps from row to row
    follow such a narrow ridge too slowly.
    """
    reach = _REFINED_STEPS * options.radius_step_px
    offsets = np.linspace(-reach, reach, 2 * _REFINED_STEPS * _REFINED_FINER + 1)
    radius = model.row_radius_px[row] + offsets
    if model.row_radius_px.min() >= 0:
        radius = radius[radius > 0]
        sigma = radius * np.sign(model.row_sigma_px[row])
    else:
        sigma = radius
    expected = smeared_power(model.lags_at(sigma), seen.pooled.taper_lags, seen.pooled.power.shape[0])
    start = seen.fit.coefficients[row], float(seen.fit.log_noise[row])
    fit = fit_spectra(seen.pooled.power, seen.pooled.trusted, expected,
                      factor=options.factor, start=start, steps=_REFINED_FISHER_STEPS)  # fmt: skip
    return Refined(radius, fit.log_likelihood)


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
    return float(ratio[-max(1, ratio.size // 100) :].sum() / ratio.sum())


def compare_sides(
    plane: NDArray[np.float32], seen: Observation, row: int, model: DepthModel, options: EvidenceOptions
) -> Comparison:
    """How sparse the far and the near side's restorations are at one row's radius."""
    radius = abs(float(model.row_radius_px[row]))
    size = int((model.kernel_lags.shape[1] + 1) // 2)
    psfs = []
    for sign in (1.0, -1.0):
        if sign * radius < model.farthest_px:
            psfs.append(model.psfs.psf_at(model.depth_mm(sign * radius), size))
        else:
            psfs.append(psfs[0][::-1, ::-1] if psfs else model.psfs.psf_at(model.depth_mm(-radius), size)[::-1, ::-1])
    good = [w for w in seen.windows if w.weight >= 0.6 * seen.windows[0].weight]
    chosen = good[:: max(1, len(good) // options.side_windows)][: options.side_windows]
    clue = compare(plane, seen.soft, chosen, psfs, seen.fit.texture(row))
    # next to focus the lens's own spot hides the aperture's shape, and with it the side
    shown = -np.expm1(-((radius / _SHAPELESS_PX) ** 2))
    # near the edge a restoration lacks what the blur carried out of the region
    trust = min(1.0, _EDGE_TRUST + clear_share(seen.clear, chosen, 2.0 * radius))
    return Comparison(clue.sparse, shown * trust * clue.favour)


def measure_region(
    plane: NDArray[np.float32],
    saturated: Mask,
    mask: Mask,
    model: DepthModel,
    learned: Learned,
    options: EvidenceOptions,
) -> DepthEstimate:
    """Depth of one region; see :func:`estimate_evidence`."""
    pixels = int(mask.sum())
    clipped = float((saturated & mask).sum()) / max(pixels, 1)
    if clipped > options.max_saturated:
        return _refused(model, "saturated", pixels, f"{clipped:.0%} of its pixels are saturated; expose less")
    usable = mask & ~saturated if clipped > 0.002 else mask
    seen = observe(plane, usable, model, options)
    if seen is None:
        return _refused(
            model, "no-texture", pixels, f"too small or too thin for a window of {options.smallest_window_px} px"
        )
    gain = float(seen.fit.log_likelihood.max()) - seen.fit.null
    if gain < options.least_evidence:
        return _refused(model, "no-texture", pixels, "no texture above the noise")
    if _is_strict_pattern(seen):
        reason = "only isolated spatial frequencies stand above the noise (a strict pattern): any blur explains them"
        return _refused(model, "no-texture", pixels, reason)
    return _conclude(plane, seen, model, learned, options)


def _is_strict_pattern(seen: Observation) -> bool:
    has_lines = seen.line_share > _LINES and seen.low_share < _LOW_SHARE_WITH_LINES
    return has_lines or seen.low_share < _LEAST_LOW_SHARE or seen.line_share > _MOST_LINE_SHARE


def _refused(model: DepthModel, status: Status, pixels: int, reason: str) -> DepthEstimate:
    nan = float("nan")
    flat = np.full(model.depths_mm.size, 1.0 / model.depths_mm.size)
    return DepthEstimate(nan, (nan, nan), 0.0, nan, nan, status, model.depths_mm, flat, nan, pixels, reason)


def _conclude(
    plane: NDArray[np.float32], seen: Observation, model: DepthModel, learned: Learned, options: EvidenceOptions
) -> DepthEstimate:
    likelihood = seen.fit.log_likelihood
    modes = find_modes(likelihood, model.row_radius_px)
    clues = [compare_sides(plane, seen, row, model, options) for row in modes]
    far, near = mode_scores(clues, np.asarray(model.sides_in_reach[modes].all(axis=1)), seen.pixels, learned)
    best = float(likelihood[modes].max())
    refined = [
        refine(seen, row, model, options)
        for row in modes
        if likelihood[row] > best - _REFINED_WITHIN and _narrow(likelihood, row)
    ]
    tempered = [Refined(part.radius_px, learned.temperature * part.log_likelihood) for part in refined]
    sigma, log_post = signed_posterior(learned.temperature * likelihood, modes, far, near, model, tempered)
    diagnostics = {
        "radius_px": model.row_radius_px,
        "log_likelihood": likelihood,
        "log_likelihood_noise": np.array([seen.fit.null]),
        "mode_radius_px": model.row_radius_px[modes],
        "mode_sparseness_far_near": np.stack([far, near]),
    }
    estimate = summarise(sigma, log_post, seen.covered, seen.line_share, model, learned, options, diagnostics)
    if seen.varied > options.varied_log_likelihood or seen.parted > options.parts_log_likelihood:
        return doubted(estimate, "its blur is not the same all over: a slanted surface, or several depths")
    estimate = unless_another_blur_fits(estimate, likelihood, modes, (far, near), model, options)
    return unless_beyond_reach(estimate, modes, side_odds(clues, learned), model)
