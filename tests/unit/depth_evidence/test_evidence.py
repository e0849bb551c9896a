"""What the evidence method must get right, refuse, or call ambiguous."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from calibration.bank import Bank
from tests.unit.depth_evidence.synthetic import as_image, leaves, make_bank, photograph, with_pupil
from workbench.depth.evidence import EvidenceOptions, estimate_evidence, prepare
from workbench.depth.evidence_colour import informative_mixture
from workbench.depth.evidence_doubt import unless_few_lines, unless_on_either_side
from workbench.depth.evidence_expected import mixed_power
from workbench.depth.evidence_learn import learn
from workbench.depth.evidence_model import LEARNED, Learned
from workbench.depth.evidence_posterior import log_prior, summarise
from workbench.depth.methods import estimate_depths
from workbench.depth.regions import whole

SIDE = 128 + 40


@pytest.mark.parametrize("depth_mm", [800.0, 950.0, 1250.0, 2150.0, 2900.0])
def test_textured_plane_is_found_on_its_side_and_within_the_interval(bank: Bank, depth_mm: float) -> None:
    image = photograph(leaves(SIDE, int(depth_mm)), depth_mm)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert abs(1 / found.depth_mm - 1 / depth_mm) < 0.012e-3
    assert found.interval_mm[0] <= depth_mm <= found.interval_mm[1]
    assert found.score.sum() == pytest.approx(1.0)


def test_irregular_region_with_hole_ignores_the_other_depth_around_it(bank: Bank) -> None:
    inside, outside = photograph(leaves(SIDE + 40, 3), 2600.0), photograph(leaves(SIDE + 40, 4), 1600.0)
    y, x = np.mgrid[: inside.shape[0], : inside.shape[1]] - inside.shape[0] // 2
    mask = (np.hypot(y, x) < 78) & (np.hypot(y - 30, x) > 8)
    image = as_image(np.where(mask[..., np.newaxis], inside.planes, outside.planes))
    found = estimate_evidence(image, bank, mask.astype(np.int32))[1]
    assert abs(found.depth_mm - 2600.0) < 150.0 or found.status == "ambiguous"
    assert found.interval_mm[0] <= 2600.0 <= found.interval_mm[1]


def test_blank_wall_with_shading_says_no_texture(bank: Bank) -> None:
    y, x = np.mgrid[:128, :128] / 128.0
    shading = 0.5 - 0.1 * x - 0.05 * (y - 0.4) ** 2
    planes = shading[..., np.newaxis] + 0.004 * np.random.default_rng(2).standard_normal((128, 128, 3))
    image = as_image(planes.astype(np.float32))
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "no-texture"
    assert np.isnan(found.depth_mm)
    assert found.reason


def test_strict_pattern_is_refused_rather_than_put_in_focus(bank: Bank) -> None:
    y, x = np.mgrid[:SIDE, :SIDE]
    pattern = 0.5 + 0.2 * np.sin(2 * np.pi * x / 9.0) * np.sin(2 * np.pi * y / 9.0)
    image = photograph(pattern, 2000.0)
    assert estimate_evidence(image, bank, whole(image.shape))[1].status != "ok"


def test_woven_pattern_in_a_small_region_is_not_put_in_focus(bank: Bank) -> None:
    """Over few pixels its lines are broad: neither their share of the power nor the emptiness between them suffices."""
    y, x = np.mgrid[:SIDE, :SIDE]
    warp, weft = np.sin(2 * np.pi * x / 11.0), np.sin(2 * np.pi * y / 11.0)
    weave = 0.5 + 0.15 * np.where((x // 11 + y // 11) % 2 == 0, np.abs(warp), np.abs(weft))
    image = photograph(weave, 2100.0)
    labels = np.zeros(image.shape, np.int32)
    labels[30:94, 30:94] = 1
    assert estimate_evidence(image, bank, labels)[1].status == "no-texture"


def test_saturated_region_is_refused(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 5), 2000.0)
    image.saturated[:, :64] = True
    assert estimate_evidence(image, bank, whole(image.shape))[1].status == "saturated"


def test_sliver_is_refused_by_name(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 6), 2000.0)
    labels = np.zeros(image.shape, np.int32)
    labels[:, :9] = 1
    found = estimate_evidence(image, bank, labels, EvidenceOptions())[1]
    assert found.status == "no-texture"
    assert "too small" in found.reason


def test_gaussian_texture_has_no_side_and_is_called_ambiguous(bank: Bank) -> None:
    generator = np.random.default_rng(8)
    spectrum = np.fft.rfft2(generator.standard_normal((SIDE, SIDE)))
    modulus = np.hypot(np.fft.fftfreq(SIDE)[:, np.newaxis], np.fft.rfftfreq(SIDE))
    noise = np.fft.irfft2(spectrum / np.maximum(modulus, 0.01), s=(SIDE, SIDE))
    image = photograph(0.5 + 0.1 * (noise - noise.mean()) / noise.std(), 2600.0)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "ambiguous"
    assert found.interval_mm[0] <= 2600.0 <= found.interval_mm[1]


def test_bright_edges_of_a_neighbour_do_not_pass_for_sparseness(bank: Bank) -> None:
    wall = photograph(0.45 + 0.2 * (leaves(SIDE + 88, 12) - 0.4), 2900.0)
    mask = np.ones(wall.shape, bool)
    planes = wall.planes.copy()
    rows, columns = np.mgrid[: wall.shape[0], : wall.shape[1]]
    for corner in ((70, 70), (0, 150), (150, 0), (160, 160)):
        beside = (abs(rows - corner[0] - 20) < 20) & (abs(columns - corner[1] - 20) < 20)
        planes[beside] = 0.9 * ((rows // 4 + columns // 4) % 2)[beside][:, np.newaxis]
        mask &= ~beside
    found = estimate_evidence(as_image(planes), bank, mask.astype(np.int32))[1]
    assert found.interval_mm[0] <= 2900.0 <= found.interval_mm[1]
    assert abs(found.depth_mm - 2900.0) < 200.0


def test_two_colours_of_equal_brightness_are_texture(bank: Bank) -> None:
    grey = photograph(leaves(SIDE, 14), 2400.0).planes[:, :, :1]
    image = as_image(np.asarray(0.5 + (grey - 0.5) * np.array([1.0, -0.5, 0.0], np.float32), np.float32))
    noisy = image.planes + 0.003 * np.random.default_rng(4).standard_normal(image.planes.shape)
    image = as_image(noisy.astype(np.float32))
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "ok"
    assert abs(found.depth_mm - 2400.0) < 60.0
    plain = estimate_evidence(image, bank, whole(image.shape), EvidenceOptions(colour_gain=1e9))[1]
    assert plain.status != "ok"


def test_grey_surface_is_measured_by_its_luminance() -> None:
    image = photograph(leaves(SIDE, 15), 2400.0)
    assert informative_mixture(image, np.ones(image.shape, bool), 1.6) is None


def test_mixture_of_neighbouring_blurs_is_their_mean() -> None:
    radii = np.arange(0.5, 12.5)
    flat = np.broadcast_to(radii.astype(np.float32)[:, np.newaxis, np.newaxis], (12, 4, 3)).copy()
    mixed = mixed_power(flat, radii, 2.0)
    # about 0.5, 3.5, 6.5, 9.5; below 0 a radius counts as the other side's
    np.testing.assert_allclose(mixed[:, 0, 0], [1.3, 3.5, 6.5, 9.5], atol=0.11)


def test_radii_that_no_range_of_mixture_fits_into_are_measured_all_the_same(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 9), 2000.0)
    found = estimate_evidence(image, bank, whole(image.shape), EvidenceOptions(varied_px=60.0))[1]
    assert found.status == "ok"
    assert abs(found.depth_mm - 2000.0) < 50.0


def test_learning_is_reproducible_and_round_trips(bank: Bank) -> None:
    first, second = learn(bank, seed=3, samples=4), learn(bank, seed=3, samples=4)
    np.testing.assert_array_equal(first[LEARNED], second[LEARNED])
    np.testing.assert_allclose(Learned.from_array(first[LEARNED]).as_array(), first[LEARNED])


@pytest.mark.parametrize("seed", [21, 22, 23])
def test_object_beyond_the_last_plane_is_not_put_in_front_without_a_word(bank: Bank, seed: int) -> None:
    """Its mirror depth lies within the bank, and the size of its blur fits there; only its side of focus tells."""
    image = photograph(leaves(SIDE + 64, seed), 4500.0)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "ambiguous"
    assert "beyond the bank's last plane" in found.reason
    assert found.interval_mm[0] <= 4500.0 <= found.interval_mm[1]


@pytest.mark.parametrize("seed", [24, 25, 26])
def test_near_object_whose_mirror_is_beyond_reach_keeps_its_depth(bank: Bank, seed: int) -> None:
    image = photograph(leaves(SIDE + 64, seed), 780.0)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "ok"
    assert abs(found.depth_mm - 780.0) < 15.0


@pytest.mark.parametrize("seed", [31, 32, 33, 34])
def test_wood_grain_does_not_pass_for_a_large_blur(bank: Bank, seed: int) -> None:
    """Nearly all of its power lies within a few frequencies of one line."""
    generator = np.random.default_rng(seed)
    side = SIDE + 164
    grain = ndimage.gaussian_filter(generator.standard_normal((side, side)), (1.0, 30.0))
    planks = np.repeat(generator.uniform(-0.1, 0.1, side), 60)[:side, np.newaxis]
    image = photograph(0.4 + 0.05 * grain / grain.std() + planks, 1100.0)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.interval_mm[0] <= 1100.0 <= found.interval_mm[1]


@pytest.mark.parametrize(
    "setting", [{"window_px": 0}, {"smallest_window_px": -3}, {"radius_step_px": 0.0}, {"margin": 2.0}]
)
def test_constants_out_of_range_are_refused_by_name(setting: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(setting))):
        EvidenceOptions(**setting)  # type: ignore[arg-type]


@pytest.mark.parametrize(("interval_mm", "status"), [
    ((1330.0, 2000.0), "ambiguous"), ((1500.0, 2000.0), "ok"), ((1330.0, 1700.0), "ok"), ((2000.0, 3000.0), "ok"),
])  # fmt: skip
def test_interval_that_reaches_far_to_both_sides_of_focus_names_neither(
    bank: Bank, interval_mm: tuple[float, float], status: str
) -> None:
    """2 pixels of blur are about 139 and 189 cm here."""
    image = photograph(leaves(SIDE, 2), 1600.0)
    sure = estimate_evidence(image, bank, whole(image.shape))[1]
    found = unless_on_either_side(replace(sure, interval_mm=interval_mm, status="ok"), prepare(bank, EvidenceOptions()))
    assert found.status == status
    assert bool(found.reason) == (status == "ambiguous")


@pytest.mark.parametrize(("true_mm", "line_share", "status"), [
    (1660.0, 0.7, "ambiguous"), (1660.0, 0.5, "ok"), (2600.0, 0.7, "ok"),
])  # fmt: skip
def test_few_spectral_lines_tell_no_small_blur_from_another(
    bank: Bank, true_mm: float, line_share: float, status: str
) -> None:
    model = prepare(bank, EvidenceOptions())
    image = photograph(leaves(SIDE, 2), true_mm)
    sure = replace(estimate_evidence(image, bank, whole(image.shape))[1], status="ok", reason="")
    found = unless_few_lines(sure, line_share, model)
    assert found.status == status
    if status == "ok":
        assert found is sure
    else:
        assert found.reason
        assert found.depth_mm == sure.depth_mm
        assert found.interval_mm[0] == pytest.approx(model.depth_within_mm(-7.5))
        assert found.interval_mm[1] == pytest.approx(model.depth_within_mm(7.5))


def test_side_of_a_single_edge_next_to_focus_stays_open(bank: Bank) -> None:
    edge = np.where(np.arange(330) < 165, 0.3, 0.6)
    image = photograph(np.tile(edge, (330, 1)), 1300.0)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "ambiguous"
    assert found.reason == "its side of focus is open: every blur within its interval fits"
    assert found.interval_mm[0] <= 1300.0 <= found.interval_mm[1]


def test_none_is_named_where_the_rest_is_spread_evenly(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 3), 2400.0)
    unsure = replace(bank, extras={LEARNED: replace(Learned(), outlier=0.3).as_array()})
    found = estimate_evidence(image, unsure, whole(image.shape))[1]
    assert found.status == "ambiguous"
    assert np.isnan(found.second_mm)
    assert found.reason == "30% probability of another depth, none of them likely by itself"


def test_windows_of_any_side_can_be_compared(bank: Bank) -> None:
    """Halves of 132 and 140 pixels are no multiples of a tile."""
    image = photograph(leaves(SIDE, 3), 2400.0)
    mask = np.zeros(image.shape, np.int32)
    mask[10:80, 20:90] = 1
    for side in (132, 140):
        found = estimate_evidence(image, bank, mask, EvidenceOptions(window_px=side))[1]
        assert found.interval_mm[0] <= 2400.0 <= found.interval_mm[1]


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_prior_weighs_depths_as_its_power_says_and_is_even_beyond_the_planes(bank: Bank, power: float) -> None:
    model = prepare(bank, EvidenceOptions())
    near, far = 1050.0, 3300.0
    sigma = np.array([model.psfs.radius_px(z) for z in (near, far)])
    found = log_prior(model, sigma, power)
    assert found[1] - found[0] == pytest.approx(power * np.log(far / near), rel=1e-6)
    first, last = model.planes_px
    assert log_prior(model, np.array([first - 0.4, last + 0.4]), power) == pytest.approx(
        log_prior(model, np.array([first, last]), power)
    )


def test_texture_without_a_side_is_taken_for_the_farther_by_the_ratio_of_the_two(bank: Bank) -> None:
    """Gaussian noise at 115 cm or 263: odds of 2.3 to 1, evenly spread radii even ones."""
    image = photograph(0.5 + 0.1 * np.random.default_rng(7).standard_normal((SIDE, SIDE)), 1150.0)
    odds = {}
    for power in (0.0, 1.0, 2.0):
        found = estimate_evidence(image, bank, whole(image.shape), EvidenceOptions(prior_power=power))[1]
        far = float(found.score[found.depths_mm > 1800.0].sum())
        odds[power] = np.log(far / float(found.score[found.depths_mm < 1400.0].sum()))
    assert odds[1.0] - odds[0.0] == pytest.approx(np.log(2630 / 1150), abs=0.15)
    assert odds[2.0] - odds[0.0] == pytest.approx(2 * np.log(2630 / 1150), abs=0.3)


@pytest.mark.parametrize("last_mm", [20000.0, 35000.0, 50000.0])
def test_bank_that_reaches_near_infinity_measures(last_mm: float) -> None:
    """Its grid of radii ends beyond the radius at infinity."""
    bank = with_pupil(make_bank(depths_mm=1.0 / np.linspace(1 / 700.0, 1 / last_mm, 24)))
    image = photograph(leaves(SIDE, 3), 2400.0)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.depth_mm == pytest.approx(2400.0, rel=0.03)
    image = photograph(leaves(SIDE, 5), 19000.0)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert 0 < found.interval_mm[0] <= 19000.0 <= found.interval_mm[1]
    assert abs(1 / found.depth_mm - 1 / 19000.0) < 8e-6  # 0.17 px of radius
    assert found.depths_mm.min() > 0


def test_no_other_depth_lies_beyond_infinity() -> None:
    bank = with_pupil(make_bank(depths_mm=1.0 / np.linspace(1 / 700.0, 1 / 40000.0, 24)))
    options = EvidenceOptions()
    model = prepare(bank, options)
    beyond = model.psfs.radius_px(1e12) + 0.2
    sigma = np.linspace(-beyond - 1.0, beyond + 0.2, 4001)
    places = ((-beyond, 0.0), (beyond, -1.0))  # a second depth, and the mirror of the first, past infinity
    log_post = np.logaddexp.reduce([level - 0.5 * ((sigma - place) / 0.05) ** 2 for place, level in places])
    found = summarise(sigma, log_post, log_post, 16384, 0.05, model, Learned(), options, {})
    assert found.depth_mm < 1600.0
    assert found.second_mm > 40000.0
    assert found.mirror_mm > 40000.0


def test_regions_measured_at_once_have_the_same_depths_as_one_by_one(bank: Bank) -> None:
    image = photograph(leaves(2 * SIDE, 8), 2600.0)
    labels = np.zeros(image.shape, np.int32)
    for number, (row, column) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1)), start=3):
        labels[row * SIDE : row * SIDE + 140, column * SIDE : column * SIDE + 140] = number
    one_by_one = estimate_depths(image, bank, labels, "evidence", {})
    at_once = estimate_depths(image, bank, labels, "evidence", {}, workers=3)
    assert list(at_once) == [3, 4, 5, 6]
    assert [e.depth_mm for e in at_once.values()] == [e.depth_mm for e in one_by_one.values()]
    assert [e.interval_mm for e in at_once.values()] == [e.interval_mm for e in one_by_one.values()]
