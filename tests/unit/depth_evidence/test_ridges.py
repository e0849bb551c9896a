"""Lines in spectra: found where edges make them, and told from those of the aperture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from calibration.bank import Bank
from tests.unit.depth_evidence.synthetic import leaves, make_bank, photograph, with_pupil
from workbench.depth import evidence_spectrum
from workbench.depth.evidence import EvidenceOptions, estimate_evidence, prepare
from workbench.depth.evidence_expected import smeared_power
from workbench.depth.evidence_observation import observe
from workbench.depth.evidence_periodogram import pooled_periodogram
from workbench.depth.evidence_ridges import MOST_RIDGES, UNEXPLAINED, VISIBLE, ridge_directions, with_perpendiculars
from workbench.depth.evidence_spectrum import EXPECTED_SLOPE, SUPERPIXELS, basis, fit_spectra, frequencies
from workbench.depth.evidence_windows import Window, hann
from workbench.depth.regions import whole

SIZE = 128


def log_power(lines: dict[float, float], seed: int = 1, size: int = SIZE) -> np.ndarray:
    """A falling spectrum, averaged over 8 windows, with lines of these directions (degrees) and heights."""
    modulus, direction, _ = frequencies(size)
    level = -2.0 * np.log(np.maximum(modulus, 1 / size))
    for degrees, height in lines.items():
        away = modulus * size * np.sin(direction - np.radians(degrees))
        level += height * np.exp(-0.5 * (away / 1.0) ** 2)
    return level + np.log(np.random.default_rng(seed).gamma(8.0, 1 / 8.0, level.shape))


def degrees(found: tuple[float, ...]) -> list[float]:
    return sorted(np.degrees(found).tolist())


@pytest.mark.parametrize("size", [32, 64, 128])
def test_spectra_without_a_direction_have_no_lines(size: int) -> None:
    for seed in range(20):
        level = log_power({}, seed, size)
        assert ridge_directions(level, (), VISIBLE) == ridge_directions(level, (), UNEXPLAINED) == ()


def test_lines_are_found_the_highest_first() -> None:
    found = ridge_directions(log_power({20.0: 3.0, -50.0: 2.0, 89.5: 4.0}), (), VISIBLE)
    assert np.degrees(found) % 180.0 == pytest.approx([89.5, 20.0, 130.0], abs=2.0)


def test_known_lines_are_not_found_again_even_across_the_half_plane_s_end() -> None:
    level = log_power({89.0: 3.0, 20.0: 3.0})
    assert degrees(ridge_directions(level, (np.radians(-89.0),), VISIBLE)) == pytest.approx([20.0], abs=2.0)


def test_faint_lines_are_none() -> None:
    assert ridge_directions(log_power({20.0: 0.5}), (), VISIBLE) == ()


def test_there_are_never_more_than_a_basis_can_hold() -> None:
    level = log_power(dict.fromkeys(np.arange(-85.0, 90.0, 20.0).tolist(), 4.0))
    assert len(ridge_directions(level, (0.1, 0.5), VISIBLE)) == MOST_RIDGES - 2


def sign(side: int, seed: int) -> np.ndarray:
    """Large letters of straight strokes."""
    generator = np.random.default_rng(seed)
    canvas = np.full((4 * side, 4 * side), 235, np.uint8)
    for row in range(1, 4):
        for column in range(3):
            letter, where = str(generator.choice(list("EKWYZAVMN"))), (360 * column + 40, 380 * row)
            cv2.putText(canvas, letter, where, cv2.FONT_HERSHEY_SIMPLEX, 10.4, 20, 52, cv2.LINE_8)
    return cv2.resize(canvas, (side, side), interpolation=cv2.INTER_AREA) / 255.0 * 0.9


@pytest.mark.parametrize("seed", [2, 6])
def test_sharp_letters_are_in_focus(bank: Bank, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """Without lines they are called ambiguous, or far off."""
    image = photograph(sign(300, seed), 1600.0, seed=seed)
    region = np.ones(image.shape, np.int32)
    found = estimate_evidence(image, bank, region)[1]
    assert found.depth_mm == pytest.approx(1600.0, abs=100.0)
    assert found.status == "ok"
    monkeypatch.setattr(evidence_spectrum, "ridge_directions", lambda *_: ())
    without = estimate_evidence(image, bank, region)[1]
    assert without.status == "ambiguous"
    assert abs(without.depth_mm - 1600.0) > 100.0


def test_a_texture_with_ridges_counts_for_less(bank: Bank, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its spectrum scatters more about what is fitted, and its radius with it."""
    image = photograph(sign(200, 2), 2600.0, noise=0.015, seed=2)
    region = np.ones(image.shape, np.int32)
    found = estimate_evidence(image, bank, region)[1]
    monkeypatch.setattr(evidence_spectrum.SpectralFit, "likelihood_weight", 1.0)
    surer = estimate_evidence(image, bank, region)[1]
    assert found.depth_mm == pytest.approx(2600.0, abs=50.0)
    assert np.ptp(found.interval_mm) > 1.08 * np.ptp(surer.interval_mm)


def test_the_aperture_s_own_edges_are_no_ridges_of_the_texture(bank: Bank) -> None:
    image = photograph(leaves(340, 3), 3000.0)
    model = prepare(bank, EvidenceOptions())
    seen = observe(image.luminance, np.ones(image.shape, np.bool_), model, EvidenceOptions())
    assert seen is not None
    assert seen.view.fit.ridges == ()
    level = np.log(seen.view.pooled.power)
    assert ridge_directions(level, (), VISIBLE) != ()  # though they are seen


