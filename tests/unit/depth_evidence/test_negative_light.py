"""Light is never negative: what that says about the side of focus, where sparseness says little."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from tests.unit.depth_evidence.synthetic import as_image, draw_psf, leaves, photograph, radius_px
from tests.unit.depth_evidence.test_side import FAR, NEAR, SIDE, psfs, texture_spectrum
from workbench.depth import evidence_view
from workbench.depth.estimate import DepthEstimate
from workbench.depth.evidence import estimate_evidence
from workbench.depth.evidence_doubt import unless_another_blur_fits, unless_negative
from workbench.depth.evidence_model import DepthModel, EvidenceOptions, Learned, prepare
from workbench.depth.evidence_observation import observe
from workbench.depth.evidence_posterior import mode_scores, negative_cost
from workbench.depth.evidence_restoration import cut_patches, root_mean_square_gain, transfer_of, wiener
from workbench.depth.evidence_side import STATISTICS, Comparison, compare, favour_by_window
from workbench.depth.evidence_view import compare_sides
from workbench.depth.evidence_windows import place_windows
from workbench.depth.regions import whole

INDEX = STATISTICS.index("negative light")
NOISE = 0.003


def specks(seed: int, *, ground: float = 0.0) -> NDArray[np.float64]:
    """Gaussian noise, cut off below nothing: half of it is as dark as the ground."""
    size = SIDE + 64
    generator = np.random.default_rng(seed)
    modulus = np.hypot(np.fft.fftfreq(size)[:, np.newaxis], np.fft.rfftfreq(size))
    noise = np.fft.irfft2(np.fft.rfft2(generator.standard_normal((size, size))) / np.maximum(modulus, 0.05))
    return np.asarray(ground + 0.3 * np.maximum(noise / noise.std(), 0.0))


@pytest.fixture(scope="module")
def model(bank: Bank) -> DepthModel:
    return prepare(bank, EvidenceOptions())


def clue(*negative: float) -> Comparison:
    """Nothing about sparseness, and these shares for the far and the near side."""
    zeros = np.zeros(len(STATISTICS))
    return Comparison(np.zeros((2, 4)), zeros, np.array(negative), np.zeros((2, 2, len(STATISTICS))))


def answer(model: DepthModel, depth_mm: float) -> DepthEstimate:
    nan, depths = float("nan"), model.depths_mm
    around = 0.98 * depth_mm, 1.02 * depth_mm
    return DepthEstimate(depth_mm, around, 0.95, nan, 0.0, "ok", depths, np.ones(depths.size), nan, 1)


def row_at(model: DepthModel, depth_mm: float) -> int:
    return int(np.abs(np.abs(model.row_radius_px) - abs(radius_px(depth_mm))).argmin())


def favour(texture: NDArray[np.float64], depth_mm: float, *, is_light: bool = True) -> float:
    plane = photograph(texture, depth_mm, noise=NOISE).luminance
    soft = np.ones(plane.shape, np.float32)
    windows = place_windows(soft > 0, soft, 128, least_weight=0.3)
    return float(
        compare(cut_patches(plane, soft, windows), windows, psfs(), texture_spectrum(), is_light=is_light).favour[INDEX]
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_dark_ground_tells_the_side(seed: int) -> None:
    assert favour(specks(seed), FAR) > 1.0
    assert favour(specks(seed), NEAR) < -1.0


@pytest.mark.parametrize("depth_mm", [FAR, NEAR])
def test_bright_ground_says_nothing(depth_mm: float) -> None:
    assert favour(specks(1, ground=2.0), depth_mm) == pytest.approx(0.0, abs=1e-3)


def test_difference_of_colours_says_nothing_since_it_may_be_negative() -> None:
    assert favour(specks(1), FAR, is_light=False) == 0.0


@pytest.mark.parametrize("level", [0.0, -0.2])
def test_noise_without_light_says_nothing_on_average(level: float) -> None:
    """As where the dark frame is brighter than the photograph."""
    generator = np.random.default_rng(0)
    plane = (level + NOISE * generator.standard_normal((3 * SIDE, 3 * SIDE))).astype(np.float32)
    soft = np.ones(plane.shape, np.float32)
    windows = place_windows(soft > 0, soft, 128, least_weight=0.3)
    each = [
        compare(cut_patches(plane, soft, [window]), [window], psfs(), texture_spectrum()).favour[INDEX]
        for window in windows
    ]
    assert len(each) > 30
    assert abs(np.mean(each)) < 0.3
    assert np.abs(each).max() < 2.0


def test_windows_across_outlines_are_not_asked() -> None:
    plane = photograph(specks(1), FAR, noise=NOISE).luminance
    soft = np.ones(plane.shape, np.float32)
    windows = place_windows(soft > 0, soft, 64, least_weight=0.3)
    each = favour_by_window(plane, soft, windows, psfs(), texture_spectrum())
    assert (each[:, INDEX] == 0.0).all()
    assert (each[:, :INDEX] != 0.0).all()


def test_blur_that_is_too_large_needs_negative_light_and_the_true_one_does_not() -> None:
    plane = photograph(specks(4), FAR, noise=NOISE).luminance
    soft = np.ones(plane.shape, np.float32)
    windows = place_windows(soft > 0, soft, 128, least_weight=0.3)
    for depth_mm, low, high in ((FAR, 0.0, 0.01), (NEAR, 0.01, 0.5), (850.0, 0.5, 100.0), (1800.0, 0.0, 1e-3)):
        near = draw_psf(depth_mm).astype(np.float32)
        found = compare(cut_patches(plane, soft, windows), windows, [near, near], texture_spectrum()).negative
        assert found[0] == found[1]
        assert low <= found[0] < high


def test_negative_light_counts_against_a_radius_but_never_rules_it_out() -> None:
    far, near = mode_scores([clue(0.0, 0.0), clue(0.5, 0.5), clue(9.0, 9.0)], np.zeros(3, np.bool_), 16384.0, Learned())
    assert far[0] == near[0] == 0.0
    assert -6.0 < far[1] == near[1] < -4.0
    assert far[2] == near[2] == -6.0


def test_rival_that_would_need_negative_light_is_none(model: DepthModel) -> None:
    options, estimate = EvidenceOptions(), answer(model, FAR)
    modes = [row_at(model, FAR), row_at(model, 800.0)]
    likelihood = np.full(model.row_radius_px.size, -100.0)
    likelihood[modes] = 0.0, -1.0
    sides = np.zeros(2), np.zeros(2)
    rivalled = unless_another_blur_fits(estimate, likelihood, modes, sides, np.zeros((2, 2)), model, options)
    assert rivalled.status == "ambiguous"
    costly = np.array([[0.0, 0.0], [12.0, 12.0]])
    assert unless_another_blur_fits(estimate, likelihood, modes, sides, costly, model, options) is estimate
    both = unless_another_blur_fits(estimate, likelihood, modes, sides, np.full((2, 2), 12.0), model, options)
    assert both.status == "ambiguous"


@pytest.mark.parametrize(("depth_mm", "costs"), [(FAR, (5.0, 0.0)), (NEAR, (0.0, 5.0))])
def test_answer_that_would_need_negative_light_is_doubted(
    model: DepthModel, depth_mm: float, costs: tuple[float, float]
) -> None:
    estimate, modes = answer(model, depth_mm), [row_at(model, depth_mm)]
    doubted = unless_negative(estimate, modes, np.array([costs]), model)
    assert doubted.status == "ambiguous"
    assert "negative" in doubted.reason
    low_mm, high_mm = doubted.interval_mm
    assert low_mm <= 1.01 * NEAR
    assert high_mm >= 0.99 * FAR
    assert unless_negative(estimate, modes, np.array([costs[::-1]]), model) is estimate
    known = replace(estimate, status="ambiguous", reason="something else", confidence=0.4)
    again = unless_negative(known, modes, np.array([costs]), model)
    assert (again.reason, again.confidence) == ("something else", 0.4)
    assert again.interval_mm == doubted.interval_mm


def test_interval_of_a_blur_that_is_too_large_ends_with_the_bank(model: DepthModel) -> None:
    doubted = unless_negative(answer(model, 800.0), [row_at(model, 800.0)], np.array([[0.0, 5.0]]), model)
    assert doubted.interval_mm == pytest.approx((784.0, 3500.0), rel=1e-3)


def test_cost_grows_with_the_share_up_to_a_limit() -> None:
    costs = negative_cost([clue(0.0, 0.02), clue(0.22, 50.0)])
    assert costs[0, 0] == 0.0
    assert costs[0, 1] == pytest.approx(1.6 * np.log(2.0))
    assert costs[1, 0] == pytest.approx(4.0, abs=0.05)
    assert costs[1, 1] == 6.0


def test_noise_behind_a_filter_is_as_strong_as_its_gain_says() -> None:
    generator = np.random.default_rng(7)
    plane = generator.standard_normal((192, 192)).astype(np.float32)
    soft = np.ones(plane.shape, np.float32)
    patches = cut_patches(plane, soft, place_windows(soft > 0, soft, 128, least_weight=0.3))
    ratio = np.full((patches.size, patches.size // 2 + 1), 50.0, np.float32)
    restoring = wiener(transfer_of(draw_psf(FAR).astype(np.float32), patches.size), ratio)
    whole = np.fft.irfft2(np.fft.rfft2(generator.standard_normal((patches.size, patches.size))) * restoring)
    assert whole.std() == pytest.approx(root_mean_square_gain(restoring), rel=0.02)


def opponents(seed: int, depth_mm: float) -> LinearImage:
    """Two colours of equal brightness: measured in a mixture that is negative where one of them prevails."""
    plane = photograph(leaves(SIDE + 64, seed), depth_mm, noise=0.0).luminance
    planes = np.stack([plane, 0.45 * np.ones_like(plane), 0.9 - plane], axis=-1)
    noise = NOISE * np.random.default_rng(seed).standard_normal(planes.shape)
    return as_image((planes + noise).astype(np.float32))


def asked(image: LinearImage, bank: Bank, monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """What each comparison of the sides was told about the plane, of a whole image measured."""
    seen = []

    def noted(*args: Any, is_light: bool, **rest: Any) -> Comparison:
        seen.append(is_light)
        return compare(*args, is_light=is_light, **rest)

    monkeypatch.setattr(evidence_view, "compare", noted)
    estimate_evidence(image, bank, whole(image.shape))
    return seen


def test_mixture_that_may_be_negative_is_no_light(bank: Bank, monkeypatch: pytest.MonkeyPatch) -> None:
    told = asked(opponents(1, FAR), bank, monkeypatch)
    assert told
    assert not any(told)


def test_luminance_is_light(bank: Bank, monkeypatch: pytest.MonkeyPatch) -> None:
    told = asked(photograph(leaves(SIDE + 64, 1), FAR), bank, monkeypatch)
    assert told
    assert all(told)


def test_parts_of_an_uneven_region_are_not_asked(bank: Bank, monkeypatch: pytest.MonkeyPatch) -> None:
    planes = [photograph(leaves(SIDE + 64, seed), z).planes for seed, z in ((1, 1050.0), (2, 2100.0))]
    told = asked(as_image(np.concatenate(planes, axis=1)), bank, monkeypatch)
    assert told.count(False) >= 2
    assert told.count(True) >= 1


def test_letters_taken_for_points_behind_a_large_blur_are_told(bank: Bank) -> None:
    """Dark bars on a bright ground next to focus: without the clue the largest blur within reach explains them too."""
    texture = np.full((SIDE + 64, SIDE + 64), 0.9)
    for row in range(10, SIDE + 64, 40):
        for column in range(10, SIDE + 64, 40):
            texture[row : row + 24, column : column + 6] = 0.05
    image = photograph(texture, 1800.0)
    model = prepare(bank, EvidenceOptions())
    seen = observe(image.luminance, np.ones(image.shape, np.bool_), model, EvidenceOptions())
    assert seen is not None
    modes = [row_at(model, 1800.0), row_at(model, 850.0)]
    costs = negative_cost(compare_sides(seen.view, seen.photosites, modes, model, EvidenceOptions()))
    assert costs[0].max() < 0.5
    assert costs[1].min() > 4.0
