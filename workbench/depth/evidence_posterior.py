"""From scores of radii to depth, interval, mirror and status."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.special import expit

from workbench.depth.estimate import DepthEstimate, Status
from workbench.depth.evidence_kernels import drawn_finer
from workbench.depth.evidence_model import NATIVE_FINER, DepthModel, EvidenceOptions, Learned
from workbench.depth.evidence_side import Comparison

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FINER, _BETWEEN = 16, 8
"""The posterior's grid is finer than the likelihood's by this factor; its interval ends at such parts of a step."""
_SOFTNESS_PX = {1: (0.10, 2.7), NATIVE_FINER: (0.07, 1.8)}
"""Close to focus a small blur and a texture that is itself a little soft or crisp look alike: standard error of the
radius at focus, and the one over which it falls to 1/e (as a Gaussian), by how fine the pixels are. Fitted to textures
rendered by the simulated rig, looked at on ray-traced ones."""
_LINES_PX, _LINES_FROM = 0.25, 0.1
"""A pattern's few spectral lines have heights of their own, which pass for blur: standard error of the radius per share
of the texture's power that they hold beyond so much."""
_FOUND_PX = 0.07
"""Standard error of the radius by what neighbours leave in a region whose outline was found, not drawn."""
_MISFIT_PX, _MISFIT_SHARE, _FITS = 1.2, 0.2, 0.025
"""Where PSFs don't quite follow one picture of the pupil, off axis with coma say: standard error of the radius, and of
each px of it, for PSFs that are wrong altogether. Of their relative error counts what is beyond so much in quadrature,
which noise and sampling leave. Fitted to 72 regions off axis of the simulated rig."""
_SAMPLED_PX = 0.06
"""Standard error of the radius by aliases, where PSFs are interpolated as they were sampled
(:mod:`workbench.depth.evidence_kernels`)."""

_NEGATIVE_SHARE, _NEGATIVE_NATS, _MOST_NEGATIVE_NATS = 0.02, 1.6, 6.0
"""Of the true blurs of 1023 regions, simulated and ray-traced, one in a hundred leaves more than 5 % of the contrast to
negative light, of the blurs too large by 3 pixels or more two in three do."""

_OPEN_SIDE = 3.0
"""A side of focus stays open if it is less likely by less than so many nats."""


def mode_scores(
    clues: Sequence[Comparison], mirrored: Mask, pixels: float, learned: Learned
) -> tuple[FloatArray, FloatArray]:
    """Log-likelihood that restorations add to each of M modes, on the far and on the near side; float64 (M,) each.

    Parameters
    ----------
    clues
        How sparse, and how negative, each mode's restorations are, the far side's first.
    mirrored
        bool (M,): whether both sides are within the bank's reach. Twice the side's probability counts there: no gain
        and no loss where the two restorations don't differ. What the mode's own restorations say for its radius is the
        same for both sides then, that of the likelier one.
    pixels
        Pixels' worth of information.
    learned
        Weights.
    """
    scale = float((pixels / 16384.0) ** learned.size_power)
    own = np.stack([-scale * clue.sparse @ np.array(learned.mode_weights) for clue in clues]) - negative_cost(clues)
    odds = side_odds(clues, learned)
    shared = own[:, 0] + expit(-odds) * (own[:, 1] - own[:, 0])
    far, near = (np.where(mirrored, np.log(2.0 * expit(sign * odds) + 1e-9) + shared, own[:, side])
                 for side, sign in enumerate((1.0, -1.0)))  # fmt: skip
    return far, near


def negative_cost(clues: Sequence[Comparison]) -> FloatArray:
    """How many nats less likely light that would have to be negative makes each mode, far and near; float64 (M, 2)."""
    share = np.stack([clue.negative for clue in clues])
    return np.minimum(_NEGATIVE_NATS * np.log1p(share / _NEGATIVE_SHARE), _MOST_NEGATIVE_NATS)


def side_odds(clues: Sequence[Comparison], learned: Learned) -> FloatArray:
    """Log-odds of the far side against the near one at each mode, float64 (M,)."""
    return np.asarray(np.stack([clue.favour for clue in clues]) @ learned.favour_weights)


