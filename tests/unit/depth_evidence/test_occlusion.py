"""Outlines between regions: found, read, their blur, and what it says of the depths to both sides."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from calibration.pupil import psf_model
from tests.unit.depth_evidence.synthetic import HALF, as_image, blurred, draw_psf, radius_px
from workbench.depth.evidence import estimate_evidence
from workbench.depth.occlusion import Candidates, order_by_outlines
from workbench.depth.outline_blur import BlurredSteps, blur_log_likelihood, blurred_steps
from workbench.depth.outlines import Outline, find_outlines, read_profiles

SIDE = 300
EVEN = np.log([0.5, 0.5])


def mirror_mm(depth_mm: float) -> float:
    return 1.0 / (2.0 / 1600.0 - 1.0 / depth_mm)


def disc(radius: float, side: int = SIDE) -> NDArray[np.bool_]:
    y, x = np.mgrid[:side, :side]
    return np.hypot(y - side / 2, x - side / 2) < radius


def occluded(
    front: NDArray[np.bool_], front_mm: float, back_mm: float, *, noise: float = 0.003, grain: float = 0.0
) -> LinearImage:
    """A plain red surface before a plain blue one, their outline blurred by the front's PSF, with photosites' noise.

    ``grain`` is the standard deviation of a Gaussian texture, white and so without a side of focus, on both.
    """
    generator = np.random.default_rng(5)
    padded = np.pad(front, HALF, mode="edge").astype(np.float64)
    near, far = draw_psf(front_mm), draw_psf(back_mm)
    planes = []
    dark, bright = 1.0 + grain * generator.standard_normal((2, *padded.shape))
    for red, blue in ((0.6, 0.2), (0.3, 0.3), (0.2, 0.5)):
        covered = blurred(padded, near)
        planes.append(blurred(padded * red * dark, near) + (1.0 - covered) * blurred(blue * bright, far))
    light = np.stack(planes, axis=-1)
    return as_image((light + noise * generator.standard_normal(light.shape)).astype(np.float32))


def steps_of(bank: Bank) -> BlurredSteps:
    return BlurredSteps(psf_model(bank))


def told_by(
    image: LinearImage, labels: NDArray[np.int32], regions: dict[int, Candidates | None], bank: Bank
) -> dict[int, NDArray[np.float64]]:
    steps = steps_of(bank)
    return order_by_outlines(image, labels, regions, lambda _: steps, (700.0, 3500.0))


def either_side(depth_mm: float) -> Candidates:
    return Candidates(np.array([depth_mm, mirror_mm(depth_mm)]), EVEN)


def test_a_blurred_step_rises_by_the_psf_along_its_direction() -> None:
    psf = np.zeros((11, 11), np.float32)
    psf[5, 5], psf[5, 9] = 0.25, 0.75  # 4 px further in x
    steps = blurred_steps(psf)
    directions, middle = len(steps), steps.shape[1] // 2
    per_px = 4
    assert steps[0, [middle - per_px, middle + 2 * per_px, middle + 5 * per_px]] == pytest.approx([0, 0.25, 1])
    assert steps[0, [middle, middle + 4 * per_px]] == pytest.approx([0.125, 0.625])
    assert steps[directions // 4, [middle - per_px, middle, middle + per_px]] == pytest.approx([0, 0.5, 1])
    # upside down it is the same step seen from the other side
    assert steps[directions // 2][::-1] == pytest.approx(1.0 - steps[0], abs=1e-6)


def test_outlines_are_found_between_regions_and_point_into_the_first() -> None:
    labels = np.where(disc(80), 2, 1).astype(np.int32)
    (found,) = find_outlines(labels)
    assert (found.first, found.second) == (1, 2)
    assert 2 * np.pi * 80 / 4 < len(found.yx) < 2 * np.pi * 80 / 2
    outward = found.yx - (SIDE - 1) / 2
    distance = np.linalg.norm(outward, axis=1)
    assert np.abs(distance - 80).max() < 1.5
    assert ((outward / distance[:, np.newaxis]) * found.normal_yx).sum(axis=1).min() > 0.95
    angle = np.sort(np.arctan2(*outward.T))
    assert np.diff(angle).max() * 80 < 6  # all the way round


def test_a_strip_of_half_shadow_between_two_regions_is_no_region_to_meet() -> None:
    labels = np.where(disc(80), 2, np.where(disc(86), 3, 1)).astype(np.int32)
    found = find_outlines(labels)
    assert [(outline.first, outline.second) for outline in found] == [(1, 2)]


def test_pixels_of_no_region_have_no_outline() -> None:
    assert find_outlines(np.where(disc(80), 2, 0).astype(np.int32)) == []
    assert find_outlines(np.ones((50, 60), np.int32)) == []


def test_profiles_run_from_the_second_region_into_the_first() -> None:
    labels = np.where(np.arange(200) < 120, 1, 2)[np.newaxis].repeat(90, axis=0).astype(np.int32)
    planes = np.where(labels == 1, 0.7, 0.2)[..., np.newaxis].repeat(3, axis=2).astype(np.float32)
    (outline,) = find_outlines(labels)
    profiles = read_profiles(planes, labels, outline, 15)
    assert profiles is not None
    assert profiles.values.shape[1] == 31
    assert (profiles.values[:, -10:].mean(axis=1) > profiles.values[:, :10].mean(axis=1)).all()
    assert np.cos(profiles.angle) == pytest.approx(-1.0)  # the first region is to the left
    assert np.argmax(np.diff(profiles.values[3])) in (14, 15)


def test_points_near_a_third_region_or_the_border_have_no_profile() -> None:
    labels = np.where(np.arange(200) < 120, 1, 2)[np.newaxis].repeat(90, axis=0).astype(np.int32)
    (outline,) = find_outlines(labels)
    planes = np.ones((90, 200, 3), np.float32)
    assert read_profiles(planes, labels, outline, 80) is None
    labels[:, :108] = 3
    assert read_profiles(planes, labels, Outline(1, 2, outline.yx, outline.normal_yx), 30) is None


@pytest.mark.parametrize("true_mm", [900.0, 1150.0, 2300.0, 3300.0])
def test_a_plain_outline_tells_its_blur_and_its_side(bank: Bank, true_mm: float) -> None:
    image = occluded(disc(90), true_mm, 3500.0)
    labels = np.where(disc(90), 2, 1).astype(np.int32)
    (outline,) = find_outlines(labels)
    profiles = read_profiles(image.planes, labels, outline, 25)
    assert profiles is not None
    depths = 1.0 / np.linspace(1 / 800.0, 1 / 3500.0, 30)
    depths = np.append(depths, true_mm)
    steps = steps_of(bank)
    likelihood = blur_log_likelihood(profiles, [steps.at(float(z)) for z in depths])
    assert likelihood.max() == 0.0
    assert radius_px(float(depths[likelihood.argmax()])) == pytest.approx(radius_px(true_mm), abs=0.5)
    wrong_side = (depths < 1600.0) != (true_mm < 1600.0)
    assert likelihood[wrong_side].max() < -20.0


def test_what_stands_in_front_settles_both_sides(bank: Bank) -> None:
    """The disc at 105 cm, or at its mirror depth; the wall behind it at 300 cm, or in front of everything."""
    image = occluded(disc(90), 1050.0, 3000.0)
    labels = np.where(disc(90), 2, 1).astype(np.int32)
    told = told_by(image, labels, {1: either_side(3000.0), 2: either_side(1050.0)}, bank)
    assert told[2][0] == 0.0
    assert told[2][1] < -2.0
    assert told[1][0] == 0.0
    # the wall's mirror depth, 109 cm, lies behind the disc, too: the outline can't tell
    assert told[1][1] > -1.0


def test_a_wall_is_not_before_what_visibly_occludes_it(bank: Bank) -> None:
    image = occluded(disc(90), 2000.0, 3000.0)
    labels = np.where(disc(90), 2, 1).astype(np.int32)
    told = told_by(image, labels, {1: either_side(3000.0), 2: either_side(2000.0)}, bank)
    assert told[1][1] < -2.0
    assert told[2][1] < -2.0


def test_no_outline_says_more_than_its_chance_to_mean_something_else(bank: Bank) -> None:
    image = occluded(disc(90), 1050.0, 3000.0, noise=0.0005)
    labels = np.where(disc(90), 2, 1).astype(np.int32)
    told = told_by(image, labels, {1: None, 2: either_side(1050.0)}, bank)
    assert set(told) == {2}
    assert np.log(0.03) - 0.1 < told[2][1] < -1.0


def test_a_region_of_several_depths_may_be_anywhere_to_its_neighbours(bank: Bank) -> None:
    image = occluded(disc(90), 2000.0, 3000.0)
    labels = np.where(disc(90), 2, 1).astype(np.int32)
    mixed = Candidates(np.array([2500.0]), np.zeros(1), is_one=False)
    nobody = told_by(image, labels, {1: None, 2: either_side(2000.0)}, bank)
    assert told_by(image, labels, {1: mixed, 2: either_side(2000.0)}, bank)[2] == pytest.approx(nobody[2])


def test_plain_regions_without_an_edge_between_them_say_nothing(bank: Bank) -> None:
    noise = np.random.default_rng(2).standard_normal((SIDE, SIDE, 3))
    image = as_image((0.5 + 0.003 * noise).astype(np.float32))
    labels = np.where(np.arange(SIDE) < 150, 1, 2)[np.newaxis].repeat(SIDE, axis=0).astype(np.int32)
    told = told_by(image, labels, {1: either_side(3000.0), 2: either_side(1050.0)}, bank)
    assert all(np.ptp(message) < 1.5 for message in told.values())


def test_grain_that_tells_no_side_is_measured_by_its_outline(bank: Bank) -> None:
    front = disc(110, 420)
    image = occluded(front, 2300.0, 3300.0, grain=0.25, noise=0.001)
    apart = {
        number: estimate_evidence(image, bank, np.where(mask, 1, 0).astype(np.int32))[1]
        for number, mask in ((1, ~front), (2, front))
    }
    together = estimate_evidence(image, bank, np.where(front, 2, 1).astype(np.int32))
    for number, true_mm in ((1, 3300.0), (2, 2300.0)):
        assert apart[number].status == "ambiguous"
        assert together[number].depth_mm == pytest.approx(true_mm, rel=0.02)
        assert together[number].confidence > apart[number].confidence + 0.2
