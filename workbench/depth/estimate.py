"""What every depth estimator returns, whatever its method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Status = Literal["ok", "ambiguous", "no-texture", "saturated"]


@dataclass(frozen=True, slots=True)
class DepthEstimate:
    """Depth of one region.

    Attributes
    ----------
    depth_mm
        Best depth; NaN where the region says nothing.
    interval_mm
        95 % interval (lo, hi); (NaN, NaN) where none can be given.
    confidence
        Probability, 0 to 1, that the depth is on the right side of focus and within the interval.
    mirror_mm, mirror_probability
        Depth of the other side of focus with the same blur (NaN where there is none in reach), and its probability.
    status
        ok, ambiguous (a second depth is nearly as good), no-texture, saturated.
    depths_mm, score
        float64 (N,): the curve that decided; for a posterior, probability mass per grid depth (sums to 1);
        for ``sharpness``, the score normalised to a maximum of 1.
    second_mm
        Depth of the second best local maximum of the curve; NaN if it has one only.
    pixels
        Pixels that were used (inner part of the region).
    reason
        One sentence when status is not ok.
    outline_odds
        Log-odds (nats) that the region's outlines gave its side of focus, against the mirror depth; 0 where they say
        nothing.
    left_out
        bool (H, W): what of the region was found to have another blur and left out; None for nothing.
    diagnostics
        Further arrays for figures, by name.
    """

    depth_mm: float
    interval_mm: tuple[float, float]
    confidence: float
    mirror_mm: float
    mirror_probability: float
    status: Status
    depths_mm: NDArray[np.float64]
    score: NDArray[np.float64]
    second_mm: float
    pixels: int
    reason: str = ""
    outline_odds: float = 0.0
    left_out: NDArray[np.bool_] | None = None
    diagnostics: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)


def local_maxima(curve: NDArray[np.float64]) -> NDArray[np.intp]:
    """Indices of maxima, ends included; of equal neighbours the first."""
    padded = np.concatenate([[-np.inf], curve, [-np.inf]])
    return np.flatnonzero((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]))
