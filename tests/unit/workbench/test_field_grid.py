"""Grids of dots: within the panel and the frame at every depth, at the same places where the panel allows."""

from __future__ import annotations

import numpy as np
import pytest

from rigs.simulated.world import PRESET_SHAPES
from workbench.config import RigConfig
from workbench.errors import InputError
from workbench.field_grid import REACH, frame_mm, grid_at, shape_of
from workbench.planning import make_plan


def test_dots_spread_as_the_panel_goes_away_until_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESET_SHAPES, "small", (1024, 1536))
    config = RigConfig.model_validate({"optics": {"focus": "160cm"}})
    grids = [grid_at(config, 3, 3, z) for z in (600.0, 1500.0, 3500.0)]
    assert [g.reach for g in grids[:2]] == [REACH, REACH]
    assert grids[2].reach < REACH
    for grid in grids:
        points = np.array(grid.points_px)
        assert len(points) == 9
        assert np.abs(points[:, 0]).max() < 960
        assert np.abs(points[:, 1]).max() < 600
    image_mm = np.array(grids[0].points_px)[-1] * 0.1 * 51.6129 / 600.0
    np.testing.assert_allclose(image_mm / (np.array(frame_mm(config)) / 2), REACH, rtol=0.01)


def test_one_point_plans_as_before_and_more_show_a_grid() -> None:
    config = RigConfig.model_validate({})
    alone, grid = make_plan(config), make_plan(config, field=(3, 2))
    assert {dot.kind for dot in alone.dots} == {"dot"}
    assert make_plan(config, field=(1, 1)).hash == alone.hash
    assert {dot.kind for dot in grid.dots} == {"grid"}
    assert {shape_of(dot.points_px) for dot in grid.dots} == {(3, 2)}


def test_a_grid_needs_a_frame_of_known_size_and_a_number_of_points_that_can_be() -> None:
    real = RigConfig.model_validate({"camera": {"kind": "gphoto2"}})
    with pytest.raises(InputError, match=r"camera\.model"):
        make_plan(real, field=(3, 3))
    make_plan(real)
    with pytest.raises(InputError, match="0x3"):
        make_plan(RigConfig.model_validate({}), field=(0, 3))
