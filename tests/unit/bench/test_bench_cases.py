"""What an accuracy run looks at: depths, cases, regions, light."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from calibration.raw import develop
from rigs.simulated.world import SimulatedRigSettings
from workbench.bench.cases import SIZES, Case, depth_list, irregular_mask, lay_out, make_cases, photograph


def test_depths_are_the_panel_s_true_places_and_one_between_each_two() -> None:
    depths = depth_list(7.0, seed=3)
    on = [z for z, grid in depths if grid]
    assert on == [607.0 + 100 * k for k in range(30)]
    assert len(depths) == 59
    assert [grid for _, grid in depths] == [True, False] * 29 + [True]
    assert depths != depth_list(7.0, seed=4)


def test_any_first_part_of_the_cases_covers_textures_and_depths() -> None:
    textures = ("chart", "text", "noise")
    cases = make_cases(textures, depth_list(0.0, 0), 6, seed=0)
    assert len(cases) == 18
    for count in (3, 9, 18):
        assert set(Counter(c.texture for c in cases[:count]).values()) == {count // 3}
    # each texture meets near, middle and far
    for name in textures:
        seen = sorted(c.true_mm for c in cases if c.texture == name)
        assert seen[0] < 1100
        assert seen[-1] > 2900
    # and textures of one turn stand at different depths
    assert len({c.true_mm for c in cases[:3]}) == 3


def test_all_depths_are_taken_when_asked_for_all() -> None:
    depths = depth_list(0.0, 0)
    cases = make_cases(("chart",), depths, 200, seed=0)
    assert sorted(c.true_mm for c in cases) == [z for z, _ in depths]


def test_same_seed_same_cases() -> None:
    depths = depth_list(0.0, 0)
    assert make_cases(("chart",), depths, 4, seed=1) == make_cases(("chart",), depths, 4, seed=1)
    assert make_cases(("chart",), depths, 4, seed=1) != make_cases(("chart",), depths, 4, seed=2)


def test_regions_are_disjoint_and_as_large_as_named() -> None:
    layout = lay_out(SIZES, seed=5)
    counts = np.bincount(layout.labels.ravel())[1:]
    assert counts.tolist() == [64**2, 128**2, 256**2, 128**2]


def test_a_region_stays_where_it_is_when_others_are_left_out() -> None:
    every, one = lay_out(SIZES, seed=5), lay_out(("128",), seed=5)
    assert np.array_equal(every.labels == 2, one.labels == 1)
    assert every.frame_shape == one.frame_shape


@pytest.mark.parametrize("seed", range(6))
def test_irregular_shapes_have_holes_and_differ(seed: int) -> None:
    mask = irregular_mask(seed)
    inside = np.argwhere(mask)
    middle_rows = mask[inside[:, 0].min() : inside[:, 0].max() + 1]
    # light and dark runs along rows: more than one run means bay or hole
    runs = (np.diff(middle_rows.astype(int), axis=1) == 1).sum(axis=1)
    assert runs.max() >= 2
    assert not np.array_equal(mask, irregular_mask(seed + 1))


def test_dim_frames_hold_an_eighth_of_the_light_and_repeat_byte_for_byte(tmp_path: Path) -> None:
    case = Case("leaves", 1450.0, False, 77)
    frames = {
        light: (path.read_bytes(), develop(path), frame)
        for light, path, frame in photograph(case, SimulatedRigSettings(), (128, 160), ("normal", "dim"), tmp_path)
    }
    bright, dim = frames["normal"][1].luminance.mean(), frames["dim"][1].luminance.mean()
    assert bright / dim == pytest.approx(8.0, rel=0.05)
    again = {light: path.read_bytes() for light, path, _ in photograph(
        case, SimulatedRigSettings(), (128, 160), ("normal", "dim"), tmp_path)}  # fmt: skip
    assert again == {light: data for light, (data, _, _) in frames.items()}
