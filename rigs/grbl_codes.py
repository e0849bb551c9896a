"""What GRBL's numbers mean, in plain words, with the way out.

Numbers and meanings: the GRBL 1.1 wiki (interface page) and its ``error_codes`` and ``alarm_codes`` tables; 11 and
above among the alarms are grblHAL's and FluidNC's.
"""

from __future__ import annotations

from rigs.errors import AlarmError, LimitError, PositionLostError, ProtocolError, StageError

ALARMS: dict[int, tuple[str, str]] = {
    1: (
        "a limit switch was hit and the position is lost",
        "look why the carriage got there, free it, check stage.limits, and home",
    ),
    2: (
        "the target was beyond the controller's soft limits; nothing moved past them",
        "compare $130 with the real travel and with stage.limits, and home",
    ),
    3: ("it was reset while moving and the position is lost", "home the stage"),
    4: ("the probe was already closed", "disconnect the probe input, and home"),
    5: ("the probe didn't close", "disconnect the probe input, and home"),
    6: ("homing was ended by a reset", "home again"),
    7: ("homing was ended by the safety door", "close the door and home again"),
    8: (
        "the limit switch stayed closed when homing moved off it",
        "the switch is stuck or the pull-off ($27) too short: press the switch by hand and watch Pn in the status, "
        "then home",
    ),
    9: (
        "homing didn't find the limit switch",
        "check switch, cable, direction ($23) and travel ($130); push the carriage nearer to the switch and home",
    ),
    10: ("the emergency stop is active, or one side of a two-motor axis found no switch", "release it and home"),
    11: ("it demands homing", "home the stage"),
    12: ("a limit switch is closed", "move the carriage off the switch by hand and home"),
    14: ("homing failed", "check switches and cables, and home"),
    17: ("a motor driver reports a fault", "switch motor power off, wait, switch it on, and home"),
}

ERRORS: dict[int, tuple[str, str]] = {
    1: ("a letter was expected", ""),
    2: ("a number is malformed or missing", ""),
    3: ("it doesn't know this $ command", "the firmware may be too old or cut down; GRBL 1.1 is needed"),
    4: ("a value is negative", ""),
    5: ("homing is off", "switch it on in the controller with $22=1"),
    6: ("a step pulse must be 3 microseconds or longer", "correct $0 in the controller"),
    7: ("its stored settings were damaged and have been replaced by defaults", "enter all $ settings anew"),
    8: ("it isn't idle", "wait until it stands still, or home it"),
    9: ("it is locked by an alarm or by jogging", "home the stage"),
    10: ("soft limits need homing", "switch homing on first: $22=1, then $20=1"),
    11: ("the line was too long", ""),
    12: ("the step rate is too high", "lower $110 or $100 in the controller"),
    13: ("the safety door is open", "close it"),
    14: ("a stored line is too long", ""),
    15: ("the target is beyond its travel", "correct stage.limits, or $130 in the controller"),
    16: ("the jog command is malformed", ""),
    17: ("laser mode needs PWM", "switch it off with $32=0"),
    20: ("a G-code word is unknown to it", ""),
    21: ("two words of one group", ""),
    22: ("no feed rate is set", ""),
    23: ("a whole number was expected", ""),
    24: ("two words claim the axes", ""),
    25: ("a word appears twice", ""),
    26: ("no axis was named", ""),
    27: ("the line number is invalid", ""),
    28: ("a value is missing", ""),
    29: ("this work coordinate system isn't supported", ""),
    30: ("G53 works with G0 and G1 only", ""),
    31: ("an axis is named where none is used", ""),
    32: ("an arc has no axis in its plane", ""),
    33: ("the target is invalid", ""),
    34: ("the arc's radius is invalid", ""),
    35: ("the arc's centre is missing", ""),
    36: ("values are left over", ""),
    37: ("tool offsets are for one axis only", ""),
    38: ("the tool number is too large", ""),
}

_NOISE = frozenset({1, 2, 3, 4, 11, 14, 16, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32, 33, 34, 35, 36, 37, 38})
"""Refusals of a line that we never send: it was changed on its way."""


def refused_as_garbled(code: int) -> bool:
    """Whether an ``error`` means that our line arrived changed (it wasn't carried out, so it may be sent again)."""
    return code in _NOISE


def alarm_error(code: int, doing: str) -> StageError:
    """Error for ``ALARM:code``."""
    meaning, way_out = ALARMS.get(code, ("a condition that this program doesn't know", "see the firmware's manual"))
    kind = PositionLostError if code == 3 else AlarmError
    return kind(f"stage: ALARM:{code} while {doing}: {meaning}; {way_out}")


def refusal(code: int, line: str) -> StageError | ProtocolError:
    """Error for ``error:code`` in answer to a line."""
    meaning, way_out = ERRORS.get(code, ("a reason that this program doesn't know", "see the firmware's manual"))
    said = f"stage: the controller refused {line!r} with error:{code} ({meaning})"
    if code == 9:
        return AlarmError(f"{said}; {way_out}")
    if code == 15:
        return LimitError(f"{said}; {way_out}")
    if code in _NOISE:
        way_out = way_out or "the line was changed on its way: check cable, ground and baud rate"
        return ProtocolError(f"{said}; {way_out}")
    return StageError(f"{said}; {way_out}")
