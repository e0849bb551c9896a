"""Messages of the Zaber ASCII protocol, version 2, as values. No hardware here.

Request ``/1 1 07 move abs 12345:4C``: device, axis, message id, command, checksum. Reply
``@01 1 07 OK BUSY -- 0``: device, axis, message id, taken or rejected, moving or not, most important warning, data.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from rigs.errors import ConfigError, DeviceBusyError, LimitError, NotHomedError, ProtocolError, RigError, StageError

_REPLY = re.compile(r"@(\d\d) (\d) (\d\d) (OK|RJ) (BUSY|IDLE) (--|[A-Z][A-Z0-9]) ?(.*)")

_CONTINUATION = re.compile(r"#(\d\d) (\d) (\d\d) cont (.*)")
_MORE = "\\"

NO_REFERENCE = frozenset({"WR", "WH"})
"""Warnings that say: home first."""

POSITION_LOST = {
    "FS": ("stalled and stopped, it may have lost steps", "look what blocks the carriage, then home"),
    "WL": ("hit a limit sensor unexpectedly", "look why the carriage got there, then home"),
    "FQ": ("encoder error", "check the encoder's cable, then home"),
    "FI": ("encoder index error", "home the stage"),
}
_FAULTS = {
    "FF": ("critical system error", "switch it off and on; if it stays, ask Zaber"),
    "FN": ("peripheral not supported", "check which stage is plugged into the controller"),
    "FZ": ("peripheral not active", "activate it in Zaber Launcher"),
    "FH": ("emergency stop pressed", "release it, then home"),
    "FV": ("supply voltage out of range", "check the power supply, then home"),
    "FO": ("motor driver switched off", "switch it on in Zaber Launcher (driver enable), then home"),
    "FC": ("inrush current too high", "check the power supply, switch it off and on, then home"),
    "FM": ("motor too hot", "let it cool, then home"),
    "FD": ("motor driver switched itself off", "check power and load, switch it off and on, then home"),
    "FA": ("encoder synchronisation error", "switch it off and on, then home"),
    "FR": ("overdrive limit exceeded", "lower the load or the acceleration, then home"),
    "FE": ("limit error: the target can't be reached", "check limit.min and limit.max, then home"),
    "FT": ("excessive twist", "check the lockstep axes, then home"),
    "FB": ("stream bounds error", "close the other program, then home"),
    "FP": ("path deviation", "close the other program, then home"),
    "NC": ("moved by its knob", "leave the knob alone (or set knob.enable 0), then try again"),
    "NB": ("in firmware update mode", "finish the update"),
}
_REMARKS = {
    "WS": ("stalled, and recovered by itself", "look what brakes the carriage: next time it may stop"),
    "WM": ("was pushed away while it stood still", "look what pushes the carriage; calibrate the depths since anew"),
    "WV": ("supply voltage outside of what it is made for", "check the power supply before it stops"),
    "WT": ("controller hot", "give it air before it stops"),
    "WP": ("its calibration is of a kind that it doesn't know", "write the calibration anew in Zaber Launcher"),
    "ND": ("a stream of movements had a gap", "close the other program"),
    "NR": ("a value was rounded", "none of ours is: close the other program"),
    "NT": ("a value was cut", "none of ours is: close the other program"),
    "NU": ("a setting takes effect later", "switch it off and on"),
    "NJ": ("its joystick is being calibrated", "finish that"),
}
OWN_DOING = frozenset({"NI", "NC"})
"""Left over from a movement that was broken off; cleared before the next one."""


def fault(flag: str) -> tuple[str, str] | None:
    """What a warning flag means that keeps the stage from moving, and the way out; None for other flags."""
    if flag in _FAULTS:
        return _FAULTS[flag]
    if flag.startswith("F") and flag not in POSITION_LOST:  # a newer firmware's: F flags stop or disable the axis
        return "a fault that this program doesn't know", "see warning flags in the device's protocol manual, then home"
    return None


def remark(flag: str) -> tuple[str, str] | None:
    """What a warning flag means that stops nothing, and what to do about it; None for other flags."""
    if flag in _REMARKS:
        return _REMARKS[flag]
    if flag in NO_REFERENCE | OWN_DOING | POSITION_LOST.keys() or fault(flag):
        return None
    return "a warning that this program doesn't know", "see warning flags in the device's protocol manual"


_REJECTIONS: dict[str, tuple[type[RigError], str, str]] = {
    "AGAIN": (DeviceBusyError, "can't do it just now", "try again"),
    "BADAXIS": (ConfigError, "has no such axis", "correct stage.axis"),
    "BADCOMMAND": (ProtocolError, "doesn't know this command", "its firmware may be too old: 6.06 or newer is needed"),
    "BADDATA": (LimitError, "can't take this value", "it is outside the device's limits: correct stage.limits"),
    "BADMESSAGEID": (ProtocolError, "got a damaged message", "check the cable, then try again"),
    "BUSY": (DeviceBusyError, "is busy", "wait, or close the other program"),
    "DEVICEONLY": (ProtocolError, "takes it for all axes only", "its firmware may be too old: 6.06 or newer is needed"),
    "DRIVERDISABLED": (
        StageError,
        "has its motor driver off",
        "check power and emergency stop, switch the driver on in Zaber Launcher (driver enable), then home",
    ),
    "FULL": (DeviceBusyError, "has no room left", "close the other program, or switch the device off and on"),
    "INACTIVE": (
        StageError,
        "has no active stage on this axis",
        "plug the stage in and activate it in Zaber Launcher, or correct stage.axis",
    ),
    "LOCKSTEP": (
        StageError,
        "drives this axis in lockstep with another",
        "dissolve the lockstep group in Zaber Launcher (lockstep 1 setup disable)",
    ),
    "NOACCESS": (StageError, "doesn't allow it at its access level", "set system.access to 2 in Zaber Launcher"),
    "NOREF": (NotHomedError, "has no reference", "home the stage"),
    "PARKED": (StageError, "is parked", "unpark or home it in Zaber Launcher"),
    "REMOTE": (StageError, "is under remote control (EtherCAT)", "hand control back to the serial line"),
    "STATUSBUSY": (DeviceBusyError, "is moving", "wait, or close the other program"),
}


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer to one request."""

    device: int
    axis: int
    message_id: int
    accepted: bool
    busy: bool
    warning: str
    """Most important warning flag, empty where there is none."""
    data: str

    @property
    def goes_on(self) -> bool:
        """Whether more of the data follows in another message."""
        return self.data.endswith(_MORE)


