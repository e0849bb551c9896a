"""Depth by evidence: the posterior over signed blur radius from a region's spectrum, its sparseness and its outlines.

1. The region is covered with tapered windows (:mod:`~workbench.depth.evidence_windows`); their periodograms are pooled
   (:mod:`~workbench.depth.evidence_periodogram`).
2. For every |radius| on a fine grid, texture and noise are fitted and the likelihood of the spectrum is taken
   (:mod:`~workbench.depth.evidence_spectrum`). It can't tell the side of focus.
   Next to focus the photosites themselves refine it (:mod:`~workbench.depth.evidence_view`).
3. At each of the likelihood's modes, restorations with both sides' PSFs are judged by how sparse they are, and by how
   much of their light is negative (:mod:`~workbench.depth.evidence_side`): the true blur, on its true side, gives the
   sparsest, and needs none.
4. Where regions meet, their outline has the blur of the nearer one (:mod:`~workbench.depth.occlusion`).
5. All join in one posterior over the signed radius, which is linear in 1/depth
   (:mod:`~workbench.depth.evidence_findings`). The likelihood is weighed by the texture's ridges and by what was
   learned from the bank, the posterior widened by errors that it doesn't know of. How wide it is about each mode
   follows what a mixture of blurs loses (:mod:`~workbench.depth.evidence_uniform`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.field import bank_at, region_place
from calibration.image import LinearImage
from calibration.pupil import psf_model
from workbench.depth.estimate import DepthEstimate
from workbench.depth.evidence_findings import Findings, candidates_of, conclude, look_at
from workbench.depth.evidence_model import DepthModel, EvidenceOptions, Learned, learned_of, prepare
from workbench.depth.occlusion import Place, outline_messages
from workbench.depth.outline_blur import EdgeSpreads
from workbench.depth.regions import without_parts
from workbench.processors import each

__all__ = ["EvidenceOptions", "estimate_evidence", "prepare"]


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
        PSFs and lens fit; of one over the field, each region and each outline is judged by those of its place.
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
    model_at, spreads_at = _by_place(bank, options)
    numbers = [int(label) for label in np.unique(labels[labels > 0])]

    def look(label: int) -> Findings | DepthEstimate:
        mask = labels == label
        return look_at(image, mask, *model_at(mask), options, outlines_found=outlines_found)

    looks = dict(zip(numbers, each(look, numbers, workers), strict=True))
    candidates = {
        label: candidates_of(seen, options) if isinstance(seen, Findings) else None for label, seen in looks.items()
    }
    nearest_mm, farthest_mm = float(bank.depths_mm[0]), float(bank.depths_mm[-1])
    kept = without_parts(labels, (seen.left_out for seen in looks.values() if isinstance(seen, Findings)))
    told = outline_messages(
        image, kept, candidates, spreads_at, (nearest_mm, farthest_mm), options.prior_power, workers
    )
    return {
        label: conclude(seen, options, told.get(label), outlines_found=outlines_found)
        if isinstance(seen, Findings)
        else seen
        for label, seen in looks.items()
    }


def _by_place(
    bank: Bank, options: EvidenceOptions
) -> tuple[
    Callable[[NDArray[np.bool_]], tuple[DepthModel, Learned]],
    Callable[[Place], EdgeSpreads],
]:
    """The bank made ready for a region, and edge spreads for a place; everywhere the same for a central bank."""
    learned = learned_of(bank)
    if len(bank.field_yx) == 1:
        model = prepare(bank, options)
        spreads = EdgeSpreads(model.psfs)
        return lambda _: (model, learned), lambda _: spreads
    return (
        lambda mask: (prepare(bank_at(bank, region_place(mask)), options), learned),
        lambda place: EdgeSpreads(psf_model(bank_at(bank, place))),
    )
