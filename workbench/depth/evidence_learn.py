"""Learn how much each clue counts, from the bank alone.

Generated textures are blurred by the bank's own PSF model at random depths, twice as fine as the pixels where that can
be drawn, with random light and noise, and measured.
The weights are those under which the true depth is most probable among the candidates (a conditional logit, McFadden
1974), held near the defaults by a Gaussian prior; the radius's least standard error is set so that 95 % of the
intervals hold. Blurring with the bank's own PSFs says nothing about accuracy, which is measured elsewhere; it shows
what this aperture at these radii can tell apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import logsumexp

from calibration.bank import Bank
from workbench.depth.evidence_kernels import drawn_finer
from workbench.depth.evidence_model import LEARNED, DepthModel, EvidenceOptions, Learned, prepare
from workbench.depth.evidence_observation import observe
from workbench.depth.evidence_posterior import find_modes, least_error_px, mode_scores, peak_of
from workbench.depth.evidence_side import FAMILIES, SPARSENESS, Comparison
from workbench.depth.evidence_textures import blurred_texture
from workbench.depth.evidence_uniform import trust_in_one_blur
from workbench.depth.evidence_view import compare_sides, view_of

FloatArray = NDArray[np.float64]

SAMPLES = 120
_SIDES = (96, 128, 128, 192)
_SHRINK = 0.004
"""Weight of the prior that holds the parameters near their defaults, relative to one sample's log-likelihood."""
_LEAST = np.log(0.002)
"""A sample that is lost anyway doesn't pull the weights."""


@dataclass(frozen=True, slots=True)
class _Sample:
    """Candidates of one generated image."""

    likelihood: FloatArray
    """(M,) spectral log-likelihood of each mode, weighed by the texture's ridges."""
    clues: list[Comparison]
    """Of each mode."""
    possible: NDArray[np.bool_]
    """(M, 2): sides (far, near) within the bank's reach."""
    pixels: float
    true: NDArray[np.bool_]
    """(M, 2): candidates (far, near) at the true radius and side."""
    error_px: float
    """Of the spectral likelihood's peak next to the true radius; NaN where there is none."""
    curvature: float
    """Of the log-likelihood there as far as it is trusted, per px^2."""
    known_px: float
    """Standard error of the radius that is known without a floor: :func:`least_error_px`."""


def learn(bank: Bank, seed: int = 0, samples: int = SAMPLES) -> dict[str, NDArray[np.float64]]:
    """Learn the estimator's weights for a bank.

    Parameters
    ----------
    bank
        Its PSFs are all that is used.
    seed
        The same bank and seed give the same numbers.
    samples
        Generated images; each takes about a quarter of a second.

    Returns
    -------
    dict
        Arrays to store among the bank's extras.
    """
    options = EvidenceOptions()
    model = prepare(bank, options)
    drawn = []
    for index in range(samples):
        sample = _draw(bank, model, options, np.random.default_rng([seed, index]))
        if sample is not None:
            drawn.append(sample)
    return {LEARNED: fit_weights(drawn).as_array()}


def fit_weights(samples: list[_Sample]) -> Learned:
    """Most probable weights given the samples and the defaults."""
    start = Learned()
    units = np.array([np.log(2.0), *[0.2] * len(SPARSENESS), *[10.0] * len(FAMILIES)])

    def unpack(p: FloatArray) -> Learned:
        change = p * units
        sides = 1 + len(SPARSENESS)
        return replace(
            start,
            spectral_weight=float(start.spectral_weight * np.exp(change[0])),
            side_weights=tuple((np.array(start.side_weights) + change[1:sides]).tolist()),
            mode_weights=tuple((np.array(start.mode_weights) + change[sides:]).tolist()),
        )

    def loss(p: FloatArray) -> float:
        learned = unpack(p)
        lost = 0.0
        for sample in samples:
            if sample.true.any():
                scores = candidate_scores(sample, learned)
                right = float(logsumexp(scores[sample.true]) - logsumexp(scores))
                lost -= max(right, _LEAST)
        return lost / max(len(samples), 1) + _SHRINK * float(p @ p)

    best = unpack(minimize(loss, np.zeros(units.size), method="L-BFGS-B", options={"maxiter": 40}).x)
    return replace(best, floor_px=_floor(samples, best.spectral_weight, start.floor_px))


