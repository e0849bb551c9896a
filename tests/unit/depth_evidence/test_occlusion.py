"""Outlines between regions: found, read, their blur, and what it says of the depths to both sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from calibration.pupil import PsfInterpolator, interpolator_of_bank, psf_model
from tests.unit.depth_evidence.synthetic import HALF, as_image, blurred, draw_psf, radius_px
from workbench.depth.evidence import estimate_evidence
from workbench.depth.occlusion import Candidates, outline_messages
from workbench.depth.outline_blur import EdgeSpreads, blur_log_likelihood, edge_spreads
from workbench.depth.outlines import Outline, find_outlines, read_profiles

SIDE = 300


def mirror_mm(depth_mm: float) -> float:
    return 1.0 / (2.0 / 1600.0 - 1.0 / depth_mm)


def disc(radius: float, side: int = SIDE) -> NDArray[np.bool_]:
    y, x = np.mgrid[:side, :side]
    return np.hypot(y - side / 2, x - side / 2) < radius


def occluded(
    front: NDArray[np.bool_],
    front_mm: float,
    back_mm: float,
    *,
    noise: float = 0.003,
    grain: tuple[float, float] = (0.0, 0.0),
) -> LinearImage:
    """A plain red surface before a plain blue one, their outline blurred by the front's PSF, with photosites' noise.

    ``grain`` is the standard deviation of a Gaussian texture, white and so without a side of focus, on each.
    """
    generator = np.random.default_rng(5)
    padded = np.pad(front, HALF, mode="edge").astype(np.float64)
    near, far = draw_psf(front_mm), draw_psf(back_mm)
    planes = []
    dark, bright = 1.0 + np.array(grain)[:, None, None] * generator.standard_normal((2, *padded.shape))
    for red, blue in ((0.6, 0.2), (0.3, 0.3), (0.2, 0.5)):
        covered = blurred(padded, near)
        planes.append(blurred(padded * red * dark, near) + (1.0 - covered) * blurred(blue * bright, far))
    light = np.stack(planes, axis=-1)
    return as_image((light + noise * generator.standard_normal(light.shape)).astype(np.float32))


def spreads_of(bank: Bank) -> EdgeSpreads:
    return EdgeSpreads(psf_model(bank))


def told_by(
    image: LinearImage, labels: NDArray[np.int32], regions: dict[int, Candidates | None], bank: Bank
) -> dict[int, NDArray[np.float64]]:
    spreads = spreads_of(bank)
    return outline_messages(image, labels, regions, lambda _: spreads, (700.0, 3500.0), 1.0)


def candidates(
    *depths_mm: float, log_probability: NDArray[np.float64] | None = None, is_one: bool = True
) -> Candidates:
    even = np.full(len(depths_mm), -np.log(len(depths_mm)))
    radii = np.array([radius_px(depth) for depth in depths_mm])
    own = even if log_probability is None else log_probability
    return Candidates(np.array(depths_mm), radii, own, np.array(depths_mm)[:, np.newaxis], is_one)


def either_side(depth_mm: float) -> Candidates:
    return candidates(depth_mm, mirror_mm(depth_mm))


def test_a_blurred_step_rises_by_the_psf_along_its_direction() -> None:
    psf = np.zeros((11, 11), np.float32)
    psf[5, 5], psf[5, 9] = 0.25, 0.75  # 4 px further in x
    steps = edge_spreads(psf)
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
    profiles = read_profiles(as_image(planes), labels, outline, 15)
    assert profiles is not None
    assert profiles.values.shape[1] == 31
    assert (profiles.values[:, -10:].mean(axis=1) > profiles.values[:, :10].mean(axis=1)).all()
    assert np.cos(profiles.angle) == pytest.approx(-1.0)  # the first region is to the left
    assert np.argmax(np.diff(profiles.values[3])) in (14, 15)


def test_points_near_a_third_region_or_the_border_have_no_profile() -> None:
    labels = np.where(np.arange(200) < 120, 1, 2)[np.newaxis].repeat(90, axis=0).astype(np.int32)
    (outline,) = find_outlines(labels)
    planes = np.ones((90, 200, 3), np.float32)
    assert read_profiles(as_image(planes), labels, outline, 80) is None
    labels[:, :108] = 3
    assert read_profiles(as_image(planes), labels, Outline(1, 2, outline.yx, outline.normal_yx), 30) is None


@pytest.mark.parametrize("true_mm", [900.0, 1150.0, 2300.0, 3300.0])
def test_a_plain_outline_tells_its_blur_and_its_side(bank: Bank, true_mm: float) -> None:
    image = occluded(disc(90), true_mm, 3500.0)
    labels = np.where(disc(90), 2, 1).astype(np.int32)
    (outline,) = find_outlines(labels)
    profiles = read_profiles(image, labels, outline, 25)
    assert profiles is not None
    depths = 1.0 / np.linspace(1 / 800.0, 1 / 3500.0, 30)
    depths = np.append(depths, true_mm)
    spreads = spreads_of(bank)
    likelihood = blur_log_likelihood(profiles, [spreads.at(float(z)) for z in depths])
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
    mixed = candidates(2500.0, is_one=False)
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
    image = occluded(front, 2300.0, 3300.0, grain=(0.25, 0.25), noise=0.001)
    apart = {
        number: estimate_evidence(image, bank, np.where(mask, 1, 0).astype(np.int32))[1]
        for number, mask in ((1, ~front), (2, front))
    }
    together = estimate_evidence(image, bank, np.where(front, 2, 1).astype(np.int32))
    for number, true_mm in ((1, 3300.0), (2, 2300.0)):
        assert apart[number].status == "ambiguous"
        assert together[number].depth_mm == pytest.approx(true_mm, rel=0.02)
        assert together[number].confidence > apart[number].confidence + 0.2


@pytest.mark.parametrize(("shift", "told"), [(8, True), (-8, True), (18, False), (-18, False)])
def test_a_step_far_from_where_the_outline_was_found_says_nothing(bank: Bank, shift: int, told: bool) -> None:
    """Placed at the end of what is tried, it would suit whichever PSF is skewed that way."""
    image = occluded(disc(90), 1050.0, 3000.0)
    labels = np.where(disc(90 + shift), 2, 1).astype(np.int32)
    message = told_by(image, labels, {1: None, 2: either_side(1050.0)}, bank)
    assert (2 in message and message[2][1] < -2.0) == told
    if not told:
        assert np.ptp(message.get(2, np.zeros(2))) < 0.7


def test_clipped_outlines_are_left_out(bank: Bank) -> None:
    image = occluded(disc(90), 1050.0, 3000.0)
    labels = np.where(disc(90), 2, 1).astype(np.int32)
    (outline,) = find_outlines(labels)
    half = np.zeros(labels.shape, bool)
    half[:, : SIDE // 2] = disc(90)[:, : SIDE // 2]
    whole, left = (read_profiles(replace(image, saturated=mask), labels, outline, 20) for mask in (half & False, half))
    assert whole is not None
    assert left is not None
    assert 0.3 < len(left.values) / len(whole.values) < 0.6
    assert read_profiles(replace(image, saturated=disc(90)), labels, outline, 20) is None


def test_a_strip_between_two_regions_doesnt_count_their_outline_twice() -> None:
    plain, double = (
        sum(
            len(outline.yx)
            for outline in find_outlines(np.where(disc(80), 2, np.where(disc(80 + gap), 3, 1)).astype(np.int32))
        )
        for gap in (0, 6)
    )
    assert double < 1.6 * plain


def test_what_a_neighbour_says_of_itself_decides_what_is_heard(bank: Bank) -> None:
    """The disc may be at 200 cm; before it the wall can't be, unless the disc is likely nearer still."""
    image = occluded(disc(90), 2000.0, 3000.0)
    labels = np.where(disc(90), 2, 1).astype(np.int32)
    surely, hardly = (
        told_by(
            image,
            labels,
            {1: either_side(3000.0), 2: candidates(2000.0, 720.0, log_probability=np.log([p, 1 - p]))},
            bank,
        )
        for p in (0.999, 0.001)
    )
    assert surely[1][1] < -2.5
    assert hardly[1][1] > surely[1][1] + 1.5


