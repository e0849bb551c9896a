"""A conversation with a GRBL controller: one line at a time, each answered; real-time bytes at any moment.

``ok`` says that a line was taken, not that anything has moved, and a status asked at once may still say Idle. So
nothing here concludes from one answer alone that the stage stands where it should; see :mod:`rigs.grbl_stage`.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from rigs.errors import DeviceTimeoutError, PositionLostError, ProtocolError, RigError
from rigs.grbl_codes import alarm_error, refusal, refused_as_garbled
from rigs.grbl_protocol import (
    ASK_STATUS,
    HOLD,
    JOG_CANCEL,
    RESET,
    Alarm,
    Banner,
    Error,
    Message,
    Ok,
    Other,
    Reply,
    Status,
    parse,
)
from rigs.serial_link import SerialLink

_SLICE_S = 0.05
"""How often a waiting thread looks whether somebody asked to stop."""
_ASK_AGAIN_S = 0.5
_RESET_AGAIN_S = 2.5
"""A boot loader is deaf for about 1.6 s; sooner than this a second attempt would only disturb."""
_QUIET_S = 0.1
_LONGEST_LAG_S = 1.0
"""More than this between question and answer isn't the line's doing but the controller's start."""
_REPORTS_WITHOUT_OFFSET = 60
"""GRBL sends the work offset with every tenth report at rest, every thirtieth in motion."""


class StopRequestedError(Exception):
    """Somebody called for a stop while we waited; never leaves the driver."""


class RestartedError(PositionLostError):
    """The controller's start-up banner came unasked."""


