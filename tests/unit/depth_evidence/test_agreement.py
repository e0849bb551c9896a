"""Found regions that hold a strip of something else: what their windows agree on decides, the strip is left out."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.bank import Bank
from calibration.image import LinearImage
from tests.unit.depth_evidence.synthetic import as_image, leaves, photograph
from workbench.depth.evidence import EvidenceOptions, estimate_evidence, prepare
from workbench.depth.evidence_agreement import agreement
from workbench.depth.evidence_observation import observe
from workbench.depth.regions import whole

SIDE = 256


def with_strip(depth_mm: float, strip_mm: float, height: int, seed: int = 31) -> LinearImage:
    """A plane along whose lower edge lies a strip of another depth, all of the same greys."""
    plane, foot = (photograph(leaves(SIDE + 60, seed + i), z) for i, z in enumerate((depth_mm, strip_mm)))
    is_foot = np.arange(plane.shape[0]) >= plane.shape[0] - height
    return as_image(np.where(is_foot[:, np.newaxis, np.newaxis], foot.planes, plane.planes))


@pytest.mark.parametrize("depth_mm", [1050.0, 2900.0])
@pytest.mark.parametrize("height", [32, 48])
def test_strip_of_sharp_ground_does_not_decide_a_found_regions_depth(bank: Bank, depth_mm: float, height: int) -> None:
    image = with_strip(depth_mm, 1650.0, height)
    labels = whole(image.shape)
    given = estimate_evidence(image, bank, labels)[1]
    assert given.status == "ambiguous"  # of an operator's region nothing is left out
    assert given.left_out is None
    found = estimate_evidence(image, bank, labels, outlines_found=True)[1]
    assert found.status == "ok"
    assert found.depth_mm == pytest.approx(depth_mm, rel=0.02)
    assert found.left_out is not None
    strip = np.arange(image.shape[0]) >= image.shape[0] - height
    assert found.left_out[strip].mean() > 0.7
    assert found.left_out[~strip].mean() < 0.15


def test_nothing_is_left_out_of_one_surface(bank: Bank) -> None:
    image = photograph(leaves(SIDE + 60, 33), 2900.0)
    found = estimate_evidence(image, bank, whole(image.shape), outlines_found=True)[1]
    assert found.status == "ok"
    assert found.left_out is None


def test_blur_of_most_windows_is_the_regions(bank: Bank) -> None:
    options = EvidenceOptions()
    model = prepare(bank, options)
    image = with_strip(1050.0, 1650.0, 48)
    mask = np.ones(image.shape, bool)
    seen = observe(image.luminance, mask, model, options)
    assert seen is not None
    agreed = agreement(seen.view, mask, model, options)
    assert agreed is not None
    assert agreed.suits(abs(model.psfs.radius_px(1050.0)))
    assert not agreed.suits(abs(model.psfs.radius_px(1650.0)))


def test_region_of_two_halves_keeps_both_depths(bank: Bank) -> None:
    """No rest that hangs together is sure of one: the region stays ambiguous, its interval wide."""
    image = with_strip(1050.0, 2600.0, SIDE // 2)
    found = estimate_evidence(image, bank, whole(image.shape), outlines_found=True)[1]
    assert found.status == "ambiguous"
    assert found.interval_mm[0] < 1050.0 < 2600.0 < found.interval_mm[1]


def test_few_windows_are_no_majority(bank: Bank) -> None:
    options = EvidenceOptions()
    model = prepare(bank, options)
    image = with_strip(1050.0, 1650.0, 48)
    small = np.zeros(image.shape, bool)
    small[-140:, :140] = True
    seen = observe(image.luminance, small, model, options)
    assert seen is not None
    assert agreement(seen.view, small, model, options) is None
