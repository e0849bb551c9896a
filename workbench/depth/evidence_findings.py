"""From a region's pixels to findings, from findings to its depth. In between its neighbours are heard.

What a region's outlines say of its depth hangs on what its neighbours say of theirs, so that all regions of a picture
are looked at before any is concluded. Findings hold what a conclusion needs and no picture but what was left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate, Status
from workbench.depth.evidence_agreement import agreement
from workbench.depth.evidence_colour import informative_mixture
from workbench.depth.evidence_doubt import (
    opposed_halves,
    uneven,
    unless_another_blur_fits,
    unless_beyond_reach,
    unless_few_lines,
    unless_halves_disagree,
    unless_negative,
    unless_on_either_side,
)
from workbench.depth.evidence_model import NATIVE_FINER, DepthModel, EvidenceOptions, Learned
from workbench.depth.evidence_observation import Observation, is_strict_pattern, observe
from workbench.depth.evidence_posterior import (
    Refined,
    find_modes,
    half_odds,
    least_error_px,
    log_prior,
    mode_scores,
    negative_cost,
    side_odds,
    signed_posterior,
    summarise,
)
from workbench.depth.evidence_side import Comparison
from workbench.depth.evidence_uniform import Part, Reading, parts_loss, read_parts, trust_in_one_blur
from workbench.depth.evidence_view import compare_sides, refine
from workbench.depth.occlusion import Candidates

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_REFINED_WITHIN, _NARROW = 30.0, 5.0
"""Modes within so much log-likelihood of the best, unweighted as in all that comes before the posterior, are looked at
more finely where it falls by so much to the next rows."""
_TRIED_PX = 0.3
"""How far from a mode its blur is tried on outlines, too: a region's radius and its outline's differ by some tenths."""
_POSSIBLE = 15.0
"""Nats that a mode may be behind and still become the answer: what four outlines can say, and the prior."""
_ABOUT_MODE_PX = 1.0
"""An answer lies within so much of its mode."""


@dataclass(frozen=True, slots=True)
class Findings:
    """All that a region's depth is concluded from.

    Attributes
    ----------
    model, learned
        The bank of its place, made ready, and weights.
    likelihood, null
        float64 (R,): log-likelihood of the spectrum for each of the model's rows, and that of noise alone.
    weight
        Power that the likelihood is raised to.
    modes, clues
        Rows of its local maxima, and how sparse their restorations are.
    far, near
        float64 (M,): log-likelihood that these add to the modes on each side of focus.
    refined
        The weighed likelihood on a fine grid about the modes that are narrow.
    native_rows
        First rows of the model that were judged by photosites.
    pixels, covered
        Superpixels' worth of information; superpixels that were looked at.
    line_share
        See :class:`~workbench.depth.evidence_observation.Observation`.
    varied
        Log-likelihood that a mixture of neighbouring blurs gains.
    is_mixed
        Whether that, or its parts, say that no single blur will do.
    parts, readings
        Its quarters by themselves, and their depths, where anybody will ask for them.
    left_out
        bool (H, W): what of the region was left out since it has another blur; None for nothing.
    """

    model: DepthModel
    learned: Learned
    likelihood: FloatArray
    null: float
    weight: float
    modes: list[int]
    clues: list[Comparison]
    far: FloatArray
    near: FloatArray
    refined: list[Refined]
    native_rows: int
    pixels: float
    covered: int
    line_share: float
    varied: float
    is_mixed: bool
    parts: list[Part]
    readings: list[Reading]
    left_out: Mask | None = None

    @property
    def mode_radius_px(self) -> FloatArray:
        """float64 (M,): radius of each mode, signed only where the sides are not mirror images."""
        return self.model.row_radius_px[self.modes]


def look_at(
    image: LinearImage,
    mask: Mask,
    model: DepthModel,
    learned: Learned,
    options: EvidenceOptions,
    *,
    outlines_found: bool = False,
) -> Findings | DepthEstimate:
    """Look at one region, bool (H, W): findings, or at once an estimate without a depth that says why.

    Of a region whose outline was found in the photograph and that has no single blur, what most of its windows deny is
    left out (:mod:`~workbench.depth.evidence_agreement`).
    """
    pixels = int(mask.sum())
    clipped = float((image.saturated & mask).sum()) / max(pixels, 1)
    if clipped > options.max_saturated:
        return _refused(model, "saturated", pixels, f"{clipped:.0%} of its pixels are saturated; expose less")
    mixture = informative_mixture(image, mask & ~image.saturated, options.colour_gain)
    plane = image.luminance if mixture is None else np.asarray(image.planes @ mixture.astype(np.float32))
    photosites = image if mixture is None else None  # a colour by itself is sampled too coarsely
    is_light = mixture is None or bool((mixture >= 0).all())
    usable = mask & ~image.saturated if clipped > 0.002 else mask
    seen = observe(plane, usable, model, options, photosites, is_light=is_light)
    if seen is None:
        return _refused(
            model, "no-texture", pixels, f"too small or too thin for a window of {options.smallest_window_px} px"
        )
    if float(seen.view.fit.log_likelihood.max()) - seen.view.fit.null < options.least_evidence:
        return _refused(model, "no-texture", pixels, "no texture above the noise")
    if is_strict_pattern(seen):
        reason = "only isolated spatial frequencies stand above the noise (a strict pattern): any blur explains them"
        return _refused(model, "no-texture", pixels, reason)
    findings = _findings(seen, model, learned, options)
    return _without_strangers(findings, seen, image, mask, options) if outlines_found else findings


def _without_strangers(
    whole: Findings, seen: Observation, image: LinearImage, mask: Mask, options: EvidenceOptions
) -> Findings:
    """Findings of what most windows of a found region agree on, where they explain why the whole has no single blur."""
    old = conclude(whole, options, outlines_found=True)
    old_px = abs(whole.model.psfs.radius_px(old.depth_mm))
    if _has_one_blur(whole, old_px, options) and not _halves_are_opposed(whole, old):
        return whole
    agreed = agreement(seen.view, mask, whole.model, options)
    rest = None if agreed is None else look_at(image, agreed.part, whole.model, whole.learned, options)
    if agreed is None or not isinstance(rest, Findings):
        return whole
    new = conclude(rest, options, outlines_found=True)
    has_their_blur = agreed.suits(abs(whole.model.psfs.radius_px(new.depth_mm)))
    if has_their_blur and (new.status == "ok" or not agreed.suits(old_px)):
        return replace(rest, left_out=mask & ~agreed.part)
    return whole


def _halves_are_opposed(findings: Findings, estimate: DepthEstimate) -> bool:
    odds = half_odds(findings.clues, findings.learned)
    return opposed_halves(estimate, findings.modes, odds, findings.model) is not None


def candidates_of(findings: Findings, options: EvidenceOptions) -> Candidates:
    """Depths that a region may have by itself: each mode's, on each side of focus that the bank reaches.

    In the order of the modes, the far sides first and then the near ones.
    """
    model, sides, sigma = findings.model, _in_reach(findings), _candidates_px(findings)
    weighed = np.tile(findings.weight * findings.likelihood[findings.modes], (2, 1))
    log = (weighed + np.stack([findings.far, findings.near]))[sides] + log_prior(model, sigma, options.prior_power)
    tried = np.minimum(np.add.outer(sigma, (0.0, -_TRIED_PX, _TRIED_PX)), model.farthest_px)
    depths = np.array([[model.depth_mm(float(value)) for value in row] for row in tried])
    is_one = _has_one_blur(findings, abs(float(sigma[log.argmax()])), options)
    return Candidates(depths[:, 0], sigma, log - logsumexp(log), depths, is_one=is_one)


def conclude(
    findings: Findings, options: EvidenceOptions, outlines: FloatArray | None = None, *, outlines_found: bool = False
) -> DepthEstimate:
    """Depth of a region.

    Parameters
    ----------
    findings
        See :func:`look_at`.
    options
        Of the method.
    outlines
        float64 (n,): what the region's outlines say of its candidates (:func:`candidates_of`), nats; None for nothing.
    outlines_found
        Whether the region's outline was found in the photograph.
    """
    sides, told = _in_reach(findings), np.zeros((2, len(findings.modes)))
    if outlines is not None:
        told[sides] = outlines
        told = np.where(sides, told, told[::-1])  # what is out of reach gains nothing by that
    far, near = findings.far + told[0], findings.near + told[1]
    estimate = _single_depth(findings, far, near, options, outlines_found=outlines_found)
    sigma = findings.model.psfs.radius_px(estimate.depth_mm)
    if outlines is not None:
        estimate = replace(estimate, outline_odds=_against_mirror(_candidates_px(findings), outlines, sigma))
    estimate = replace(estimate, left_out=findings.left_out)
    return estimate if _has_one_blur(findings, abs(sigma), options) else uneven(estimate, findings.readings)


def _candidates_px(findings: Findings) -> FloatArray:
    """Signed radii of the candidates, float64 (n,)."""
    return np.asarray((np.abs(findings.mode_radius_px) * np.array([[1.0], [-1.0]]))[_in_reach(findings)], np.float64)


def _against_mirror(candidates_px: FloatArray, outlines: FloatArray, sigma_px: float) -> float:
    """What outlines say for a signed radius against its mirror image, nats; 0 where that is no candidate."""
    own, mirror = (int(np.abs(candidates_px - value).argmin()) for value in (sigma_px, -sigma_px))
    if abs(candidates_px[mirror] + candidates_px[own]) > _ABOUT_MODE_PX:
        return 0.0
    return float(outlines[own] - outlines[mirror])


def _findings(seen: Observation, model: DepthModel, learned: Learned, options: EvidenceOptions) -> Findings:
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
    is_mixed = seen.varied > options.varied_log_likelihood
    is_mixed = is_mixed or parts_loss(seen.parts, model) > options.parts_log_likelihood
    score = weight * likelihood[modes] + np.maximum(far, near)
    possible = model.row_radius_px[modes][score > score.max() - _POSSIBLE]
    near_modes = np.abs(np.add.outer(possible, (-_ABOUT_MODE_PX, 0.0, _ABOUT_MODE_PX))).ravel()
    lost = max(parts_loss(seen.parts, model, float(radius)) for radius in near_modes)
    asked = is_mixed or lost > options.parts_log_likelihood
    return Findings(
        model=model,
        learned=learned,
        likelihood=likelihood,
        null=seen.view.fit.null,
        weight=weight,
        modes=modes,
        clues=clues,
        far=far,
        near=near,
        refined=[Refined(part.radius_px, weight * part.log_likelihood) for part in refined],
        native_rows=0 if seen.photosites is None else seen.photosites.fit.log_likelihood.size,
        pixels=seen.pixels,
        covered=seen.covered,
        line_share=seen.line_share,
        varied=seen.varied,
        is_mixed=is_mixed,
        parts=seen.parts,
        readings=read_parts(seen.parts, seen.view, model, learned, options) if asked else [],
    )


def _has_one_blur(findings: Findings, radius_px: float, options: EvidenceOptions) -> bool:
    """Whether neither a mixture of blurs nor its parts deny that all of a region has one blur, this one."""
    return (
        not findings.is_mixed and parts_loss(findings.parts, findings.model, radius_px) <= options.parts_log_likelihood
    )


def _narrow(likelihood: FloatArray, row: int) -> bool:
    """Whether the likelihood falls steeply enough from this row to the next ones for them to miss its shape."""
    beside = likelihood[max(row - 1, 0) : row + 2]
    return bool(likelihood[row] - beside.min() > _NARROW)


def _in_reach(findings: Findings) -> Mask:
    """bool (2, M): whether each mode may lie on the far side, and on the near side."""
    radius = findings.mode_radius_px
    sides = findings.model.sides_in_reach[findings.modes].T
    if findings.model.row_radius_px.min() < 0:  # rows have a side of their own
        return sides & (np.array([[1.0], [-1.0]]) * radius > 0)
    return sides


def _single_depth(
    findings: Findings, far: FloatArray, near: FloatArray, options: EvidenceOptions, *, outlines_found: bool
) -> DepthEstimate:
    """From findings to an answer; nothing else is doubted of a region that has no single depth."""
    model, learned, modes = findings.model, findings.learned, findings.modes
    weighed = findings.weight * findings.likelihood
    trust = trust_in_one_blur(findings.varied)
    sigma, log_post, trusted = signed_posterior(weighed, modes, far, near, model, options, findings.refined, trust)
    diagnostics = {
        "radius_px": model.row_radius_px,
        "log_likelihood": findings.likelihood,
        "log_likelihood_noise": np.array([findings.null]),
        "mode_radius_px": findings.mode_radius_px,
        "mode_sparseness_far_near": np.stack([findings.far, findings.near]),
    }
    best_px = float(sigma[log_post.argmax()])
    row = int(np.abs(np.abs(model.row_radius_px) - abs(best_px)).argmin())
    finer = NATIVE_FINER if row < findings.native_rows else 1
    se = least_error_px(best_px, findings.line_share, finer, model, learned, outlines_found=outlines_found)
    estimate = summarise(sigma, log_post, trusted, findings.covered, se, model, learned, options, diagnostics)
    if findings.is_mixed:
        return estimate
    estimate = unless_halves_disagree(estimate, modes, half_odds(findings.clues, learned), model)
    cost = negative_cost(findings.clues)
    estimate = unless_another_blur_fits(estimate, weighed, modes, (far, near), cost, model, options)
    estimate = unless_beyond_reach(estimate, modes, side_odds(findings.clues, learned), model)
    estimate = unless_on_either_side(unless_negative(estimate, modes, cost, model), model)
    return unless_few_lines(estimate, findings.line_share, model)


def _refused(model: DepthModel, status: Status, pixels: int, reason: str) -> DepthEstimate:
    nan = float("nan")
    flat = np.full(model.depths_mm.size, 1.0 / model.depths_mm.size)
    return DepthEstimate(nan, (nan, nan), 0.0, nan, nan, status, model.depths_mm, flat, nan, pixels, reason)
