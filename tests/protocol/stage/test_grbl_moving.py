"""What every GRBL stage must do, a real one included (WORKBENCH_TEST_GRBL=/dev/ttyACM0 or socket://...)."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from rigs.errors import LimitError, StoppedError
from rigs.grbl_stage import GrblStage

Background = Callable[[Callable[[], object]], "object"]


def inner(stage: GrblStage, part: float) -> float:
    """A place that is this part of (at most 200 mm of) the way from where homing ended."""
    low, high = stage.limits_mm()
    home = stage.position_mm()
    towards = 1 if home - low < high - home else -1
    return home + towards * part * min(200.0, (high - low) * 0.9)


def test_moves_end_where_they_should(any_grbl: GrblStage) -> None:
    places = [inner(any_grbl, part) for part in (0.3, 1.0, 0.999, 0.05)]
    for place in places:
        assert any_grbl.move_to_mm(place) == pytest.approx(place, abs=0.03)
        assert any_grbl.position_mm() == pytest.approx(place, abs=0.03)
    assert any_grbl.homed()


def test_duration_of_a_move_follows_from_distance_speed_and_acceleration(any_grbl: GrblStage) -> None:
    place, start = inner(any_grbl, 1.0), any_grbl.position_mm()
    foretold = [any_grbl.travel_time_s(part * (place - start)) for part in (0.001, 0.5, 1.0)]
    assert foretold == sorted(foretold)
    assert foretold[2] < 2 * foretold[1]  # speeding up and braking take their share


def test_identity_names_firmware_and_limits(any_grbl: GrblStage) -> None:
    identity = any_grbl.identify()
    assert identity.kind == "grbl"
    assert identity.firmware
    assert identity.extra["homing"] == "on"


def test_positions_outside_travel_are_refused(any_grbl: GrblStage) -> None:
    low, high = any_grbl.limits_mm()
    before = any_grbl.position_mm()
    for place in (low - 1, high + 1, float("nan")):
        with pytest.raises(LimitError, match="travel"):
            any_grbl.move_to_mm(place)
    assert any_grbl.position_mm() == before


def test_stop_from_another_thread_stops_the_stage_and_keeps_the_position(
    any_grbl: GrblStage, in_background: Callable[..., object]
) -> None:
    start, place = any_grbl.position_mm(), inner(any_grbl, 1.0)
    moving = in_background(lambda: any_grbl.move_to_mm(place))
    while any_grbl.position_mm() == start and moving.is_alive():  # type: ignore[attr-defined]
        time.sleep(0.01)
    any_grbl.stop()
    where = any_grbl.position_mm()
    assert isinstance(moving.ended(), StoppedError)  # type: ignore[attr-defined]
    time.sleep(0.3)
    assert any_grbl.position_mm() == where
    assert any_grbl.homed()
    assert abs(where - place) > 0.1
    assert any_grbl.move_to_mm(start) == pytest.approx(start, abs=0.03)


def test_stop_at_rest_changes_nothing(any_grbl: GrblStage) -> None:
    before = any_grbl.position_mm()
    any_grbl.stop()
    any_grbl.stop()
    assert any_grbl.position_mm() == before
    assert any_grbl.move_to_mm(inner(any_grbl, 0.2)) == pytest.approx(inner(any_grbl, 0.0), abs=50)
