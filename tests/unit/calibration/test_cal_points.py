from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_points import as_frame, draw_psf, point_image

from calibration.errors import PointError
from calibration.points import find_points, remove_hot_pixels
from calibration.psf import Plane, place, stack_repeats, undo_dot


def test_flux_noise_and_gain_of_a_point_are_measured() -> None:
    light = draw_psf(12.0, (96, 96), (48.2, 47.9), 0.5) * 60.0
    point = find_points(as_frame(light))[0]
    # luminance of the frame is (0.6 + 2 + 0.7) / 4 of the light
    assert point.flux == pytest.approx(60.0 * 0.825, rel=2e-3)
    assert point.noise == pytest.approx(np.sqrt(1e-7 * 6) / 4, rel=0.05)
    # channel variance 4e-5 per unit; luminance (R + 2 G + B) / 4 of channels of unequal brightness
    true_gain = 4e-5 * (0.6 + 4 + 0.7) / 16 / 0.825
    assert 0.5 * true_gain < point.noise_gain < 2.0 * true_gain


def test_a_one_pixel_point_at_focus_is_no_hot_pixel() -> None:
    light = np.zeros((64, 64))
    light[30, 31] = 0.7
    point = find_points(as_frame(light))[0]
    assert point.support.sum() < 30
    assert point.flux == pytest.approx(0.7 * 0.825, rel=0.02)


def test_hot_photosites_do_not_make_a_point_doubled_or_shift_it() -> None:
    frame = point_image(1000.0)
    planes = frame.planes.copy()
    rng = np.random.default_rng(3)
    for _ in range(60):
        planes[rng.integers(0, 96), rng.integers(0, 96), rng.integers(0, 3)] += rng.uniform(0.05, 0.9)
    clean = find_points(frame)[0]
    hot = find_points(type(frame)(planes, frame.saturated, frame.recipe, frame.pixel_pitch_mm, frame.info))[0]
    assert hot.flux == pytest.approx(clean.flux, rel=0.02)
    cleaned, mask = remove_hot_pixels(planes)
    assert mask.sum() > 40
    assert np.abs(cleaned - frame.planes).max() < 0.2


def test_one_saturated_photosite_within_even_light_is_hot_and_not_the_point() -> None:
    light = draw_psf(14.0, (96, 96), (48.0, 48.0), 0.5)
    light *= 0.65 / light.max()
    frame = as_frame(light)
    clean = find_points(frame)[0]
    around = cv2.erode(light, np.ones((3, 3), np.uint8))
    row, column = np.unravel_index(int(around.argmax()), around.shape)
    assert around[row, column] > 0.5
    planes, saturated = frame.planes.copy(), frame.saturated.copy()
    planes[row, column, 1], saturated[row, column] = 1.0, True
    spoilt = type(frame)(planes, saturated, frame.recipe, frame.pixel_pitch_mm, frame.info)
    assert find_points(spoilt)[0].flux == pytest.approx(clean.flux, rel=1e-3)
    planes[row, column : column + 2], saturated[row, column : column + 2] = 1.0, True  # side by side: the point's own
    with pytest.raises(PointError, match="saturated"):
        find_points(spoilt)


def test_a_sloping_background_is_removed_locally() -> None:
    yy, xx = np.mgrid[0:96, 0:96] / 96.0
    light = draw_psf(12.0, (96, 96), (48.0, 48.0), 0.5) * 60.0
    clean = find_points(as_frame(light))[0]
    sloping = find_points(as_frame(light + 0.05 + 0.04 * yy - 0.03 * xx))[0]
    assert sloping.flux == pytest.approx(clean.flux, rel=0.01)
    assert sloping.background > 0.03


def test_a_wide_faint_point_that_no_single_pixel_shows_is_found_whole() -> None:
    light = draw_psf(30.0, (160, 160), (80.0, 80.0), 0.5)
    light *= 4.5 * np.sqrt(1e-7 * 6) / 4 / 0.825 / light.max()
    found = find_points(as_frame(light))[0]
    assert found.flux == pytest.approx(light.sum() * 0.825, rel=0.06)


