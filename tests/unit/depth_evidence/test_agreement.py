"""Found regions that hold a strip of something else: what their windows agree on decides, the strip is left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from calibration.bank import Bank
from calibration.image import LinearImage
from tests.unit.depth_evidence.synthetic import as_image, leaves, photograph
from workbench.depth.evidence import EvidenceOptions, estimate_evidence, prepare
from workbench.depth.evidence_agreement import agreement, most_agreed
from workbench.depth.evidence_observation import observe
from workbench.depth.evidence_uniform import same_blur
from workbench.depth.regions import whole

SIDE = 256


def grain(side: int, seed: int) -> NDArray[np.float64]:
    """Gaussian texture, which has no side of focus."""
    rough = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((side, side)), 1.0)
    return np.asarray(0.4 + 0.1 * rough / rough.std())


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


def test_nothing_is_left_out_of_one_surface_whose_side_is_open(bank: Bank) -> None:
    image = photograph(grain(SIDE + 60, 33), 2900.0)
    found = estimate_evidence(image, bank, whole(image.shape), outlines_found=True)[1]
    assert found.status == "ambiguous"
    assert found.left_out is None


def test_highlights_do_not_cut_a_region(bank: Bank) -> None:
    image = with_strip(1050.0, 1650.0, 48)
    saturated = np.zeros(image.shape, bool)
    saturated[100:103] = True
    image = replace(image, saturated=saturated)
    found = estimate_evidence(image, bank, whole(image.shape), outlines_found=True)[1]
    assert found.depth_mm == pytest.approx(1050.0, rel=0.02)
    assert found.left_out is not None
    assert found.left_out[:150].mean() < 0.1


def test_blank_windows_are_no_majority(bank: Bank) -> None:
    """Of what shows a texture half is at one depth, half at another: neither is a stranger."""
    image = with_strip(2100.0, 1250.0, 60)
    planes = image.planes.copy()
    planes[: image.shape[0] - 120] = 0.4 + 0.003 * np.random.default_rng(5).standard_normal(
        planes[: image.shape[0] - 120].shape
    )
    found = estimate_evidence(as_image(planes), bank, whole(image.shape), outlines_found=True)[1]
    assert found.status != "ok" or found.interval_mm[0] < 1250.0 < 2100.0 < found.interval_mm[1]


def test_what_is_more_than_a_strip_is_no_stranger(bank: Bank) -> None:
    image = with_strip(1050.0, 1650.0, 110)
    found = estimate_evidence(image, bank, whole(image.shape), outlines_found=True)[1]
    assert found.status == "ambiguous"
    assert found.left_out is None


def test_what_strangers_cut_off_is_left_out_with_them(bank: Bank) -> None:
    plane, foot = (photograph(leaves(SIDE + 60, seed), z) for seed, z in ((31, 1050.0), (32, 1650.0)))
    row = np.arange(plane.shape[0])
    across = (row >= 212) & (row < 240)
    image = as_image(np.where(across[:, np.newaxis, np.newaxis], foot.planes, plane.planes))
    found = estimate_evidence(image, bank, whole(image.shape), outlines_found=True)[1]
    assert found.depth_mm == pytest.approx(1050.0, rel=0.02)
    assert found.left_out is not None
    assert found.left_out[-15:].mean() > 0.9


def test_windows_vote_with_bounded_voices() -> None:
    radius = np.arange(0.0, 20.0)
    calm, loud = 3.9 * np.minimum(np.abs(radius - 12.0) / 6.0, 1.0), 100.0 * np.abs(radius - 3.0)
    best, denies = most_agreed(np.stack([calm] * 7 + [loud] * 3), np.ones(10), radius)
    assert same_blur(np.array([12.0]), radius[best])[0]
    assert denies.tolist() == [False] * 7 + [True] * 3


def test_windows_that_claim_focus_hardly_count() -> None:
    radius = np.arange(0.0, 20.0)
    blurred, sharp = np.abs(radius - 12.0), radius.copy()
    best, denies = most_agreed(np.stack([blurred] * 4 + [sharp] * 6), np.ones(10), radius)
    assert best == 12
    assert denies.tolist() == [False] * 4 + [True] * 6


def test_of_equally_good_blurs_the_windows_own_is_taken() -> None:
    radius = np.arange(0.0, 20.0, 0.5)
    lost = np.stack([5.0 * np.abs(radius - 12.0)] * 5)
    assert radius[most_agreed(lost, np.ones(5), radius)[0]] == 12.0


def test_strip_that_was_left_out_is_no_outline_of_the_region(bank: Bank) -> None:
    """Its border to ground of its own depth would speak for the ground's side of focus."""
    coat = with_strip(1050.0, 1650.0, 48)
    ground = photograph(leaves(SIDE + 60, 35), 1650.0)
    image = as_image(np.concatenate([coat.planes, 0.5 * ground.planes]))
    labels = np.repeat(np.array([1, 2], np.int32), coat.shape[0])[:, np.newaxis] * np.ones(coat.shape[1], np.int32)
    found = estimate_evidence(image, bank, labels, outlines_found=True)[1]
    assert found.left_out is not None
    assert abs(found.outline_odds) < 0.5
    assert found.depth_mm == pytest.approx(1050.0, rel=0.02)


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
