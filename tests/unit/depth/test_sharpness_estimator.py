import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from drawings import FOCUS_MM, PITCH_MM, SCALE_PX, as_image, blur, draw_bank, draw_chart, draw_lights
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.errors import MismatchError
from calibration.image import LinearImage
from workbench.depth.regions import from_roi, whole
from workbench.depth.richardson_lucy import Deconvolver
from workbench.depth.sharpness import (
    MAPS,
    SharpnessOptions,
    denoise,
    edge_maps,
    estimate_sharpness,
    lambda_factor,
)

DEPTHS_MM = [800.0, 1000.0, 1300.0, 1600.0, 2000.0, 2600.0]
BANK = draw_bank(DEPTHS_MM)
FRAME = 140


def photograph(index: int, seed: int = 0, draw: Callable[[int, int], NDArray[np.float32]] = draw_chart) -> LinearImage:
    """A plane at one of the depths, with noise of 0.2 % of white."""
    rng = np.random.default_rng(seed + 100)
    reach = BANK.psf.shape[-1] - 1
    plane = blur(draw(FRAME + reach, seed), BANK.central[index])
    return as_image(plane + rng.normal(0, 2e-3, plane.shape).astype(np.float32))


# The published score is fragile (see docs): it is asked here for what its idea promises, that marks are sharpest when
# deconvolved with the right PSF, on marks that stand apart even when blurred. At 800 mm these run into each other.
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("index", [1, 2, 4, 5])
def test_scattered_marks_are_found_on_both_sides_of_focus(index: int, seed: int) -> None:
    estimate = estimate_sharpness(photograph(index, seed, draw_lights), BANK, whole((FRAME, FRAME)))[1]
    assert estimate.depth_mm == DEPTHS_MM[index]
    assert estimate.interval_mm[0] <= DEPTHS_MM[index] <= estimate.interval_mm[1]
    assert estimate.score.max() == 1
    assert estimate.status in ("ok", "ambiguous")


def test_score_is_what_the_equations_say() -> None:
    """One depth and region computed the long way, pixel by pixel."""
    image = photograph(1)
    options = SharpnessOptions(margin_px=12, lambda_reading="one-minus-sigma-mm")
    estimate = estimate_sharpness(image, BANK, whole((FRAME, FRAME)), options)[1]
    at = 4
    size = BANK.psf.shape[-1]
    j = Deconvolver((FRAME, FRAME), size).richardson_lucy(image.luminance, BANK.central[at]).astype(np.float64)
    sums: dict[str, list[float]] = {name: [] for name in MAPS}
    inside = range(12, FRAME - 12)
    for y in inside:
        for x in inside:
            sums["x"].append(sum(abs(j[y, m] - j[y, m - 1]) for m in range(x - 2, x + 3)))
            sums["y"].append(sum(abs(j[m, x] - j[m - 1, x]) for m in range(y - 2, y + 3)))
            sums["xx"].append(sum(abs(j[y, m + 1] - 2 * j[y, m] + j[y, m - 1]) for m in range(x - 2, x + 3)))
            sums["yy"].append(sum(abs(j[m + 1, x] - 2 * j[m, x] + j[m - 1, x]) for m in range(y - 2, y + 3)))
    expected = []
    for name in MAPS:
        values = np.array(sums[name]) / sum(sums[name])
        ends = [np.quantile(values, k / 10) for k in range(11)]
        threshold = next(
            (ends[k] for k in range(1, 10) if ends[k + 1] - ends[k] >= 2 * (ends[k] - ends[k - 1])),
            np.quantile(values, 0.9),
        )
        expected.append(values[values > threshold].mean())
    np.testing.assert_allclose(estimate.diagnostics["scores"][:, at], expected, rtol=1e-3)
    sigma_mm = SCALE_PX * PITCH_MM * (1 - FOCUS_MM / np.array(DEPTHS_MM))
    total = (1 - sigma_mm) * estimate.diagnostics["scores"].sum(axis=0)
    np.testing.assert_allclose(estimate.score, total / total.max())


def test_edges_do_not_telescope() -> None:
    ramp_up_and_down = np.tile(np.array([0, 1, 2, 3, 2, 1, 0, 0, 0, 0], np.float32), (10, 1))
    maps = edge_maps(ramp_up_and_down, window=1)
    assert maps["x"][5, 1:6].tolist() == [2, 3, 3, 3, 3]
    assert maps["xx"][5, 3] == 2
    assert not maps["y"].any()
    assert not maps["yy"].any()


def test_threshold_ends_the_first_section_whose_successor_spans_twice_as_much() -> None:
    ends = np.array([0, 1, 2, 3, 4, 5, 6, 7, 9.5, 12, 20]) / 20
    values = np.interp(np.linspace(0, 1, 2001), np.linspace(0, 1, 11), ends)
    result = denoise(values, SharpnessOptions())
    assert result.threshold * values.sum() == pytest.approx(7 / 20, rel=1e-6)
    later = denoise(values, SharpnessOptions(increment_ratio=3.0))
    assert later.threshold * values.sum() == pytest.approx(12 / 20, rel=1e-6)
    fallback = denoise(values, SharpnessOptions(increment_ratio=50.0, fallback_cdf=0.5))
    assert fallback.threshold * values.sum() == pytest.approx(5 / 20, rel=1e-6)
    assert denoise(np.zeros(10), SharpnessOptions()).score == 0