class GrblController:
    """A GRBL controller behind a line. One thread at a time; only :meth:`urge` is for everybody.

    Parameters
    ----------
    link
        The open line.
    reply_timeout_s
        How long an answer may take.
    boot_timeout_s
        How long the controller may take to start.
    """

    def __init__(self, link: SerialLink, *, reply_timeout_s: float, boot_timeout_s: float) -> None:
        self._link = link
        self._reply_timeout_s, self._boot_timeout_s = reply_timeout_s, boot_timeout_s
        self._synchronised = True
        self._offset: tuple[float, ...] | None = None
        self._lag_s = 0.0
        """From question to answer, as measured: older answers may be under way for so long."""
        self.banner = ""
        self.latest: Status | None = None
        self.was_deaf = False
        """Whether it took a reset to wake it."""
        self.stop_requested: Callable[[], bool] = lambda: False
        """Asked before every line that is sent and while waiting."""

    def urge(self, realtime: bytes) -> None:
        """Send real-time bytes now, from any thread."""
        self._link.write(realtime)

    # -- starting, resetting, coming to rest ---------------------------------------------------------------------

    def wake(self) -> Status:
        """Wait for a controller that was just connected, whatever state it is in.

        It may be starting (opening the port resets many boards), running, homing (silent) or deaf after an alarm.

        Raises
        ------
        DeviceTimeoutError
            Nothing answers.
        ProtocolError
            Something answers, but not a GRBL controller.
        """
        start = time.monotonic()
        asked, reset = float("-inf"), start
        first_asked = start
        noise: list[str] = []
        while (now := time.monotonic()) < start + self._boot_timeout_s:
            if now >= asked + 0.3:
                self._link.write(ASK_STATUS)
                asked = now
            if now >= reset + _RESET_AGAIN_S:
                self._link.write(RESET)
                reset = now
                self.was_deaf = True
            reply = self._next(_SLICE_S)
            if isinstance(reply, Status):
                self._lag_s = min(time.monotonic() - first_asked, _LONGEST_LAG_S)
                self._quiet()
                self._synchronised = True
                return self.latest or reply
            if isinstance(reply, Banner):
                self._quiet()
                asked = float("-inf")
                first_asked = time.monotonic()
            elif isinstance(reply, Other):
                noise.append(reply.text)
        fragment = self._link.fragment()
        if noise or fragment:
            heard = (noise[-1] if noise else fragment)[:60]
            raise ProtocolError(
                f"stage: {self._link.port} answers, but not as GRBL 1.1 does ({heard!r}); "
                "check stage.port, stage.kind and the baud rate"
            )
        raise DeviceTimeoutError(
            f"stage: no answer from {self._link.port} in {self._boot_timeout_s:g} s; "
            "check power, stage.port, stage.kind and the baud rate"
        )

    def reset(self) -> bool:
        """Reset the controller and wait for its banner; whatever it was doing ends.

        Returns
        -------
        bool
            Whether its position survived: False where it was moving.

        Raises
        ------
        DeviceTimeoutError
            No banner.
        """
        self._quiet(0.0)
        kept = True
        end = time.monotonic() + self._boot_timeout_s
        again = float("-inf")
        while (now := time.monotonic()) < end:
            if now >= again:
                self._link.write(RESET)
                again = now + _RESET_AGAIN_S
            reply = self._next(_SLICE_S)
            if isinstance(reply, Alarm):
                kept = False
            elif isinstance(reply, Banner):
                self._quiet()  # after some alarms a second banner follows
                self._synchronised = True
                return kept
        raise DeviceTimeoutError(
            f"stage: {self._link.port} doesn't come back after a reset; switch the controller off and on, then home"
        )

    def rest(self, patience_s: float) -> bool:
        """Bring the stage to a stand, drop whatever it still had to do, and stay ready for commands.

        A feed hold brakes without losing steps, and a reset while held drops the rest of the movement; only a stage
        that doesn't come to rest in time is reset on the run. Over a slow line answers to earlier questions may still
        be under way: they speak of the time before the stop, so they are let pass first.

        Parameters
        ----------
        patience_s
            How long braking may take.

        Returns
        -------
        bool
            Whether the controller still knows its position.
        """
        end = time.monotonic() + patience_s
        previous: Status | None = None
        fresh = False
        while time.monotonic() < end:
            reply = self._fresh_report() if fresh else self._let_pass()
            if reply is None:
                fresh = not fresh  # a question without an answer: that may still be under way
                continue
            if not isinstance(reply, Status) or reply.state in ("Alarm", "Sleep", "Home"):
                self.reset()
                return False
            if reply.held or reply.parked:
                return self.reset()
            if reply.state in ("Idle", "Check") and previous is not None and previous.state == reply.state:
                return True
            if reply.state in ("Run", "Jog"):
                self._link.write(JOG_CANCEL if reply.state == "Jog" else HOLD)
            previous = reply
            time.sleep(0.02)
        self.reset()
        return False

    def _let_pass(self) -> Alarm | Banner | None:
        """Wait until every question that was asked before is answered; an alarm or a restart among the answers."""
        end = time.monotonic() + self._lag_s * 1.5 + 0.02
        while (left := end - time.monotonic()) > 0:
            reply = self._next(left)
            if isinstance(reply, Alarm | Banner):
                return reply
        return None

    def _fresh_report(self) -> Status | Alarm | Banner | None:
        """Ask once, nothing else being under way; None where no answer comes."""
        self._link.write(ASK_STATUS)
        end = time.monotonic() + self._ask_again_s
        while (left := end - time.monotonic()) > 0:
            reply = self._next(left)
            if isinstance(reply, Status | Alarm | Banner):
                return reply
        return None

    # -- commands and reports ------------------------------------------------------------------------------------

    def command(
        self,
        line: str,
        *,
        doing: str,
        timeout_s: float | None = None,
        watch: Callable[[Status], bool] | None = None,
        retries: int = 0,
    ) -> list[Reply]:
        """Send one line and wait for its ``ok``.

        Parameters
        ----------
        line
            Without its end (a line feed is added; carriage return and line feed would earn two ``ok``).
        doing
            What the operator calls it, for messages.
        timeout_s
            How long the ``ok`` may take.
        watch
            Where given, status reports are asked for meanwhile and shown to it; it returns True when the ``ok`` is
            overdue. A controller that stops reporting is given up after the reply timeout.
        retries
            How often to send it again where noise changed it on its way (it was refused then, not carried out).

        Returns
        -------
        list of Reply
            What was said before the ``ok``: settings, messages.

        Raises
        ------
        DeviceTimeoutError, ProtocolError
            No answer in time; none but noise.
        AlarmError, PositionLostError, StageError
            Refused, or interrupted by alarm or reset.
        StopRequestedError
            :attr:`stop_requested` said so.
        """
        while True:
            self._resynchronise()
            self.drain(doing)
            if not self._link.write(line.encode("ascii") + b"\n", unless=self.stop_requested):
                raise StopRequestedError
            self._synchronised = False
            sent = time.monotonic()
            answer = self._answer(line, doing, timeout_s or self._reply_timeout_s, watch)
            if line == "$I":  # answered at once, and by nothing else
                self._lag_s = min(time.monotonic() - sent, _LONGEST_LAG_S)
            if not isinstance(answer, Error):
                return answer
            if not (refused_as_garbled(answer.code) and retries > 0):
                raise refusal(answer.code, line)
            retries -= 1

    def _answer(
        self, line: str, doing: str, timeout_s: float, watch: Callable[[Status], bool] | None
    ) -> list[Reply] | Error:
        said: list[Reply] = []
        noise: list[str] = []
        asked = heard = time.monotonic()
        end = heard + timeout_s
        while (now := time.monotonic()) < end:
            if self.stop_requested():
                raise StopRequestedError
            if watch is not None:
                if now - heard > self._reply_timeout_s:
                    break
                if now >= asked + 2 * _SLICE_S:
                    self._link.write(ASK_STATUS)
                    asked = now
            match self._next(min(_SLICE_S, end - now)):
                case Ok():
                    self._synchronised = True
                    return said
                case Error() as error:
                    self._synchronised = True
                    return error
                case Alarm() | Banner() as fault:
                    raise StopRequestedError if self.stop_requested() else _fault(fault, doing)
                case Status() as status:
                    heard = now
                    if status.rest:
                        noise.append(status.rest)
                    if watch is not None and watch(status):
                        break
                case Other(text):
                    if text != line:
                        noise.append(text)
                case None:
                    pass
                case reply:
                    said.append(reply)
        raise self._no_answer(line, doing, noise)

    def status(self, doing: str) -> Status:
        """Ask for one report.

        Raises
        ------
        DeviceTimeoutError
            None comes.
        AlarmError, PositionLostError
            There is an alarm, or the controller was reset since we last looked.
        """
        self.drain(doing)
        noise: list[str] = []
        end = time.monotonic() + self._reply_timeout_s
        again = float("-inf")
        reports = 0
        while (now := time.monotonic()) < end:
            if self.stop_requested():
                raise StopRequestedError
            if now >= again:
                self._link.write(ASK_STATUS)
                again = now + self._ask_again_s
            match self._next(_SLICE_S):
                case Alarm() | Banner() as fault:
                    raise StopRequestedError if self.stop_requested() else _fault(fault, doing)
                case Status() as status:
                    reports += 1
                    if status.machine is not None or self._offset is not None:
                        return status
                    if reports < _REPORTS_WITHOUT_OFFSET:
                        again = float("-inf")
                        end = now + self._reply_timeout_s
                case Other(text):
                    noise.append(text)
                case _:
                    pass
        raise self._no_answer("?", doing, noise)

    def steady(self, doing: str) -> Status:
        """Ask until two reports in a row agree in state and place, or one says that it moves.

        One report alone may be stale, or changed by noise into another number.
        """
        end = time.monotonic() + self._reply_timeout_s
        previous = self.status(doing)
        while time.monotonic() < end:
            status = self.status(doing)
            if status.state in ("Run", "Jog", "Home") or (
                status.state == previous.state and self.place(status) == self.place(previous)
            ):
                return status
            previous = status
        raise ProtocolError(f"stage: reports contradict each other while {doing}: check the cable for noise")

    def place(self, status: Status) -> tuple[float, ...]:
        """Machine coordinates of a report, in its own unit (work coordinates plus their offset where it has those)."""
        if status.machine is not None:
            return status.machine
        if status.work is None or self._offset is None:
            raise ProtocolError("stage: a report without a position; set $10=1 in the controller")
        if len(status.work) != len(self._offset):
            self._offset = None  # whichever of the two lost a coordinate: ask for both again
            raise ProtocolError(
                "stage: its reports differ in their number of axes: check the cable for noise, try again"
            )
        return tuple(work + offset for work, offset in zip(status.work, self._offset, strict=True))

    def drain(self, doing: str) -> None:
        """Take what arrived unasked.

        Raises
        ------
        AlarmError, PositionLostError
            There was an alarm or a reset.
        """
        while (reply := self._next(0.0)) is not None:
            if isinstance(reply, Alarm | Banner):
                raise _fault(reply, doing)

    def _resynchronise(self) -> None:
        """After an unanswered line its ``ok`` may still come: find an answer that is surely ours."""
        if self._synchronised:
            return
        self._quiet()
        self._link.write(b"$I\n")
        end = time.monotonic() + self._reply_timeout_s
        ours = False
        while time.monotonic() < end:
            match self._next(_SLICE_S):
                case Message("VER", _):
                    ours = True
                case Ok() if ours:
                    self._synchronised = True
                    return
                case Error(8):  # not at rest: nothing can be sent anyway
                    break
                case Alarm() | Banner() as fault:
                    raise _fault(fault, "asking for its version")
                case _:
                    pass
        raise self._no_answer("$I", "asking for its version", [])

    @property
    def _ask_again_s(self) -> float:
        return max(_ASK_AGAIN_S, 3 * self._lag_s)

    def _quiet(self, seconds: float | None = None) -> None:
        """Throw away what arrives until nothing more comes."""
        seconds = max(_QUIET_S, 1.5 * self._lag_s) if seconds is None else seconds
        end = time.monotonic() + 2.0 + 2 * seconds
        while self._next(seconds) is not None and time.monotonic() < end:
            pass

    def _next(self, timeout_s: float) -> Reply | None:
        line = self._link.next_line(timeout_s)
        if line is None:
            return None
        reply = parse(line)
        if isinstance(reply, Status):
            self._offset = reply.offset or self._offset
            self.latest = reply
        elif isinstance(reply, Banner):
            self._offset = None
            self.banner = reply.text
        return reply

    def _no_answer(self, line: str, doing: str, noise: list[str]) -> RigError:
        fragment = self._link.fragment()
        if fragment:
            noise = [*noise, fragment]
        if noise:
            return ProtocolError(
                f"stage: the answer to {line!r} was garbled or cut off while {doing} ({noise[-1][:60]!r}); "
                "check cable, ground and baud rate, then try again"
            )
        if isinstance(report := self._fresh_report(), Status):
            return DeviceTimeoutError(
                f"stage: the controller reports {report.state}, but doesn't answer {line!r} while {doing}: it may be "
                "waiting out a pause (G4) of another program; end that program or reset the controller, then home"
            )
        return DeviceTimeoutError(
            f"stage: no answer to {line!r} in time while {doing}; check power and cable, switch the controller off and "
            "on, then home"
        )


def _fault(reply: Alarm | Banner, doing: str) -> RigError:
    if isinstance(reply, Alarm):
        return alarm_error(reply.code, doing)
    return RestartedError(
        f"stage: the controller restarted while {doing} (reset button, power, or another program): the position is "
        "lost; home the stage"
    )
