"""The Zaber driver on a pseudo-terminal and on loopback TCP; the first part also on a real device
(WORKBENCH_TEST_ZABER=/dev/ttyUSB0 with WORKBENCH_TEST_ZABER_MICROSTEP_MM, in mm)."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import pytest

from rigs.errors import (
    ConfigError,
    ConnectionLostError,
    DeviceBusyError,
    DeviceTimeoutError,
    LimitError,
    NotHomedError,
    PositionLostError,
    ProtocolError,
    RigError,
    StageError,
    StoppedError,
)
from rigs.zaber_protocol import NO_REFERENCE, OWN_DOING, POSITION_LOST, fault, remark
from rigs.zaber_stage import ZaberSettings, ZaberStage
from tests.standins.pty_server import PtyServer
from tests.standins.tcp_server import TcpServer
from tests.standins.zaber_device import ZaberChain, ZaberDevice

MICROSTEP_MM = 0.0005
InBackground = Callable[[Callable[[], object]], Any]


@dataclass
class ZaberBench:
    chain: ZaberChain
    line: PtyServer
    stages: list[ZaberStage] = field(default_factory=list)

    @property
    def device(self) -> ZaberDevice:
        return self.chain.devices[0]

    def open(self, **changes: Any) -> ZaberStage:
        stage = ZaberStage(
            ZaberSettings(**{"port": self.line.path, "microstep_mm": MICROSTEP_MM, "reply_timeout_s": 0.5} | changes)
        )
        self.stages.append(stage)
        return stage

    def homed(self, **changes: Any) -> ZaberStage:
        stage = self.open(**changes)
        stage.home()
        return stage

    def wait_until(self, what: Callable[[], bool], limit_s: float = 5.0) -> None:
        end = time.monotonic() + limit_s
        while not what():
            assert time.monotonic() < end, "it never came to that"
            time.sleep(0.002)

    def slow(self) -> None:
        self.device.settings |= {"maxspeed": "327680", "accel": "400"}  # 100 mm/s


@pytest.fixture
def zaber() -> Iterator[ZaberBench]:
    chain = ZaberChain(ZaberDevice(), ZaberDevice(address=2, position=5.0))
    with PtyServer(chain) as line:
        bench = ZaberBench(chain, line)
        try:
            yield bench
        finally:
            for stage in bench.stages:
                with suppress(RigError):
                    stage.close()


_BENCH = [pytest.param(os.environ["WORKBENCH_TEST_ZABER"], marks=pytest.mark.hardware, id="bench")]\
    if "WORKBENCH_TEST_ZABER" in os.environ else []  # fmt: skip


@pytest.fixture(params=["pty", "tcp", *_BENCH])
def any_zaber(request: pytest.FixtureRequest) -> Iterator[ZaberStage]:
    """A Zaber stage, homed."""
    if request.param == "pty":
        bench: ZaberBench = request.getfixturevalue("zaber")
        bench.slow()
        yield bench.homed()
        return
    if request.param == "tcp":
        device = ZaberDevice(address=3)
        device.settings |= {"maxspeed": "327680", "accel": "400", "resolution": "128", "comm.checksum": "1"}
        with TcpServer(ZaberChain(ZaberDevice(), device)) as server:
            stage = ZaberStage(ZaberSettings(port=server.url, microstep_mm=MICROSTEP_MM, device=3))
            stage.home()
            yield stage
            stage.close()
        return
    microstep_mm = float(os.environ.get("WORKBENCH_TEST_ZABER_MICROSTEP_MM", "0.00049609375"))
    stage = ZaberStage(ZaberSettings(port=request.param, microstep_mm=microstep_mm))
    try:
        stage.home()
        yield stage
    finally:
        stage.close()


def inner(stage: ZaberStage, part: float) -> float:
    low, high = stage.limits_mm()
    return low + part * min(60.0, high - low)


def test_moves_end_where_they_should(any_zaber: ZaberStage) -> None:
    for part in (0.3, 1.0, 0.1):
        place = inner(any_zaber, part)
        assert any_zaber.move_to_mm(place) == pytest.approx(place, abs=0.01)
        assert any_zaber.position_mm() == pytest.approx(place, abs=0.01)
    assert any_zaber.homed()


def test_identity(any_zaber: ZaberStage) -> None:
    identity = any_zaber.identify()
    assert (identity.kind, identity.make) == ("zaber", "Zaber")
    assert identity.firmware
    assert identity.serial


def test_positions_outside_travel_are_refused(any_zaber: ZaberStage) -> None:
    low, high = any_zaber.limits_mm()
    before = any_zaber.position_mm()
    for place in (low - 1, high + 1, float("nan")):
        with pytest.raises(LimitError, match="travel"):
            any_zaber.move_to_mm(place)
    assert any_zaber.position_mm() == before


def test_stop_from_another_thread(any_zaber: ZaberStage, in_background: InBackground) -> None:
    place = inner(any_zaber, 1.0)
    moving = in_background(lambda: any_zaber.move_to_mm(place))
    time.sleep(0.4 * any_zaber.travel_time_s(place - any_zaber.position_mm()))
    any_zaber.stop()
    where = any_zaber.position_mm()
    assert isinstance(moving.ended(), StoppedError)
    assert abs(where - place) > 0.1
    assert any_zaber.position_mm() == where
    assert any_zaber.homed()
    assert any_zaber.move_to_mm(place) == pytest.approx(place, abs=0.01)


# -- the stand-in only -------------------------------------------------------------------------------------------


def test_no_reference_no_move(zaber: ZaberBench) -> None:
    stage = zaber.open()
    assert not stage.homed()
    for refused in (stage.position_mm, lambda: stage.move_to_mm(10)):
        with pytest.raises(NotHomedError, match="home"):
            refused()
    assert b"move" not in zaber.line.sent


def test_reference_hidden_behind_a_more_important_warning(zaber: ZaberBench) -> None:
    stage = zaber.open()
    zaber.device.flags = {"WL", "WR"}
    assert not stage.homed()


def test_position_survives_a_reopened_port(zaber: ZaberBench) -> None:
    zaber.homed().close()
    assert zaber.open().homed()


def test_power_cut(zaber: ZaberBench) -> None:
    stage = zaber.homed()
    zaber.device.power_on()
    with pytest.raises(PositionLostError, match="restarted"):
        stage.move_to_mm(10)
    assert not stage.homed()


def test_stall_loses_the_position_until_homed(zaber: ZaberBench) -> None:
    stage = zaber.homed()
    zaber.device.jam_at = 1e6
    with pytest.raises(PositionLostError, match="stalled"):
        stage.move_to_mm(1000)
    assert not stage.homed()
    with pytest.raises(PositionLostError, match="FS"):
        stage.move_to_mm(10)
    zaber.device.jam_at = None
    stage.home()
    assert stage.move_to_mm(1000) == 1000


def test_home_sensor_dead(zaber: ZaberBench) -> None:
    zaber.device.dead_home_sensor = True
    with pytest.raises(StageError, match="home sensor"):
        zaber.open().home()


def test_knob_turned_on_the_way(zaber: ZaberBench, in_background: InBackground) -> None:
    stage = zaber.homed()
    zaber.slow()
    moving = in_background(lambda: stage.move_to_mm(1000))
    zaber.wait_until(lambda: zaber.device.busy)
    with zaber.line.lock:
        zaber.device.flags.add("NC")
        zaber.device.answer(1, "stop")
    error = moving.ended()
    assert isinstance(error, StageError)
    assert "knob" in str(error)


@pytest.mark.parametrize("flag", ["NI", "NC"])
def test_warning_left_over_from_a_broken_off_movement_stops_no_other(zaber: ZaberBench, flag: str) -> None:
    zaber.device.lasting = {flag}  # until it is cleared
    stage = zaber.homed()
    zaber.device.flags.add(flag)
    assert stage.move_to_mm(100) == 100


@pytest.mark.parametrize(
    ("flag", "words"),
    [("FB", "close the other program"), ("FV", "power supply"), ("FZ", "activate it"), ("FY", "doesn't know .FY")],
)
def test_fault_keeps_it_from_moving_and_says_the_way_out(zaber: ZaberBench, flag: str, words: str) -> None:
    stage = zaber.homed()
    zaber.device.flags.add(flag)
    with pytest.raises(StageError, match=words) as caught:
        stage.move_to_mm(10)
    assert flag in str(caught.value)
    assert b"move abs" not in zaber.line.sent
    problem = stage.facts().problem
    assert problem is not None
    assert flag in problem[0]
    assert problem[1]


def test_fault_that_is_over_is_homed_away(zaber: ZaberBench) -> None:
    stage = zaber.homed()
    zaber.device.flags.add("FB")
    assert not stage.homed()  # so that a session homes it
    stage.home()
    assert stage.homed()
    assert stage.move_to_mm(10) == 10


@pytest.mark.parametrize("flag", ["WS", "WM", "WV", "WT", "WP", "ND", "NR", "NT", "NU", "NJ", "WQ"])
def test_warning_that_stops_nothing_is_a_remark_with_a_way_out(zaber: ZaberBench, flag: str) -> None:
    stage = zaber.homed()
    zaber.device.flags.add(flag)
    assert stage.move_to_mm(10) == 10
    facts = stage.facts()
    assert facts.problem is None
    ((name, seen, way_out),) = facts.remarks
    assert name == "warning"
    assert flag in seen
    assert way_out


def test_every_flag_that_the_vendor_knows_has_its_words() -> None:
    vendor = pytest.importorskip("zaber_motion.ascii").WarningFlags
    for flag in (value for name, value in vars(vendor).items() if name.isupper()):
        known = fault(flag) or remark(flag) or flag in NO_REFERENCE | OWN_DOING | POSITION_LOST.keys()
        assert known, flag
        assert "this program doesn't know" not in str(fault(flag) or remark(flag)), flag


@pytest.mark.parametrize("limits_mm", [(-10.0, 3000.0), (0.0, 3000.1), (9e4, 9e5)])
def test_limits_beyond_the_devices_own_are_refused(zaber: ZaberBench, limits_mm: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match=r"stage\.limits: .* beyond the device's own .*0 to 3000 mm; correct"):
        zaber.open(limits_mm=limits_mm)
    assert b"home" not in zaber.line.sent
    assert b"move" not in zaber.line.sent


@pytest.mark.parametrize(
    ("reason", "error", "words"),
    [
        ("AGAIN", DeviceBusyError, "try again"),
        ("BADDATA", LimitError, "limits"),
        ("BADAXIS", ConfigError, r"stage\.axis"),
        ("BADCOMMAND", ProtocolError, "firmware may be too old"),
        ("BADMESSAGEID", ProtocolError, "cable"),
        ("BUSY", DeviceBusyError, "close the other program"),
        ("DEVICEONLY", ProtocolError, "firmware may be too old"),
        ("DRIVERDISABLED", StageError, "driver"),
        ("FULL", DeviceBusyError, "switch the device off and on"),
        ("INACTIVE", StageError, "activate it"),
        ("LOCKSTEP", StageError, "dissolve"),
        ("NOACCESS", StageError, r"system\.access"),
        ("PARKED", StageError, "parked"),
        ("REMOTE", StageError, "hand control back"),
        ("STATUSBUSY", DeviceBusyError, "wait"),
        ("SOMETHINGNEW", StageError, "SOMETHINGNEW"),
    ],
)
def test_rejected_moves(zaber: ZaberBench, reason: str, error: type[RigError], words: str) -> None:
    stage = zaber.homed()
    zaber.device.reject["move"] = reason
    with pytest.raises(error, match=words):
        stage.move_to_mm(10)
    assert not zaber.device.busy


def test_axis_that_is_not_there(zaber: ZaberBench) -> None:
    with pytest.raises(ConfigError, match=r"stage\.axis"):
        zaber.open(axis=2)


def test_address_that_nobody_has_names_those_that_answer(zaber: ZaberBench) -> None:
    with pytest.raises(ProtocolError, match=r"device 7 doesn't answer, but devices 1, 2 do; correct stage\.device"):
        zaber.open(device=7, reply_timeout_s=0.3)


def test_nobody_answers(zaber: ZaberBench) -> None:
    zaber.line.silent = True
    with pytest.raises(DeviceTimeoutError, match=r"no answer .* check power, cable, stage\.device"):
        zaber.open(reply_timeout_s=0.1)


def test_two_devices_with_one_address_are_refused_before_both_move(zaber: ZaberBench) -> None:
    zaber.chain.devices[1].address = 1
    zaber.chain.devices[1].settings["system.serial"] = "100236"
    with pytest.raises(ProtocolError, match=r"2 devices answer as device 1 .*100235, 100236.*renumber"):
        zaber.open()
    assert b"home" not in zaber.line.sent


def test_number_that_noise_changed_is_asked_for_again(zaber: ZaberBench) -> None:
    answers = iter(range(100))
    zaber.chain.change_reply = lambda reply: (
        reply.replace(b"6000000", b"600000") if b"6000000" in reply and next(answers) == 0 else reply
    )
    assert zaber.open().limits_mm() == (0, 3000)


def test_power_cut_on_the_way_is_no_arrival(zaber: ZaberBench, in_background: InBackground) -> None:
    stage = zaber.homed()
    zaber.slow()
    moving = in_background(lambda: stage.move_to_mm(1000))
    zaber.wait_until(lambda: zaber.device.busy)
    with zaber.line.lock:
        zaber.device.power_on()
    error = moving.ended()
    assert isinstance(error, PositionLostError)
    assert "restarted while moving to 1000 mm" in str(error)


def test_another_programs_command_on_the_way_is_told_from_a_stop(
    zaber: ZaberBench, in_background: InBackground
) -> None:
    stage = zaber.homed()
    zaber.slow()
    moving = in_background(lambda: stage.move_to_mm(1000))
    zaber.wait_until(lambda: zaber.device.busy)
    with zaber.line.lock:
        zaber.device.answer(1, "stop")
    error = moving.ended()
    assert isinstance(error, StoppedError)
    assert "interrupted by another program or its knob" in str(error)


def test_answer_from_another_address(zaber: ZaberBench) -> None:
    zaber.chain.change_reply = lambda reply: reply.replace(b"@01", b"@02")
    with pytest.raises(ProtocolError, match=r"device 1 doesn't answer, but device 2 does"):
        zaber.open(reply_timeout_s=0.1)


def test_garbled_reply_with_a_checksum_is_asked_again(zaber: ZaberBench) -> None:
    stage = zaber.homed(reply_timeout_s=0.15)
    zaber.device.settings["comm.checksum"] = "1"
    count = iter(range(10**6))
    zaber.chain.change_reply = lambda reply: reply.replace(b" OK", b" OJ") if next(count) % 4 == 1 else reply
    assert stage.move_to_mm(100) == 100


@pytest.mark.parametrize("in_replies", ["0", "1"])
def test_warning_at_the_end_of_a_reply_in_several_messages_is_seen(zaber: ZaberBench, in_replies: str) -> None:
    stage = zaber.homed()
    zaber.device.settings["comm.checksum"] = in_replies
    zaber.chain.longest_data = 6
    zaber.device.flags = {"WL", "WR", "NI", "WS", "WT"}
    assert not stage.homed()
    zaber.device.flags -= {"WL", "WR"}
    assert stage.homed()
    assert stage.move_to_mm(100) == 100


def test_list_of_warnings_that_lost_one_is_not_believed(zaber: ZaberBench) -> None:
    stage = zaber.homed()
    zaber.device.flags = {"WR"}
    zaber.chain.change_reply = lambda reply: reply.replace(b"01 WR", b"01 ")
    with pytest.raises(ProtocolError, match="list of warnings is damaged"):
        stage.move_to_mm(100)
    assert not stage.homed()


def test_garbage_only(zaber: ZaberBench) -> None:
    stage = zaber.homed(reply_timeout_s=0.1)
    zaber.chain.change_reply = lambda reply: reply[:-8]
    with pytest.raises(ProtocolError, match="garbled"):
        stage.move_to_mm(100)


def test_alerts_information_and_late_replies_are_nobodys_answer(zaber: ZaberBench) -> None:
    stage = zaber.homed()
    zaber.device.settings["comm.alert"] = "1"
    late: list[bytes] = []

    def disorder(reply: bytes) -> bytes:
        late.append(reply)
        return b"#01 1 talkative\r\n!01 1 IDLE --\r\n" + (late[-2] if len(late) > 1 else b"") + reply

    zaber.chain.change_reply = disorder
    for place in (100, 300, 200):
        assert stage.move_to_mm(place) == place


def test_silence_on_the_way(zaber: ZaberBench, in_background: InBackground) -> None:
    zaber.slow()
    stage = zaber.homed(reply_timeout_s=0.2)
    moving = in_background(lambda: stage.move_to_mm(1000))
    time.sleep(0.2)
    zaber.line.silent = True
    assert isinstance(moving.ended(), DeviceTimeoutError)
    time.sleep(0.1)
    assert b" stop:" in zaber.line.sent  # told to although it doesn't answer


def test_unplugged_on_the_way(zaber: ZaberBench, in_background: InBackground) -> None:
    zaber.slow()
    stage = zaber.homed()
    moving = in_background(lambda: stage.move_to_mm(1000))
    time.sleep(0.2)
    zaber.line.unplug()
    assert isinstance(moving.ended(2), ConnectionLostError)
    assert not stage.homed()


def test_move_that_takes_too_long_is_stopped(zaber: ZaberBench) -> None:
    stage = zaber.homed(patience=0.1, reply_timeout_s=0.3)
    zaber.slow()  # slower than it said
    with pytest.raises(DeviceTimeoutError, match="moving to 1000 mm"):
        stage.move_to_mm(1000)
    stage.stop()
    assert not zaber.device.busy


def test_speed_limit_goes_with_the_move(zaber: ZaberBench) -> None:
    stage = zaber.homed(speed_mm_s=500.0)
    began = time.monotonic()
    stage.move_to_mm(100)
    assert time.monotonic() - began > 0.2
    assert stage.travel_time_s(500) == pytest.approx(1.0, abs=0.2)


def test_speed_limit_is_refused_where_the_firmware_cannot_keep_it(zaber: ZaberBench) -> None:
    zaber.device.settings["version"] = "6.28"
    with pytest.raises(ConfigError, match=r"stage\.speed: needs firmware 7\.25 or newer, the device has 6\.28"):
        zaber.open(speed_mm_s=500.0)
    assert zaber.homed().move_to_mm(100) == pytest.approx(100)


def test_stop_while_homing(zaber: ZaberBench, in_background: InBackground) -> None:
    stage = zaber.open()
    zaber.device.position = 1.2e6
    zaber.device.settings["limit.approach.maxspeed"] = "327680"
    homing = in_background(stage.home)
    time.sleep(0.2)
    stage.stop()
    assert isinstance(homing.ended(), StoppedError)
    assert not stage.homed()


@pytest.mark.parametrize(
    "changes",
    [{"microstep_mm": 0.0}, {"device": 0}, {"axis": 12}, {"limits_mm": (5.0, 5.0)}, {"speed_mm_s": -1.0}],
)  # fmt: skip
def test_settings_that_cannot_be(zaber: ZaberBench, changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"stage\."):
        zaber.open(**changes)
