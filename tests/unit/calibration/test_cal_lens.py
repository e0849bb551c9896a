from __future__ import annotations

import numpy as np
import pytest
from drawn_points import DEPTHS_MM, FOCUS_MM, SCALE_PX, draw_psf

from calibration.errors import DepthListError, FitError
from calibration.lens_fit import aperture_radius_mm, check_aperture, check_depths, fit_lens
from calibration.pupil_outline import circumscribed
from calibration.render import Core, render, render_slopes, share_matrix
from calibration.template import Spot, TemplateFit, fit_spots
from rigs.simulated.lens import Lens, point_image

DEPTHS = np.arange(600.0, 3501.0, 200.0)


def _radii(zero_mm: float = 0.0, noise: float = 0.02, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return SCALE_PX * (1 - FOCUS_MM / (DEPTHS + zero_mm)) + noise * rng.standard_normal(DEPTHS.size)


def test_focus_scale_and_zero_come_back_with_errors_that_cover() -> None:
    inside = []
    for seed in range(40):
        fit = fit_lens(DEPTHS, _radii(12.0, seed=seed), np.full(DEPTHS.size, 0.02), apply_zero=True)
        pulls = (
            (fit.focus_mm - FOCUS_MM) / fit.focus_se_mm,
            (fit.scale_px - SCALE_PX) / fit.scale_se_px,
            (fit.zero_mm - 12.0) / fit.zero_se_mm,
        )
        inside.append(np.abs(pulls) < 2.0)
    assert 0.85 < float(np.mean(inside)) <= 1.0
    assert fit.sigma_px(DEPTHS + 12.0) == pytest.approx(_radii(12.0, noise=0.0), abs=0.1)


def test_reported_zero_leaves_the_depths_alone() -> None:
    fit = fit_lens(DEPTHS, _radii(3.0), np.full(DEPTHS.size, 0.02), apply_zero=False)
    assert not fit.zero_applied
    assert fit.zero_mm == pytest.approx(3.0, abs=3 * fit.zero_se_mm)
    np.testing.assert_allclose(fit.sigma_px(DEPTHS) + fit.residual_px, fit.radius_px, atol=1e-9)


def test_one_wrong_frame_is_named_and_does_not_bend_the_lens() -> None:
    radius = _radii()
    radius[7] += 1.5
    fit = fit_lens(DEPTHS, radius, np.full(DEPTHS.size, 0.02), apply_zero=True)
    assert np.flatnonzero(fit.suspect).tolist() == [7]
    assert fit.focus_mm == pytest.approx(FOCUS_MM, rel=0.003)


def test_three_depths_give_a_lens_without_a_zero() -> None:
    depths = np.array([800.0, 1500.0, 3000.0])
    fit = fit_lens(depths, 13 * (1 - 1600 / depths), np.full(3, 0.02), apply_zero=True)
    assert fit.focus_mm == pytest.approx(1600.0, rel=1e-4)
    assert np.isnan(fit.zero_mm)
    assert not fit.zero_applied


def test_radii_that_no_lens_makes_are_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(FitError, match="depths and files"):
        fit_lens(DEPTHS, rng.permutation(_radii()), np.full(DEPTHS.size, 0.02), apply_zero=False)


def test_aperture_radius_follows_from_the_papers_numbers() -> None:
    depths = DEPTHS
    scale = 7.0 * 50 / (1600 - 50) / 0.0086
    fit = fit_lens(depths, scale * (1 - 1600 / depths), np.full(depths.size, 0.01), apply_zero=False)
    assert aperture_radius_mm(fit, focal_length_mm=50.0, pixel_pitch_mm=0.0086) == pytest.approx(7.0, rel=1e-3)


@pytest.mark.parametrize(
    ("depths_mm", "expected"),
    [
        ([600.0, 700.0], "at least 3"),
        ([600.0, 700.0, 700.0, 800.0], "70 cm is listed twice"),
        ([600.0, 800.0, 700.0], "ascend up to plane 2 \\(80 cm\\), but plane 3 is at 70"),
        ([6.0, 7.0, 35.0], "metres"),
        ([60_000.0, 70_000.0, 350_000.0], "millimetres"),
        ([60.0, 700.0, 35_000.0], "mix units"),
        ([-100.0, 700.0, 800.0], "positive"),
        ([600.0, float("nan"), 800.0], "positive"),
    ],
)
def test_impossible_depth_lists_are_refused(depths_mm: list[float], expected: str) -> None:
    with pytest.raises(DepthListError, match=expected):
        check_depths(depths_mm, ordered=True)


@pytest.mark.parametrize("dot_variance_px2", [0.0, 0.3])
@pytest.mark.parametrize("radius", [12.0, -7.5, 0.4])
def test_slopes_of_the_rendered_image_are_its_differences(radius: float, dot_variance_px2: float) -> None:
    template = np.random.default_rng(3).random((24, 24))
    at = np.array([radius, 20.2, 18.7, 0.25, 0.1])

    def image(p: np.ndarray) -> np.ndarray:
        core = Core(float(np.sqrt(p[3])), float(p[4]), dot_variance_px2)
        return render(template, 1.25, (41, 39), radius=p[0], centre=(p[1], p[2]), core=core)

    core = Core(0.5, 0.1, dot_variance_px2)
    plain, slopes = render_slopes(template, 1.25, (41, 39), radius=at[0], centre=(at[1], at[2]), core=core)
    np.testing.assert_allclose(plain, image(at), atol=1e-10)
    assert len(slopes) == len(at)
    for k, step in enumerate(1e-5 * np.eye(5)):
        difference = (image(at + step) - image(at - step)) / 2e-5
        np.testing.assert_allclose(slopes[k], difference, atol=1e-6 * np.abs(difference).max())


def test_share_matrix_keeps_the_flux_and_matches_sampling() -> None:
    matrix = share_matrix(71, 16, 1.25, centre=34.3, radius=-8.0, core=Core(0.7, 0.2, 0.25))
    np.testing.assert_allclose(matrix.sum(axis=0), 1.0, atol=1e-9)
    rng = np.random.default_rng(0)
    u = -1.25 + 2.5 * (5 + rng.uniform(size=400_000)) / 16  # cell 5
    sigma = np.where(rng.uniform(size=u.size) < 0.2, 4 * 0.7, 0.7)
    x = 34.3 - 8.0 * u + sigma * rng.standard_normal(u.size) + 0.5 * rng.standard_normal(u.size)
    counted = np.histogram(x, bins=71, range=(-0.5, 70.5))[0] / u.size
    np.testing.assert_allclose(matrix[:, 5], counted, atol=3e-3)


def test_outline_of_a_polygon_is_measured_to_a_fraction_of_a_cell() -> None:
    picture = draw_psf(50.0, (128, 128), (63.2, 64.4), 0.5, samples=2_000_000)
    row, column, radius = circumscribed(picture)
    # the seven's box is centred on its circle
    assert (row, column) == pytest.approx((63.2, 64.4), abs=0.15)
    assert radius == pytest.approx(50.0, rel=0.005)


@pytest.mark.parametrize("radius", [20.0, 35.0, 50.0, 64.0])
def test_a_round_outline_gets_no_corners(radius: float) -> None:
    yy, xx = np.mgrid[0:160, 0:160]
    disc = np.clip(radius + 0.5 - np.hypot(yy - 80.2, xx - 79.6), 0, 1)
    assert circumscribed(disc)[2] == pytest.approx(radius, rel=0.01)


@pytest.mark.parametrize("core", [0.0, 0.8])
def test_radii_signs_and_chief_rays_come_from_one_aperture(core: float) -> None:
    depths = np.array(DEPTHS_MM)
    true = SCALE_PX * (1 - FOCUS_MM / depths)
    spots = []
    for k, radius in enumerate(true):
        image = draw_psf(float(radius), (61, 61), (30.3, 29.8), core, samples=400_000)
        se = np.sqrt(image * 1e-6 + 1e-12)
        spots.append(Spot(image + se * np.random.default_rng(k).standard_normal(image.shape), se))
    fit = fit_spots(spots, 1.0 / depths)
    found = np.array([s.radius_px for s in fit.spots])
    assert (np.sign(found) == np.sign(true)).all()
    np.testing.assert_allclose(found / found[0] * true[0], true, atol=0.08)
    np.testing.assert_allclose(found, true, rtol=0.015, atol=0.06)
    np.testing.assert_allclose([(s.centre_y, s.centre_x) for s in fit.spots], [(30.3, 29.8)] * len(spots), atol=0.1)
    assert fit.core.sigma_px == pytest.approx(max(core, 0.05), abs=0.08)


def diffracted_spots(lens: Lens, depths_mm: np.ndarray, pitch_mm: float, seed: int) -> list[Spot]:
    rng = np.random.default_rng(seed)
    spots = []
    for depth_mm in depths_mm:
        offset = tuple(rng.uniform(-0.5, 0.5, 2).tolist())
        image = np.pad(point_image(lens, float(depth_mm), pitch_mm, offset_px=offset), 4)
        se = 1e-3 * np.sqrt(image * image.max() + (0.02 * image.max()) ** 2)
        spots.append(Spot(image + se * rng.standard_normal(image.shape), se))
    return spots


def fit_diffracted(seed: int, **lens: float) -> TemplateFit:
    depths = np.arange(600.0, 3501.0, 100.0)
    return fit_spots(diffracted_spots(Lens(**lens), depths, 0.0086, seed), 1.0 / depths)


@pytest.mark.parametrize("seed", [5, 6])
def test_light_that_diffraction_spreads_is_told_from_the_aperture(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    with_wings = fit_diffracted(seed)
    assert with_wings.core.wings == pytest.approx(0.095, abs=0.03)
    monkeypatch.setattr("calibration.spot_fit._MOST_WINGS", 0.0)
    without = fit_diffracted(seed)
    assert without.core.wings == 0.0
    unexplained, more = (np.median([s.misfit for s in fit.spots]) for fit in (with_wings, without))
    assert unexplained < 0.7 * more


def test_a_core_on_finer_pixels_is_the_same_in_their_units() -> None:
    core, finer = Core(0.3, 0.1, 0.2), Core(0.3, 0.1, 0.2).finer(2)
    assert (finer.sigma_px, finer.wings, finer.dot_variance_px2) == pytest.approx((0.6, 0.1, 0.8))
    assert finer.sigmas_px == pytest.approx([2.0 * sigma for sigma in core.sigmas_px])
    assert finer.reach_px == pytest.approx(2.0 * core.reach_px)


@pytest.mark.parametrize("core", [Core(0.3), Core(0.3, 0.1), Core(0.3, 0.3), Core(0.3, 0.1, 0.2)])
def test_next_to_no_light_lies_beyond_the_reach(core: Core) -> None:
    pixels, cells = 201, 51  # a pixel each tenth of one, about a point's cell
    blurred = share_matrix(pixels, cells, 1.0, centre=100.0, radius=1.0, core=core.finer(10))[:, cells // 2]
    beyond = np.abs(np.arange(pixels) - 100) > 10.0 * core.reach_px
    assert blurred[beyond].sum() < 2e-4


def test_a_gaussian_core_gets_no_wings() -> None:
    fit = fit_diffracted(5, wavelength_um=0.0, aberration_um=2.2)
    assert fit.core.wings < 0.01
    assert fit.core.sigma_px == pytest.approx(2.2 / 8.6, abs=0.01)


def test_points_all_in_focus_say_so() -> None:
    spots = [Spot(draw_psf(r, (21, 21), (10, 10), 0.5), np.full((21, 21), 1e-4)) for r in (0.2, 0.4, 0.6)]
    with pytest.raises(FitError, match="in focus"):
        fit_spots(spots, 1.0 / np.array([1500.0, 1550.0, 1600.0]))


@pytest.mark.parametrize(("times", "expected"), [(10.0, "millimetres given as centimetres"), (0.1, "or inches")])
def test_depths_in_another_unit_make_an_aperture_that_no_lens_has(times: float, expected: str) -> None:
    check_aperture(7.0, focal_length_mm=50.0, f_number=3.6)
    check_aperture(7.0, focal_length_mm=50.0, f_number=None)
    with pytest.raises(DepthListError, match=expected):
        check_aperture(times * 7.0, focal_length_mm=50.0, f_number=3.6)
