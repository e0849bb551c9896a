"""What a stage is asked when its rig is checked: the controller's own words, and nothing that moves or changes it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rigs.errors import DeviceTimeoutError, ProtocolError
from rigs.grbl_inspect import inspect_grbl
from rigs.grbl_stage import GrblSettings
from rigs.stage_facts import StageFacts
from rigs.zaber_stage import ZaberSettings, ZaberStage
from tests.protocol.stage.conftest import GrblBench
from tests.standins.pty_server import PtyServer
from tests.standins.zaber_device import ZaberChain


def look(grbl: GrblBench) -> StageFacts:
    facts = inspect_grbl(GrblSettings(port=grbl.line.path, reply_timeout_s=1.0, boot_timeout_s=6.0))
    sent = bytes(grbl.line.sent)
    assert not any(word in sent for word in (b"$H", b"$X", b"$J", b"G", b"!", b"~")), sent
    return facts


def test_controller_after_power_up_is_told_as_it_is(grbl: GrblBench) -> None:
    facts = look(grbl)
    assert (facts.identity.model, facts.identity.firmware) == ("GRBL", "1.1h.20190830")
    assert facts.state == "Alarm"
    assert (facts.problem, facts.disturbance, facts.referenced) == (None, None, False)
    assert (facts.homing, facts.soft_limits, facts.hard_limits) == (True, True, True)
    assert facts.travel_mm == (-2895.0, 0.0)
    assert facts.max_speed_mm_s == 50000.0
    assert [check for check, _, _ in facts.remarks] == ["motors"]
    assert grbl.firmware.rail.carriage_mm == 60.0


def test_controller_that_protects_nothing_is_told_rather_than_refused(grbl: GrblBench) -> None:
    grbl.firmware.settings |= {1: 255, 20: 0, 21: 0, 22: 0}
    grbl.firmware.power_on()
    facts = look(grbl)
    assert (facts.homing, facts.soft_limits, facts.hard_limits) == (False, False, False)
    assert facts.state == "Idle"
    assert facts.remarks == ()


def test_pause_of_another_program_is_told_apart_from_a_dead_line(grbl: GrblBench) -> None:
    grbl.homed().close()
    grbl.forget_sent()
    grbl.firmware.receive(b"G4 P600\n")
    with pytest.raises(DeviceTimeoutError, match=r"reports Idle, but doesn't answer '\$.*' .*pause \(G4\)"):
        look(grbl)


def test_alarm_that_nothing_but_power_ends(grbl: GrblBench) -> None:
    with grbl.line.lock:
        grbl.firmware.settings[22] = 0
    facts = look(grbl)
    assert facts.state == "Alarm"
    assert facts.problem is not None
    assert "can't be homed" in facts.problem[0]


def test_closed_switch_is_remarked(grbl: GrblBench) -> None:
    with grbl.line.lock:
        grbl.firmware.rail.stuck_switch = True
    remarks = {check: (seen, mend) for check, seen, mend in look(grbl).remarks}
    assert "axis X is closed" in remarks["limit switch"][0]


def test_deaf_controller_is_woken_and_told(grbl: GrblBench) -> None:
    with grbl.line.lock:
        grbl.firmware._kill("Alarm", 1)
    assert "last alarm" in [check for check, _, _ in look(grbl).remarks]


def test_check_mode_is_a_disturbance(grbl: GrblBench) -> None:
    grbl.homed().close()
    grbl.forget_sent()
    with grbl.line.lock:
        grbl.firmware.receive(b"$C\n")
    grbl.wait_until(lambda: grbl.firmware.state == "Check")
    facts = look(grbl)
    assert facts.disturbance is not None
    assert "only checks G-code" in facts.disturbance[0]
    grbl.homed()  # as was promised, a session isn't kept from homing
    assert grbl.firmware.state == "Idle"


def test_open_door_is_a_problem_and_a_closed_one_is_none(grbl: GrblBench) -> None:
    grbl.homed().close()
    grbl.forget_sent()
    with grbl.line.lock:
        grbl.firmware.open_door(stays_open=True)
    grbl.wait_until(lambda: grbl.firmware.state == "Hold")
    facts = look(grbl)
    assert facts.problem == ("the controller sees its safety door open", "close the door")
    with grbl.line.lock:
        grbl.firmware.close_door()
    facts = look(grbl)
    assert facts.problem is None
    assert facts.disturbance is not None
    assert "closed again: calibrate ends that" in facts.disturbance[0]
    grbl.homed()  # as was promised


def test_stage_that_somebody_else_moves_is_left_alone(grbl: GrblBench) -> None:
    grbl.homed().close()
    grbl.slow(mm_min=600.0)
    grbl.forget_sent()
    with grbl.line.lock:
        grbl.firmware.receive(b"G90 G21 G53 G1 X-2000 F600\n")
    grbl.wait_until(lambda: grbl.firmware.state == "Run")
    facts = look(grbl)
    assert facts.disturbance is not None
    assert "moving on somebody else's command" in facts.disturbance[0]
    assert facts.homing is None
    assert grbl.firmware.state == "Run"  # it wasn't stopped either


def test_silence_and_other_devices_are_named_errors(grbl: GrblBench) -> None:
    grbl.line.silent = True
    with pytest.raises(DeviceTimeoutError, match="no answer"):
        inspect_grbl(GrblSettings(port=grbl.line.path, reply_timeout_s=0.3, boot_timeout_s=0.5))
    with PtyServer(ZaberChain()) as line, pytest.raises((DeviceTimeoutError, ProtocolError)):
        inspect_grbl(GrblSettings(port=line.path, reply_timeout_s=0.3, boot_timeout_s=0.5))


@pytest.fixture
def zaber() -> Iterator[tuple[ZaberChain, ZaberStage]]:
    chain = ZaberChain()
    with PtyServer(chain) as line:
        stage = ZaberStage(ZaberSettings(port=line.path, microstep_mm=0.0005))
        yield chain, stage
        stage.close()


def test_zaber_tells_reference_faults_and_travel(zaber: tuple[ZaberChain, ZaberStage]) -> None:
    chain, stage = zaber
    device = chain.devices[0]
    facts = stage.facts()
    assert (facts.referenced, facts.problem, facts.travel_mm) == (False, None, (0.0, 3000.0))
    device.flags = set()
    assert stage.facts().referenced
    device.flags = {"FS"}
    facts = stage.facts()
    assert not facts.referenced
    assert facts.problem is None  # it is homed again
    assert facts.remarks[0][0] == "last alarm"
    assert "look what blocks" in facts.remarks[0][2]
    device.flags = {"FD"}
    facts = stage.facts()
    assert facts.problem is not None
    assert "driver switched itself off (FD)" in facts.problem[0]