def candidate_scores(sample: _Sample, learned: Learned) -> FloatArray:
    """Log-likelihood of each candidate, float64 (M, 2) for far and near; -inf where the bank doesn't reach."""
    far, near = mode_scores(sample.clues, np.asarray(sample.possible.all(axis=1)), sample.pixels, learned)
    scores = learned.spectral_weight * sample.likelihood[:, np.newaxis] + np.stack([far, near], axis=1)
    return np.where(sample.possible, scores, -np.inf)


def _floor(samples: list[_Sample], weight: float, least: float) -> float:
    """Standard error to add in quadrature so that 95 % of the errors are within 1.96 standard errors."""
    usable = [s for s in samples if np.isfinite(s.error_px) and s.curvature > 0 and abs(s.error_px) < 1.0]
    if len(usable) < 20:
        return least
    error = np.array([abs(s.error_px) for s in usable])
    variance = np.array([1.0 / (weight * s.curvature) + s.known_px**2 for s in usable])
    needed = np.sqrt(np.maximum((error / 1.96) ** 2 - variance, 0.0))
    return float(np.clip(np.quantile(needed, 0.95), least, 0.5))


def _draw(bank: Bank, model: DepthModel, options: EvidenceOptions, generator: np.random.Generator) -> _Sample | None:
    side = int(generator.choice(_SIDES))
    low, high = 1.0 / bank.depths_mm[-1], 1.0 / bank.depths_mm[0]
    focus = np.clip(1.0 / bank.lens.focus_mm, low, high)
    # half of the depths where a mirror is in reach, if there are any
    reach = min(high - focus, focus - low)
    span = (focus - reach, focus + reach) if generator.random() < 0.5 and reach > 0.05 * (high - low) else (low, high)
    depth_mm = float(1.0 / generator.uniform(*span))
    plane = _photograph(side, model, depth_mm, generator)
    seen = observe(plane, np.ones(plane.shape, np.bool_), model, options, as_one=True)
    if seen is None or seen.likelihood.max() - seen.view.fit.null < options.least_evidence:
        return None
    likelihood, radius = seen.likelihood, np.abs(model.row_radius_px)
    sigma = model.psfs.radius_px(depth_mm)
    tolerance = max(0.8, 0.04 * abs(sigma))
    # the peak next to the truth is always a candidate, found by its height or not
    close = np.flatnonzero(np.abs(radius - abs(sigma)) < tolerance)
    modes = find_modes(likelihood, model.row_radius_px)
    peak = int(close[likelihood[close].argmax()])
    if not any(abs(radius[m] - abs(sigma)) < tolerance for m in modes):
        modes.append(peak)
    clues = compare_sides(seen.view, seen.photosites, modes, model, options)
    at_radius = np.abs(radius[modes] - abs(sigma)) < tolerance
    both = abs(sigma) < tolerance  # at focus either side is right
    true = np.stack([at_radius & (both or sigma > 0), at_radius & (both or sigma < 0)], axis=1)
    possible = model.sides_in_reach[modes]
    weighed = seen.view.fit.likelihood_weight * likelihood
    error, curvature = peak_of(weighed, radius, peak)
    curvature *= trust_in_one_blur(seen.varied)
    finer = view_of(seen.view, seen.photosites, peak).finer
    known = least_error_px(sigma, seen.line_share, finer, model, Learned(floor_px=0.0), outlines_found=False)
    return _Sample(weighed[modes], clues, possible, seen.pixels, true & possible, error - abs(sigma), curvature, known)


def _photograph(side: int, model: DepthModel, depth_mm: float, generator: np.random.Generator) -> NDArray[np.float32]:
    """A generated texture at a depth, with shot and white noise of random strength; float32 (side, side)."""
    psfs, finer = drawn_finer(model.psfs)
    image = blurred_texture(side, psfs.psf_at(depth_mm), generator, finer)
    shot, white = np.exp(generator.uniform(np.log([1e-3, 3e-4]), np.log([6e-3, 4e-3])))
    deviation = np.hypot(white, shot * np.sqrt(np.maximum(image, 0.0)))
    return np.asarray(image + deviation * generator.standard_normal(image.shape), np.float32)
