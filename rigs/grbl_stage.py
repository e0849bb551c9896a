"""A rail on a GRBL 1.1 controller (also FluidNC, grblHAL).

What the controller says and what is true differ in known ways; the driver's answers:

- Opening the port may reset the controller: the position counts only after *we* homed on this connection.
- ``ok`` means queued, Idle may be stale: a move ends with ``G4 P0.01`` (answered when motion has ended) and then with
  two equal reports that say Idle at the target.
- After any alarm, reset or restart the stage refuses to move until it is homed again; ``$X`` is never sent, since it
  unlocks without a position.
- Lost steps are invisible to the controller: the lens fit shows them, or homing.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Literal

from rigs.errors import (
    AlarmError,
    ConfigError,
    ConnectionLostError,
    DeviceTimeoutError,
    LimitError,
    NotHomedError,
    PositionLostError,
    ProtocolError,
    RigError,
    StageError,
    StoppedError,
)
from rigs.grbl_controller import GrblController, RestartedError, StopRequestedError
from rigs.grbl_machine import GrblMachine, read_machine
from rigs.grbl_moves import NOT_READY, Patience, require_running
from rigs.grbl_protocol import HOLD, NORMAL_OVERRIDES, RESET, Status
from rigs.motion import braking_time_s, move_time_s
from rigs.protocols import DeviceIdentity
from rigs.serial_link import SerialLink

_STALE_IDLE_S = 1.5
"""How long the controller may say Idle somewhere else before we believe that it isn't going to move."""

_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class GrblSettings:
    """How to reach and to treat the controller.

    Attributes
    ----------
    port
        Device path, ``usb:VID:PID[:SERIAL]``, or a URL (``socket://host:port``, ``rfc2217://host:port``).
    baud_rate
        Bits per second.
    axis
        Axis of the controller that drives the rail.
    speed_mm_s
        Highest speed of moves (mm/s); None: the controller's own limit (``$110``).
    limits_mm
        Smallest and largest machine position to use; None: the controller's travel (``$130``), less the pull-off at the
        homing switch. Needed where homing is off.
    tolerance_mm
        How far from the target a finished move may be reported; None: one step and the report's last digit.
    allow_without_homing
        Run although the controller has homing off (``$22=0``). The position is then counted from where the carriage
        stood when the controller was switched on.
    allow_without_soft_limits
        Run although the controller has soft limits off (``$20=0``).
    home_command
        Line that homes.
    reply_timeout_s, boot_timeout_s
        How long an answer, and the start of the controller, may take.
    patience
        Deadlines of movements are this many times what distance, speed and acceleration make of them.
    """

    port: str
    baud_rate: int = 115200
    axis: Literal["X", "Y", "Z"] = "X"
    speed_mm_s: float | None = None
    limits_mm: tuple[float, float] | None = None
    tolerance_mm: float | None = None
    allow_without_homing: bool = False
    allow_without_soft_limits: bool = False
    home_command: str = "$H"
    reply_timeout_s: float = 5.0
    boot_timeout_s: float = 10.0
    patience: float = 2.0


