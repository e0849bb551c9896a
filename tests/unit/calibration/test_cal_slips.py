"""Slips that only all frames together betray: a point within a point's light, two frames under each other's depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn_points import DEPTHS_MM, SCALE_PX, as_frame, draw_psf, point_image

from calibration.build import BuildOptions, BuiltBank, PointFrame, build_bank
from calibration.errors import DepthListError, PointError
from calibration.image import LinearImage
from calibration.optics import signed_radius
from calibration.swapped import swapped_pair


def _doubled(depth_mm: float, share: float, shift: tuple[int, int]) -> LinearImage:
    """A point and its fainter copy, ``share`` of its light, (rows, columns) away; a little overlaps or all of it."""
    radius = SCALE_PX * (1 - 1600.0 / depth_mm)
    one = draw_psf(radius, (96, 96), (48.2, 47.9), 0.4, samples=60_000)
    both = one + share * np.roll(one, shift, (0, 1))
    return as_frame(both / both.max() * 0.6, name=f"psf_{depth_mm / 10:03.0f}cm.dng", seed=int(depth_mm))


def _frames(depth_mm: float, *images: LinearImage) -> list[PointFrame]:
    return [PointFrame(z, images if z == depth_mm else (point_image(z),)) for z in DEPTHS_MM]


@pytest.mark.parametrize(
    ("depth_mm", "share", "shift"),
    [
        (600.0, 1.0, (4, 3)),
        (600.0, 0.3, (-2, 6)),
        (800.0, 1.0, (4, 3)),
        (800.0, 0.3, (-2, 6)),
        (800.0, 0.05, (5, 3)),
        (2800.0, 1.0, (4, 3)),
        (2800.0, 0.05, (5, 3)),
    ],
)
def test_a_second_point_within_the_first_ones_light_is_named(
    depth_mm: float, share: float, shift: tuple[int, int]
) -> None:
    distance, percent = np.hypot(*shift), 100 * share / (1 + share)
    with pytest.raises(PointError, match=rf"psf_{depth_mm / 10:03.0f}cm\.dng: shows its point twice") as caught:
        build_bank(_frames(depth_mm, _doubled(depth_mm, share, shift)))
    assert caught.value.reason == "doubled"
    words = str(caught.value).split()
    assert float(words[words.index("px") - 1]) == pytest.approx(distance, abs=1.0)
    assert float(words[words.index("%") - 1]) == pytest.approx(percent, abs=2.0 + 0.1 * percent)


def test_of_repeats_the_doubled_one_is_named() -> None:
    good = point_image(800.0)
    spoilt = _doubled(800.0, 0.3, (-2, 6))
    spoilt = replace(spoilt, info=replace(spoilt.info, path="psf_080cm_2.dng", sha256="another"))
    with pytest.raises(PointError, match=r"psf_080cm_2\.dng: shows its point twice"):
        build_bank(_frames(800.0, good, spoilt))


def test_good_frames_and_a_frame_of_another_depth_are_not_doubled(built: BuiltBank) -> None:
    assert built.quality.verdict != "bad"
    moved = build_bank(_frames(1800.0, point_image(2400.0)))  # wrong, but no double point
    assert moved.quality.verdict == "bad"


@pytest.mark.parametrize("pair", [(800.0, 1000.0), (1300.0, 2200.0), (2200.0, 2800.0), (600.0, 3500.0)])
def test_two_frames_under_each_others_depth_are_both_named(pair: tuple[float, float]) -> None:
    given = dict(zip(pair, reversed(pair), strict=True))
    frames = [PointFrame(z, (point_image(given.get(z, z)),)) for z in DEPTHS_MM]
    with pytest.raises(DepthListError, match="exchanged") as caught:
        build_bank(frames, (), BuildOptions(apply_zero=True))
    for depth_mm, other in given.items():
        assert f"psf_{other / 10:03.0f}cm.dng ({depth_mm / 10:g} cm)" in str(caught.value)


@pytest.mark.parametrize("count", [4, 5, 9, 30])
def test_an_exchange_is_found_among_few_depths_and_many_and_nothing_where_there_is_none(count: int) -> None:
    rng = np.random.default_rng(count)
    nominal = np.linspace(600.0, 3500.0, count)
    radius = signed_radius(nominal + 7.0, focus_mm=1600.0, scale=28.0) + rng.normal(0, 0.02, count)
    error = np.full(count, 0.01)
    assert swapped_pair(nominal, radius, error, apply_zero=True) is None
    lone = radius.copy()
    lone[1] += 2.0
    assert swapped_pair(nominal, lone, error, apply_zero=True) is None
    first, second = sorted(rng.choice(count, 2, replace=False).tolist())
    radius[[first, second]] = radius[[second, first]]
    assert swapped_pair(nominal, radius, error, apply_zero=True) == (first, second)


def test_a_copy_within_the_blur_of_neighbouring_depths_may_be_the_lenss_own_and_is_left_to_the_quality() -> None:
    ghost = {z: _doubled(z, 0.3, (3, 2)) for z in (800.0, 1000.0)}
    built = build_bank([PointFrame(z, (ghost.get(z) or point_image(z),)) for z in DEPTHS_MM])
    assert built.quality.verdict != "good"
    assert any("model_misfit" in reason for reason in built.quality.reasons)
