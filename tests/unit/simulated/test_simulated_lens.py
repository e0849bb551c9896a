import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigs.simulated.coverage import box_overlap, clip_to_convex, polygon_coverage, signed_area
from rigs.simulated.lens import SEVEN, Lens, MaskPupil, PolygonPupil, Spot, point_image, transmission

PITCH_MM = 0.0043
SHARP = Lens(aberration_um=0.0, wavelength_um=0.0)


def _moments(image: np.ndarray) -> tuple[float, float, float]:
    """Centroid (rows, columns) from the centre pixel, and the summed variance along both axes."""
    half = image.shape[0] // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    cy, cx = float((image * y).sum()), float((image * x).sum())
    return cy, cx, float((image * ((y - cy) ** 2 + (x - cx) ** 2)).sum())


def _polygon_moments_mm(loop: np.ndarray) -> tuple[float, float, float]:
    """Centroid and summed central second moment of a polygon by Green's theorem, independent of any grid."""
    x, y = loop.T
    u, v = np.roll(x, -1), np.roll(y, -1)
    cross = x * v - u * y
    area = cross.sum() / 2
    cx, cy = ((x + u) * cross).sum() / (6 * area), ((y + v) * cross).sum() / (6 * area)
    xx, yy = ((x * x + x * u + u * u) * cross).sum(), ((y * y + y * v + v * v) * cross).sum()
    return cx, cy, (xx + yy) / (12 * area) - cx * cx - cy * cy


@pytest.mark.parametrize("depth_mm", [600.0, 1000.0, 1590.0, 1600.0, 1700.0, 3500.0])
def test_point_image_has_unit_sum_and_no_negative_light(depth_mm: float) -> None:
    image = point_image(Lens(), depth_mm, PITCH_MM)
    assert image.sum() == pytest.approx(1.0, abs=1e-12)
    assert image.min() >= 0.0
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert border.max() < 0.01 * image.max()


def test_size_of_the_cone_follows_the_thin_lens_law() -> None:
    """sigma = A f / (z1 - f) (1 - z1 / z), linear in 1/z, against the similar triangles of the implementation."""
    lens = Lens()
    for depth_mm in (450.0, 600.0, 1599.0, 1600.0, 2000.0, 3500.0, 1e6):
        expected = 50.0 / (1600.0 - 50.0) * (1.0 - 1600.0 / depth_mm)
        assert lens.cone_section(depth_mm) == pytest.approx(expected, abs=1e-12)


def test_measured_radius_is_linear_in_inverse_depth() -> None:
    """The square root of the second moment, on the pixels, without the core."""
    inverse = np.linspace(1 / 3500, 1 / 600, 12)
    radius = []
    for u in inverse:
        _, _, variance = _moments(point_image(SHARP, 1 / u, PITCH_MM))
        # A pixel's own extent adds 1/12 per axis.
        radius.append(math.sqrt(variance - 2 / 12) * (1 if u < 1 / 1600 else -1))
    fit = np.polyfit(inverse, radius, 1)
    # What is left is the sampling of a sharp-edged image by its pixels.
    assert np.abs(np.polyval(fit, inverse) - radius).max() < 0.01
    assert -fit[1] / fit[0] == pytest.approx(1 / 1600, rel=5e-4)


def test_light_is_shared_out_by_exact_areas() -> None:
    """Area, centroid and second moment on the pixels equal those of the projected polygon."""
    cx, cy, second = _polygon_moments_mm(np.array(SEVEN.loops_mm[0]))
    for depth_mm in (700.0, 2600.0):
        scale = SHARP.cone_section(depth_mm) / PITCH_MM
        row, column, variance = _moments(point_image(SHARP, depth_mm, PITCH_MM, offset_px=(0.31, -0.44)))
        assert row == pytest.approx(0.31 - scale * cy, abs=5e-3)
        assert column == pytest.approx(-0.44 + scale * cx, abs=5e-3)
        assert variance == pytest.approx(scale**2 * second + 2 / 12, rel=1e-3)


