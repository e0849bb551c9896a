"""From a cost per depth of the bank to an estimate, for methods that take the depth of the least."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.optics import mirror_depth
from workbench.depth.estimate import DepthEstimate, Status, local_maxima
from workbench.depth.screening import Region

FloatArray = NDArray[np.float64]


def estimate_from_cost(
    bank: Bank,
    region: Region,
    cost: FloatArray,
    ambiguity: float,
    max_saturated: float,
    diagnostics: Mapping[str, FloatArray],
) -> DepthEstimate:
    """Depth of the least cost.

    Parameters
    ----------
    bank, region
        What was measured.
    cost
        float64 (D,), positive.
    ambiguity
        A second minimum that costs less than this fraction more makes the region ambiguous.
    max_saturated
        Larger fractions of saturated pixels are reported.
    diagnostics
        Further arrays.
    """
    score = float(cost.min()) / np.maximum(cost, 1e-300)
    best = int(np.argmax(score))
    depths = bank.depths_mm
    peaks = [int(index) for index in local_maxima(score) if index != best]
    second = max(peaks, key=lambda index: score[index], default=None)
    depth = float(depths[best])
    mirror = mirror_depth(depth, focus_mm=bank.lens.focus_mm)
    status: Status = "ok"
    reason = ""
    if second is not None and 1.0 - score[second] < ambiguity:
        status, reason = "ambiguous", f"{depths[second] / 10:.1f} cm costs within {100 * ambiguity:g} % of the best"
    if region.saturated > max_saturated:
        status, reason = "saturated", f"{100 * region.saturated:.0f} % of the inner pixels are saturated"
    nan = float("nan")
    return DepthEstimate(
        depth_mm=depth,
        interval_mm=(nan, nan),
        confidence=nan,
        mirror_mm=mirror if depths[0] <= mirror <= depths[-1] else nan,
        mirror_probability=nan,
        status=status,
        depths_mm=depths,
        score=score,
        second_mm=nan if second is None else float(depths[second]),
        pixels=region.pixels,
        reason=reason,
        diagnostics={"cost": cost, **diagnostics},
    )