def _frame_without_point() -> np.ndarray:
    return np.zeros((96, 96))


def _two_points() -> np.ndarray:
    return 40.0 * (draw_psf(8.0, (96, 96), (30, 30), 0.5) + 0.3 * draw_psf(8.0, (96, 96), (70, 66), 0.5))


@pytest.mark.parametrize(
    ("light", "reason"),
    [
        (_frame_without_point(), "missing"),
        (_two_points(), "doubled"),
        (400.0 * draw_psf(8.0, (96, 96), (48, 48), 0.5), "saturated"),
        (40.0 * draw_psf(20.0, (96, 96), (85, 48), 0.5), "clipped"),
        (0.05 * draw_psf(4.0, (96, 96), (48, 48), 0.5), "faint"),
    ],
)
def test_unusable_points_are_refused_by_name(light: np.ndarray, reason: str) -> None:
    with pytest.raises(PointError) as caught:
        find_points(as_frame(light, name="psf_100cm.dng"))
    assert caught.value.reason == reason
    assert "psf_100cm.dng" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_grid_of_points_comes_back_in_rows() -> None:
    light = sum(30.0 * draw_psf(6.0, (160, 160), (y, x), 0.5, 50_000) for y in (40, 80, 120) for x in (40, 80, 120))
    found = find_points(as_frame(np.asarray(light)), expected=9)
    centres = [(round(p.corner_yx[0] / 40), round(p.corner_yx[1] / 40)) for p in found]
    assert centres == sorted(centres)
    assert len(set(centres)) == 9


def test_repeats_are_registered_to_a_fraction_of_a_pixel() -> None:
    shifts = [(0.0, 0.0), (0.4, -0.3), (1.7, 0.6)]
    points = [
        find_points(point_image(700.0, centre=(48 + dy, 48 + dx), core=0.8, seed=k))[0]
        for k, (dy, dx) in enumerate(shifts)
    ]
    stacked = stack_repeats(points)
    np.testing.assert_allclose(stacked.shifts_px, shifts, atol=0.05)


def test_averaging_repeats_lowers_the_error_and_the_scatter_is_one() -> None:
    points = [find_points(point_image(900.0, seed=1000 * k))[0] for k in range(4)]
    stacked = stack_repeats(points)
    assert stacked.repeats == 4
    assert 0.7 < stacked.scatter < 1.4
    assert stacked.point.flux_snr == pytest.approx(2.0 * points[0].flux_snr, rel=0.3)


def test_placed_psf_sums_to_one_about_the_chief_ray_with_honest_errors() -> None:
    sample = []
    for seed in range(24):
        point = find_points(point_image(900.0, seed=10_000 * (seed + 1)))[0]
        sample.append(place(point, (48.2, 47.9), (48, 48), 20))
    psf = np.stack([p.psf for p in sample])
    np.testing.assert_allclose(psf.sum(axis=(1, 2)), 1.0, atol=1e-12)
    assert sample[0].offset_yx == pytest.approx((0.2, -0.1))
    common = (psf != 0).all(axis=0)
    ratio = psf.std(axis=0, ddof=1)[common] / np.mean([p.se for p in sample], axis=0)[common]
    assert 0.7 < float(np.median(ratio)) < 1.4


def test_undoing_the_dot_brings_the_psf_closer_to_the_true_one() -> None:
    true = draw_psf(-9.0, (41, 41), (20, 20), 0.4)
    blurred = draw_psf(-9.0, (41, 41), (20, 20), 0.4, dot=1.5)
    plane = Plane(blurred, np.full(blurred.shape, 1e-5), (0.0, 0.0))
    mended = undo_dot(plane, 1.5)
    before, after = np.abs(blurred - true).sum(), np.abs(mended.psf - true).sum()
    assert after < 0.6 * before
    assert mended.psf.sum() == pytest.approx(1.0)
    assert undo_dot(plane, 0.2) is plane
