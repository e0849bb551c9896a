"""From single outcomes (true depth, estimate) to the figures of an accuracy table."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Name = TypeVar("Name", bound=Hashable)

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
    on_grid: bool = True
    """Whether the truth is a depth of the 10 cm grid."""
    pixels: int = 0
    """Pixels of the region as it was given."""
    bound_mm: float = float("nan")
    """Least standard error that any estimator could reach that knows the texture's spectrum (Cramer-Rao)."""

    @property
    def answered(self) -> bool:
        """Whether the method gave a depth at all."""
        return math.isfinite(self.depth_mm) and self.status not in ("no-texture", "saturated")

    @property
    def marked(self) -> bool:
        """Whether the depth is called ambiguous."""
        return self.status == "ambiguous"

    @property
    def has_interval(self) -> bool:
        """Whether there is a depth with an interval about it."""
        return self.answered and all(math.isfinite(end) for end in self.interval_mm)

    @property
    def interval_holds(self) -> bool:
        """Whether the truth is inside the interval."""
        low, high = self.interval_mm
        return low <= self.true_mm <= high


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of one method over a set of outcomes. Rates are fractions, of the answered ones where not said otherwise.

    Attributes
    ----------
    count, answered
        Regions, and fraction of them with a depth.
    exact
        Rounded to the bank's 10 cm grid, the depth is the true one (off-grid truths: within 5 cm).
    unmarked
        Fraction of all regions with a depth that is not marked ambiguous.
    neighbour
        Rounded to the grid, the depth is the true one or next to it (within 15 cm).
    within_10cm
        Absolute error of at most 10 cm.
    gross, unmarked_gross
        Error over 40 cm; of these, not marked ambiguous. Fractions of all regions.
    side_flips
        Not exact, on the wrong side of focus, and nearer to the mirror depth than to the focal plane.
    rms_dioptres, rms_cm, median_cm
        Errors in 1/m and cm (gross errors included).
    fine_rms_cm
        RMS error of the answers that are neither gross nor on the wrong side.
    bound_cm
        RMS of the Cramer-Rao bounds of the same answers; NaN where the textures' spectra aren't known.
    coverage
        Fraction whose 95 % interval holds the truth; NaN without intervals.
    seconds
        Median time per region.
    """

    count: int
    answered: float
    unmarked: float
    exact: float
    neighbour: float
    within_10cm: float
    gross: float
    unmarked_gross: float
    side_flips: float
    rms_dioptres: float
    rms_cm: float
    median_cm: float
    fine_rms_cm: float
    bound_cm: float
    coverage: float
    seconds: float


def is_exact(true_mm: float, depth_mm: float) -> bool:
    """Nearest grid depth for a truth on the 10 cm grid; within half a step for one between."""
    return abs(depth_mm - true_mm) <= GRID_MM / 2


def is_flipped(true_mm: float, depth_mm: float, focus_mm: float) -> bool:
    """Not exact, on the other side of focus, and nearer (in 1/z) to the mirror of the truth than to the focal plane."""
    if (true_mm - focus_mm) * (depth_mm - focus_mm) >= 0 or is_exact(true_mm, depth_mm):
        return False
    mirror = 2 / focus_mm - 1 / true_mm  # in 1/z it is there even where it lies beyond infinity
    return abs(1 / depth_mm - mirror) < abs(1 / depth_mm - 1 / focus_mm)


def summarise(outcomes: Sequence[Outcome], focus_mm: float) -> Figures:
    """Figures of a set of outcomes; NaN where nothing was answered."""
    answered = [o for o in outcomes if o.answered]
    count = len(outcomes)
    errors = np.array([o.depth_mm - o.true_mm for o in answered])
    dioptres = np.array([1000 / o.depth_mm - 1000 / o.true_mm for o in answered])
    marked = np.array([o.marked for o in answered], np.bool_)
    flipped = np.array([is_flipped(o.true_mm, o.depth_mm, focus_mm) for o in answered], np.bool_)
    bounds = np.array([o.bound_mm for o in answered])
    gross = np.abs(errors) > GROSS_MM
    fine = ~gross & ~flipped
    return Figures(
        count=count,
        answered=len(answered) / max(count, 1),
        unmarked=float((~marked).sum()) / max(count, 1),
        exact=_mean([is_exact(o.true_mm, o.depth_mm) for o in answered]),
        neighbour=_mean(np.abs(errors) <= 1.5 * GRID_MM),
        within_10cm=_mean(np.abs(errors) <= NEAR_MM),
        gross=float(gross.sum()) / max(count, 1),
        unmarked_gross=float((gross & ~marked).sum()) / max(count, 1),
        side_flips=_mean(flipped),
        rms_dioptres=_rms(dioptres),
        rms_cm=_rms(errors) / 10,
        median_cm=_median(np.abs(errors)) / 10,
        fine_rms_cm=_rms(errors[fine]) / 10,
        bound_cm=_rms(bounds[fine & np.isfinite(bounds)]) / 10,
        coverage=_mean([o.interval_holds for o in answered if o.has_interval]),
        seconds=_median([o.seconds for o in outcomes]),
    )


def grouped(
    outcomes: Iterable[Outcome], key: Callable[[Outcome], tuple[str, ...]], focus_mm: float
) -> dict[tuple[str, ...], Figures]:
    """Figures per group, groups in order of first appearance."""
    return {name: summarise(group, focus_mm) for name, group in split(outcomes, key).items()}


def split(outcomes: Iterable[Outcome], key: Callable[[Outcome], Name]) -> dict[Name, list[Outcome]]:
    """Outcomes per group, groups in order of first appearance."""
    groups: dict[Name, list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(key(outcome), []).append(outcome)
    return groups


def _median(values: Sequence[float] | FloatArray) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _mean(values: Sequence[bool] | NDArray[np.bool_]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
