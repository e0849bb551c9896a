"""Reading GRBL's lines: whole ones exactly, everything else never."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.grbl_codes import ALARMS, ERRORS, alarm_error, refusal
from rigs.grbl_protocol import Alarm, Banner, Error, Message, Ok, Other, Setting, Status, parse


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        ("ok", Ok()),
        ("error:9", Error(9)),
        ("ALARM:2", Alarm(2)),
        ("Grbl 1.1h ['$' for help]", Banner("Grbl 1.1h ['$' for help]")),
        ("\\xffrst:0x1 Grbl 3.7 [FluidNC v3.7.15 (wifi) '$' for help]",
         Banner("Grbl 3.7 [FluidNC v3.7.15 (wifi) '$' for help]")),
        ("GrblHAL 1.1f ['$' or '$HELP' for help]", Banner("GrblHAL 1.1f ['$' or '$HELP' for help]")),
        ("$110=6000.000", Setting(110, "6000.000")),
        ("$110=500.000 (x max rate, mm/min)", Setting(110, "500.000")),
        ("[MSG:Check Limits]", Message("MSG", "Check Limits")),
        ("[VER:1.1h.20190830:]", Message("VER", "1.1h.20190830:")),
        ("o", Other("o")), ("okok", Other("okok")), ("error:", Other("error:")), ("error:9x", Other("error:9x")),
        ("000,0.000|FS:0,0|Pn:X>", Other("000,0.000|FS:0,0|Pn:X>")),
        ("<Idle|MPos:-28\\xff5.000,0.000,0.000|FS:0,0>", Other("<Idle|MPos:-28\\xff5.000,0.000,0.000|FS:0,0>")),
        ("<Idle|FS:0,0>", Other("<Idle|FS:0,0>")),
        ("<Idxe|MPos:0.000,0.000,0.000>", Other("<Idxe|MPos:0.000,0.000,0.000>")),
    ],
)  # fmt: skip
def test_lines(line: str, reply: object) -> None:
    assert parse(line) == reply


def test_status_reports() -> None:
    status = parse("<Hold:0|WPos:5.000,0.000,0.000|Bf:15,128|FS:0,0|Pn:XP|WCO:-1.500,0.000,0.000>")
    assert isinstance(status, Status)
    assert (status.state, status.substate, status.held) == ("Hold", 0, True)
    assert (status.machine, status.work, status.offset) == (None, (5.0, 0.0, 0.0), (-1.5, 0.0, 0.0))
    assert status.pins == "XP"


def test_torn_report_that_runs_into_the_next() -> None:
    status = parse("<Idle|MPo<Run|MPos:-2.000,0.000,0.000|FS:0,0>")
    assert isinstance(status, Status)
    assert (status.state, status.machine, status.rest) == ("Run", (-2.0, 0.0, 0.0), "<Idle|MPo")


@given(st.text())
def test_no_text_upsets_the_reader(text: str) -> None:
    parse(text)
    parse(f"<{text}>")
    parse(f"<Idle|{text}>")


@pytest.mark.parametrize("code", [*range(1, 11), 99])
def test_every_alarm_says_the_way_out(code: int) -> None:
    assert code in ALARMS or code == 99
    assert f"ALARM:{code} while homing: " in str(alarm_error(code, "homing"))
    assert ";" in str(alarm_error(code, "homing"))


@pytest.mark.parametrize("code", [*range(1, 18), *range(20, 39), 99])
def test_every_refusal_says_the_way_out(code: int) -> None:
    assert code in ERRORS or code == 99
    assert f"error:{code} (" in str(refusal(code, "G1 X1"))
    assert str(refusal(code, "G1 X1")).split("); ")[1]
