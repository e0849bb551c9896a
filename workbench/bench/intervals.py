"""Whether 95 % intervals hold the truth as often as they say, and how surely a number of regions tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from workbench.bench.scoring import Outcome


@dataclass(frozen=True, slots=True)
class Held:
    """How many of some intervals hold the truth.

    Attributes
    ----------
    count
        Intervals.
    share
        Fraction of them that holds the truth; NaN where there are none.
    between
        Fractions that so many may come from, with a confidence of 95 % (Clopper and Pearson 1934, Biometrika 26:404),
        as if all regions were independent. Regions of one frame share its noise and lens, so that it is rather wider.
    half_width_cm
        Median of half their widths.
    """

    count: int
    share: float
    between: tuple[float, float]
    half_width_cm: float


def held(outcomes: Sequence[Outcome], *, unmarked: bool = False) -> Held:
    """Count the intervals that hold the truth.

    Parameters
    ----------
    outcomes
        Those without a depth, or without a finite interval, are left out.
    unmarked
        Only those that are not called ambiguous.
    """
    chosen = [o for o in outcomes if o.has_interval and not (unmarked and o.status == "ambiguous")]
    if not chosen:
        return Held(0, float("nan"), (float("nan"), float("nan")), float("nan"))
    right = sum(o.interval_holds for o in chosen)
    found = stats.binomtest(right, len(chosen)).proportion_ci(0.95, "exact")
    widths = [o.interval_mm[1] - o.interval_mm[0] for o in chosen]
    return Held(len(chosen), right / len(chosen), (float(found.low), float(found.high)), float(np.median(widths)) / 20)