def test_score_does_not_depend_on_brightness() -> None:
    values = np.random.default_rng(0).random(500) ** 4
    options = SharpnessOptions()
    assert denoise(values * 37, options).score == pytest.approx(denoise(values, options).score, rel=1e-5)


@pytest.mark.parametrize(
    "changed",
    [
        {"iterations": 4},
        {"window": 4},
        {"sections": 5},
        {"increment_ratio": 1.2},
        {"lambda_reading": "none"},
        {"lambda_reading": "minus-sigma"},
        {"margin_px": 30.0},
    ],
)
def test_every_constant_acts(changed: dict[str, Any]) -> None:
    image, regions = photograph(1), whole((FRAME, FRAME))
    default = estimate_sharpness(image, BANK, regions)[1]
    other = estimate_sharpness(image, BANK, regions, SharpnessOptions(**changed))[1]
    assert not np.allclose(default.score, other.score, atol=1e-4)


def test_readings_of_lambda() -> None:
    sigma_mm = np.array([-0.3, 0.0, 0.1])
    assert lambda_factor(sigma_mm, "one-minus-abs-sigma-mm").tolist() == [0.7, 1.0, 0.9]
    assert lambda_factor(sigma_mm, "one-minus-sigma-mm").tolist() == [1.3, 1.0, 0.9]
    assert lambda_factor(sigma_mm, "minus-sigma").tolist() == [0.3, 0.0, -0.1]
    assert lambda_factor(sigma_mm, "none").tolist() == [1.0, 1.0, 1.0]


def two_planes() -> tuple[LinearImage, NDArray[np.int32]]:
    near, far = photograph(1, 0, draw_lights).planes, photograph(5, 1, draw_lights).planes
    labels = np.full((FRAME, 2 * FRAME), 3, np.int32)
    labels[:, FRAME:] = 8
    return as_image(np.concatenate([near, far], axis=1)), labels


def test_regions_are_told_apart_and_keep_their_labels() -> None:
    image, labels = two_planes()
    estimates = estimate_sharpness(image, BANK, labels)
    assert {label: e.depth_mm for label, e in estimates.items()} == {3: DEPTHS_MM[1], 8: DEPTHS_MM[5]}


def test_only_the_inner_part_of_a_region_counts() -> None:
    image = photograph(1)
    labels = from_roi(image.shape, (20, 20, 100, 100))
    estimate = estimate_sharpness(image, BANK, labels, SharpnessOptions(margin_px=15))[1]
    assert estimate.pixels == 70 * 70
    assert estimate.diagnostics["window_x"].shape == (100, 100)
    assert not estimate.diagnostics["window_x"][:15].any()
    narrow = from_roi(image.shape, (20, 20, 30, 100))
    kept = estimate_sharpness(image, BANK, narrow, SharpnessOptions(margin_px=15))[1]
    assert 0.25 * 3000 <= kept.pixels < 0.4 * 3000


def test_region_without_texture_has_no_depth() -> None:
    noise = np.random.default_rng(0).normal(0.4, 0.004, (FRAME, FRAME)).astype(np.float32)
    slope = np.linspace(0, 0.2, FRAME, dtype=np.float32)
    estimate = estimate_sharpness(as_image(noise + slope), BANK, whole((FRAME, FRAME)))[1]
    assert estimate.status == "no-texture"
    assert np.isnan(estimate.depth_mm)
    assert "texture" in estimate.reason


def test_tiny_region_has_no_depth_and_says_why() -> None:
    image = photograph(1)
    estimate = estimate_sharpness(image, BANK, from_roi(image.shape, (5, 5, 12, 12)))[1]
    assert np.isnan(estimate.depth_mm)
    assert "inner pixels" in estimate.reason


def test_saturation_is_reported() -> None:
    image = photograph(1)
    saturated = np.zeros(image.shape, np.bool_)
    saturated[40:100, 40:100] = True
    estimate = estimate_sharpness(dataclasses.replace(image, saturated=saturated), BANK, whole(image.shape))[1]
    assert estimate.status == "saturated"
    assert "%" in estimate.reason


def test_figures_get_their_data() -> None:
    found = estimate_sharpness(photograph(1), BANK, whole((FRAME, FRAME)), SharpnessOptions(diagnostics_side=50))[1]
    for name in MAPS:
        window, denoised = found.diagnostics[f"window_{name}"], found.diagnostics[f"denoised_{name}"]
        assert window.shape == denoised.shape == (50, 50)
        assert 0 < denoised.sum() < window.sum()
        assert found.diagnostics[f"histogram_{name}"].sum() == found.pixels
        threshold = found.diagnostics[f"threshold_{name}"][0]
        assert threshold in found.diagnostics[f"sections_{name}"][1:-1]


def test_bank_without_pitch_is_refused_for_lambda_in_mm_alone() -> None:
    bank: Bank = dataclasses.replace(BANK, pixel_pitch_mm=None)
    image = photograph(1)
    with pytest.raises(MismatchError, match="pixel pitch"):
        estimate_sharpness(image, bank, whole(image.shape))
    options = SharpnessOptions(lambda_reading="none")
    assert estimate_sharpness(image, bank, whole(image.shape), options)[1].depth_mm > 0


@pytest.mark.parametrize(
    "bad", [{"iterations": 0}, {"window": -1}, {"sections": 1}, {"lambda_reading": "two"}, {"keep_fraction": 0.0}]
)
def test_options_out_of_range_are_refused_by_name(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        SharpnessOptions(**bad)