def half_odds(clues: Sequence[Comparison], learned: Learned) -> FloatArray:
    """The same by the halves of the region by themselves, float64 (M, 2, 2)."""
    return np.asarray(np.stack([clue.halves for clue in clues]) @ learned.favour_weights)


def open_sides(
    radius_px: float, likelihood_odds: float, in_reach: Mask, model: DepthModel, options: EvidenceOptions
) -> list[float]:
    """Signed radii of a blur on the sides of focus that stay open, the likelier one first.

    Parameters
    ----------
    radius_px
        Its |radius|.
    likelihood_odds
        Log-odds of the far side against the near one, as sparseness tells. The prior adds to them.
    in_reach
        bool (2,): whether the bank reaches the far and the near one.
    model, options
        The bank, made ready, and the prior's power.
    """
    prior = log_prior(model, np.array([radius_px, -radius_px]), options.prior_power)
    odds = likelihood_odds + float(prior[0] - prior[1])
    sides = [(odds, radius_px, bool(in_reach[0])), (0.0, -radius_px, bool(in_reach[1]))]
    reached = sorted(((score, sigma) for score, sigma, reachable in sides if reachable), reverse=True)
    return [sigma for score, sigma in reached if score > reached[0][0] - _OPEN_SIDE]


def find_modes(
    log_likelihood: FloatArray, radius_px: FloatArray, *, depth: float = 70.0, apart_px: float = 1.5, most: int = 5
) -> list[int]:
    """Rows of the highest local maxima, at least ``apart_px`` (and a twentieth of the radius) apart, best first."""
    padded = np.concatenate([[-np.inf], log_likelihood, [-np.inf]])
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    found: list[int] = []
    for peak in peaks[np.argsort(-log_likelihood[peaks])]:
        if log_likelihood[peak] < log_likelihood.max() - depth or len(found) == most:
            break
        gap = max(apart_px, 0.05 * abs(radius_px[peak]))
        if all(abs(radius_px[peak] - radius_px[other]) >= gap for other in found):
            found.append(int(peak))
    return found


def peak_of(log_likelihood: FloatArray, radius_px: FloatArray, row: int) -> tuple[float, float]:
    """Radius and curvature of the parabola through a maximum; NaN at the grid's end."""
    if not 0 < row < radius_px.size - 1:
        return float("nan"), 0.0
    step = float(abs(radius_px[row] - radius_px[row - 1]))
    before, top, after = (float(v) for v in log_likelihood[row - 1 : row + 2])
    bend = before - 2 * top + after
    if bend >= 0:
        return float("nan"), 0.0
    shift = 0.5 * (before - after) / bend * float(np.sign(radius_px[row + 1] - radius_px[row]))
    return float(radius_px[row] + shift * step), -bend / step**2


@dataclass(frozen=True, slots=True)
class Refined:
    """Log-likelihood about a mode on a fine grid of ascending radii (signed as the rows are); float64 (n,) each."""

    radius_px: FloatArray
    log_likelihood: FloatArray


