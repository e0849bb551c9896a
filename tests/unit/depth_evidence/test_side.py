"""The comparison of the two sides of focus: for the true one, in units of its own standard error."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.unit.depth_evidence.synthetic import draw_psf, leaves, photograph, radius_px
from workbench.depth import evidence_side
from workbench.depth.evidence_restoration import cut_patches
from workbench.depth.evidence_side import FAMILIES, STATISTICS, Comparison, compare, favour_by_window
from workbench.depth.evidence_spectrum import TextureSpectrum, basis
from workbench.depth.evidence_windows import place_windows, soft_mask

SIDE = 192
FAR, NEAR = 2400.0, 1200.0
"""Mirror depths about the focus."""


def texture_spectrum() -> TextureSpectrum:
    """Falls as 1/f^2, a thousand times over the noise at a tenth of a cycle per pixel."""
    modulus = np.geomspace(0.02, 0.4, 50)
    terms = basis(modulus, np.zeros_like(modulus), ())
    wanted = np.log(0.003**2) + np.log(1e3) - 2.0 * np.log(modulus / 0.1)
    coefficients = np.zeros(terms.shape[1])
    hats = slice(0, 5)
    coefficients[hats] = np.linalg.lstsq(terms[:, hats], wanted, rcond=None)[0]
    return TextureSpectrum(coefficients, float(np.log(0.003**2)), ())


def psfs() -> list[NDArray[np.float32]]:
    return [draw_psf(depth).astype(np.float32) for depth in (FAR, NEAR)]


def compared(texture: NDArray[np.float64], depth_mm: float) -> Comparison:
    plane = photograph(texture, depth_mm).luminance
    mask = np.ones(plane.shape, np.bool_)
    soft, _ = soft_mask(mask, margin_px=6.0, ramp_px=12.0)
    windows = place_windows(mask, soft, 128, least_weight=0.3)
    return compare(cut_patches(plane, soft, windows), windows, psfs(), texture_spectrum())


@pytest.mark.parametrize("seed", [31, 32, 33])
def test_true_side_is_sparser_by_every_statistic(seed: int) -> None:
    far, near = compared(leaves(SIDE + 64, seed), FAR), compared(leaves(SIDE + 64, seed), NEAR)
    assert far.favour.shape == (len(STATISTICS),)
    assert far.sparse.shape == (2, len(FAMILIES))
    assert (far.favour[:-1] > 1.5).all()
    assert (near.favour[:-1] < -1.5).all()
    assert (far.sparse[0] < far.sparse[1]).all()
    assert np.abs(np.concatenate([far.favour, near.favour])).max() < 4.0


def test_texture_without_phases_favours_no_side() -> None:
    generator = np.random.default_rng(5)
    found = []
    for _ in range(6):
        size = SIDE + 64
        modulus = np.hypot(np.fft.fftfreq(size)[:, np.newaxis], np.fft.rfftfreq(size))
        noise = np.fft.irfft2(np.fft.rfft2(generator.standard_normal((size, size))) / np.maximum(modulus, 0.01))
        found.append(compared(0.4 + 0.1 * noise / noise.std(), FAR).favour)
    assert np.abs(np.mean(found, axis=0)).max() < 1.5
    assert np.abs(found).mean() < 1.5


@pytest.mark.parametrize("depth_mm", [FAR, NEAR])
def test_zone_plate_favours_no_side_since_it_has_no_edges(depth_mm: float, monkeypatch: pytest.MonkeyPatch) -> None:
    y, x = np.mgrid[: SIDE + 64, : SIDE + 64] - (SIDE + 64) / 3
    plate = 0.45 + 0.3 * np.cos(np.pi * 0.45 * (x * x + y * y) / SIDE)
    wrong_side = -np.sign(radius_px(depth_mm))
    wrong = wrong_side * compared(plate, depth_mm).favour
    monkeypatch.setattr(evidence_side, "_WAVES", (10.0, 9.0))  # whatever it is, take it for edges
    unguarded = wrong_side * compared(plate, depth_mm).favour
    assert unguarded.mean() > 1.0
    assert wrong.mean() < 0.3 * unguarded.mean()


def test_more_of_the_same_texture_says_more_though_the_difference_stays() -> None:
    plane = photograph(leaves(384, 35), FAR, noise=0.02).luminance
    soft = np.ones(plane.shape, np.float32)
    windows = place_windows(soft > 0, soft, 128, least_weight=0.3)
    few = [compare(cut_patches(plane, soft, [window]), [window], psfs(), texture_spectrum()) for window in windows[::4]]
    all_of_them = compare(cut_patches(plane, soft, windows), windows, psfs(), texture_spectrum())
    differences = np.array([c.sparse[1] - c.sparse[0] for c in few]).mean(axis=0)
    np.testing.assert_allclose(all_of_them.sparse[1] - all_of_them.sparse[0], differences, rtol=0.5, atol=0.01)
    errors = [c.favour / np.sqrt(1.0 - (c.favour / 4.0) ** 2) for c in (all_of_them, *few)]
    assert errors[0].mean() > 1.4 * np.median([own.mean() for own in errors[1:]])


def test_window_by_window_is_the_same_as_one_window_alone() -> None:
    plane = photograph(leaves(SIDE + 64, 34), FAR).luminance
    mask = np.ones(plane.shape, np.bool_)
    soft, _ = soft_mask(mask, margin_px=0.0, ramp_px=1.0)
    windows = place_windows(mask, soft, 128, least_weight=0.3)
    texture = texture_spectrum()
    each = favour_by_window(plane, soft, windows, psfs(), texture)
    assert each.shape == (len(windows), len(STATISTICS))
    for window, own in zip(windows, each, strict=True):
        alone = compare(cut_patches(plane, soft, [window]), [window], psfs(), texture, is_light=False)
        np.testing.assert_allclose(own, alone.favour, rtol=1e-5)
