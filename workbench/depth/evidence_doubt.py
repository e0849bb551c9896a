"""What makes an answer ambiguous besides its posterior, and what its interval then holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from workbench.depth.estimate import DepthEstimate
from workbench.depth.evidence_model import DepthModel, EvidenceOptions
from workbench.depth.evidence_posterior import open_sides
from workbench.depth.evidence_uniform import Reading

FloatArray = NDArray[np.float64]

_FEW_LINES, _NEXT_TO_FOCUS_PX, _ALL_FIT_PX = 0.62, 4.0, 7.5
"""Where a hundredth of the frequencies holds so much of the texture's power, and the answer is within so many pixels of
focus, all blurs up to the last figure fit. Of 236 woven patterns 15 are answered, 11 of them unmarked before this, and
7 of those missed their intervals; bricks next to focus have up to 0.6. Of 47 woven ones of three other seeds four with
blurs of 4.6 to 7.1 px read 2.7 or 0."""
_SAME_PX, _APART_PX = 1.0, 2.0
_EITHER_SIDE_PX = 2.0
"""An interval that reaches farther than this to both sides of focus names neither."""
_RIVAL_PX = 1.0
"""Standard errors or not, a rival blur is known to a pixel."""
_OPPOSED = 2.5
"""Log-odds that each of two halves has for its own side, at least, to name two depths instead of one. Of 143 unmarked
regions of one depth two pass it, of 21 unmarked ones of two mirror depths all."""
_IMPOSSIBLE = 4.0
"""Nats that negative light costs a blur which is not believed: 22 % of the contrast's energy."""
_OUT_OF_REACH = 3.0
"""Log-odds against a depth that the bank doesn't reach, before its sides are compared: scenes are mostly within it."""


def doubted(estimate: DepthEstimate, reason: str) -> DepthEstimate:
    """The same estimate, called ambiguous."""
    return replace(estimate, status="ambiguous", confidence=0.5 * estimate.confidence, reason=reason)


def uneven(estimate: DepthEstimate, parts: Sequence[Reading]) -> DepthEstimate:
    """Call an estimate ambiguous because its region has no single depth; its interval then holds those of its parts.

    Parameters
    ----------
    estimate
        Of the whole region as if it had one depth: often that of its sharpest edge.
    parts
        What pieces of it read, as far as they say anything.
    """
    told = [f"{depth_mm / 10:.0f}" for depth_mm in sorted(part.depth_mm for part in parts)]
    low, high = zip(estimate.interval_mm, *(part.interval_mm for part in parts), strict=True)
    reason = "its blur is not the same all over: a slanted surface, or several depths"
    if told:
        alike = len(told) > 1 and len(set(told)) == 1
        read = f"each of its parts reads {told[0]}" if alike else f"its parts read {', '.join(told)}"
        reason += f" ({read} cm)"
    return doubted(replace(estimate, interval_mm=(min(low), max(high))), reason)


def unless_another_blur_fits(
    estimate: DepthEstimate,
    likelihood: FloatArray,
    modes: Sequence[int],
    sides: tuple[FloatArray, FloatArray],
    cost: FloatArray,
    model: DepthModel,
    options: EvidenceOptions,
) -> DepthEstimate:
    """Call an estimate ambiguous where the spectrum alone hardly prefers its blur to quite another possible one.

    Parameters
    ----------
    estimate
        What the posterior says.
    likelihood
        float64 (D,): log-likelihood of the spectrum for each of the model's rows, as the posterior weighs it.
    modes, sides
        Rows of its local maxima, and what restorations add to each on the far and on the near side.
    cost
        float64 (M, 2): by how much negative light makes each of them, far and near, less likely. A rival counts for
        less by what it needs more than the answer does.
    model, options
        Rows' radii; what counts as close.

    Returns
    -------
    DepthEstimate
        The same, or ambiguous with an interval that holds the rivals on the sides that stay open.
    """
    if estimate.status != "ok":
        return estimate
    radius = np.abs(model.row_radius_px)
    chosen = abs(model.psfs.radius_px(estimate.depth_mm))
    near = np.abs(radius - chosen) <= _SAME_PX
    own = float(likelihood[near].max()) if near.any() else float(likelihood.max())
    needed = _cost_of(estimate, modes, cost, model)
    rivals: list[float] = []
    for index, row in enumerate(modes):
        low, high = sorted((float(radius[row]) + 0.5, chosen + 0.5))
        apart = high / low > options.close_ratio and high - low > _APART_PX
        more = max(float(cost[index][model.sides_in_reach[row]].min()) - needed, 0.0)
        if apart and likelihood[row] - more > own - options.close_log_likelihood:
            odds = float(sides[0][index] - sides[1][index])
            rivals += open_sides(float(radius[row]), odds, model.sides_in_reach[row], model, options)
    if not rivals:
        return estimate
    wider = _holding(estimate, np.add.outer(rivals, (-_RIVAL_PX, _RIVAL_PX)), model)
    return doubted(wider, f"its spectrum fits the blur of {model.depth_mm(rivals[0]) / 10:.0f} cm nearly as well")


