"""From single outcomes (true depth, estimate) to the figures of an accuracy table."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.optics import mirror_depth

GROSS_MM = 400.0
NEAR_MM = 100.0
GRID_MM = 100.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """One region measured by one method."""

    method: str
    texture: str
    size: str
    """Region size or shape, as text: ``128``, ``irregular`` ..."""
    light: str
    true_mm: float
    depth_mm: float
    interval_mm: tuple[float, float]
    confidence: float
    status: str
    seconds: float

    @property
    def answered(self) -> bool:
        """Whether the method gave a depth at all."""
        return math.isfinite(self.depth_mm) and self.status not in ("no-texture", "saturated")


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of one method over a set of outcomes. Rates are fractions, of the answered ones where not said otherwise.

    Attributes
    ----------
    count, answered
        Regions, and fraction of them with a depth.
    exact
        Rounded to the bank's 10 cm grid, the depth is the true one (off-grid truths: within 5 cm).
    within_10cm
        Absolute error of at most 10 cm.
    gross, unmarked_gross
        Error over 40 cm; of these, not marked ambiguous. Fractions of all regions.
    side_flips
        On the wrong side of focus, and nearer to the mirror depth than to the truth.
    rms_dioptres, rms_cm, median_cm
        Errors in 1/m and cm (gross errors included).
    coverage
        Fraction whose 95 % interval holds the truth; NaN without intervals.
    seconds
        Median time per region.
    """

    count: int
    answered: float
    exact: float
    within_10cm: float
    gross: float
    unmarked_gross: float
    side_flips: float
    rms_dioptres: float
    rms_cm: float
    median_cm: float
    coverage: float
    seconds: float


def is_exact(true_mm: float, depth_mm: float) -> bool:
    """Nearest grid depth for a truth on the 10 cm grid; within half a step for one between."""
    return abs(depth_mm - true_mm) <= GRID_MM / 2


def is_flipped(true_mm: float, depth_mm: float, focus_mm: float) -> bool:
    """On the other side of focus, and nearer (in 1/z) to the mirror of the truth than to the truth itself."""
    if (true_mm - focus_mm) * (depth_mm - focus_mm) >= 0:
        return False
    mirror = mirror_depth(true_mm, focus_mm=focus_mm)
    return abs(1 / depth_mm - 1 / mirror) < abs(1 / depth_mm - 1 / true_mm)


def summarise(outcomes: Sequence[Outcome], focus_mm: float) -> Figures:
    """Figures of a set of outcomes; NaN where nothing was answered."""
    answered = [o for o in outcomes if o.answered]
    count = len(outcomes)
    if not answered:
        nan = float("nan")
        return Figures(count, 0.0, nan, nan, 0.0, 0.0, nan, nan, nan, nan, nan, _median(o.seconds for o in outcomes))
    errors = np.array([o.depth_mm - o.true_mm for o in answered])
    dioptres = np.array([1000 / o.depth_mm - 1000 / o.true_mm for o in answered])
    gross = np.abs(errors) > GROSS_MM
    marked = np.array([o.status == "ambiguous" for o in answered])
    with_interval = [o for o in answered if all(math.isfinite(bound) for bound in o.interval_mm)]
    covered = [o.interval_mm[0] <= o.true_mm <= o.interval_mm[1] for o in with_interval]
    return Figures(
        count=count,
        answered=len(answered) / count,
        exact=float(np.mean([is_exact(o.true_mm, o.depth_mm) for o in answered])),
        within_10cm=float(np.mean(np.abs(errors) <= NEAR_MM)),
        gross=float(gross.sum() / count),
        unmarked_gross=float((gross & ~marked).sum() / count),
        side_flips=float(np.mean([is_flipped(o.true_mm, o.depth_mm, focus_mm) for o in answered])),
        rms_dioptres=float(np.sqrt(np.mean(dioptres**2))),
        rms_cm=float(np.sqrt(np.mean(errors**2)) / 10),
        median_cm=float(np.median(np.abs(errors)) / 10),
        coverage=float(np.mean(covered)) if covered else float("nan"),
        seconds=_median(o.seconds for o in outcomes),
    )


def grouped(
    outcomes: Iterable[Outcome], key: Callable[[Outcome], tuple[str, ...]], focus_mm: float
) -> dict[tuple[str, ...], Figures]:
    """Figures per group, groups in order of first appearance."""
    groups: dict[tuple[str, ...], list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(key(outcome), []).append(outcome)
    return {name: summarise(group, focus_mm) for name, group in groups.items()}


def _median(values: Iterable[float]) -> float:
    listed = list(values)
    return float(np.median(listed)) if listed else float("nan")
