"""Regions of the off-axis comparison: square, apart, and where they are said to be."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.field import region_place
from workbench.bench.field import OFF_AXIS, corner_regions


def test_regions_lie_towards_the_corners() -> None:
    labels = corner_regions((512, 768), 96)
    assert [int((labels == k).sum()) for k in range(1, 5)] == [96 * 96] * 4
    assert region_place(labels == 1) == pytest.approx((-OFF_AXIS, -OFF_AXIS), abs=0.01)
    assert region_place(labels == 4) == pytest.approx((OFF_AXIS, OFF_AXIS), abs=0.01)


def test_regions_too_large_for_their_place_stay_in_the_frame() -> None:
    labels = corner_regions((512, 768), 250)
    assert all(int((labels == k).sum()) == 250 * 250 for k in np.unique(labels)[1:])
