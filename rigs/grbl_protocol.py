"""Lines that GRBL 1.1 (also FluidNC and grblHAL) sends, as values. No hardware here."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

HOLD = b"!"
RESET = b"\x18"
JOG_CANCEL = b"\x85"
ASK_STATUS = b"?"
NORMAL_OVERRIDES = b"\x90\x95"
"""Feed and rapid override back to 100 %: noise may have changed them, since each is a single byte."""

_BANNER = re.compile(r"Grbl(HAL)?\s+\S", re.IGNORECASE)
_NUMBERED = re.compile(r"(error|ALARM):(\d{1,3})")
_SETTING = re.compile(r"\$(\d{1,3})=(.*)")
_STATES = ("Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep", "Tool")
_NUMBER = re.compile(r"-?\d+(\.\d+)?")


@dataclass(frozen=True, slots=True)
class Ok:
    """A line was taken."""


@dataclass(frozen=True, slots=True)
class Error:
    """A line was refused."""

    code: int


@dataclass(frozen=True, slots=True)
class Alarm:
    """The controller has gone into alarm."""

    code: int


@dataclass(frozen=True, slots=True)
class Banner:
    """The controller has started, or was reset."""

    text: str


@dataclass(frozen=True, slots=True)
class Setting:
    """One line of ``$$``."""

    number: int
    value: str


@dataclass(frozen=True, slots=True)
class Message:
    """A line in brackets: ``[MSG:...]``, ``[VER:...]`` and so on."""

    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Other:
    """Anything else: an echo, a boot message, noise, half a line."""

    text: str


@dataclass(frozen=True, slots=True)
class Status:
    """A status report. Coordinates are in the controller's report unit (mm, or inches with ``$13=1``)."""

    state: str
    substate: int | None = None
    machine: tuple[float, ...] | None = None
    """Machine position, where reported (``$10`` bit 0 set)."""
    work: tuple[float, ...] | None = None
    """Position in work coordinates, where reported instead."""
    offset: tuple[float, ...] | None = None
    """Work coordinate offset; comes with some reports only."""
    pins: str = ""
    fields: Mapping[str, str] = field(default_factory=dict)
    rest: str = ""
    """What stood in front of it on its line: the rest of a torn reply, or noise."""

    @property
    def held(self) -> bool:
        """Whether the motion has come to rest in a feed hold."""
        return self.state == "Hold" and self.substate in (0, None)

    @property
    def parked(self) -> bool:
        """Whether the motion has come to rest since a safety door was opened."""
        return self.state == "Door" and self.substate in (0, 1)


Reply = Ok | Error | Alarm | Banner | Setting | Message | Other | Status


def parse(line: str) -> Reply:
    """Read one line; what isn't wholly well-formed is :class:`Other`, never a guess."""
    if line == "ok":
        return Ok()
    numbered = _NUMBERED.fullmatch(line)
    if numbered:
        code = int(numbered[2])
        return Error(code) if numbered[1] == "error" else Alarm(code)
    if line.endswith(">") and "<" in line:
        return _status(line) or Other(line)
    setting = _SETTING.match(line)
    if setting:
        value = setting[2].partition("(")[0].strip()  # some builds add words: $110=500.000 (x max rate, mm/min)
        return Setting(int(setting[1]), value) if value else Other(line)
    if line.startswith("[") and line.endswith("]"):
        kind, _, text = line[1:-1].partition(":")
        return Message(kind, text)
    # Boot loaders and noise leave bytes in front of the banner; the first letter of the name may be gone with them.
    banner = _BANNER.search(line)
    return Banner(line[banner.start() :]) if banner else Other(line)


def _status(line: str) -> Status | None:
    # A torn report may have run into the next one: the last '<' begins the whole one.
    start = line.rindex("<")
    head, *parts = line[start + 1 : -1].split("|")
    state, _, substate = head.partition(":")
    if state not in _STATES or (substate and not substate.isdigit()):
        return None
    fields = dict(part.partition(":")[::2] for part in parts)
    vectors: dict[str, tuple[float, ...]] = {}
    for name in ("MPos", "WPos", "WCO"):
        if name in fields:
            numbers = fields[name].split(",")
            if not all(_NUMBER.fullmatch(number) for number in numbers):
                return None
            vectors[name] = tuple(float(number) for number in numbers)
    if "MPos" not in vectors and "WPos" not in vectors:
        return None
    if len({len(vector) for vector in vectors.values()}) > 1:  # a coordinate was lost on the way
        return None
    return Status(
        state=state,
        substate=int(substate) if substate else None,
        machine=vectors.get("MPos"),
        work=vectors.get("WPos"),
        offset=vectors.get("WCO"),
        pins=fields.get("Pn", ""),
        fields=fields,
        rest=line[:start],
    )