def test_mirror_depths_are_turned_by_180_degrees() -> None:
    mirror_mm = 1 / (2 / 1600 - 1 / 3500)
    far, near = point_image(Lens(), 3500.0, PITCH_MM), point_image(Lens(), mirror_mm, PITCH_MM)
    np.testing.assert_allclose(near[::-1, ::-1], far, atol=1e-10)
    assert np.abs(near - far).max() > 0.5 * far.max()


def test_beyond_focus_the_seven_stands_upright() -> None:
    image = point_image(Lens(), 3500.0, PITCH_MM)
    half = image.shape[0] // 2
    lit = image > 0.5 * image.max()
    assert lit[: half - 5].sum() > 1.5 * lit[half + 6 :].sum()  # the bar is at the top
    row = lit[half - 15]
    assert row[half + 12]
    assert row[half - 12]


def test_peak_falls_with_the_area() -> None:
    peaks = {depth: point_image(Lens(), depth, PITCH_MM).max() for depth in (600.0, 800.0, 3500.0)}
    area = {depth: SEVEN.area_mm2 * (Lens().cone_section(depth) / PITCH_MM) ** 2 for depth in peaks}
    for depth, peak in peaks.items():
        assert peak * area[depth] == pytest.approx(1.0, rel=0.03)


def test_in_focus_the_core_alone_is_left_in_the_middle() -> None:
    for offset in ((0.0, 0.0), (0.5, -0.25), (0.13, 0.4)):
        lens = Lens(aberration_um=3.0, wavelength_um=0.0)  # no tails that the border would cut
        row, column, _ = _moments(point_image(lens, 1600.0, PITCH_MM, offset_px=offset))
        assert (row, column) == pytest.approx(offset, abs=1e-3)


def test_aberrations_and_the_source_add_their_variance() -> None:
    lens = Lens(aberration_um=3.0, wavelength_um=0.0)
    depth_mm = 2200.0
    plain = _moments(point_image(SHARP, depth_mm, PITCH_MM))[2]
    core = _moments(point_image(lens, depth_mm, PITCH_MM))[2]
    assert core - plain == pytest.approx(2 * (3.0 / 4.3) ** 2, rel=0.01)
    for spot, variance in ((Spot("disc", 0.02), 2 * 0.01**2 / 4), (Spot("square", 0.02), 2 * 0.02**2 / 12)):
        wide = _moments(point_image(lens, depth_mm, PITCH_MM, spot=spot))[2]
        assert wide - core == pytest.approx(variance / PITCH_MM**2, rel=0.02)


def test_an_image_as_pupil_gives_what_the_same_polygon_gives() -> None:
    n, side_mm = 800, 16.0
    loop = np.array(SEVEN.loops_mm[0]) * (n / side_mm)
    mask = polygon_coverage([np.stack([n / 2 + loop[:, 0], n / 2 - loop[:, 1]], axis=1)], (n, n))
    lens = Lens(pupil=MaskPupil(mask, side_mm))
    assert lens.pupil.area_mm2 == pytest.approx(SEVEN.area_mm2, rel=1e-9)
    for depth_mm in (900.0, 3000.0):
        drawn, image = point_image(Lens(), depth_mm, PITCH_MM), point_image(lens, depth_mm, PITCH_MM)
        crop = (image.shape[0] - drawn.shape[0]) // 2
        image = image[crop : image.shape[0] - crop, crop : image.shape[1] - crop]
        assert np.abs(image - drawn).max() < 0.01 * drawn.max()


def test_a_hole_in_the_pupil_stays_dark() -> None:
    frame = ((-6.0, -6.0), (6.0, -6.0), (6.0, 6.0), (-6.0, 6.0))
    hole = ((-3.0, 3.0), (3.0, 3.0), (3.0, -3.0), (-3.0, -3.0))
    lens = Lens(pupil=PolygonPupil((frame, hole)))
    assert lens.pupil.area_mm2 == pytest.approx(144 - 36)
    image = point_image(lens, 3500.0, PITCH_MM)
    half = image.shape[0] // 2
    assert image[half, half] < 0.01 * image.max()


