"""Rays: where a point's light goes, what hides what, and that planes blur as points do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import fftconvolve

from workbench.raytrace.tracing import trace, trace_point
from workbench.raytrace.world import Camera, Surface, upright

CAMERA = Camera(height=128, width=128)
SQUARE = Camera(height=96, width=96, aperture_mm=((-4.0, 3.0), (4.0, 3.0), (4.0, -3.0), (-4.0, -3.0)), spot_mm=1e-6)


def _flat(grey: int, shape: tuple[int, int] = (8, 8)) -> np.ndarray:
    picture = np.full((*shape, 4), grey, np.uint8)
    picture[..., 3] = 255
    return picture


def _centred(light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    return y - light.shape[0] / 2, x - light.shape[1] / 2


@pytest.mark.parametrize("depth_mm", [1000.0, 3000.0])
def test_a_points_spot_has_the_aperture_s_extent(depth_mm: float) -> None:
    light = trace_point(SQUARE, depth_mm, rays=1 << 14, seed=1)
    assert light.sum() == pytest.approx(1.0)
    y, x = _centred(light)
    scale = SQUARE.image_mm * abs(1 / depth_mm - 1 / SQUARE.focus_mm) / SQUARE.pitch_mm
    for at, side_mm in ((x, 8.0), (y, 6.0)):
        variance = (light * at**2).sum()
        assert variance == pytest.approx((side_mm * scale) ** 2 / 12 + 1 / 12, rel=0.01)


def test_a_point_in_focus_stays_within_its_spot() -> None:
    light = trace_point(CAMERA, CAMERA.focus_mm, rays=1 << 14, seed=1)
    y, x = _centred(light)
    expected = (CAMERA.spot_mm / CAMERA.pitch_mm) ** 2 + 1 / 12  # the spot, and the photosite's own width
    assert (light * x**2).sum() == pytest.approx(expected, rel=0.02)
    assert (light * y**2).sum() == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("depth_mm", [1600.0, 1700.0])
def test_a_tiny_surface_is_photographed_as_a_point_is(depth_mm: float) -> None:
    side = 3.0 * CAMERA.photosite_at_mm(depth_mm)
    dot = upright("dot", _flat(255), (0, 0, depth_mm), (side, side))
    light = trace(CAMERA, [dot], rays=1 << 12, seed=3).light.astype(float)
    light /= light.sum()
    point = trace_point(CAMERA, depth_mm, rays=1 << 16, seed=1)
    for at in _centred(light):
        spread = [(image * at**2).sum() - (image * at).sum() ** 2 for image in (light, point)]
        assert spread[0] - 3.0**2 / 12 == pytest.approx(spread[1], rel=0.05)


def test_far_points_make_an_upright_seven_and_near_ones_a_turned_one() -> None:
    far_mm = 2400.0
    near_mm = 1 / (2 / CAMERA.focus_mm - 1 / far_mm)  # the mirror depth
    far, near = (trace_point(CAMERA, z, rays=1 << 16, seed=1) for z in (far_mm, near_mm))
    assert far[: CAMERA.height // 2].sum() > 0.55  # the seven's bar is at its top
    assert np.abs(far - near[::-1, ::-1]).sum() < 0.1
    assert np.abs(far - near).sum() > 0.5


def test_a_plane_is_blurred_by_what_a_point_becomes() -> None:
    rng = np.random.default_rng(5)
    depth_mm, cells = 1200.0, 16
    side = CAMERA.width * CAMERA.photosite_at_mm(depth_mm)
    blocks = rng.integers(0, 255, (cells, cells)).repeat(128 // cells, 0).repeat(128 // cells, 1).astype(np.uint8)
    picture = np.dstack([blocks] * 3 + [np.full_like(blocks, 255)])
    light = trace(CAMERA, [upright("plane", picture, (0, 0, depth_mm), (side, side))], rays=256, seed=2).light
    spot = trace_point(CAMERA, depth_mm, rays=1 << 16, seed=1)
    # An even kernel's middle lies between two pixels, as the frame's middle does: crop from there.
    blurred = fftconvolve(blocks / 255.0, spot, mode="full")[64:192, 64:192]
    inner = slice(40, 88)
    difference = (light - blurred)[inner, inner]
    assert np.std(blurred[inner, inner]) > 0.08
    assert np.std(difference) < 0.02


def test_what_is_near_hides_what_is_far_and_holes_show_it() -> None:
    board = _flat(0, (64, 64))
    board[24:40, 24:40, 3] = 0
    front = upright("front", board, (0, 0, 1000.0), (4.0, 4.0))
    back = upright("back", _flat(255), (0, 0, 3000.0), (100.0, 100.0))
    traced = trace(CAMERA, [back, front], rays=16, seed=1)
    assert traced.surface[32, 32] == 0
    assert traced.depth_mm[32, 32] == pytest.approx(3000.0)
    assert traced.surface[24, 32] == 1
    assert traced.depth_mm[24, 32] == pytest.approx(1000.0)
    # Blurred, the hole lets through some of the aperture and not all of it.
    assert 0.02 < traced.light[60:68, 60:68].mean() < 0.9


def test_a_cylinder_bulges_towards_the_camera_and_is_darker_at_its_sides() -> None:
    radius = 3.0
    item = Surface("can", _flat(255), (-radius, -20.0, 1000.0), (2 * radius, 0, 0), (0, 40.0, 0), radius)
    traced = trace(CAMERA, [item], rays=16, seed=1)
    assert traced.depth_mm[32, 32] == pytest.approx(1000.0, abs=0.1)
    row = traced.depth_mm[32]
    seen = np.flatnonzero(np.isfinite(row))
    assert 0 < seen[0] < 32
    assert row[seen[0]] > row[seen[0] + 3] > 1000.0
    assert traced.light[64, 64] > 1.3 * traced.light[64, 2 * seen[0] + 2]


def test_nothing_is_dark_and_infinitely_far() -> None:
    behind = upright("behind", _flat(255), (0, 0, -500.0), (100.0, 100.0))
    traced = trace(CAMERA, [behind], rays=4, seed=1)
    assert traced.light.max() == 0.0
    assert np.isinf(traced.depth_mm).all()
    assert (traced.surface == -1).all()


def test_the_same_seed_gives_the_same_rays() -> None:
    plane = upright("plane", _flat(200), (0, 0, 1000.0), (3.0, 3.0))
    first, again, other = (trace(CAMERA, [plane], rays=4, seed=seed).light for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_photosites_see_through_their_colour_filters() -> None:
    picture = _flat(0)
    picture[..., 0], picture[..., 1], picture[..., 2] = 255, 128, 0
    light = trace(CAMERA, [upright("plane", picture, (0, 0, 1000.0), (50.0, 50.0))], rays=4, seed=1).light
    assert light[0::2, 0::2] == pytest.approx(1.0)
    assert light[0::2, 1::2] == pytest.approx(128 / 255)
    assert light[1::2, 0::2] == pytest.approx(128 / 255)
    assert light[1::2, 1::2] == pytest.approx(0.0)


def test_an_outline_that_encloses_nothing_is_refused() -> None:
    line = Camera(height=64, width=64, aperture_mm=((0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (3.0, 3.0)))
    with pytest.raises(ValueError, match="encloses nothing"):
        trace_point(line, 1000.0, rays=16, seed=1)
