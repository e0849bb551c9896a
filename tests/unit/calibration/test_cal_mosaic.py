"""Photosites: which part is which, what their luminance passes, and whether they hold details of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drawn_points import BLACK, WHITE, write_dng

from calibration.mosaic import (
    Mosaic,
    grey_photosites,
    native_luminance_power,
    native_pixels,
    resolves_photosites,
    superpixels,
)
from calibration.raw import develop

PATTERNS = {"RGGB": (0, 1, 3, 2), "BGGR": (2, 1, 3, 0), "GRBG": (1, 0, 2, 3), "GBRG": (1, 2, 0, 3)}


def mosaic_of(light: np.ndarray, pattern: str = "RGGB") -> Mosaic:
    sites = np.rint(1000 + 8000 * light).astype(np.uint16)
    return Mosaic(sites, PATTERNS[pattern], (1000.0,) * 4, 9000.0)


def smooth_light(side: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((side, side))
    fy, fx = np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)
    kept = np.fft.ifft2(np.fft.fft2(noise) * np.exp(-((np.hypot(fy, fx) / 0.15) ** 2))).real
    return 0.5 + 0.1 * kept / kept.std()


@pytest.mark.parametrize("pattern", PATTERNS)
def test_details_of_photosites_are_told_from_cells_filled_from_one_pixel(pattern: str) -> None:
    light = smooth_light(96, 1)
    assert resolves_photosites(mosaic_of(light, pattern))
    coarse = light[::2, ::2].repeat(2, axis=0).repeat(2, axis=1)
    noise = 0.004 * np.random.default_rng(2).standard_normal(light.shape)
    assert not resolves_photosites(mosaic_of(coarse + noise, pattern))


def test_mosaic_is_kept_on_request_where_it_says_more(tmp_path: Path) -> None:
    light = smooth_light(96, 3)
    raw = np.rint(BLACK + light * (WHITE - BLACK)).astype(np.uint16)
    path = write_dng(tmp_path / "fine.dng", raw)
    assert develop(path).mosaic is None
    assert develop(path, recipe="native", keep_mosaic=True).mosaic is None
    kept = develop(path, keep_mosaic=True).mosaic
    assert kept is not None
    np.testing.assert_array_equal(kept.photosites, raw)
    filled = write_dng(tmp_path / "coarse.dng", raw[::2, ::2].repeat(2, axis=0).repeat(2, axis=1))
    assert develop(filled, keep_mosaic=True).mosaic is None


def test_part_is_cut_in_whole_cells() -> None:
    whole = mosaic_of(smooth_light(64, 4))
    part = whole.part(slice(3, 20), slice(5, 30))
    np.testing.assert_array_equal(superpixels(part)[0], superpixels(whole)[0][3:20, 5:30])


@pytest.mark.parametrize("pattern", PATTERNS)
def test_tinted_light_is_made_grey_and_filtered_like_all_luminance(pattern: str) -> None:
    light = smooth_light(64, 5)
    tint = np.array([{0: 0.5, 1: 1.0, 3: 1.0, 2: 0.7}[index] for index in PATTERNS[pattern]]).reshape(2, 2)
    tinted = mosaic_of(light * np.tile(tint, (32, 32)), pattern)
    grey = grey_photosites(tinted, np.ones((32, 32), np.bool_))
    assert grey is not None
    expected = native_pixels(mosaic_of(light))[0] @ np.array([0.25, 0.5, 0.25])
    np.testing.assert_allclose(grey / grey.mean(), expected / expected.mean(), rtol=0.02)
    dark = mosaic_of(light * np.tile(np.where(tint < 1, 0.01, 1.0), (32, 32)), pattern)
    assert grey_photosites(dark, np.ones((32, 32), np.bool_)) is None


@pytest.mark.parametrize(("fy", "fx"), [(0.0, 0.125), (0.25, 0.0), (0.1875, 0.25), (0.3125, 0.125)])
def test_luminance_at_photosite_pitch_passes_grey_waves_as_stated(fy: float, fx: float) -> None:
    y, x = np.mgrid[:64, :64]
    light = 0.5 + 0.3 * np.cos(2 * np.pi * (fy * y + fx * x))
    planes, _ = native_pixels(mosaic_of(light))
    seen = (planes @ np.array([0.25, 0.5, 0.25]))[16:48, 16:48]
    power = np.abs(np.fft.fft2(seen - seen.mean())) ** 2
    ratio = power.max() / (0.15 * 32 * 32) ** 2
    assert ratio == pytest.approx(float(native_luminance_power(np.array(fy), np.array(fx))), rel=2e-3)
