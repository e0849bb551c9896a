"""The firmware stand-in against recordings of real GRBL 1.1h: the same bytes in, the same lines out."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.standins.grbl_firmware import GrblFirmware
from tests.standins.rail import Rail

RECORDINGS = Path(__file__).parents[4] / "shared" / "rig" / "grbl-1.1h-transcript.txt"

_EVENT = re.compile(r"^ *(\d+\.\d+) ([<>]) (b(?:'.*?'|\".*?\"))(?: .*)?$")
_TICK_S = 0.002

FACTORY = {20: 0, 21: 0, 22: 0, 23: 0, 24: 25, 25: 500, 27: 1, 100: 250, 110: 500, 120: 10, 130: 200}

NOT_COMPARED = {
    "wake: soft reset": "the recording begins in the middle",
    "RX buffer overflow: 20 lines of 20 bytes at once, no character counting": "the lines sent aren't recorded",
    "homing with stuck switch": "the recorder tried twice, and what it sent in the reset vanished",
    "line noise + 20 lost bytes": "a fault of the line, not of the firmware",
    "emergency stop button (reset pin) in motion": "polled between recorded lines",
    "unplug": "a fault of the line, not of the firmware",
}
STOPPED_ON_THE_WAY = {
    "jog + cancel", "feed-hold button", "feed hold / resume", "reset in mid-move", "reset while held",
    "override 50 % feed",
    "soft limit during motion", "hard limit hit in motion", "$J=F100 without axis word (moves to X0!)",
}  # fmt: skip
"""Where the carriage came to rest depends on when the recorder's byte arrived."""
AT_REST_AGAIN = {"$ command during motion", "homing with dead switch (never closes)"}


@dataclass
class Sent:
    gap_s: float
    data: bytes
    replies: list[str] = field(default_factory=list)


@dataclass
class Section:
    name: str
    events: list[Sent | str]


def read_recordings(text: str) -> list[list[Section]]:
    recordings = []
    for part in text.split("\n\n\n"):
        sections = []
        before = 0.0
        for block in re.split(r"^## ", part, flags=re.MULTILINE)[1:]:
            name, *lines = block.splitlines()
            events: list[Sent | str] = []
            sent = Sent(0.0, b"")
            for line in lines:
                match = _EVENT.match(line)
                if match is None:
                    events.append(line)
                    continue
                data = ast.literal_eval(match[3])
                if match[2] == ">":
                    events.append(sent := Sent(float(match[1]) - before, data))
                    before = float(match[1])
                else:
                    if sent not in events:
                        events.append(sent)
                    sent.replies.append(data.decode("latin-1").strip())
            sections.append(Section(name, events))
        recordings.append(sections)
    return recordings


def act(firmware: GrblFirmware, section: str, sent: bytes) -> None:
    """What hands did beside the recorded bytes, just before some of these."""
    match section, sent:
        case "homing with dead switch (never closes)", b"$H\n":
            firmware.rail.stuck_switch, firmware.rail.dead_switch = False, True
        case "rehome", b"$H\n":
            firmware.rail.stuck_switch, firmware.rail.dead_switch = True, False
        case "homing with switch stuck closed", b"\x18":
            firmware.rail.stuck_switch = False
        case "feed-hold button", b"?":
            firmware.press_hold()


class Replay:
    """Feeds a firmware in its own time, as fast as it can be computed."""

    def __init__(self, firmware: GrblFirmware) -> None:
        self.firmware, self.now = firmware, 0.0

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / _TICK_S)):
            self.now += _TICK_S
            self.firmware.step(self.now)

    def heard(self) -> list[str]:
        return [line for line in self.firmware.output.decode("latin-1").split("\r\n") if line]

    def section(self, section: Section) -> list[str]:
        self.firmware.output.clear()
        wanted, sent_at = 0, self.now
        for event in section.events:
            if isinstance(event, Sent):
                self.run(event.gap_s - (self.now - sent_at))
                self._wait_for(wanted)
                act(self.firmware, section.name, event.data)
                self.run(0.6 if section.name == "feed-hold button" else 2 * _TICK_S)
                sent_at = self.now
                self.firmware.receive(event.data)
                wanted += len(event.replies)
                if section.name.startswith("emergency stop") and event.data.startswith(b"G1"):
                    self.run(0.6)
                    self.firmware.press_reset()
                    wanted = 0
            elif "power off" in event:
                self.firmware.power_on()
            elif "ctl limit stuck" in event:
                self.run(0.5)
                self.firmware.trip_switch()
            elif "(b'<" in event or "idle after" in event:  # the recorder polled until idle, or for so many seconds
                self._wait_for(wanted)
                limit = self.now + 40
                while self.firmware.state in ("Run", "Jog") and self.now < limit:
                    self.run(0.02)
        self._wait_for(wanted)
        self.run(0.3)
        return self.heard()

    def _wait_for(self, lines: int) -> None:
        deadline = self.now + 100
        while len(self.heard()) < lines and self.now < deadline:
            self.run(0.02)


def comparable(lines: list[str]) -> list[str]:
    """Moments differ by the recorder's delays: places in motion and the fields that come every so often."""
    return [re.sub(r"FS:[\d.]+|\|(WCO|Ov):[^|>]*", "", line) for line in lines]


def same(recorded: str, said: str, tolerance_mm: float) -> bool:
    place = re.compile(r"Pos:(-?[\d.]+)")
    if place.sub("", recorded) != place.sub("", said):
        return False
    a, b = place.search(recorded), place.search(said)
    in_motion = recorded.startswith(("<Run", "<Jog", "<Hold"))
    return a is None or b is None or abs(float(a[1]) - float(b[1])) <= (60 if in_motion else tolerance_mm)


@pytest.mark.skipif(not RECORDINGS.exists(), reason=f"needs the recordings of real firmware ({RECORDINGS})")
def test_stand_in_answers_line_for_line_as_real_firmware_did() -> None:
    recordings = read_recordings(RECORDINGS.read_text())
    machines = [
        GrblFirmware(Rail(carriage_mm=110), FACTORY),
        GrblFirmware(Rail(carriage_mm=110)),
        GrblFirmware(Rail(carriage_mm=10, stuck_switch=True)),
    ]
    different: list[str] = []
    compared = 0
    for number, (sections, firmware) in enumerate(zip(recordings, machines, strict=True), start=1):
        replay = Replay(firmware)
        stopped_on_the_way = False
        for section in sections:
            stopped_on_the_way |= section.name in STOPPED_ON_THE_WAY
            stopped_on_the_way &= section.name not in AT_REST_AGAIN
            said = comparable(replay.section(section))
            recorded = comparable([r for e in section.events if isinstance(e, Sent) for r in e.replies])
            if section.name in NOT_COMPARED:
                continue
            compared += len(recorded)
            tolerance_mm = 60 if stopped_on_the_way else 0.001
            pairs = zip(recorded, said, strict=False)
            if len(said) != len(recorded) or not all(same(r, s, tolerance_mm) for r, s in pairs):
                different.append(f"{number} {section.name}:\n  recorded {recorded}\n  stand-in {said}")
    assert not different, "\n".join(different)
    assert compared > 200
