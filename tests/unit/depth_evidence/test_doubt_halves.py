"""Two halves of one outline at mirror depths: one blur all over, and two sides of focus."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.bank import Bank
from calibration.image import LinearImage
from tests.unit.depth_evidence.synthetic import FOCUS_MM, as_image, leaves, photograph
from workbench.depth.evidence import estimate_evidence
from workbench.depth.regions import whole

SIDE = 256 + 40


def mirror_of(depth_mm: float) -> float:
    return 1.0 / (2.0 / FOCUS_MM - 1.0 / depth_mm)


def joined(first: LinearImage, second: LinearImage, *, along: int) -> LinearImage:
    """The first one in the upper (along 0) or left half (1), the other in the rest; they fade over into each other."""
    place = np.indices(first.shape)[along] - first.shape[along] / 2
    share = np.clip(0.5 - place / 24.0, 0.0, 1.0)[..., np.newaxis]
    return as_image((share * first.planes + (1.0 - share) * second.planes).astype(np.float32))


def at_mirror_depths(first_mm: float, *, along: int, drawn: int) -> LinearImage:
    """One half at a depth, the other at its mirror depth."""
    depths = first_mm, mirror_of(first_mm)
    first, second = (photograph(leaves(SIDE, drawn + i), z) for i, z in enumerate(depths))
    return joined(first, second, along=along)


@pytest.mark.parametrize("drawn", [16, 40])
@pytest.mark.parametrize("along", [0, 1])
@pytest.mark.parametrize("first_mm", [2400.0, mirror_of(2400.0), mirror_of(3000.0)])
def test_halves_at_mirror_depths_are_told(bank: Bank, first_mm: float, along: int, drawn: int) -> None:
    image = at_mirror_depths(first_mm, along=along, drawn=drawn)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "ambiguous"
    low_mm, high_mm = found.interval_mm
    near_mm, far_mm = sorted((first_mm, mirror_of(first_mm)))
    assert low_mm < 1.02 * near_mm
    assert high_mm > 0.98 * far_mm


@pytest.mark.parametrize(("along", "first", "second"), [(0, "upper", "lower"), (1, "left", "right")])
def test_reason_names_each_half_and_its_depth(bank: Bank, along: int, first: str, second: str) -> None:
    image = at_mirror_depths(2400.0, along=along, drawn=16)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert f"its {first} half speaks for 240 cm, its {second} half for 120 cm" in found.reason


@pytest.mark.parametrize("depth_mm", [2400.0, 1200.0])
def test_halves_of_one_depth_agree(bank: Bank, depth_mm: float) -> None:
    image = joined(*(photograph(leaves(SIDE, drawn), depth_mm) for drawn in (16, 17)), along=1)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "ok"
    assert found.depth_mm == pytest.approx(depth_mm, rel=0.02)
