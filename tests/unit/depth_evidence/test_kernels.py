"""Autocorrelations of blurs on pixels: frequencies that fold back count as what a texture has of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft

from calibration.bank import Bank
from calibration.pupil import PupilModel, interpolator_of_bank, psf_model
from tests.unit.depth_evidence.synthetic import as_image, blurred, draw_psf, make_bank, radius_px, with_pupil
from workbench.depth.evidence import estimate_evidence
from workbench.depth.evidence_kernels import kernel_lags
from workbench.depth.regions import whole

FINER, SIDE = 4, 41


@pytest.mark.parametrize("depth_mm", [900.0, 1300.0, 1500.0, 1700.0, 2000.0])
def test_power_folds_by_the_fall_of_a_textures_spectrum(bank: Bank, depth_mm: float) -> None:
    """Against the whole plane of frequencies of the same PSF on pixels of half the size, folded one by one."""
    psfs = psf_model(bank)
    assert isinstance(psfs, PupilModel)
    side = psfs.side_px(depth_mm)
    size = 2 * fft.next_fast_len(side)
    fine = psfs.finer(2).psf_at(depth_mm, 2 * side).astype(np.float64)
    box = np.zeros((2 * size, 2 * size))
    box[:2, :2] = 0.25
    power = np.abs(fft.fft2(fine, box.shape) * fft.fft2(box)) ** 2
    expected = np.zeros((size, size))
    for row, column in np.ndindex(power.shape):
        true = [k / size if k < size else k / size - 2.0 for k in (row, column)]  # cycles per pixel
        seen = [f - np.rint(f) for f in true]
        fall = 1.0 if row == column == 0 else (np.hypot(*seen) / np.hypot(*true)) ** 2.4
        expected[row % size, column % size] += fall * power[row, column]
    lags = fft.fftshift(fft.ifft2(expected).real)
    middle = slice(size // 2 - side + 1, size // 2 + side)
    found = kernel_lags(psfs, np.array([depth_mm]), side, 0.0)[0]
    np.testing.assert_allclose(found, lags[middle, middle], atol=1e-5 * float(found.max()))


def test_small_blurs_are_drawn_on_few_pixels_and_lie_in_the_middle(bank: Bank) -> None:
    large, small = (kernel_lags(psf_model(bank), np.array([1700.0]), size, 0.0)[0] for size in (41, 21))
    np.testing.assert_allclose(large[20:-20, 20:-20], small, atol=1e-7)
    assert not large[:10].any()


def test_error_of_the_psf_is_white(bank: Bank) -> None:
    exact, rough = (kernel_lags(psf_model(bank), np.array([2500.0]), SIDE, error)[0] for error in (0.0, 0.1))
    more = rough - exact
    assert more[SIDE - 1, SIDE - 1] == pytest.approx(0.01 * exact[SIDE - 1, SIDE - 1], rel=1e-3)
    assert np.count_nonzero(more) == 1


def test_measured_psfs_fold_as_they_were_sampled(bank: Bank) -> None:
    blend = interpolator_of_bank(bank, 0)
    lags = kernel_lags(blend, np.array([2500.0]), SIDE, 0.0)[0]
    psf = blend.psf_at(2500.0, SIDE).astype(np.float64)
    assert lags[SIDE - 1, SIDE - 1] == pytest.approx((psf**2).sum(), rel=1e-4)
    assert lags[SIDE - 1, SIDE] == pytest.approx((psf[:, 1:] * psf[:, :-1]).sum(), rel=1e-4)


@pytest.mark.parametrize("depth_mm", [2150.0, 2600.0])
def test_detail_finer_than_pixels_makes_no_blur_look_smaller(depth_mm: float) -> None:
    """Crisp edges drawn four times as fine as the pixels; sampled PSFs' own power reads them 0.05 px too sharp."""
    bank, generator, errors = with_pupil(make_bank()), np.random.default_rng(5), []
    for _ in range(4):
        steps = np.cumsum(generator.integers(3, 24, size=(2, 400)), axis=1)
        lines = [np.searchsorted(edges, np.arange(4 * 224)) % 2 for edges in steps]
        texture = 0.3 + 0.4 * (lines[0][:, np.newaxis] ^ lines[1])
        light = blurred(texture, draw_psf(depth_mm, per_superpixel=FINER))
        side = light.shape[0] // FINER
        seen = light[: FINER * side, : FINER * side].reshape(side, FINER, side, FINER).mean(axis=(1, 3))
        noisy = seen[..., np.newaxis] + 0.004 * generator.standard_normal((side, side, 3))
        found = estimate_evidence(as_image(noisy.astype(np.float32)), bank, whole((side, side)))[1]
        errors.append(abs(radius_px(found.depth_mm)) - abs(radius_px(depth_mm)))
    assert abs(np.mean(errors)) < 0.03, errors