def unless_halves_disagree(
    estimate: DepthEstimate, modes: Sequence[int], far_odds: FloatArray, model: DepthModel
) -> DepthEstimate:
    """Call an estimate ambiguous where two halves of its region speak for opposite sides of focus; say so if it is.

    Parameters
    ----------
    estimate
        What the posterior says.
    modes
        Rows of the likelihood's local maxima.
    far_odds
        float64 (M, 2, 2): at each, the log-odds of the far side against the near one that the upper and the lower, the
        left and the right half of the region have by themselves.
    model
        The bank, made ready.

    Returns
    -------
    DepthEstimate
        The same, or ambiguous with an interval that holds the mirror depth, too.
    """
    low_mm, high_mm = estimate.interval_mm
    settled = estimate.status == "ok"
    pair = opposed_halves(estimate, modes, far_odds, model)
    if pair is None or not (settled or low_mm <= estimate.mirror_mm <= high_mm):
        return estimate
    odds = far_odds[_nearest_mode(estimate, modes, model)]
    names = (("upper", "lower"), ("left", "right"))[pair]
    near, far = sorted((estimate.depth_mm / 10, estimate.mirror_mm / 10))
    where = (near, far) if odds[pair][0] < 0 else (far, near)
    reason = (
        f"its {names[0]} half speaks for {where[0]:.0f} cm, its {names[1]} half for {where[1]:.0f} cm, "
        "which have the same blur on both sides of focus: it may hold two depths"
    )
    if not settled:
        return replace(estimate, reason=reason)
    return doubted(replace(estimate, interval_mm=_with_mirrored(estimate, model)), reason)


def opposed_halves(
    estimate: DepthEstimate, modes: Sequence[int], far_odds: FloatArray, model: DepthModel
) -> int | None:
    """Which pair of halves speaks for opposite sides of focus: 0 the upper and the lower one, 1 the left and the right.

    None if neither does, or no mirror depth is in reach. For the parameters see :func:`unless_halves_disagree`.
    """
    if not np.isfinite(estimate.mirror_mm):
        return None
    odds = far_odds[_nearest_mode(estimate, modes, model)]
    strength = np.minimum(odds.max(axis=1), -odds.min(axis=1))
    pair = int(strength.argmax())
    return pair if strength[pair] >= _OPPOSED else None


def unless_negative(
    estimate: DepthEstimate, modes: Sequence[int], cost: FloatArray, model: DepthModel
) -> DepthEstimate:
    """Call an estimate ambiguous whose blur would need negative light: a smaller one is likelier than any that fits.

    Parameters
    ----------
    estimate
        What the posterior says.
    modes
        Rows of the likelihood's local maxima.
    cost
        float64 (M, 2): nats that negative light costs each of them, on the far and on the near side.
    model
        The bank, made ready.

    Returns
    -------
    DepthEstimate
        The same, or ambiguous with an interval that holds every smaller blur on both sides of focus within the bank's
        planes. What was ambiguous before keeps its reason.
    """
    if _cost_of(estimate, modes, cost, model) < _IMPOSSIBLE:
        return estimate
    radius = abs(model.psfs.radius_px(estimate.depth_mm))
    held = _holding(estimate, np.array([-radius, radius]), model)
    if estimate.status != "ok":
        return held
    return doubted(held, "its light would have to be negative: its blur is smaller, on its other side, or not one")