def test_sure_regions_are_not_asked(bank: Bank) -> None:
    image = occluded(disc(90), 2000.0, 3000.0)
    labels = np.where(disc(90), 2, 1).astype(np.int32)
    assert told_by(image, labels, {1: candidates(3000.0), 2: candidates(2000.0)}, bank) == {}
    assert set(told_by(image, labels, {1: candidates(3000.0), 2: either_side(2000.0)}, bank)) == {1, 2}


def interpolator_of_bank_at_centre(bank: Bank, field_index: int | None = None) -> PsfInterpolator:
    return interpolator_of_bank(bank, bank.central_index if field_index is None else field_index)


def grained(front_mm: float = 2300.0, back_mm: float = 3300.0) -> tuple[LinearImage, NDArray[np.int32]]:
    front = disc(110, 420)
    return occluded(front, front_mm, back_mm, grain=(0.25, 0.25), noise=0.001), np.where(front, 2, 1).astype(np.int32)


def test_the_estimate_says_what_its_outlines_gave_it(bank: Bank) -> None:
    image, labels = grained()
    found = estimate_evidence(image, bank, labels)
    assert all(1.0 < estimate.outline_odds < 4.0 for estimate in found.values())
    assert estimate_evidence(image, bank, (labels == 2).astype(np.int32))[1].outline_odds == 0.0


def test_banks_without_a_pupil_hear_outlines_too(bank: Bank, monkeypatch: pytest.MonkeyPatch) -> None:
    image, labels = grained()
    monkeypatch.setattr("workbench.depth.evidence_model.psf_model", interpolator_of_bank_at_centre)
    found = estimate_evidence(image, bank, labels)
    assert found[2].depth_mm == pytest.approx(2300.0, rel=0.04)
    assert found[2].outline_odds > 1.0


def test_outlines_are_judged_by_the_psfs_of_their_place(bank: Bank) -> None:
    """PSFs are upside down in the right half of the frame: the same disc before a blank wall is on the other side."""
    front = disc(110, 420)
    image = occluded(front, 2300.0, 3300.0, grain=(0.25, 0.0), noise=0.001)
    wide = as_image(np.concatenate([image.planes, image.planes], axis=1))
    labels = np.concatenate([np.where(front, 1, 3), np.where(front, 2, 3)], axis=1).astype(np.int32)
    turned = bank.psf[..., ::-1, ::-1]
    extras = {name: value for name, value in bank.extras.items() if name not in ("aperture", "chief_yx")}
    field = replace(
        bank, psf=np.concatenate([bank.psf, turned]), psf_se=np.concatenate([bank.psf_se] * 2),
        field_yx=np.array([[0.0, -0.5], [0.0, 0.5]]), extras=extras,
    )  # fmt: skip
    found = estimate_evidence(wide, field, labels)
    assert found[3].status == "no-texture"
    for number, true_mm in ((1, 2300.0), (2, mirror_mm(2300.0))):
        assert found[number].depth_mm == pytest.approx(true_mm, rel=0.03)
        assert found[number].outline_odds > 1.0
