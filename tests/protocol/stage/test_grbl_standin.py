"""The GRBL stand-in, case by case: the traps of the real firmware that the driver must not fall into."""

from __future__ import annotations

import pytest

from tests.standins.grbl_firmware import GrblFirmware
from tests.standins.rail import Rail

TICK_S = 0.002
BANNER = "Grbl 1.1h ['$' for help]"
UNLOCK = "[MSG:'$H'|'$X' to unlock]"


class Talk:
    def __init__(self) -> None:
        self.firmware = GrblFirmware(Rail(carriage_mm=60))
        self.now = 0.0
        self.run(0.05)
        self.heard()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.now += TICK_S
            self.firmware.step(self.now)

    def heard(self) -> list[str]:
        lines = self.firmware.output.decode("latin-1").split("\r\n")
        self.firmware.output.clear()
        return [line for line in lines if line]

    def say(self, data: bytes, seconds: float = 0.1) -> list[str]:
        self.firmware.receive(data)
        self.run(seconds)
        return self.heard()

    def state(self) -> str:
        (report,) = self.say(b"?")
        return report[1:].split("|")[0]

    def home(self) -> None:
        assert self.say(b"$H\n", 12) == ["ok"]


@pytest.fixture
def talk() -> Talk:
    return Talk()


@pytest.fixture
def homed(talk: Talk) -> Talk:
    talk.home()
    return talk


def test_power_up_is_alarm_at_zero(talk: Talk) -> None:
    assert talk.state() == "Alarm"
    assert talk.say(b"G0 X-100\n") == ["error:9"]
    assert talk.say(b"$J=G91 X5 F100\n") == ["error:8"]


def test_homing_is_silent_and_ends_at_the_pull_off(talk: Talk) -> None:
    assert talk.say(b"$H\n?", 3) == []
    talk.run(9)
    report, ok = talk.heard()
    assert report.startswith("<Home|MPos:-2895.000,0.000,0.000|FS:0,0")
    assert ok == "ok"


def test_ok_comes_before_motion_and_idle_may_be_stale(homed: Talk) -> None:
    report, ok = homed.say(b"?G0X-2795\n", 2 * TICK_S) or ["", ""]
    assert (report[:6], ok) == ("<Idle|", "ok")
    homed.run(0.2)
    assert homed.state() == "Run"


def test_dwell_is_answered_when_motion_has_ended(homed: Talk) -> None:
    assert homed.say(b"G0X-2795\nG4P0.01\n", 1.4) == ["ok"]
    homed.run(0.4)
    assert homed.heard() == ["ok"]
    assert homed.state() == "Idle"


def test_soft_limit_is_deaf_until_reset_and_keeps_the_position(homed: Talk) -> None:
    assert homed.say(b"G0X50\n") == ["ALARM:2", "[MSG:Reset to continue]"]
    assert homed.say(b"?$X\nG0X-5\n") == []
    assert homed.say(b"\x18") == ["ok", BANNER, UNLOCK]
    assert homed.state() == "Alarm"
    assert homed.firmware.machine_mm == -2895


def test_reset_in_motion_is_an_alarm_and_held_is_not(homed: Talk) -> None:
    homed.say(b"G0X-2000\n", 0.6)
    assert homed.say(b"\x18")[0] == "ALARM:3"
    homed.home()
    homed.say(b"G0X-2000\n", 0.6)
    homed.say(b"!", 0.7)
    assert homed.state() == "Hold:0"
    assert homed.say(b"\x18") == [BANNER]
    assert homed.state() == "Idle"


def test_hold_resumes(homed: Talk) -> None:
    homed.say(b"G0X-2800\n!", 0.2)
    assert homed.state() == "Hold:0"
    assert homed.say(b"G0X-2700\n") == []  # not read before the resume
    assert homed.say(b"~", 4) == ["ok"]
    assert homed.firmware.machine_mm == -2700


def test_jog_is_cancelled_with_its_position(homed: Talk) -> None:
    assert homed.say(b"$J=G91X500F6000\n", 1.0) == ["ok"]
    assert homed.state() == "Jog"
    assert homed.say(b"\x85", 0.7) == []
    assert homed.state() == "Idle"
    assert homed.firmware.rail.carriage_mm == pytest.approx(homed.firmware.machine_mm + 2905, abs=0.02)


def test_carriage_return_and_line_feed_are_two_lines(homed: Talk) -> None:
    assert homed.say(b"G0X-2895\r\n") == ["ok", "ok"]


def test_unpaced_lines_are_lost_without_a_word(homed: Talk) -> None:
    heard = homed.say(b"G1X-2800F60000\nG1X-2890\n" + b"G1 X-2800 F6000\nG1 X-2890 F6000\n" * 30, 120)
    assert 15 < heard.count("ok") < 62
    assert homed.firmware.truncated > 0


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"hello world", "error:2"), (b"G999", "error:20"), (b"X1X2", "error:25"), (b"G1G2X1", "error:24"),
        (b"G1X-2001F0", "error:22"), (b"$J=G91X10", "error:22"), (b"$J=G91X5000F3000", "error:15"),
        (b"$999=1", "error:3"), (b"$foo", "error:2"), (b"$100=-5", "error:4"), (b"$0=2", "error:6"), (b"", "ok"),
        (b"G0 X-" + b"0" * 90, "error:11"), (b"G53G2X1", "error:30"), (b"\xc3\xa9\xff\xfe", "ok"),
    ],
)  # fmt: skip
def test_refusals(homed: Talk, line: bytes, answer: str) -> None:
    assert homed.say(line + b"\n") == [answer]


def test_settings_are_refused_in_motion(homed: Talk) -> None:
    homed.say(b"G0X-2000\n", 0.3)
    for line in (b"$110=5000\n", b"$H\n", b"$#\n"):
        assert homed.say(line) == ["error:8"]


def test_soft_limits_need_homing(talk: Talk) -> None:
    assert talk.say(b"$22=0\n$20=1\n$22=1\n$20=1\n") == ["ok", "error:10", "ok", "ok"]


def test_offset_comes_with_some_reports_only(homed: Talk) -> None:
    reports = [homed.say(b"?")[0] for _ in range(20)]
    assert 1 <= sum("|WCO:" in report for report in reports) <= 3