def unless_beyond_reach(
    estimate: DepthEstimate, modes: Sequence[int], far_odds: FloatArray, model: DepthModel
) -> DepthEstimate:
    """Call an estimate ambiguous where its sides speak for the mirror depth, and the bank doesn't reach that far.

    Parameters
    ----------
    estimate
        What the posterior over the bank's own depths says.
    modes, far_odds
        Rows of the likelihood's local maxima; at each, the log-odds of the far side against the near one.
    model
        Its reach.

    Returns
    -------
    DepthEstimate
        The same, or ambiguous with the depth out of reach as its mirror, and inside its interval.
    """
    if not np.isfinite(estimate.depth_mm):
        return estimate
    sigma = model.psfs.radius_px(estimate.depth_mm)
    if model.sigma_px[0] <= -sigma <= model.sigma_px[-1] or -sigma >= model.farthest_px:
        return estimate
    against = float(far_odds[_nearest_mode(estimate, modes, model)]) * (1.0 if sigma < 0 else -1.0) - _OUT_OF_REACH
    if against < 0:
        return estimate
    mirror = model.depth_mm(-sigma)
    held = _with_mirrored(estimate, model)
    where = "last" if sigma < 0 else "first"
    end = float(model.depth_within_mm(model.planes_px[1 if sigma < 0 else 0])) / 10
    wider = replace(estimate, mirror_mm=mirror, mirror_probability=float(expit(against)), interval_mm=held)
    reason = (
        f"may as well be at {mirror / 10:.0f} cm, beyond the bank's {where} plane ({end:.0f} cm): "
        "its sharp edges fit that side of focus better; use a bank that reaches so far"
    )
    return doubted(wider, reason)


def _cost_of(estimate: DepthEstimate, modes: Sequence[int], cost: FloatArray, model: DepthModel) -> float:
    """What the estimate's own mode costs on its side, of float64 (M, 2) for far and near."""
    side = 0 if model.psfs.radius_px(estimate.depth_mm) > 0 else 1
    return float(cost[_nearest_mode(estimate, modes, model), side])


def _nearest_mode(estimate: DepthEstimate, modes: Sequence[int], model: DepthModel) -> int:
    """Index of the mode whose radius is nearest to the estimate's."""
    radius = abs(model.psfs.radius_px(estimate.depth_mm))
    return int(np.abs(np.abs(model.row_radius_px[list(modes)]) - radius).argmin())


def _holding(estimate: DepthEstimate, sigma_px: FloatArray, model: DepthModel) -> DepthEstimate:
    """The same estimate, its interval wide enough for these signed radii, as far as the bank's planes reach."""
    low_mm, high_mm = estimate.interval_mm
    depths_mm = model.depth_within_mm(sigma_px)
    return replace(estimate, interval_mm=(min(low_mm, float(depths_mm.min())), max(high_mm, float(depths_mm.max()))))


def _with_mirrored(estimate: DepthEstimate, model: DepthModel) -> tuple[float, float]:
    """An interval that holds the estimate's and its mirror image beyond focus."""
    mirrored = [model.depth_mm(min(-model.psfs.radius_px(end), model.farthest_px)) for end in estimate.interval_mm]
    return min(*estimate.interval_mm, *mirrored), max(*estimate.interval_mm, *mirrored)


def unless_on_either_side(estimate: DepthEstimate, model: DepthModel) -> DepthEstimate:
    """Call an estimate ambiguous whose interval reaches far to both sides of focus: it names neither."""
    nearer, farther = (model.psfs.radius_px(end) for end in estimate.interval_mm)
    if estimate.status != "ok" or nearer > -_EITHER_SIDE_PX or farther < _EITHER_SIDE_PX:
        return estimate
    return doubted(estimate, "its side of focus is open: every blur within its interval fits")


def unless_few_lines(estimate: DepthEstimate, line_share: float, model: DepthModel) -> DepthEstimate:
    """Call an estimate next to focus ambiguous where a few spectral lines hold the texture; its interval then holds
    every small blur, on both sides.

    Parameters
    ----------
    estimate
        What the posterior says.
    line_share
        Part of the texture's power in the strongest hundredth of the frequencies.
    model
        The bank, made ready.
    """
    radius = model.psfs.radius_px(estimate.depth_mm)
    if line_share <= _FEW_LINES or abs(radius) > _NEXT_TO_FOCUS_PX:
        return estimate
    wider = _holding(estimate, np.array([-_ALL_FIT_PX, _ALL_FIT_PX]), model)
    if estimate.status != "ok":
        return wider
    return doubted(wider, "a few spatial frequencies hold its texture, and every small blur explains them")
