"""A chain of Zaber devices that speak ASCII version 2; what the vendor's own client accepts of it is the protocol."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

from tests.standins.rail import Braking, Motion, Trapezoid

_SPEED_UNIT = 1.6384
_BY_IMPORTANCE = ("FF", "FD", "FS", "FE", "WL", "WR", "WH", "NC", "NI")


def lrc(body: bytes) -> str:
    total = 0
    for byte in body:
        total = (total + byte) & 0xFF
    return f"{((total ^ 0xFF) + 1) & 0xFF:02X}"


@dataclass
class ZaberDevice:
    """One device with one axis, in microsteps."""

    address: int = 1
    settings: dict[str, str] = field(
        default_factory=lambda: {
            "device.id": "50081", "system.serial": "100235", "version": "7.38", "system.access": "1",
            "system.axiscount": "1", "comm.alert": "0", "comm.checksum": "0",
            "resolution": "64", "limit.min": "0", "limit.max": "6000000", "maxspeed": "32768000", "accel": "40000",
            "limit.approach.maxspeed": "32768000",
        }
    )  # fmt: skip
    flags: set[str] = field(default_factory=lambda: {"WR"})
    position: float = 4e4
    true_offset: float = 0.0
    jam_at: float | None = None
    dead_home_sensor: bool = False
    now: float = 0.0
    motion: Motion | None = None
    homing: bool = False
    lasting: set[str] = field(default_factory=set)
    """Flags that a new movement doesn't clear."""
    reject: dict[str, str] = field(default_factory=dict)
    """Commands (their beginnings) that are answered with RJ and this reason."""

    def power_on(self) -> None:
        self.flags, self.motion, self.homing, self.position = {"WR"}, None, False, 0.0

    @property
    def busy(self) -> bool:
        return self.motion is not None

    def step(self, now: float) -> list[bytes]:
        self.now = now
        if self.motion is None:
            return []
        self.position, _ = self.motion.at(now)
        if self.jam_at is not None and self.position > self.jam_at:
            self.motion, self.position = None, self.jam_at
            self.flags.add("FS")
        elif now >= self.motion.end_s:
            self.motion = None
            if self.homing and not self.dead_home_sensor:
                self.position = 0.0
                self.flags -= {"WR", "WH"}
            self.homing = False
        if self.motion is None and self.settings["comm.alert"] == "1":
            return [f"!{self.address:02d} 1 IDLE {self._flag()}".encode()]
        return []

    def answer(self, axis: int, command: str) -> tuple[bool, str]:
        """Whether it is taken, and the data."""
        for start, reason in self.reject.items():
            if command.startswith(start):
                return False, reason
        words = command.split()
        if axis > 1:
            return False, "BADAXIS"
        match words:
            case []:
                return True, "0"
            case ["get", "pos"]:
                return True, f"{round(self.position)}"
            case ["get", name]:
                return (True, self.settings[name]) if name in self.settings else (False, "BADCOMMAND")
            case ["set", name, value]:
                if name not in self.settings:
                    return False, "BADCOMMAND"
                self.settings[name] = value
                return True, "0"
            case ["home"]:
                self.homing = True
                return self._go(0.0, float(self.settings["limit.approach.maxspeed"]))
            case ["move", "abs", target, *speed]:
                if not re.fullmatch(r"-?\d+", target) or not self._within(int(target)):
                    return False, "BADDATA"
                return self._go(float(target), float(speed[0] if speed else self.settings["maxspeed"]))
            case ["stop"] | ["estop"]:
                if self.motion is not None:
                    position, velocity = self.motion.at(self.now)
                    self.motion = Braking(self.now, position, velocity or 1e-9, self._acceleration, 0.0)
                    self.flags.add("NI")
                    self.homing = False
                return True, "0"
            case ["warnings"]:
                return True, " ".join([f"{len(self.flags):02d}", *sorted(self.flags, key=_rank)])
            case ["warnings", "clear"]:
                data = " ".join([f"{len(self.flags):02d}", *sorted(self.flags, key=_rank)])
                self.flags &= {"WR", "WH"}
                return True, data
            case _:
                return False, "BADCOMMAND"

    @property
    def _acceleration(self) -> float:
        return float(self.settings["accel"]) * 1e4 / _SPEED_UNIT

    def _within(self, target: int) -> bool:
        return int(self.settings["limit.min"]) <= target <= int(self.settings["limit.max"])

    def _go(self, target: float, speed: float) -> tuple[bool, str]:
        self.flags -= {"NI", "FS"} - self.lasting
        self.motion = Trapezoid(self.now, self.position, target, speed / _SPEED_UNIT, self._acceleration)
        return True, "0"

    def _flag(self) -> str:
        return min(self.flags, key=_rank, default="--")


def _rank(flag: str) -> int:
    return _BY_IMPORTANCE.index(flag) if flag in _BY_IMPORTANCE else len(_BY_IMPORTANCE)


class ZaberChain:
    """Devices on one line: bytes in, bytes out."""

    def __init__(self, *devices: ZaberDevice) -> None:
        self.devices = devices or (ZaberDevice(),)
        self.output = bytearray()
        self.checksums_required = False
        self.longest_data = 1000
        """Characters of data in one message; the rest follows in further ones."""
        self.change_reply: Callable[[bytes], bytes] = bytes
        self._input = bytearray()

    def receive(self, data: bytes) -> None:
        self._input += data
        *lines, rest = re.split(rb"\r?\n|\r", bytes(self._input))
        self._input = bytearray(rest)
        for line in lines:
            self._obey(line)

    def step(self, now: float) -> None:
        for device in self.devices:
            for alert in device.step(now):
                self.output += alert + b"\r\n"

    def _obey(self, line: bytes) -> None:
        start = line.rfind(b"/")
        if start < 0:
            return
        body, colon, check = line[start + 1 :].partition(b":")
        if colon and lrc(body).encode() != check:
            return  # a damaged message is ignored
        if not colon and self.checksums_required:
            return
        numbers = re.match(rb"(\d+)?(?: (\d+))?(?: (\d+))? ?(.*)", body)
        assert numbers is not None
        address, axis, message_id = (int(n) if n is not None else None for n in numbers.groups()[:3])
        for device in self.devices:
            if address in (None, 0, device.address):
                accepted, data = device.answer(axis or 0, numbers[4].decode("latin-1"))
                words = [f"{device.address:02d}", f"{axis or 0}"]
                words += [f"{message_id:02d}"] if message_id is not None else []
                kinds = [("@", ["OK" if accepted else "RJ", "BUSY" if device.busy else "IDLE", device._flag()])]
                parts = _split(data, self.longest_data)
                kinds += [("#", ["cont"])] * (len(parts) - 1)
                for (kind, head), part in zip(kinds, parts, strict=True):
                    reply = " ".join([*words, *head, part]).encode()
                    if device.settings["comm.checksum"] == "1":
                        reply += f":{lrc(reply)}".encode()
                    self.output += self.change_reply(kind.encode() + reply + b"\r\n")


def _split(data: str, longest: int) -> list[str]:
    """Data as it goes into several messages, between words, each but the last with a mark that more follows."""
    parts: list[str] = []
    for word in data.split():
        if parts and len(parts[-1]) + len(word) < longest:
            parts[-1] += f" {word}"
        else:
            parts.append(word)
    return [f"{part}\\" for part in parts[:-1]] + parts[-1:]