def checksum(body: str) -> str:
    """Longitudinal redundancy check of everything after the first character: two's complement of the sum of bytes."""
    return f"{-sum(body.encode('ascii')) & 0xFF:02X}"


def request(device: int, axis: int, message_id: int, command: str) -> bytes:
    """Bytes of a request; an empty command asks for the state."""
    body = f"{device} {axis} {message_id:02d} {command}".rstrip()
    return f"/{body}:{checksum(body)}\n".encode("ascii")


def parse(line: str) -> Reply | None:
    """Read a reply; None for alerts (``!``), information (``#``) and anything that isn't whole.

    Replies carry a checksum only where the device is set so (``comm.checksum``); a wrong one makes the line unreadable.
    """
    match = _REPLY.fullmatch(_checked(line, "@"))
    if match is None:
        return None
    return Reply(
        device=int(match[1]),
        axis=int(match[2]),
        message_id=int(match[3]),
        accepted=match[4] == "OK",
        busy=match[5] == "BUSY",
        warning="" if match[6] == "--" else match[6],
        data=match[7],
    )


def continued(reply: Reply, line: str) -> Reply | None:
    """A reply and what a line adds to it; None where the line isn't its continuation (``#01 1 07 cont more data``)."""
    match = _CONTINUATION.fullmatch(_checked(line, "#"))
    if match is None or (int(match[1]), int(match[2]), int(match[3])) != (reply.device, reply.axis, reply.message_id):
        return None
    return replace(reply, data=f"{reply.data.removesuffix(_MORE)} {match[4]}")


def _checked(line: str, kind: str) -> str:
    """The message of this kind at a line's end, without its checksum; empty where there is none or it is wrong."""
    start = line.rfind(kind)
    if start < 0:
        return ""
    line = line[start:]
    if re.search(r":[0-9A-F]{2}$", line):
        line, _, check = line.rpartition(":")
        if checksum(line[1:]) != check:
            return ""
    return line


def is_unasked(line: str) -> bool:
    """Whether a line is an alert or information, sent without a request."""
    return line.startswith(("!", "#"))


def rejection(command: str, reason: str) -> RigError:
    """Error for a rejected command."""
    kind, meaning, way_out = _REJECTIONS.get(
        reason, (StageError, "rejected the command", "see reject reasons in the device's protocol manual")
    )
    return kind(f"stage: the device {meaning} ({command!r}: {reason}); {way_out}")
