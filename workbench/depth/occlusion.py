"""Which of two regions lies in front, told by the blur of the outline between them; and with it their sides of focus.

An outline belongs to the nearer surface and is blurred like that one. So a hypothesis about the depths of two regions
that meet says how their outline must look: like the nearer one's blur, on the nearer one's side of focus. A wall whose
grain tells no side can't lie before the things that visibly stand in front of it, and a coat's own outline shows the
aperture the right way up or upside down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calibration.image import LinearImage
from workbench.depth.outline_blur import EdgeSpreads, blur_log_likelihood
from workbench.depth.outlines import Outline, find_outlines, read_profiles
from workbench.processors import each

FloatArray = NDArray[np.float64]
Place = tuple[float, float]

_CHANCE = 0.03
"""Probability that an outline has nothing to do with the two regions' depths: paint, a shadow, a third thing."""
_ANY_DEPTH_STEPS = 20
"""Depths, evenly spread in 1/z, that stand for a region whose depth nobody knows."""
_LEAST_LIKELY = 1e-3
"""What is less likely is not asked for, nor looked for."""
_SAME_PX = 2.0
"""Blurs that differ by less are one to a region that is sure of itself."""
_REACH, _REACH_PX = 1.2, 7
"""Profiles reach so many radii of the largest likely blur, and so many pixels more."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """Depths that a region may have.

    Attributes
    ----------
    depth_mm, radius_px, log_probability
        float64 (n,) each: the depths, their signed blur radii, and probabilities that sum to 1.
    tried_mm
        float64 (n, k): depths at which the blur of each is tried on an outline, since its radius is not quite known.
    is_one
        Whether the region has one depth. What its neighbours hear of one that hasn't is that it may be anywhere.
    """

    depth_mm: FloatArray
    radius_px: FloatArray
    log_probability: FloatArray
    tried_mm: FloatArray
    is_one: bool = True

    @property
    def is_open(self) -> bool:
        """Whether another blur than the likeliest is possible."""
        others = np.abs(self.radius_px - self.radius_px[self.log_probability.argmax()]) > _SAME_PX
        return bool(np.exp(self.log_probability[others]).sum() > _LEAST_LIKELY)

    @property
    def largest_blur_px(self) -> float:
        """|radius| of the largest blur that is likely."""
        return float(np.abs(self.radius_px[self.log_probability > np.log(_LEAST_LIKELY)]).max())


def outline_messages(
    image: LinearImage,
    labels: NDArray[np.int32],
    regions: Mapping[int, Candidates | None],
    spreads_at: Callable[[Place], EdgeSpreads],
    planes_mm: tuple[float, float],
    prior_power: float,
    workers: int = 1,
) -> dict[int, FloatArray]:
    """What the outlines of each region say of its candidates.

    For regions a and b with candidates ``i`` and ``j``, an outline's log-likelihood ``E`` of being blurred as from a
    depth, and ``p_b`` what b says of itself,

        m_a(i) = log sum_j p_b(j) exp E(min(z_i, z_j)),

    summed over the regions b that meet a. ``E`` is never lower than a small chance of its maximum.

    Parameters
    ----------
    image
        Developed like the bank.
    labels
        int32 (H, W): region of each pixel, 0 = none.
    regions
        Candidates by label; None for regions of unknown depth, whose outlines say what they can all the same.
    spreads_at
        Edge spreads for a place in the frame, (y, x) as fractions of the half frame.
    planes_mm
        The bank's nearest and farthest depth.
    prior_power
        What depths a region may have of which nothing is known: as this power of z per step of 1/z.
    workers
        Threads.

    Returns
    -------
    dict
        Float64 (n,) by label, the best candidate's 0, for regions with candidates that meet others.
    """
    anywhere = 1.0 / np.linspace(1.0 / planes_mm[0], 1.0 / planes_mm[1], _ANY_DEPTH_STEPS)
    log_prior = prior_power * np.log(anywhere)
    log_probability = log_prior - logsumexp(log_prior)
    unknown = Candidates(anywhere, np.zeros(anywhere.size), log_probability, anywhere[:, np.newaxis], is_one=False)

    def of_outline(outline: Outline) -> list[tuple[int, FloatArray]]:
        meeting = [regions[outline.first] or unknown, regions[outline.second] or unknown]
        known = [region for region in meeting if region is not unknown]
        if not any(region.is_open for region in known):
            return []
        reach = int(np.ceil(_REACH * max(region.largest_blur_px for region in known))) + _REACH_PX
        profiles = read_profiles(image, labels, outline, reach)
        if profiles is None:
            return []
        spreads = spreads_at(_place(outline, labels.shape))
        tried = [*(region.tried_mm for region in meeting), unknown.tried_mm]
        depths = np.concatenate([depths.ravel() for depths in tried])
        fits = blur_log_likelihood(profiles, [spreads.at(float(z)) for z in depths])
        fits = np.logaddexp(fits + np.log1p(-_CHANCE), np.log(_CHANCE))
        parts = np.split(fits, np.cumsum([depths.size for depths in tried])[:-1])
        *own, anyhow = (part.reshape(depths.shape).max(axis=1) for part, depths in zip(parts, tried, strict=True))
        told = zip(meeting, own, strict=True)
        heard = [(region, fit) if region.is_one else (unknown, anyhow) for region, fit in told]
        return [
            (outline.first, _message(meeting[0], own[0], *heard[1])),
            (outline.second, _message(meeting[1], own[1], *heard[0])),
        ]

    told: dict[int, FloatArray] = {}
    for messages in each(of_outline, find_outlines(labels), workers):
        for label, message in messages:
            if regions[label] is not None:
                told[label] = told.get(label, np.zeros(message.size)) + message
    return {label: message - message.max() for label, message in told.items()}


def _message(to: Candidates, fit: FloatArray, by: Candidates, fit_by: FloatArray) -> FloatArray:
    """What an outline says to a region, from how well it fits its own candidates and those of the other region."""
    in_front = to.depth_mm[:, np.newaxis] <= by.depth_mm
    joint = np.where(in_front, fit[:, np.newaxis], fit_by) + by.log_probability
    return np.asarray(logsumexp(joint, axis=1))


def _place(outline: Outline, shape: tuple[int, ...]) -> Place:
    """Middle of an outline as fractions of the half frame."""
    y, x = (2.0 * (outline.yx.mean(axis=0) + 0.5) / shape - 1.0).tolist()
    return y, x
