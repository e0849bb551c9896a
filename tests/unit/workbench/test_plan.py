import pytest

from workbench.config import RigConfig
from workbench.errors import InputError
from workbench.plan import depth_grid_mm
from workbench.planning import cost, dot_size_px, make_plan


def test_the_default_plan_goes_from_60_to_350_cm_by_tens_ascending() -> None:
    plan = make_plan(RigConfig())
    assert plan.depths_mm == tuple(float(d) for d in range(600, 3501, 100))
    depths = [shot.depth_mm for shot in plan.shots()]
    assert depths == sorted(depths)


def test_each_depth_has_its_repeats_and_panel_off_frames_with_ids_of_their_own() -> None:
    plan = make_plan(RigConfig(), repeats=3)
    shots = list(plan.shots())
    assert len({shot.id for shot in shots}) == len(shots) == 30 * 4
    assert sum(shot.kind == "off" for shot in shots) == 30


@pytest.mark.parametrize(
    ("start", "stop", "step", "word"),
    [
        (600, 3500, 0, "step"),
        (3500, 600, 100, "ascending"),
        (600, 700, 100, "too few"),
        (6, 35, 1, "unit"),
        (600, 3500, 0.5, "larger"),
        (-5, 600, 10, "above 0"),
    ],
)
def test_depths_that_cannot_be_are_refused(start: float, stop: float, step: float, word: str) -> None:
    with pytest.raises(InputError, match=word):
        depth_grid_mm(start, stop, step)


def test_a_grid_reaches_its_end_in_spite_of_rounding() -> None:
    assert depth_grid_mm(600.0, 1200.0, 200.0 / 3)[-1] == pytest.approx(1200.0)


def test_the_dot_grows_with_distance_but_its_image_does_not() -> None:
    config = RigConfig()
    sizes = [dot_size_px(config, depth) for depth in (600, 1600, 3500, 10000)]
    assert sizes == sorted(sizes)
    assert sizes[0] == 1
    for size, depth in zip(sizes, (600, 1600, 3500, 10000), strict=True):
        assert size == 1 or size * 0.1 * 50 / depth <= 0.5 * 0.0086


def test_the_plan_hash_is_of_its_content() -> None:
    assert make_plan(RigConfig()).hash == make_plan(RigConfig()).hash
    assert make_plan(RigConfig()).hash != make_plan(RigConfig(), repeats=5).hash


def test_a_finer_plan_costs_more() -> None:
    config = RigConfig()
    coarse, fine = (cost(make_plan(config, step_mm=step), config) for step in (200, 50))
    assert fine.shots > coarse.shots
    assert fine.seconds > coarse.seconds
    assert fine.bytes > coarse.bytes


def test_the_widest_pattern_is_the_one_that_reaches_farthest() -> None:
    grid = make_plan(RigConfig(), field=(3, 3))
    reach = [max(max(abs(x), abs(y)) for x, y in dot.points_px) for dot in grid.dots]
    assert max(max(abs(x), abs(y)) for x, y in grid.widest.points_px) == max(reach) > min(reach)
    assert make_plan(RigConfig()).widest.points_px == ()


def test_grids_stay_within_the_panel_that_there_is() -> None:
    small = RigConfig.model_validate({"panel": {"pixels": [600, 1000]}})
    for made, (width, height) in ((make_plan(small, field=(3, 3)), (600, 1000)),
                                  (make_plan(RigConfig(), field=(3, 3)), (1920, 1200))):  # fmt: skip
        for dot in made.dots:
            assert max(abs(x) for x, _ in dot.points_px) + dot.size_px / 2 <= width / 2
            assert max(abs(y) for _, y in dot.points_px) + dot.size_px / 2 <= height / 2
