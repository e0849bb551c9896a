"""What the reports of a GRBL controller mean for a move: whether it can begin, goes on, or takes too long."""

from __future__ import annotations

import math
import time

from rigs.errors import AlarmError, DeviceBusyError, DeviceTimeoutError, PositionLostError, StageError
from rigs.grbl_controller import StopRequestedError
from rigs.grbl_protocol import Status

_SLOWEST = 5.0
"""A move that goes on may take so many times longer than one that doesn't."""
_PROGRESS_MM = 0.1

NOT_READY = {
    "Alarm": (AlarmError, "is in alarm", "home the stage"),
    "Hold": (StageError, "is paused (feed-hold button)", "press its resume button, or stop and home"),
    "Door": (StageError, "sees its safety door open", "close the door, then home the stage"),
    "Sleep": (StageError, "sleeps", "home the stage"),
    "Check": (StageError, "only checks G-code ($C)", "switch check mode off, or home the stage"),
    "Run": (DeviceBusyError, "is moving on somebody else's command", "close the other program, then home"),
    "Jog": (DeviceBusyError, "is being jogged", "wait until it stands, then try again"),
    "Home": (DeviceBusyError, "is homing on somebody else's command", "wait, then home"),
    "Tool": (StageError, "waits for a tool change", "home the stage"),
}
"""States in which a move isn't started: the error, what the controller does, and the way out."""


def require_running(status: Status) -> None:
    """Go on with a move that reports come from.

    Raises
    ------
    StopRequestedError
        It was stopped: by us, or by a button on the machine.
    AlarmError, PositionLostError, StageError
        It won't arrive.
    """
    if status.held:
        raise StopRequestedError
    if status.state == "Alarm":
        raise AlarmError("stage: the controller went into alarm on the way; home the stage")
    if status.state == "Sleep":
        raise PositionLostError("stage: the controller fell asleep on the way: the position is lost; home the stage")
    if status.state in ("Door", "Check", "Tool"):
        kind, what, way_out = NOT_READY[status.state]
        raise kind(f"stage: the controller {what} on the way; {way_out}")


class Patience:
    """How long a move may take: a multiple of what distance, speed and acceleration make of it.

    A carriage that still comes nearer is waited for some times longer: firmware that is short of processor time, or
    whose feed is turned down at a pendant, is slow and not stuck.

    Parameters
    ----------
    doing, target_mm
        The move, for messages, and where it ends.
    expected_s
        What distance, speed and acceleration make of it.
    patience
        Times of that until it is given up.
    slack_s
        For answers on their way; also how long one that comes nearer may rest in between.
    """

    def __init__(self, doing: str, target_mm: float, expected_s: float, *, patience: float, slack_s: float) -> None:
        self._doing, self._target_mm, self._slack_s = doing, target_mm, slack_s
        self._nearest_mm = math.inf
        start = time.monotonic()
        self._end = start + patience * expected_s + self._slack_s
        self._last = start + _SLOWEST * patience * expected_s + self._slack_s

    @property
    def longest_s(self) -> float:
        """Seconds that are left at most."""
        return max(self._last - time.monotonic(), 0.1) + self._slack_s

    def check(self, position_mm: float) -> None:
        """Take note of a position on the way.

        Raises
        ------
        DeviceTimeoutError
            It should have arrived by now.
        """
        now = time.monotonic()
        left_mm = abs(position_mm - self._target_mm)
        if left_mm < self._nearest_mm - _PROGRESS_MM:
            self._nearest_mm = left_mm
            self._end = max(self._end, min(now + self._slack_s, self._last))
        if now > self._end:
            raise DeviceTimeoutError(
                f"stage: not arrived while {self._doing} in the time that speed and acceleration allow; check motor "
                "power, feed override and $110, $120"
            )