class GrblStage:
    """A stage on GRBL; opens the port (see :class:`rigs.protocols.Stage`).

    Raises
    ------
    ConfigError
        Settings that can't be.
    DeviceNotFoundError, DeviceBusyError, DeviceTimeoutError, ProtocolError
        Nothing there, somebody else's, silent, or no GRBL.
    StageError
        Homing or soft limits are off and the configuration doesn't allow it.
    """

    def __init__(self, settings: GrblSettings) -> None:
        _check(settings)
        self._settings = settings
        self._lock = threading.RLock()
        self._stops = 0
        self._homing = self._moving = self._closed = False
        self._known = self._unsettled = False
        self._lost = NotHomedError("stage: the position isn't known since the port was opened; home the stage")
        self._expected_mm: float | None = None
        self._link = SerialLink(settings.port, settings.baud_rate)
        try:
            self._controller = GrblController(
                self._link, reply_timeout_s=settings.reply_timeout_s, boot_timeout_s=settings.boot_timeout_s
            )
            self._become_ready(self._controller.wake())
            self._machine = self._read_machine()
            self._machine.require_safety(settings.allow_without_homing, settings.allow_without_soft_limits)
            self._limits_mm = self._machine.usable_mm(settings.limits_mm)
        except BaseException:
            self._link.close()
            raise
        self._speed_mm_s = min(settings.speed_mm_s or math.inf, self._machine.max_speed_mm_s)

    def _become_ready(self, status: Status) -> None:
        """Bring a controller that was just opened into a state in which it answers lines."""
        if status.state in ("Idle", "Alarm"):
            return
        if status.state == "Check":  # nothing moves in it, and nothing but a reset leaves it for sure
            self._controller.reset()
        else:
            self._controller.rest(self._settings.reply_timeout_s)
        status = self._controller.status("opening it")
        if status.state not in ("Idle", "Alarm"):  # a safety door that is still open
            kind, what, _ = NOT_READY[status.state]
            way_out = "close the door, then start again" if status.state == "Door" else "switch it off and on"
            raise kind(f"stage: the controller {what}; {way_out}")

    def _read_machine(self) -> GrblMachine:
        try:
            return read_machine(self._controller, self._settings.axis)
        except DeviceTimeoutError:  # reports but no lines: it is still at what another program gave it, a long pause
            self._controller.reset()
            return read_machine(self._controller, self._settings.axis)

    def identify(self) -> DeviceIdentity:
        """Firmware and settings of the controller."""
        machine = self._machine
        extra = {"port": self._settings.port, "axis": self._settings.axis} | machine.facts()
        return DeviceIdentity(kind="grbl", make="", model=machine.model, firmware=machine.firmware, extra=extra)

    def limits_mm(self) -> tuple[float, float]:
        """Machine positions that may be commanded."""
        return self._limits_mm

    def travel_time_s(self, distance_mm: float) -> float:
        """Duration of a move by speed and acceleration, and of the reports that confirm it."""
        return move_time_s(distance_mm, self._speed_mm_s, self._machine.acceleration_mm_s2) + 0.1

    def homed(self) -> bool:
        """Whether the position is known; looks for alarms and restarts that came meanwhile."""
        if self._known and self._lock.acquire(blocking=False):
            try:
                with suppress(RigError), self._operation("waiting"):
                    self._controller.drain("waiting")
            finally:
                self._lock.release()
        return self._known

    def position_mm(self) -> float:
        """Position that the controller reports; during a move on another thread its latest report.

        Raises
        ------
        NotHomedError
            It isn't known (PositionLostError: not any more).
        """
        self._require_known()
        if not self._lock.acquire(blocking=False):
            latest = self._controller.latest
            if latest is None:
                raise self._lost
            return self._mm(latest)
        try:
            with self._operation("reading the position"):
                self._settle()
                return self._mm(self._ready_status("reading the position"))
        finally:
            self._lock.release()

    def home(self) -> None:
        """Find the reference switch.

        Raises
        ------
        AlarmError
            The switch is stuck, dead, or the way is too long.
        DeviceTimeoutError
            Not done in the time that travel and rates allow.
        StoppedError
            Somebody stopped it.
        """
        stops = self._stops
        with self._lock, self._operation("homing", stops):
            self._known, self._lost = False, NotHomedError("stage: homing didn't finish; home the stage")
            self._unsettled = False
            self._homing = self._machine.homing
            try:
                # From any state, alarm and deafness included; there is no position to lose.
                self._controller.reset()
                if self._machine.homing:
                    self._seek_reference()
                status = self._controller.steady("homing")
            except StopRequestedError:
                self._controller.reset()
                raise
            except BaseException:
                with suppress(RigError):
                    self._controller.urge(RESET)
                raise
            finally:
                self._homing = False
            self._accept_reference(status)

    def _seek_reference(self) -> None:
        settings = self._settings
        timeout_s = settings.patience * self._machine.homing_time_s + settings.reply_timeout_s
        for attempts_left in (1, 0):
            try:
                self._controller.command(settings.home_command, doing="homing", timeout_s=timeout_s, retries=1)
                return
            except RestartedError:  # a second banner: the command was sent into a reset and vanished
                if not attempts_left:
                    raise
                self._controller.reset()  # or it was carried out all the same: nothing may be under way twice

    def _accept_reference(self, status: Status) -> None:
        if status.state != "Idle":
            raise AlarmError(
                f"stage: the controller says {status.state} after homing; look at its switches, switch it off and on "
                "(without homing: with the carriage at its zero), and home"
            )
        position = self._mm(status)
        low, high = self._machine.limits_mm
        if self._machine.homing and not low - self._machine.pull_off_mm - 1 <= position <= high + 1:
            raise StageError(
                f"stage: homing ended at {position:g} mm, outside the controller's travel ({low:g} to {high:g} mm); "
                "correct $23, $27 and $130 in the controller"
            )
        self._expected_mm, self._known = position, True

    def move_to_mm(self, position_mm: float) -> float:
        """Move there and wait until it stands still at the target.

        Parameters
        ----------
        position_mm
            Machine position within :meth:`limits_mm`.

        Returns
        -------
        float
            Position as reported.

        Raises
        ------
        LimitError
            Out of limits; nothing was sent.
        NotHomedError, PositionLostError
            The position isn't known; nothing was sent.
        AlarmError, StoppedError, DeviceTimeoutError, ProtocolError, ConnectionLostError
            It went wrong on the way. :meth:`homed` says whether the position is still known.
        """
        stops = self._stops
        low, high = self._limits_mm
        if not low - 1e-6 <= position_mm <= high + 1e-6:
            raise LimitError(
                f"stage: {position_mm:g} mm is outside its travel ({low:g} to {high:g} mm); shorten the plan, or "
                "correct stage.limits"
            )
        self._require_known()
        doing = f"moving to {position_mm:g} mm"
        with self._lock, self._operation(doing, stops):
            self._require_known()
            self._settle()
            start_mm = self._mm(self._ready_status(doing))
            if abs(position_mm - start_mm) <= 0.5 * self._machine.resolution_mm:
                return start_mm
            patience = Patience(
                doing,
                position_mm,
                self.travel_time_s(position_mm - start_mm),
                patience=self._settings.patience,
                slack_s=self._settings.reply_timeout_s,
            )
            self._moving, self._expected_mm = True, None
            self._controller.urge(NORMAL_OVERRIDES)
            # G53: machine coordinates, whatever work offsets are stored. All modes in every line, for after a reset.
            line = f"G90 G94 G21 G53 G1 {self._settings.axis}{position_mm:.3f} F{60 * self._speed_mm_s:.3f}"
            # The ok of the second comes when all motion has ended.
            for command in (line, "G4 P0.01"):
                self._controller.command(
                    command, doing=doing, timeout_s=patience.longest_s, watch=self._watch(patience), retries=1
                )
            reached_mm = self._confirm(position_mm, doing, patience)
            self._moving, self._expected_mm = False, reached_mm
            return reached_mm

    def _watch(self, patience: Patience) -> Callable[[Status], bool]:
        """Look at the reports of a move: an answer is overdue where the stage has long been idle."""
        idle_since = math.inf

        def watch(status: Status) -> bool:
            nonlocal idle_since
            require_running(status)
            now = time.monotonic()
            idle_since = min(idle_since, now) if status.state == "Idle" else math.inf
            patience.check(self._mm(status))
            return now > idle_since + self._settings.reply_timeout_s

        return watch

    def _confirm(self, target_mm: float, doing: str, patience: Patience) -> float:
        idle_since: float | None = None
        while True:
            status = self._controller.steady(doing)
            now = time.monotonic()
            require_running(status)
            if status.state == "Idle":
                position_mm = self._mm(status)
                if self.near(position_mm, target_mm):
                    return position_mm
                idle_since = idle_since or now
                if now > idle_since + _STALE_IDLE_S:
                    raise ProtocolError(
                        f"stage: stands still at {position_mm:g} mm instead of {target_mm:g} mm: noise on the line, or "
                        "another program; check the cable, then try again"
                    )
                time.sleep(_POLL_S)
                continue
            idle_since = None
            time.sleep(_POLL_S)
            patience.check(self._mm(status))

    def stop(self) -> None:
        """Brake now, keep the position where possible, drop the rest of the movement. For any thread, at any time.

        The bytes leave at once, whoever waits for what. Returns when the stage stands.

        Raises
        ------
        ConnectionLostError, DeviceTimeoutError
            The controller can't be reached: use the emergency stop.
        """
        self._stops += 1
        if self._closed:
            return
        self._unsettled = True
        # Homing doesn't listen to a feed hold; a reset ends it.
        self._controller.urge(RESET if self._homing else HOLD)
        patience_s = self._rest_patience_s() + 2 * self._settings.boot_timeout_s
        if not self._lock.acquire(timeout=patience_s):
            raise DeviceTimeoutError("stage: doesn't come to rest; use its emergency stop")
        try:
            self._settle()
        except ConnectionLostError as error:
            self._lose(error)
            raise
        finally:
            self._lock.release()

    def close(self) -> None:
        """Release the port; a movement under way is braked."""
        if self._closed:
            return
        if self._moving or self._homing:
            with suppress(RigError):
                self.stop()
        self._closed, self._known = True, False
        self._lost = NotHomedError("stage: the connection is closed; open it again and home the stage")
        self._link.close()

    # -- bookkeeping ---------------------------------------------------------------------------------------------

    @contextmanager
    def _operation(self, doing: str, stops: int | None = None) -> Iterator[None]:
        """Whatever goes wrong within: the stage comes to rest, and a position that is lost is marked as lost."""
        controller = self._controller
        controller.stop_requested = (lambda: False) if stops is None else (lambda: self._stops != stops)
        try:
            yield
        except StopRequestedError:
            by_us = stops is None or self._stops != stops
            self._unsettled = True
            self._settle()
            how = "stopped" if by_us else "paused by its feed hold (a button, or another program)"
            raise StoppedError(
                f"stage: {how} while {doing}; "
                + ("its position is still known" if self._known else "its position isn't known: home the stage")
            ) from None
        except (AlarmError, PositionLostError, ConnectionLostError) as error:
            self._lose(error)
            raise
        except RigError:
            if self._moving:
                self._unsettled = True
                with suppress(RigError):
                    self._controller.urge(HOLD)
                    self._settle()
            raise
        except BaseException:  # Ctrl-C: brake at once; what else is to be done waits until somebody asks
            if self._moving:
                self._unsettled = True
                with suppress(RigError):
                    controller.urge(HOLD)
            raise
        finally:
            self._moving = False
            controller.stop_requested = lambda: False

    def _settle(self) -> None:
        """Bring the stage to rest where a stop or a failure left that open; the lock must be held."""
        if not self._unsettled:
            return
        was_stop_requested = self._controller.stop_requested
        self._controller.stop_requested = lambda: False
        try:
            kept = self._controller.rest(self._rest_patience_s())
        except RigError as error:
            self._lose(error)
            raise
        finally:
            self._controller.stop_requested = was_stop_requested
        self._unsettled, self._expected_mm = False, None
        if not kept:
            self._lose(PositionLostError("stage: it was reset on the run and lost its position; home the stage"))

    def _lose(self, error: RigError) -> None:
        if self._known:
            self._lost = PositionLostError(f"stage: the position was lost earlier; home the stage ({error})")
        self._known = False

    def _require_known(self) -> None:
        if not self._known:
            raise type(self._lost)(str(self._lost))

    def _ready_status(self, doing: str) -> Status:
        """Report of a controller that is idle where we left it."""
        status = self._controller.steady(doing)
        if status.state == "Hold" and self._unsettled:  # our own stop, from another thread
            self._settle()
            status = self._controller.steady(doing)
        if status.state != "Idle":
            kind, what, way_out = NOT_READY[status.state]
            raise kind(f"stage: the controller {what} instead of {doing}; {way_out}")
        position_mm = self._mm(status)
        if self._expected_mm is not None and not self.near(position_mm, self._expected_mm):
            raise PositionLostError(
                f"stage: the controller says {position_mm:g} mm, we left it at {self._expected_mm:g} mm: it was "
                "restarted or moved by another program; home the stage"
            )
        self._expected_mm = position_mm
        return status

    def near(self, position_mm: float, target_mm: float) -> bool:
        """Whether a reported position is the target as far as steps and digits can tell."""
        tolerance_mm = self._settings.tolerance_mm or self._machine.resolution_mm
        return abs(position_mm - target_mm) <= tolerance_mm

    def _mm(self, status: Status) -> float:
        place = self._controller.place(status)
        index = "XYZ".index(self._settings.axis)
        if index >= len(place):
            raise ProtocolError(f"stage: the controller reports no axis {self._settings.axis}; correct stage.axis")
        return place[index] * self._machine.report_unit_mm

    def _rest_patience_s(self) -> float:
        return 3 * braking_time_s(self._machine.max_speed_mm_s, self._machine.acceleration_mm_s2) + 3.0


def _check(settings: GrblSettings) -> None:
    if settings.speed_mm_s is not None and not settings.speed_mm_s > 0:
        raise ConfigError(f"stage.speed: {settings.speed_mm_s:g} mm/s must be above zero")
    if settings.limits_mm is not None and not settings.limits_mm[0] < settings.limits_mm[1]:
        low, high = settings.limits_mm
        raise ConfigError(f"stage.limits: {low:g} to {high:g} mm is no range; give the smaller one first")
    if settings.axis not in ("X", "Y", "Z"):
        raise ConfigError(f"stage.axis: {settings.axis!r} is none of X, Y, Z")