@pytest.mark.parametrize("seed", [31, 45])
def test_flat_letters_are_no_mixture_of_blurs(bank: Bank, seed: int) -> None:
    """Mixtures have the ridges of the single blurs that they are compared with."""
    image = photograph(sign(300, seed), 1600.0, seed=seed)
    model = prepare(bank, EvidenceOptions())
    seen = observe(image.luminance, np.ones(image.shape, np.bool_), model, EvidenceOptions())
    assert seen is not None
    assert seen.view.fit.ridges != ()
    assert seen.varied < EvidenceOptions().varied_log_likelihood


def test_perpendiculars_join_where_they_are_new() -> None:
    assert degrees(with_perpendiculars(np.radians([30.0, 118.0]).tolist())) == pytest.approx([30.0, 118.0])
    assert degrees(with_perpendiculars((0.1,))) == pytest.approx(np.degrees([0.1, 0.1 + np.pi / 2]).tolist())
    assert degrees(with_perpendiculars(np.radians([30.0, 60.0]).tolist(), first=1)) == pytest.approx(
        [30.0, 60.0, 120.0]
    )
    assert len(with_perpendiculars(np.radians(np.arange(0.0, 80.0, 15.0)).tolist())) == MOST_RIDGES


@pytest.mark.parametrize(("across", "is_kept"), [(0.5, True), (0.2, False)])
def test_the_highest_ridge_s_perpendicular_is_one_where_it_explains_much(
    bank: Bank, across: float, is_kept: bool
) -> None:
    """Lines too low to be seen beside the others: rows of letters whose strokes mostly run one way."""
    model = prepare(bank, EvidenceOptions())
    window = Window(0, 0, np.outer(hann(SIZE), hann(SIZE)).astype(np.float32), 1.0)
    pooled = pooled_periodogram(np.zeros((SIZE, SIZE), np.float32), [window], model.kernel_lags.shape[1] // 2)
    expected = smeared_power(model.kernel_lags, pooled.taper_lags, SIZE)
    modulus, direction, _ = frequencies(SIZE)
    terms = basis(modulus.ravel(), direction.ravel(), (np.pi / 2, 0.0))
    coefficients = np.zeros(terms.shape[1])
    coefficients[: SUPERPIXELS.log_knots.size] = EXPECTED_SLOPE * SUPERPIXELS.log_knots - 8.0
    coefficients[-2:] = 0.8, across
    power = np.exp(terms @ coefficients).reshape(modulus.shape) * expected[20] + 1e-7
    power *= np.random.default_rng(1).gamma(6.0, 1.0 / 6.0, power.shape)
    ridges = fit_spectra(power, 6.0, expected, independent_share=0.3).ridges
    assert any(abs(np.cos(ridge)) < 0.05 for ridge in ridges)
    assert any(abs(np.sin(ridge)) < 0.05 for ridge in ridges) == is_kept


@pytest.fixture(scope="module")
def far_reaching_bank() -> Bank:
    """Blurs up to a radius of 41 pixels, which spans more than half of a window."""
    return with_pupil(make_bank(depths_mm=1.0 / np.linspace(1.0 / 385.0, 1.0 / 3500.0, 26), half=48))


def plaid(side: int, seed: int, narrowest: int, widest: int, softness: float, grain: float) -> np.ndarray:
    """Stripes down and across, a little soft, and a grain."""
    generator = np.random.default_rng(seed)
    stripes = []
    for _ in range(2):
        widths = generator.integers(narrowest, widest, side)
        stripes.append(
            ndimage.gaussian_filter1d(np.repeat(generator.uniform(0, 1, side), widths)[: side + 5], softness)
        )
    cloth = 0.2 + 0.3 * (stripes[0][:side, np.newaxis] + stripes[1][:side])
    rough = ndimage.gaussian_filter(generator.standard_normal((side, side)), 1.0)
    return cloth + grain * rough / rough.std()


@pytest.mark.parametrize("depth_mm", [560.0, 612.0])
@pytest.mark.parametrize(
    ("seed", "stripes", "grain", "noise"),
    [(0, (6, 30, 0.5), 0.0, 0.003), (2, (6, 30, 0.5), 0.0, 0.003), (3, (10, 60, 1.0), 0.005, 0.002)],
)
def test_plaid_is_not_taken_for_the_lines_that_the_largest_blurs_draw(
    far_reaching_bank: Bank, depth_mm: float, seed: int, stripes: tuple[int, int, float], grain: float, noise: float
) -> None:
    """Without its own lines it read 39 cm, or nothing."""
    cloth = plaid(256 + 140, seed, *stripes, grain)
    image = photograph(cloth, depth_mm, noise=noise, half=48)
    found = estimate_evidence(image, far_reaching_bank, whole(image.shape))[1]
    assert found.depth_mm == pytest.approx(depth_mm, rel=0.02)
    assert found.interval_mm[0] < depth_mm < found.interval_mm[1]


def test_blur_that_is_right_keeps_its_lines(far_reaching_bank: Bank) -> None:
    """Leaves have no lines; those that are seen are the aperture's own."""
    image = photograph(leaves(256 + 140, 41), 450.0, half=48)
    mask = np.ones(image.shape, bool)
    model = prepare(far_reaching_bank, EvidenceOptions())
    seen = observe(image.luminance, mask, model, EvidenceOptions())
    assert seen is not None
    assert abs(model.row_radius_px[seen.view.fit.log_likelihood.argmax()]) > 128 / 4
    assert seen.view.fit.ridges == ()
