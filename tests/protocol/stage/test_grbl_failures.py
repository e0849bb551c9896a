"""What goes wrong with a GRBL stage, and what the operator reads for it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from rigs.errors import (
    AlarmError,
    ConfigError,
    ConnectionLostError,
    DeviceBusyError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    LimitError,
    NotHomedError,
    PositionLostError,
    ProtocolError,
    StageError,
    StoppedError,
)
from rigs.grbl_protocol import Other, parse
from rigs.grbl_stage import GrblSettings, GrblStage
from tests.standins.grbl_firmware import GrblFirmware
from tests.standins.tcp_server import TcpServer

Grbl = Any
InBackground = Callable[[Callable[[], object]], Any]


# -- opening -----------------------------------------------------------------------------------------------------


def moving_while(grbl: Grbl, stage: GrblStage, in_background: InBackground, happens: Callable[[], None]) -> Any:
    """A slow move on another thread, during which something happens to the controller."""
    grbl.slow()
    moving = in_background(lambda: stage.move_to_mm(-1000))
    grbl.wait_until(lambda: grbl.firmware.moving)
    with grbl.line.lock:
        happens()
    return moving


def test_opening_never_means_knowing_the_position(grbl: Grbl) -> None:
    first = grbl.homed()
    first.close()
    again = grbl.open()  # Idle, no banner, a plausible position
    assert not again.homed()
    grbl.forget_sent()
    with pytest.raises(NotHomedError, match="home"):
        again.position_mm()
    with pytest.raises(NotHomedError, match="home"):
        again.move_to_mm(-1000)
    assert not grbl.line.sent


def test_alarm_at_power_up_is_waited_out_and_homed_away(grbl: Grbl) -> None:
    stage = grbl.open()
    assert grbl.firmware.state == "Alarm"
    assert not stage.homed()
    stage.home()
    assert stage.homed()
    assert stage.position_mm() == -2895
    assert b"$X" not in grbl.line.sent


def test_board_that_is_reset_by_the_port_and_boots_slowly(grbl: Grbl) -> None:
    grbl.firmware.boot_s = 1.7
    grbl.line._on_open = grbl.firmware.power_on
    stage = grbl.homed()
    assert stage.move_to_mm(-2800) == -2800


def test_controller_left_moving_is_brought_to_rest(grbl: Grbl) -> None:
    grbl.homed().close()
    grbl.slow()
    grbl.firmware.receive(b"G1 X-1000 F6000\n")
    grbl.wait_until(lambda: grbl.firmware.state == "Run")
    grbl.open()
    assert grbl.firmware.state == "Idle"
    assert not grbl.firmware.moving


@pytest.mark.parametrize("state", ["$SLP\n", "$C\n", "!"])
def test_controller_asleep_checking_or_held_homes(grbl: Grbl, state: str) -> None:
    stage = grbl.homed()
    grbl.line.device.receive(state.encode())
    time.sleep(0.05)
    with pytest.raises((StageError, DeviceTimeoutError)):
        stage.move_to_mm(-2000)
    stage.home()
    assert stage.move_to_mm(-2800) == -2800


def test_pause_that_another_program_left_behind_is_ended(grbl: Grbl) -> None:
    grbl.homed().close()
    grbl.firmware.receive(b"G4 P600\n")
    assert grbl.homed().move_to_mm(-2000) == -2000


def test_deaf_after_an_alarm_of_an_earlier_program_is_woken(grbl: Grbl) -> None:
    grbl.homed().close()
    grbl.firmware.receive(b"G90G0X50\n")
    grbl.wait_until(lambda: grbl.firmware.state == "Alarm")
    stage = grbl.open()
    stage.home()
    assert stage.homed()


def test_silence_at_open(grbl: Grbl) -> None:
    grbl.line.silent = True
    with pytest.raises(DeviceTimeoutError, match=r"no answer.*baud"):
        grbl.open(boot_timeout_s=0.5)


def test_another_kind_of_device_at_open(grbl: Grbl) -> None:
    grbl.line.corrupt = lambda data: b"@01 0 RJ IDLE WR BADCOMMAND\r\n"
    with pytest.raises(ProtocolError, match=r"not as GRBL.*stage\.kind"):
        grbl.open(boot_timeout_s=0.7)


def test_port_that_is_not_there() -> None:
    with pytest.raises(DeviceNotFoundError, match=r"/dev/no-such-port.*serial ports found"):
        GrblStage(GrblSettings(port="/dev/no-such-port"))


def test_usb_device_that_is_not_plugged_in() -> None:
    with pytest.raises(DeviceNotFoundError, match="usb:dead:beef is not plugged in"):
        GrblStage(GrblSettings(port="usb:dead:beef"))


@pytest.mark.parametrize(
    ("port", "words"),
    [
        ("socket://127.0.0.1:9", "can't be reached .*refused.*; check the network"),
        ("rfc2217://127.0.0.1:9", "can't be reached .*refused.*; check the network"),
        ("/dev/null", "is no serial port; correct stage.port"),
        ("/tmp", "is no serial port; correct stage.port"),
    ],
)
def test_port_that_leads_nowhere(port: str, words: str) -> None:
    with pytest.raises(DeviceNotFoundError, match=words):
        GrblStage(GrblSettings(port=port))


def test_terminal_server_that_speaks_no_rfc2217() -> None:
    with (
        TcpServer(GrblFirmware()) as raw,
        pytest.raises(DeviceNotFoundError, match=r"doesn't speak RFC 2217; correct stage\.port, or try socket://"),
    ):
        GrblStage(GrblSettings(port=raw.url.replace("socket", "rfc2217")))


@pytest.mark.parametrize("port", ["usb:12", "", "nonsense://x", "socket://127.0.0.1", "rfc2217://host"])
def test_port_that_is_no_port(port: str) -> None:
    with pytest.raises(ConfigError, match=r"stage\.port"):
        GrblStage(GrblSettings(port=port))


def test_port_used_by_another_program(grbl: Grbl) -> None:
    grbl.open()
    with pytest.raises(DeviceBusyError, match="another program"):
        grbl.open()


@pytest.mark.parametrize(
    ("settings", "key"),
    [({20: 0}, "allow_without_soft_limits"), ({20: 0, 22: 0}, "allow_without_homing")],
)
def test_refuses_without_homing_or_soft_limits(grbl: Grbl, settings: dict[int, float], key: str) -> None:
    grbl.firmware.settings |= settings
    with pytest.raises(StageError, match=rf"stage\.{key}: true"):
        grbl.open()


def test_runs_without_homing_where_the_configuration_says_so(grbl: Grbl) -> None:
    grbl.firmware.settings |= {20: 0, 21: 0, 22: 0}
    grbl.firmware.power_on()
    words = {"allow_without_homing": True, "allow_without_soft_limits": True}
    with pytest.raises(ConfigError, match=r"stage\.limits"):
        grbl.open(**words)
    stage = grbl.homed(**words, limits_mm=(0.0, 500.0))
    assert stage.move_to_mm(400) == 400
    with pytest.raises(LimitError):
        stage.move_to_mm(501)


@pytest.mark.parametrize("limits", [(-2900.0, 0.0), (-2895.0, 100.0), (0.0, 2895.0)])
def test_limits_beyond_the_controllers_travel_are_refused_before_anything_moves(
    grbl: Grbl, limits: tuple[float, float]
) -> None:
    with pytest.raises(ConfigError, match=r"stage\.limits: .* beyond the controller's travel .*-2895 to 0 mm; correct"):
        grbl.open(limits_mm=limits)
    assert b"$H" not in grbl.line.sent
    assert b"G" not in grbl.line.sent


def test_limits_that_leave_out_the_switch_are_kept_though_homing_ends_there(grbl: Grbl) -> None:
    stage = grbl.homed(limits_mm=(-2000.0, -100.0))
    assert stage.position_mm() == -2895
    with pytest.raises(LimitError, match="-2000 to -100 mm"):
        stage.move_to_mm(-2500)
    assert stage.move_to_mm(-2000) == -2000


def test_setting_lost_to_noise_is_read_again(grbl: Grbl) -> None:
    answers = iter(range(100))

    def first_answer_loses_a_digit(data: bytes) -> bytes:
        return data.replace(b"$130=2900", b"$130=290") if b"$130" in data and next(answers) == 0 else data

    grbl.line.corrupt = first_answer_loses_a_digit
    assert grbl.open().limits_mm() == (-2895, 0)


def test_settings_that_read_otherwise_each_time_are_not_believed(grbl: Grbl) -> None:
    answers = iter(range(100))
    grbl.line.corrupt = lambda data: data.replace(b"$130=2900", b"$130=29%02d" % next(answers))
    with pytest.raises(ProtocolError, match=r"settings .* read otherwise each time; check cable"):
        grbl.open()


def test_safety_door_open_at_the_start_is_named(grbl: Grbl) -> None:
    grbl.homed().close()
    with grbl.line.lock:
        grbl.firmware.open_door(stays_open=True)
    grbl.wait_until(lambda: grbl.firmware.state == "Hold")
    with pytest.raises(StageError, match="sees its safety door open; close the door, then start again"):
        grbl.open()
    with grbl.line.lock:
        grbl.firmware.close_door()
    assert grbl.homed().move_to_mm(-2000) == -2000


# -- homing ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fault", "code"), [("stuck_switch", 8), ("dead_switch", 9)])
def test_homing_fails(grbl: Grbl, fault: str, code: int) -> None:
    stage = grbl.open()
    setattr(grbl.firmware.rail, fault, True)
    with pytest.raises(AlarmError, match=f"ALARM:{code} while homing.*switch.*home"):
        stage.home()
    assert not stage.homed()
    with pytest.raises(NotHomedError):
        stage.move_to_mm(-1000)
    setattr(grbl.firmware.rail, fault, False)
    grbl.firmware.rail.carriage_mm = 50.0  # pushed by hand
    stage.home()
    assert stage.homed()


def test_homing_that_never_ends(grbl: Grbl) -> None:
    stage = grbl.open(patience=0.01, reply_timeout_s=0.4)
    grbl.firmware.settings |= {25: 600.0, 24: 600.0}
    began = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match="homing"):
        stage.home()
    assert time.monotonic() - began < 3
    grbl.wait_until(lambda: grbl.firmware.state == "Alarm")  # it was told to stop
    assert not stage.homed()


def test_stop_while_homing(grbl: Grbl, in_background: InBackground) -> None:
    stage = grbl.open()
    grbl.firmware.settings[25] = 600.0
    homing = in_background(stage.home)
    grbl.wait_until(lambda: grbl.firmware.state == "Home" and grbl.firmware.moving)
    stage.stop()
    assert isinstance(homing.ended(), StoppedError)
    assert not grbl.firmware.moving
    assert not stage.homed()
    grbl.firmware.settings[25] = 600000.0
    stage.home()
    assert stage.homed()


# -- moving ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", [-2895.5, 0.5, float("inf"), float("nan")])
def test_move_outside_the_limits_touches_nothing(grbl: Grbl, place: float) -> None:
    stage = grbl.homed()
    grbl.forget_sent()
    with pytest.raises(LimitError, match="-2895 to 0 mm"):
        stage.move_to_mm(place)
    assert not grbl.line.sent


@pytest.mark.parametrize("stale_s", [0.0, 0.08, 0.4])
def test_stale_idle_isnt_arrival(grbl: Grbl, stale_s: float) -> None:
    stage = grbl.homed()
    grbl.firmware.cycle_start_s = stale_s
    for place in (-2000, -100.125, -2500):
        assert stage.move_to_mm(place) == pytest.approx(place, abs=0.02)
        assert not grbl.firmware.moving
        assert grbl.firmware.machine_mm == pytest.approx(place, abs=0.02)


def test_soft_limit_of_the_controller_narrower_than_it_said(grbl: Grbl) -> None:
    stage = grbl.homed()
    grbl.firmware.settings[130] = 1000.0
    with pytest.raises(AlarmError, match=r"ALARM:2 while moving to -2000 mm.*\$130"):
        stage.move_to_mm(-2000)
    with pytest.raises(NotHomedError, match="ALARM:2"):
        stage.move_to_mm(-1000)
    grbl.firmware.settings[130] = 2900.0
    stage.home()
    assert stage.move_to_mm(-1000) == -1000


def test_hard_limit_on_the_way(grbl: Grbl, in_background: InBackground) -> None:
    stage = grbl.homed()
    moving = moving_while(grbl, stage, in_background, grbl.firmware.trip_switch)
    error = moving.ended()
    assert isinstance(error, AlarmError)
    assert "ALARM:1" in str(error)
    assert not stage.homed()
    grbl.forget_sent()
    with pytest.raises(PositionLostError, match="home"):
        stage.move_to_mm(-2000)
    assert not grbl.line.sent


def test_reset_on_the_way_loses_the_position(grbl: Grbl, in_background: InBackground) -> None:
    stage = grbl.homed()
    moving = moving_while(grbl, stage, in_background, grbl.firmware.press_reset)
    assert isinstance(moving.ended(), PositionLostError)
    assert not stage.homed()
    with pytest.raises(PositionLostError, match="home"):
        stage.move_to_mm(-2000)
    stage.home()
    assert stage.move_to_mm(-2890) == -2890


def test_reset_button_while_nobody_looks(grbl: Grbl) -> None:
    stage = grbl.homed()
    with grbl.line.lock:
        grbl.firmware.press_reset()
    grbl.wait_until(lambda: not stage.homed())
    with pytest.raises(PositionLostError, match="restarted"):
        stage.move_to_mm(-2000)


def test_power_cut_while_nobody_looks(grbl: Grbl) -> None:
    stage = grbl.homed()
    stage.move_to_mm(-1000)
    grbl.line.silent = True  # the banner is lost
    with grbl.line.lock:
        grbl.firmware.power_on()
    time.sleep(0.05)
    grbl.line.silent = False
    with pytest.raises(AlarmError, match="alarm"):
        stage.move_to_mm(-2000)
    assert not stage.homed()


def test_moved_by_another_program(grbl: Grbl) -> None:
    stage = grbl.homed()
    stage.move_to_mm(-1000)
    grbl.firmware.receive(b"G0X-900\n")
    time.sleep(0.2)
    with pytest.raises(PositionLostError, match="-900 mm, we left it at -1000 mm"):
        stage.move_to_mm(-2000)


def test_feed_hold_button_ends_the_move_and_keeps_the_position(grbl: Grbl, in_background: InBackground) -> None:
    stage = grbl.homed()
    moving = moving_while(grbl, stage, in_background, grbl.firmware.press_hold)
    error = moving.ended()
    assert isinstance(error, StoppedError)
    assert "paused by its feed hold" in str(error)
    assert stage.homed()
    assert grbl.firmware.state == "Idle"  # nothing is left that a resume button could set going


def test_door_opened_during_a_move_is_named_at_once_and_keeps_the_position(
    grbl: Grbl, in_background: InBackground
) -> None:
    stage = grbl.homed()
    moving = moving_while(grbl, stage, in_background, grbl.firmware.open_door)
    error = moving.ended()
    assert isinstance(error, StageError)
    assert "sees its safety door open on the way; close the door" in str(error)
    assert stage.homed()
    assert grbl.firmware.rail.carriage_mm == pytest.approx(stage.position_mm() + 2905, abs=0.02)
    assert stage.move_to_mm(stage.position_mm() + 2)


def test_work_offset_that_lost_a_coordinate_is_no_report(grbl: Grbl) -> None:
    grbl.firmware.settings[10] = 0
    stage = grbl.homed()
    stage._controller._offset = (0.0, 0.0)  # as a build without the check would keep it
    with pytest.raises(ProtocolError, match="number of axes"):
        stage.position_mm()
    assert stage.position_mm() == pytest.approx(grbl.firmware.machine_mm, abs=0.01)
    assert isinstance(parse("<Idle|WPos:0.000,0.000,0.000|WCO:-5.000,0.000>"), Other)


def test_stop_brakes_within_the_braking_distance(grbl: Grbl, in_background: InBackground) -> None:
    stage = grbl.homed()
    grbl.slow(6000.0, 1000.0)
    stage.close()
    stage = grbl.homed()  # reads the slower settings
    moving = in_background(lambda: stage.move_to_mm(-1000))
    grbl.wait_until(lambda: abs(grbl.firmware._speed) > 99)
    before = grbl.firmware.machine_mm
    stage.stop()
    assert isinstance(moving.ended(), StoppedError)
    assert grbl.firmware.machine_mm - before < 100**2 / 2000 + 5
    assert grbl.firmware.rail.carriage_mm == pytest.approx(stage.position_mm() + 2905, abs=0.02)
    assert stage.move_to_mm(stage.position_mm() + 10)


def test_stop_just_before_a_move_is_not_overtaken(grbl: Grbl) -> None:
    stage = grbl.homed()
    at = stage.position_mm()
    write = stage._link.write

    def stop_first(data: bytes, **rest: Any) -> bool:
        if data.startswith(b"G90"):
            stage._stops += 1
        return write(data, **rest)

    stage._link.write = stop_first
    with pytest.raises(StoppedError):
        stage.move_to_mm(-1000)
    assert grbl.firmware.machine_mm == at
    assert b"G1" not in grbl.line.sent


@pytest.mark.parametrize("after_s", [0.0, 0.15, 0.4, 0.8])
def test_stop_over_a_slow_line_is_not_deceived_by_answers_from_before(
    grbl: Grbl, in_background: InBackground, after_s: float
) -> None:
    grbl.slow(6000.0, 1000.0)
    grbl.line.late_s = 0.2
    stage = grbl.homed(reply_timeout_s=5.0)
    grbl.forget_sent()
    moving = in_background(lambda: stage.move_to_mm(-1000))
    grbl.wait_until(lambda: bool(grbl.line.sent))
    time.sleep(after_s)
    stage.stop()
    assert isinstance(moving.ended(), StoppedError)
    assert not grbl.firmware.moving
    assert grbl.firmware.state == "Idle"
    assert stage.position_mm() == pytest.approx(grbl.firmware.machine_mm, abs=0.02)
    there = stage.position_mm() + 2
    assert stage.move_to_mm(there) == pytest.approx(there, abs=0.02)


def test_position_asked_for_while_another_thread_stops_is_told(grbl: Grbl) -> None:
    stage = grbl.homed()
    steady = stage._controller.steady

    def stopped_first(doing: str) -> Any:
        if not stage._unsettled and grbl.firmware.state == "Idle":
            stage._controller.steady = steady
            stage._unsettled = True  # as stop() does before it waits for its turn
            stage._controller.urge(b"!")
            grbl.wait_until(lambda: grbl.firmware.state == "Hold")
        return steady(doing)

    stage._controller.steady = stopped_first
    assert stage.position_mm() == -2895
    assert stage.move_to_mm(-2000) == -2000


def test_control_c_during_a_move_brakes(grbl: Grbl, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = grbl.homed()
    grbl.slow()
    monkeypatch.setattr(stage, "_confirm", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    answer = stage._controller._answer

    def interrupted(line: str, *rest: Any) -> Any:
        if line.startswith("G4"):
            raise KeyboardInterrupt
        return answer(line, *rest)

    monkeypatch.setattr(stage._controller, "_answer", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stage.move_to_mm(-1000)
    stage.stop()
    assert not grbl.firmware.moving
    assert grbl.firmware.machine_mm < -2500
    assert stage.homed()


def test_jam_is_invisible_until_homing(grbl: Grbl) -> None:
    stage = grbl.homed()
    grbl.firmware.rail.jammed = True
    assert stage.move_to_mm(-2000) == -2000
    grbl.firmware.rail.jammed = False
    assert grbl.firmware.rail.carriage_mm == pytest.approx(10)
    stage.home()
    stage.move_to_mm(-2000)
    assert grbl.firmware.rail.carriage_mm == pytest.approx(905)


def test_firmware_that_falls_silent_on_the_way(grbl: Grbl, in_background: InBackground) -> None:
    stage = grbl.homed(boot_timeout_s=1.0)
    grbl.slow()
    moving = in_background(lambda: stage.move_to_mm(-1000))
    grbl.wait_until(lambda: grbl.firmware.moving)
    grbl.line.silent = True
    error = moving.ended(30)
    assert isinstance(error, DeviceTimeoutError)
    assert "no answer" in str(error)
    assert b"!" in grbl.line.sent
    assert not stage.homed()


def test_move_that_takes_too_long(grbl: Grbl) -> None:
    stage = grbl.homed(patience=0.1, reply_timeout_s=0.3)
    grbl.firmware.settings[110] = 3000.0  # 100 times slower than it said
    with pytest.raises(DeviceTimeoutError, match="moving to -1000"):
        stage.move_to_mm(-1000)
    assert not grbl.firmware.moving
    assert stage.homed()


def test_duration_of_a_move_is_foretold_by_what_the_controller_says(grbl: Grbl) -> None:
    grbl.slow(6000.0, 1000.0)  # 100 mm/s, reached in 0.1 s
    stage = grbl.open()
    assert stage.travel_time_s(-100) == pytest.approx(1.1, abs=0.15)
    stage.close()
    assert grbl.open(speed_mm_s=50.0).travel_time_s(100) == pytest.approx(2.05, abs=0.15)


def test_slow_carriage_that_comes_nearer_is_waited_for(grbl: Grbl) -> None:
    stage = grbl.homed(reply_timeout_s=0.3)
    grbl.firmware.settings[110] = 100000.0  # 1.7 m/s, where it said 50: 0.9 s, and half of that should do
    assert stage.move_to_mm(-1400) == -1400


def test_homing_started_by_a_command_that_a_restart_seemed_to_swallow_does_not_run_twice(grbl: Grbl) -> None:
    stage = grbl.open()
    banner = iter([b"\r\nGrbl 1.1h ['$' for help]\r\n"])
    grbl.line.corrupt_input = lambda data: (grbl.line.say(next(banner, b"") if b"$H" in data else b""), data)[1]
    stage.home()
    assert stage.homed()
    assert grbl.firmware.state == "Idle"
    assert stage.move_to_mm(-2800) == -2800


# -- the line ----------------------------------------------------------------------------------------------------


def test_unplugged_on_the_way(grbl: Grbl, in_background: InBackground) -> None:
    stage = grbl.homed()
    grbl.slow()
    moving = in_background(lambda: stage.move_to_mm(-1000))
    grbl.wait_until(lambda: grbl.firmware.moving)
    grbl.line.unplug()
    error = moving.ended(2)
    assert isinstance(error, ConnectionLostError)
    assert "plug it in" in str(error)
    assert not stage.homed()
    with pytest.raises(PositionLostError):
        stage.move_to_mm(-2000)
    with pytest.raises(ConnectionLostError):
        stage.stop()
    stage.close()
    stage.close()


def garbled_ok(data: bytes) -> bytes:
    return data.replace(b"ok\r\n", b"\xffo\x80\r\n")


def torn_ok(data: bytes) -> bytes:
    return data.replace(b"ok\r\n", b"o")


@pytest.mark.parametrize("corrupt", [garbled_ok, torn_ok])
def test_garbled_or_torn_answer(grbl: Grbl, corrupt: Callable[[bytes], bytes]) -> None:
    stage = grbl.homed()
    grbl.line.corrupt = corrupt
    with pytest.raises(ProtocolError, match="garbled or cut off"):
        stage.move_to_mm(-2000)
    grbl.line.corrupt = bytes
    assert stage.homed()
    assert stage.move_to_mm(-1500) == -1500
    assert grbl.firmware.machine_mm == -1500


def test_noise_between_answers_is_ignored(grbl: Grbl) -> None:
    stage = grbl.homed()
    for place in (-2000, -1000):
        grbl.line.say(b"\xff\x00\x81?~\xfeqz000,0.000|FS:0,0|Pn:X>\r\n<Idle|MPo")
        assert stage.move_to_mm(place) == place


def test_answers_too_many_do_not_shift_the_count(grbl: Grbl) -> None:
    stage = grbl.homed()
    grbl.line.corrupt = lambda data: data.replace(b"ok\r\n", b"ok\r\nok\r\n")
    for place in (-2000, -1000, -2500):
        assert stage.move_to_mm(place) == place
        assert not grbl.firmware.moving


def test_echo_is_ignored(grbl: Grbl) -> None:
    grbl.line.corrupt_input = lambda data: (grbl.firmware.output.extend(data), data)[1]
    stage = grbl.homed()
    assert stage.move_to_mm(-2000) == -2000


def test_late_answer_is_not_taken_for_the_next(grbl: Grbl) -> None:
    stage = grbl.homed()
    held_back = bytearray()

    def hold_back(data: bytes) -> bytes:
        if b"ok" in data and not held_back:
            held_back.extend(b"ok\r\n")
            return data.replace(b"ok\r\n", b"", 1)
        return data

    grbl.line.corrupt = hold_back
    with pytest.raises(DeviceTimeoutError):
        stage.move_to_mm(-2000)
    grbl.line.corrupt = bytes
    grbl.line.say(bytes(held_back))
    assert stage.move_to_mm(-1000) == -1000
    assert grbl.firmware.machine_mm == -1000


def test_line_changed_by_noise_is_refused_and_sent_again(grbl: Grbl) -> None:
    stage = grbl.homed()
    changes = iter([b"Q", b"X", b"X"])
    grbl.line.corrupt_input = lambda data: data.replace(b"X", next(changes)) if b"G1 X" in data else data
    assert stage.move_to_mm(-2000) == -2000


def test_noise_that_changes_the_target_is_noticed(grbl: Grbl) -> None:
    stage = grbl.homed()
    grbl.line.corrupt_input = lambda data: data.replace(b"X-2000", b"X-2200")
    with pytest.raises(ProtocolError, match="-2200 mm instead of -2000 mm"):
        stage.move_to_mm(-2000)


def test_overrides_changed_by_noise_are_put_back(grbl: Grbl) -> None:
    stage = grbl.homed()
    grbl.firmware.receive(b"\x92\x92\x92\x92\x92\x92\x92\x92\x92")
    stage.move_to_mm(-2000)
    assert grbl.firmware._override == 100


@pytest.mark.parametrize("settings", [{13: 1}, {10: 2}, {10: 0, 13: 1}])
def test_inches_and_work_positions_are_understood(grbl: Grbl, settings: dict[int, float]) -> None:
    grbl.firmware.settings |= settings
    grbl.firmware.work_offset_mm = -123.0
    stage = grbl.homed()
    assert stage.position_mm() == pytest.approx(-2895, abs=0.02)
    assert stage.move_to_mm(-1234.5) == pytest.approx(-1234.5, abs=0.02)
    assert grbl.firmware.machine_mm == pytest.approx(-1234.5, abs=0.02)


def test_speed_limit_is_kept(grbl: Grbl) -> None:
    stage = grbl.homed(speed_mm_s=500.0)
    began = time.monotonic()
    stage.move_to_mm(-2795)
    assert time.monotonic() - began > 0.2
    assert stage.travel_time_s(500) == pytest.approx(1.0, abs=0.2)


def test_closed_stage_refuses(grbl: Grbl) -> None:
    stage = grbl.homed()
    stage.close()
    with pytest.raises(NotHomedError, match="closed"):
        stage.move_to_mm(-1000)
    stage.stop()
