"""The demonstration: simulated rig, calibration, one photograph, its depths, compared with the truth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigs.simulated.scene import SceneTruth
from workbench.depth.regions import inner
from workbench.measurement import Measurement

INNER_SHARE = 0.5
"""Part of an object, far from its outline, over which its depth is read: its rim mixes two depths."""


@dataclass(frozen=True, slots=True)
class ObjectResult:
    """One object of the scene: what is true, and what was measured."""

    name: str
    true_mm: float
    measured_mm: float
    """Median of the depth map over the object's inner part; NaN where it has no depth."""
    status: str
    """Status of the region that covers most of that part."""
    region: int


def compare(measurement: Measurement, truth: SceneTruth) -> list[ObjectResult]:
    """Compare a measurement with the scene's truth, object by object, nearest first.

    An object's depth is the median over its inner part: the half of its pixels that lie farthest from its outline.
    """
    results = []
    for number, name in enumerate(truth.names, start=1):
        core = object_core(truth.object_id == number)
        if not core.any():
            continue
        depths = measurement.depth_map_mm[core]
        held = np.bincount(measurement.labels[core])
        held[0] = 0  # what is in no region
        region = int(held.argmax())
        known = depths[np.isfinite(depths)]
        # fewer than half of its pixels with a depth: the object as a whole has none
        measured = float(np.median(known)) if known.size * 2 > depths.size else float("nan")
        estimate = measurement.estimates.get(region)
        true_mm = float(np.median(truth.depth_mm[core]))
        results.append(ObjectResult(name, true_mm, measured, estimate.status if estimate else "-", region))
    return sorted(results, key=lambda result: result.true_mm)


def object_core(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Inner part of an object, bool (H, W): the half of its pixels that lie farthest from its outline."""
    if not mask.any():
        return mask
    distance = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    return inner(mask, float(np.quantile(distance[mask], 1.0 - INNER_SHARE)), frame_is_edge=True)
