from collections.abc import Callable

import pytest

from rigs.errors import ConfigError, LimitError, NotHomedError, StageError
from rigs.manual_stage import ManualSettings, ManualStage
from rigs.simulated.followers import FollowedStage
from rigs.simulated.rig import make_rig


def _answers(*texts: str) -> Callable[[str], str]:
    left = list(texts)

    def ask(_question: str) -> str:
        if not left:
            raise EOFError
        return left.pop(0)

    return ask


def test_enter_confirms_the_position_that_was_asked_for() -> None:
    stage = ManualStage(ManualSettings((0, 3000)), _answers(""))
    assert stage.move_to_mm(700.0) == 700.0
    assert stage.position_mm() == 700.0


def test_the_operator_may_say_where_the_panel_really_stands() -> None:
    assert ManualStage(ManualSettings((0, 3000)), _answers("soon", "702.5")).move_to_mm(700.0) == 702.5


def test_the_question_is_in_the_operators_words() -> None:
    asked: list[str] = []

    def ask(question: str) -> str:
        asked.append(question)
        return ""

    ManualStage(ManualSettings((0, 3000), lambda p: f"{(p + 500) / 10:g} cm"), ask).move_to_mm(700.0)
    assert "120 cm" in asked[0]
    assert "press Enter" in asked[0]


def test_a_position_out_of_range_is_refused_asked_for_or_answered() -> None:
    stage = ManualStage(ManualSettings((0, 3000)), _answers("9999"))
    with pytest.raises(LimitError, match=r"stage\.limits"):
        stage.move_to_mm(4000.0)
    with pytest.raises(StageError):  # asked again, and nobody is left to answer
        stage.move_to_mm(700.0)
    with pytest.raises(NotHomedError):
        stage.position_mm()


def test_an_answer_out_of_range_is_asked_for_again() -> None:
    assert ManualStage(ManualSettings((0, 3000)), _answers("9999", "701")).move_to_mm(700.0) == 701.0


def test_a_place_that_was_another_depths_already_is_asked_for_again() -> None:
    stage = ManualStage(ManualSettings((0, 3000)), _answers("701", "701.5", "799", "701", "", "701", "701", "701"))
    assert stage.move_to_mm(700.0) == 701.0
    assert stage.move_to_mm(800.0) == 799.0  # 701.5 is where it stood for 700
    assert stage.move_to_mm(700.0) == 701.0  # the same depth once more
    assert stage.move_to_mm(900.0) == 900.0
    with pytest.raises(StageError, match="no usable answer"):
        stage.move_to_mm(1000.0)


def test_without_anybody_to_answer_it_says_so() -> None:
    with pytest.raises(StageError, match="terminal"):
        ManualStage(ManualSettings((0, 3000)), _answers()).move_to_mm(1.0)
    with pytest.raises(StageError, match="no usable answer"):
        ManualStage(ManualSettings((0, 3000)), _answers("a", "b", "c")).move_to_mm(1.0)


def test_a_reversed_range_is_a_configuration_error() -> None:
    with pytest.raises(ConfigError, match="smaller one first"):
        ManualStage(ManualSettings((5, 1)), _answers())


def test_the_simulated_panel_follows_a_stage_moved_by_hand() -> None:
    rig = make_rig()
    stage = FollowedStage(ManualStage(ManualSettings((0, 3000)), _answers("", "")), rig.world)
    stage.move_to_mm(100.0)
    near = rig.world.true_depth_mm
    stage.move_to_mm(1100.0)
    assert rig.world.true_depth_mm - near == pytest.approx(1000.0, abs=1.0)