def signed_posterior(
    log_rows: FloatArray,
    modes: list[int],
    far: FloatArray,
    near: FloatArray,
    model: DepthModel,
    options: EvidenceOptions,
    refined: Sequence[Refined] = (),
    about_modes: float = 1.0,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unnormalised log posteriors on a finer grid of signed radii, from the rows' and the modes' log-likelihoods.

    Between the modes the nearest one's sparseness holds. Where the likelihood was refined that replaces the rows'.

    Returns
    -------
    sigma, log_post, log_trusted
        float64 (G,) each. In the last one what the likelihood falls by from a mode to all that is nearest to it is
        multiplied by ``about_modes``; the modes keep their heights.
    """
    nearest = np.abs(np.arange(log_rows.size)[:, np.newaxis] - np.array(modes)).argmin(axis=1)
    sigma = model.sigma_px
    side = np.where(sigma > 0, far[nearest][model.row_of], near[nearest][model.row_of])
    fine = np.linspace(sigma[0], sigma[-1], (sigma.size - 1) * _FINER + 1)
    closest = np.clip(np.rint((fine - sigma[0]) / (sigma[1] - sigma[0])).astype(int), 0, sigma.size - 1)
    log_likelihood = CubicSpline(sigma, log_rows[model.row_of])(fine)
    place = np.abs(fine) if model.row_radius_px.min() >= 0 else fine
    for part in refined:
        within = (place >= part.radius_px[0]) & (place <= part.radius_px[-1])
        log_likelihood[within] = CubicSpline(part.radius_px, part.log_likelihood)(place[within])
    mode = nearest[model.row_of][closest]
    top = np.full(len(modes), -np.inf)
    np.maximum.at(top, mode, log_likelihood)
    trusted = top[mode] + about_modes * (log_likelihood - top[mode])
    others = side[closest] + log_prior(model, fine, options.prior_power)
    return fine, log_likelihood + others, trusted + others


def log_prior(model: DepthModel, sigma_px: FloatArray, power: float) -> FloatArray:
    """Log density of signed radii before anything is seen, but for a constant; float64 like ``sigma_px``.

    The radius is linear in 1/z. Where log z is evenly spread, as for a scale of which nothing is known (Jeffreys 1946),
    the radius is as likely as d(log z) / d(1/z) = z, the power 1; evenly spread depths make it z^2, evenly spread radii
    1. Beyond the bank's planes the density stays what it is there.
    """
    return power * np.log(model.depth_within_mm(sigma_px))


def least_error_px(
    sigma_px: float,
    line_share: float,
    finer: int,
    model: DepthModel,
    learned: Learned,
    *,
    outlines_found: bool,
) -> float:
    """Standard error (px) of a signed radius by what the likelihood doesn't know of.

    Parameters
    ----------
    sigma_px
        The radius.
    line_share
        Part of the texture's power in the strongest hundredth of the frequencies.
    finer
        Pixels a superpixel is wide, in the view that the radius was read from.
    model, learned
        The bank, made ready, with its PSFs' and its lens fit's errors; the error that no evidence undercuts.
    outlines_found
        Whether the region's outline was found in the photograph.
    """
    at_focus, reach = _SOFTNESS_PX[finer]
    soft = at_focus * float(np.exp(-((sigma_px / reach) ** 2)))
    lens = float(np.interp(sigma_px, model.sigma_px, model.sigma_se_px))
    lines = _LINES_PX * max(0.0, line_share - _LINES_FROM)
    beyond = float(np.sqrt(max(model.psf_error**2 - _FITS**2, 0.0)))
    misfit = beyond * (_MISFIT_PX + _MISFIT_SHARE * abs(sigma_px))
    sampled = _SAMPLED_PX * (drawn_finer(model.psfs)[1] == 1)
    return float(np.linalg.norm([learned.floor_px, soft, lens, lines, misfit, sampled, _FOUND_PX * outlines_found]))


def summarise(
    sigma: FloatArray,
    log_post: FloatArray,
    log_trusted: FloatArray,
    pixels: int,
    se: float,
    model: DepthModel,
    learned: Learned,
    options: EvidenceOptions,
    diagnostics: dict[str, FloatArray],
) -> DepthEstimate:
    """Depth, interval, mirror and status from a log posterior over signed radii.

    Parameters
    ----------
    sigma
        float64 (G,): signed radii (px), in even steps.
    log_post, log_trusted
        float64 (G,): the posterior's logarithm but for a constant, as blurs far apart are compared, and as far as it is
        trusted about its modes. Depth and status come from the first, the interval from the second.
    pixels
        That were looked at.
    se
        Standard error (px) that the posterior doesn't know of.
    model, learned, options
        The bank, made ready; the probability that all is wrong; when an answer is ambiguous.
    diagnostics
        Kept with the estimate.
    """
    step = float(sigma[1] - sigma[0])
    density, trusted = (_density(log, step, se, learned.outlier) for log in (log_post, log_trusted))
    modes = _split(density, step)
    masses = [float(density[a:b].sum()) for a, b in modes]
    order = np.argsort(masses)[::-1]
    first, last = modes[int(order[0])]
    share = density[first:last] / density[first:last].sum()
    centre = min(float((share * sigma[first:last]).sum()), model.farthest_px)
    depth = model.depth_mm(centre)
    low, high = _hull(trusted, 0.95)
    # the mean of a mode that is steep on one side only may lie beyond what is trusted
    ends = (min(sigma[0] + step * low, centre), max(min(sigma[0] + step * high, model.farthest_px), centre))
    interval = sorted(model.depth_mm(float(end)) for end in ends)
    mirror, mirror_probability = float("nan"), 0.0
    if abs(centre) > 2 * se and sigma[0] <= -centre <= sigma[-1]:
        mirror = model.depth_mm(min(-centre, model.farthest_px))
        around = np.abs(sigma + centre) < max(6 * se, 1.0)
        around &= np.sign(sigma) == -np.sign(centre)
        mirror_probability = float(density[around].sum())
    second = float("nan")
    if len(modes) > 1 and masses[int(order[1])] > 1e-4:
        start, stop = modes[int(order[1])]
        second = model.depth_mm(min(float(sigma[start + int(density[start:stop].argmax())]), model.farthest_px))
    mass = masses[int(order[0])]
    # what holds 95 % may reach beyond this mode though it holds as much
    joined = low <= first - 1 or high >= last
    status: Status = "ok" if mass >= options.ambiguous_below and not joined else "ambiguous"
    reason = ""
    if status == "ambiguous":
        other = mirror if mirror_probability > 0.5 * (1.0 - mass) else second
        named = f"most likely {other / 10:.0f} cm" if np.isfinite(other) else "none of them likely by itself"
        reason = f"{1 - mass:.0%} probability of another depth, {named}"
    coarse = np.zeros(model.sigma_px.size)
    np.add.at(coarse, np.clip(np.rint((sigma - sigma[0]) / (step * _FINER)).astype(int), 0, coarse.size - 1), trusted)
    return DepthEstimate(
        depth_mm=depth,
        interval_mm=(float(interval[0]), float(interval[1])),
        confidence=mass * 0.95,
        mirror_mm=mirror,
        mirror_probability=mirror_probability,
        status=status,
        depths_mm=model.depths_mm,
        score=coarse / coarse.sum(),
        second_mm=second,
        pixels=pixels,
        reason=reason,
        diagnostics=diagnostics,
    )


def _density(log_post: FloatArray, step: float, se: float, outlier: float) -> FloatArray:
    """Probability per step, convolved with a Gaussian error, and a share of it spread evenly."""
    density = np.exp(log_post - log_post.max())
    reach = int(np.ceil(4 * se / step))
    blur = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / se) ** 2)
    density = np.convolve(density, blur)[reach : reach + density.size]
    return np.asarray((1.0 - outlier) * density / density.sum() + outlier / density.size)


def _split(density: FloatArray, step: float, gap_px: float = 1.0) -> list[tuple[int, int]]:
    """Cut the density at its deep valleys into modes [first, last)."""
    floor = max(1e-3 * float(density.max()), 2.0 * float(np.median(density)))
    above = np.flatnonzero(density > min(floor, 0.5 * float(density.max())))
    breaks = np.flatnonzero(np.diff(above) > gap_px / step)
    starts, ends = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [above.size - 1]])
    return [(int(above[s]), int(above[e]) + 1) for s, e in zip(starts, ends, strict=True)]


def _hull(density: FloatArray, mass: float) -> tuple[float, float]:
    """Ends of the highest-density set of this mass, in steps of the grid: narrow peaks end between two of them."""
    steps = np.arange((density.size - 1) * _BETWEEN + 1) / _BETWEEN
    fine = np.interp(steps, np.arange(density.size), density)
    falling = np.sort(fine)[::-1]
    level = falling[min(int(np.searchsorted(np.cumsum(falling), mass * fine.sum())), fine.size - 1)]
    held = steps[fine >= level]
    return float(held[0]), float(held[-1])
