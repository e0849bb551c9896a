"""A stage that speaks Zaber ASCII.

The device knows whether it has a reference (warnings WR and WH), keeps positions over a reconnected cable, and numbers
its replies; so the driver asks it instead of remembering. A reply that comes late or belongs to another message is
never taken for the one that is waited for.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

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
from rigs.motion import braking_time_s, move_time_s, range_within
from rigs.protocols import DeviceIdentity
from rigs.serial_link import SerialLink
from rigs.stage_facts import StageFacts
from rigs.zaber_line import ZaberLine
from rigs.zaber_protocol import (
    NO_REFERENCE,
    OWN_DOING,
    POSITION_LOST,
    fault,
    remark,
)

_POLL_S = 0.03
_SPEED_UNIT = 1.6384
"""Speeds are in microsteps / 1.6384 s, accelerations in 10000 microsteps / (1.6384 s s) (Zaber ASCII manual, units)."""
_MOVES_WITH_SPEED_SINCE = (7, 25)
_FULL_STEP = 64
"""Data sheets give the microstep size at this ``resolution``."""


@dataclass(frozen=True, slots=True)
class ZaberSettings:
    """How to reach the device and to read its numbers.

    Attributes
    ----------
    port
        Device path, ``usb:VID:PID[:SERIAL]``, or a URL (``socket://host:55551``).
    microstep_mm
        Travel of one microstep as the data sheet states it, at the default resolution of 64 (mm).
    baud_rate
        Bits per second.
    device, axis
        Address in the chain, and axis of the controller.
    speed_mm_s
        Highest speed of moves (mm/s), sent along with each (firmware 7.25 or newer); None: the device's ``maxspeed``.
    limits_mm
        Smallest and largest position to use; None: the device's own limits.
    tolerance_mm
        How far from the target a finished move may end; None: two microsteps, at least 5 micrometres.
    reply_timeout_s
        How long an answer may take.
    patience
        Deadlines of movements are this many times what distance, speed and acceleration make of them.
    """

    port: str
    microstep_mm: float
    baud_rate: int = 115200
    device: int = 1
    axis: int = 1
    speed_mm_s: float | None = None
    limits_mm: tuple[float, float] | None = None
    tolerance_mm: float | None = None
    reply_timeout_s: float = 2.0
    patience: float = 2.0


class ZaberStage:
    """A stage on Zaber ASCII; opens the port (see :class:`rigs.protocols.Stage`).

    Raises
    ------
    ConfigError
        Settings that can't be, or an axis that isn't there.
    DeviceNotFoundError, DeviceBusyError, DeviceTimeoutError, ProtocolError
        Nothing there, somebody else's, silent, or another protocol.
    """

    def __init__(self, settings: ZaberSettings) -> None:
        _check(settings)
        self._settings = settings
        self._moving = threading.RLock()
        self._stops = 0
        self._was_known = self._closed = False
        link = SerialLink(settings.port, settings.baud_rate)
        self._line = ZaberLine(link, settings.device, settings.axis, reply_timeout_s=settings.reply_timeout_s)
        try:
            self._line.require_one_device()
            self._read_device()
        except BaseException:
            self._line.close()
            raise

    def _read_device(self) -> None:
        settings, line = self._settings, self._line
        resolution = line.optional("resolution", settings.axis)
        self._step_mm = settings.microstep_mm * (_FULL_STEP / resolution if resolution else 1.0)
        own = (line.number("limit.min") * self._step_mm, line.number("limit.max") * self._step_mm)
        self._travel_mm = own[1] - own[0]
        self._limits_mm = range_within(
            settings.limits_mm,
            own,
            slack_mm=2 * self._step_mm,
            whose="the device's own (limit.min, limit.max)",
            mend="stage.microstep",
        )
        max_speed = line.number("maxspeed") / _SPEED_UNIT * self._step_mm
        self._speed_mm_s = min(settings.speed_mm_s or math.inf, max_speed)
        acceleration = line.number("accel") * 1e4 / _SPEED_UNIT * self._step_mm
        self._acceleration_mm_s2 = acceleration or 1e4 * max_speed  # 0 means: at once
        approach = line.optional("limit.approach.maxspeed", settings.axis)
        self._homing_speed_mm_s = approach / _SPEED_UNIT * self._step_mm if approach else max_speed / 4
        self._firmware = line.ask("get version", axis=0).data
        self._serial = line.text("system.serial")
        self._device_id = line.text("device.id") or line.text("deviceid")
        if settings.speed_mm_s is not None and _version(self._firmware) < _MOVES_WITH_SPEED_SINCE:
            raise ConfigError(
                f"stage.speed: needs firmware 7.25 or newer, the device has {self._firmware}; leave it out and set "
                "maxspeed in the device"
            )

    def identify(self) -> DeviceIdentity:
        """Device id, serial number and firmware."""
        low, high = self._limits_mm
        return DeviceIdentity(
            kind="zaber",
            make="Zaber",
            model=f"device id {self._device_id}" if self._device_id else "",
            serial=self._serial,
            firmware=self._firmware,
            extra={
                "port": self._settings.port,
                "address": f"{self._settings.device} {self._settings.axis}",
                "microstep": f"{self._step_mm:g} mm",
                "limits": f"{low:g} to {high:g} mm",
                "max speed": f"{self._speed_mm_s:g} mm/s",
            },
        )

    def facts(self) -> StageFacts:
        """What a check of the rig wants to know; asks, changes nothing."""
        busy, flags = self._line.busy(), sorted(self._line.flags())
        faults = _faults(flags)
        lost = [(flag, *POSITION_LOST[flag]) for flag in flags if flag in POSITION_LOST]
        others = [(flag, *what) for flag in flags if (what := remark(flag))]
        problem = next(((f"the device says: {what} ({flag})", way_out) for flag, what, way_out in faults), None)
        if busy:
            problem = ("the device is moving on somebody else's command", "close that program")
        return StageFacts(
            identity=self.identify(),
            state="BUSY" if busy else " ".join(["IDLE", *flags]),
            referenced=not set(flags) & (NO_REFERENCE | POSITION_LOST.keys()),
            problem=problem,
            remarks=tuple(
                (name, f"the device says: {what} ({flag})", way_out)
                for name, found in (("last alarm", lost), ("warning", others))
                for flag, what, way_out in found
            ),
            homing=True,  # every device homes, and keeps to limit.min and limit.max by itself
            soft_limits=True,
            travel_mm=self._limits_mm,
            max_speed_mm_s=self._speed_mm_s,
        )

    def limits_mm(self) -> tuple[float, float]:
        """Positions that may be commanded."""
        return self._limits_mm

    def travel_time_s(self, distance_mm: float) -> float:
        """Duration of a move by speed and acceleration, and of the replies that confirm it."""
        return move_time_s(distance_mm, self._speed_mm_s, self._acceleration_mm_s2) + 0.1

    def homed(self) -> bool:
        """Whether the device has a reference and nothing speaks against it."""
        if self._closed:
            return False
        try:
            flags = self._line.flags()
        except RigError:
            self._was_known = False
            return False
        # A fault may be over and only stand there still: homing clears it, or says that it isn't.
        known = not flags & (NO_REFERENCE | POSITION_LOST.keys()) and not _faults(flags)
        self._was_known = self._was_known or known
        return known

    def position_mm(self) -> float:
        """Position that the device reports.

        Raises
        ------
        NotHomedError
            It has no reference (PositionLostError: not any more).
        """
        self._require_reference()
        return self._position_mm()

    def home(self) -> None:
        """Find the reference.

        Raises
        ------
        StageError
            The device reports a fault.
        DeviceTimeoutError
            Not done in the time that travel and speed allow.
        StoppedError
            Somebody stopped it.
        """
        stops = self._stops
        with self._moving, self._braking_on_failure():
            self._was_known = False

            def stopped() -> bool:
                return self._stops != stops

            self._line.ask("warnings clear", unless=stopped)
            self._line.ask("home", unless=stopped)
            expected_s = 1.2 * self._travel_mm / self._homing_speed_mm_s + 5.0
            self._wait("homing", stops, time.monotonic() + self._settings.patience * expected_s)
            if self._line.flags() & NO_REFERENCE:
                raise StageError("stage: no reference after homing; check the home sensor, then home again")
            self._was_known = True

    def move_to_mm(self, position_mm: float) -> float:
        """Move there and wait until it stands still at the target.

        Parameters
        ----------
        position_mm
            Position within :meth:`limits_mm`.

        Returns
        -------
        float
            Position as reported.

        Raises
        ------
        LimitError
            Out of limits; nothing was sent.
        NotHomedError, PositionLostError
            No reference; nothing moved.
        StageError, StoppedError, DeviceTimeoutError, ProtocolError, ConnectionLostError
            It went wrong on the way.
        """
        stops = self._stops
        low, high = self._limits_mm
        if not low - 1e-6 <= position_mm <= high + 1e-6:
            raise LimitError(
                f"stage: {position_mm:g} mm is outside its travel ({low:g} to {high:g} mm); shorten the plan, or "
                "correct stage.limits"
            )
        with self._moving:
            self._require_reference()
            if self._line.busy():
                raise DeviceBusyError("stage: the device is moving on somebody else's command; close that program")
            expected_s = self.travel_time_s(position_mm - self._position_mm())
            if self._line.flags() & OWN_DOING:
                self._line.ask("warnings clear")
            command = f"move abs {round(position_mm / self._step_mm)}"
            if self._settings.speed_mm_s is not None:
                command += f" {round(self._speed_mm_s / self._step_mm * _SPEED_UNIT)}"
            doing = f"moving to {position_mm:g} mm"
            with self._braking_on_failure():
                self._line.ask(command, unless=lambda: self._stops != stops)
                end = time.monotonic() + self._settings.patience * expected_s + self._settings.reply_timeout_s
                self._wait(doing, stops, end)
                reached_mm = self._position_mm()
            tolerance_mm = self._settings.tolerance_mm or max(2 * self._step_mm, 0.005)
            if abs(reached_mm - position_mm) > tolerance_mm:
                raise StageError(
                    f"stage: stands still at {reached_mm:g} mm instead of {position_mm:g} mm: another program, or "
                    "something in the way; look at the carriage, then try again"
                )
            return reached_mm

    def stop(self) -> None:
        """Brake now; the position stays known. For any thread, at any time. Returns when the stage stands.

        Raises
        ------
        ConnectionLostError, DeviceTimeoutError
            The device can't be reached: cut its power.
        """
        self._stops += 1
        if self._closed:
            return
        self._line.send("stop")
        end = time.monotonic() + 3 * braking_time_s(self._speed_mm_s, self._acceleration_mm_s2) + 3.0
        while self._line.busy():
            if time.monotonic() > end:
                raise DeviceTimeoutError("stage: doesn't come to rest; cut its power")
            time.sleep(_POLL_S)

    def close(self) -> None:
        """Release the port; a movement under way is braked."""
        if self._closed:
            return
        if not self._moving.acquire(blocking=False):
            with suppress(RigError):
                self.stop()
        else:
            self._moving.release()
        self._closed = True
        self._line.close()

    # -- waiting, judging ----------------------------------------------------------------------------------------

    def _wait(self, doing: str, stops: int, end: float) -> None:
        """Poll until the device is idle, without a fault."""
        while True:
            if not self._line.busy():
                break
            if time.monotonic() > end:
                raise DeviceTimeoutError(
                    f"stage: not done while {doing} in the time that speed and acceleration allow; check load, "
                    "maxspeed and accel"
                )
            time.sleep(_POLL_S)
        flags = self._line.flags()
        for flag in sorted(flags & POSITION_LOST.keys()):
            what, way_out = POSITION_LOST[flag]
            raise PositionLostError(f"stage: {what} ({flag}) while {doing}; {way_out}")
        if flags & NO_REFERENCE and self._was_known:
            raise PositionLostError(
                f"stage: the device was restarted while {doing} and lost its reference; home the stage"
            )
        for flag in sorted(flags):
            if found := fault(flag):
                raise StageError(f"stage: {found[0]} ({flag}) while {doing}; {found[1]}")
        if self._stops != stops or "NI" in flags:
            how = "stopped" if self._stops != stops else "interrupted by another program or its knob"
            known = "its position is still known" if not flags & NO_REFERENCE else "home the stage"
            raise StoppedError(f"stage: {how} while {doing}; {known}")

    def _require_reference(self) -> None:
        if self._closed:
            raise NotHomedError("stage: the connection is closed; open it again")
        flags = self._line.flags()
        for flag in sorted(flags & POSITION_LOST.keys()):
            what, way_out = POSITION_LOST[flag]
            raise PositionLostError(f"stage: {what} ({flag}); {way_out}")
        if flags & NO_REFERENCE:
            if self._was_known:
                raise PositionLostError("stage: the device was restarted and lost its reference; home the stage")
            raise NotHomedError("stage: the device has no reference; home the stage")
        for flag, what, way_out in _faults(flags):
            raise StageError(f"stage: {what} ({flag}); {way_out}")
        self._was_known = True

    def _position_mm(self) -> float:
        """Position from two equal answers: without a checksum a digit may be changed by noise."""
        previous = None
        for _ in range(10):
            steps = self._line.latest("pos")
            if steps == previous or self._line.busy():
                return steps * self._step_mm
            previous = steps
        raise ProtocolError("stage: positions contradict each other at rest: check the cable for noise")

    @contextmanager
    def _braking_on_failure(self) -> Iterator[None]:
        """Whatever ends a movement early, Ctrl-C included: the stage is told to stop."""
        try:
            yield
        except (StoppedError, ConnectionLostError):
            raise
        except BaseException:
            with suppress(RigError):
                self._line.send("stop")
            raise


def _faults(flags: Iterable[str]) -> list[tuple[str, str, str]]:
    """Flags that keep a stage at rest from moving: the flag, what it means, the way out."""
    return [(flag, *what) for flag in sorted(flags) if flag not in OWN_DOING and (what := fault(flag))]


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(".") if part.isdigit())


def _check(settings: ZaberSettings) -> None:
    if not settings.microstep_mm > 0:
        raise ConfigError("stage.microstep: must be above zero; see the stage's data sheet")
    if settings.speed_mm_s is not None and not settings.speed_mm_s > 0:
        raise ConfigError(f"stage.speed: {settings.speed_mm_s:g} mm/s must be above zero")
    if not 1 <= settings.device <= 99:
        raise ConfigError(f"stage.device: {settings.device} is no address; 1 to 99")
    if not 1 <= settings.axis <= 9:
        raise ConfigError(f"stage.axis: {settings.axis} is no axis; 1 to 9")
    if settings.limits_mm is not None and not settings.limits_mm[0] < settings.limits_mm[1]:
        low, high = settings.limits_mm
        raise ConfigError(f"stage.limits: {low:g} to {high:g} mm is no range; give the smaller one first")
