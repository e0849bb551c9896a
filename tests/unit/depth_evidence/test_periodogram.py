"""The pooled periodogram against the same sums written out, for regions of any shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from workbench.depth.evidence_periodogram import effective_pixels, pooled_periodogram
from workbench.depth.evidence_spectrum import frequencies
from workbench.depth.evidence_windows import Window, place_windows, soft_mask

SHAPE = 150, 170


def written_out(plane: np.ndarray, windows: Sequence[Window], lags: int) -> tuple[np.ndarray, np.ndarray]:
    """Power and lags in double precision, one window after another, nothing shared."""
    size = windows[0].taper.shape[0]
    y, x = np.mgrid[:size, :size] / size
    padded = np.pad(plane.astype(np.float64), size + 1, mode="symmetric")
    power, correlation, energy = np.zeros((size, size // 2 + 1)), np.zeros((4 * size, 4 * size)), 0.0
    for window in windows:
        taper = window.taper.astype(np.float64)
        top, left = window.row + size, window.column + size
        patch = padded[top : top + size + 1, left : left + size + 1]
        for step in (patch[1:, 1:] - patch[:-1, 1:], patch[1:, 1:] - patch[1:, :-1]):
            root = np.sqrt(taper).ravel()
            terms = np.stack([np.ones(size * size), y.ravel(), x.ravel()], axis=1)
            tilt = np.linalg.lstsq(terms * root[:, np.newaxis], step.ravel() * root, rcond=None)[0]
            power += np.abs(np.fft.rfft2((step - (terms @ tilt).reshape(step.shape)) * taper)) ** 2
        correlation += np.fft.ifft2(np.abs(np.fft.fft2(taper, (4 * size, 4 * size))) ** 2).real
        energy += (taper**2).sum()
    turn = 2 * np.pi * np.fft.fftfreq(size)
    response = np.abs(np.exp(1j * turn) - 1)[:, np.newaxis] ** 2 + np.abs(np.exp(1j * turn[: size // 2 + 1]) - 1) ** 2
    response[0, 0] = 1.0
    wanted = np.arange(-lags, lags + 1)
    return power / response / energy, correlation[np.ix_(wanted, wanted)] / energy


def regions() -> dict[str, np.ndarray]:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    ring = np.hypot(y - 75, x - 80)
    return {
        "whole": np.ones(SHAPE, np.bool_),
        "corner": (y > 90) & (x > 100),
        "ring": (ring < 74) & (ring > 20),
        "smaller than a window": (np.abs(y - 20) < 22) & (np.abs(x - 20) < 25),
    }


@pytest.mark.parametrize("region", regions())
@pytest.mark.parametrize("lags", [10, 80])
def test_power_and_lags_are_those_written_out(region: str, lags: int) -> None:
    generator = np.random.default_rng(5)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    plane = (generator.normal(0, 0.02, SHAPE).cumsum(axis=1) + 0.01 * y - 0.003 * x).astype(np.float32)
    mask = regions()[region]
    soft, _ = soft_mask(mask, margin_px=2.0, ramp_px=8.0)
    windows = place_windows(mask, soft, 64, least_weight=0.1)
    pooled = pooled_periodogram(plane, windows, lags)
    power, correlation = written_out(plane, windows, lags)
    np.testing.assert_allclose(pooled.power[1:, 1:], power[1:, 1:], rtol=2e-3, atol=1e-9)
    np.testing.assert_allclose(pooled.taper_lags, correlation, atol=1e-6)


@pytest.mark.parametrize("region", regions())
def test_white_noise_scatters_as_that_many_pixels_would(region: str) -> None:
    """The power in the band that is used, over draws of the noise."""
    mask = regions()[region]
    soft, _ = soft_mask(mask, margin_px=2.0, ramp_px=8.0)
    windows = place_windows(mask, soft, 64, least_weight=0.1)
    _, _, used = frequencies(64)
    draws = (np.random.default_rng(seed).standard_normal(SHAPE).astype(np.float32) for seed in range(300))
    total = np.array([pooled_periodogram(noise, windows, 1).power[used].sum() for noise in draws])
    share = 2.0 * used.sum() / 64**2  # of all frequencies, the other half of the plane repeating this one
    scattered = 2.0 * total.mean() ** 2 / total.var() / share  # the sum of n squared normal numbers: 2 mean^2 / n
    assert scattered == pytest.approx(effective_pixels(windows), rel=0.25)


def test_frequencies_of_full_windows_count_alike_however_many_and_those_of_cut_ones_for_less() -> None:
    plane = np.random.default_rng(1).standard_normal((256, 256)).astype(np.float32)

    def share(mask: np.ndarray, ramp_px: float) -> float:
        soft, _ = soft_mask(mask, margin_px=0.0, ramp_px=ramp_px)
        return pooled_periodogram(plane, place_windows(mask, soft, 64, least_weight=0.1), 20).independent_share

    whole, one = np.ones((256, 256), np.bool_), np.zeros((256, 256), np.bool_)
    one[:64, :64] = True
    blob = np.hypot(*np.mgrid[-32:224, -32:224]) < 20
    assert share(one, 1e-6) == pytest.approx(0.3, rel=0.02)
    assert share(whole, 1e-6) == pytest.approx(0.3, rel=0.1)
    assert share(blob, 12.0) < 0.15
