"""Whether 95 % intervals hold the truth as often as they say, and how surely so many regions tell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from workbench.bench.scoring import Outcome, split

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Coverage:
    """How many of some intervals hold the truth.

    Attributes
    ----------
    count
        Intervals.
    coverage
        Fraction of them that holds the truth; NaN where there are none.
    confidence_interval
        95 % confidence interval of that fraction (:func:`confidence_interval`).
    half_width_cm
        Median of half their widths.
    """

    count: int
    coverage: float
    confidence_interval: tuple[float, float]
    half_width_cm: float


def coverage_of(outcomes: Sequence[Outcome]) -> Coverage:
    """Count the intervals that hold the truth; outcomes without an interval are left out."""
    chosen = [o for o in outcomes if o.has_interval]
    if not chosen:
        return Coverage(0, math.nan, (math.nan, math.nan), math.nan)
    # regions of one texture at one depth in one light are cut from one frame, or are one thing measured twice
    things = split(chosen, lambda o: (o.texture, o.true_mm, o.light)).values()
    right = np.array([float(sum(o.interval_holds for o in thing)) for thing in things])
    total = np.array([float(len(thing)) for thing in things])
    widths = [o.interval_mm[1] - o.interval_mm[0] for o in chosen]
    return Coverage(
        len(chosen), float(right.sum() / total.sum()), confidence_interval(right, total), float(np.median(widths)) / 20
    )


def confidence_interval(right: FloatArray, total: FloatArray) -> tuple[float, float]:
    """95 % confidence interval of a fraction that was counted in clusters.

    That of a binomial (Clopper and Pearson 1934, Biometrika 26:404) of as many independent trials as scatter like the
    clusters, at most as many as there are (Korn and Graubard 1998, Survey Methodology 24:193).

    Parameters
    ----------
    right, total
        float64 (C,): successes and trials of each cluster.
    """
    clusters, trials, fraction = total.size, float(total.sum()), float(right.sum() / total.sum())
    if clusters > 1 and 0.0 < fraction < 1.0:
        variance = clusters / (clusters - 1) * float(((right - fraction * total) ** 2).sum()) / trials**2
        design_effect = variance / (fraction * (1.0 - fraction) / (trials - 1))
        few = float(stats.t.ppf(0.975, trials - 1) / stats.t.ppf(0.975, clusters - 1)) ** 2
        trials *= few / max(design_effect, few)
    held, missed = trials * fraction, trials * (1.0 - fraction)
    low = float(stats.beta.ppf(0.025, held, missed + 1.0)) if held > 0 else 0.0
    high = float(stats.beta.ppf(0.975, held + 1.0, missed)) if missed > 0 else 1.0
    return low, high