def test_vignetting_clips_the_pupil_towards_the_corner_only() -> None:
    lens = Lens(vignetting=0.6)
    assert transmission(lens, (0.0, 0.0)) == 1.0
    along = [transmission(lens, (x, 0.0)) for x in (2.0, 5.0, 8.0, 11.0)]
    assert all(a > b for a, b in itertools.pairwise(along))
    assert 0.3 < along[-1] < 0.95
    full, clipped = (point_image(lens, 3500.0, PITCH_MM, field_mm=f) for f in ((0.0, 0.0), (11.0, 0.0)))
    assert (clipped > 0.5 * clipped.max()).sum() / (full > 0.5 * full.max()).sum() == pytest.approx(along[-1], abs=0.04)
    np.testing.assert_array_equal(full, point_image(Lens(), 3500.0, PITCH_MM))


def test_coma_grows_with_the_field_and_points_outwards() -> None:
    lens = Lens(coma_um=10.0)
    plain = _moments(point_image(Lens(), 1600.0, PITCH_MM))
    shifts = [_moments(point_image(lens, 1600.0, PITCH_MM, field_mm=(x, 0.0)))[1] - plain[1] for x in (3.0, 6.0, 12.0)]
    assert shifts[0] > 0.1
    assert shifts[1] / shifts[0] == pytest.approx(2.0, rel=0.02)
    assert shifts[2] / shifts[0] == pytest.approx(4.0, rel=0.02)
    row, column, _ = _moments(point_image(lens, 1600.0, PITCH_MM, field_mm=(0.0, 12.0)))
    assert row < -0.5
    assert abs(column) < 0.5 * abs(row)


def test_without_coma_the_two_ways_to_draw_agree() -> None:
    drawn = point_image(Lens(), 900.0, PITCH_MM)
    traced = point_image(Lens(coma_um=1e-6), 900.0, PITCH_MM, field_mm=(5.0, 5.0))
    crop = (traced.shape[0] - drawn.shape[0]) // 2
    traced = traced[crop : traced.shape[0] - crop, crop : traced.shape[1] - crop]
    assert np.abs(traced - drawn).max() < 0.02 * drawn.max()


def test_breathing_changes_the_magnification() -> None:
    ratio = Lens(breathing=0.5).magnification(2000.0) / Lens().magnification(2000.0)
    assert 0.97 < ratio < 0.995


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.3, 1.0), st.floats(0.0, 0.9)), min_size=3, max_size=9),
    st.floats(3.0, 12.0),
    st.tuples(st.floats(12.5, 17.0), st.floats(12.5, 17.0)),
)
def test_coverage_adds_up_to_the_area(
    spokes: list[tuple[float, float]], radius: float, centre: tuple[float, float]
) -> None:
    angle = 2 * math.pi * (np.arange(len(spokes)) + [jitter for _, jitter in spokes]) / len(spokes)
    length = radius * np.array([share for share, _ in spokes])
    loop = np.stack([centre[0] + length * np.cos(angle), centre[1] + length * np.sin(angle)], axis=1)
    covered = polygon_coverage([loop], (30, 30))
    assert covered.sum() == pytest.approx(abs(signed_area(loop)), rel=1e-9, abs=1e-9)
    assert covered.min() > -1e-9
    assert covered.max() < 1 + 1e-9


def test_coverage_of_a_polygon_beyond_the_grid_is_cut_off() -> None:
    loop = np.array([(-5.0, -5.0), (2.5, -5.0), (2.5, 50.0), (-5.0, 50.0)])
    expected = np.tile([1.0, 1.0, 0.5, 0.0], (6, 1))
    np.testing.assert_allclose(polygon_coverage([loop], (6, 4)), expected, atol=1e-12)


def test_box_overlap_keeps_the_light_and_mirrors() -> None:
    edges = np.linspace(1.3, 7.9, 12)
    forward, backward = box_overlap(edges, 10), box_overlap(edges[::-1], 10)
    np.testing.assert_allclose(forward.sum(axis=0), 6.6 / 11)
    np.testing.assert_allclose(backward, forward[:, ::-1])


def test_clipping_to_a_window_keeps_the_common_area() -> None:
    square = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)])
    assert abs(signed_area(clip_to_convex(square + 1.0, square))) == pytest.approx(1.0)
    assert len(clip_to_convex(square + 5.0, square)) == 0
