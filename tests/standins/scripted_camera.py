"""Stands in for the camera's process: an EOS 650D in mode M that fails as it is told to.

Speaks the pipe protocol of ``rigs.gphoto2_wire``, nothing of libgphoto2. As ``python -m
tests.standins.scripted_camera DIR`` it reads ``DIR/rules.json``: a list of rules ``{"op", "name"?, "first"?, "last"?,
"do", ...}``, each for the calls number ``first`` to ``last`` of one operation, counted over all processes of the
test. Every call is noted in ``DIR/calls.jsonl``.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from rigs.gphoto2_wire import Unpacker, pack

CARD = "/store_00010001/DCIM/100CANON"
TIMES = ["bulb", "30", "2.5", "1", "0.3", "1/15", "1/60", "1/125", "1/1000", "1/4000"]
FORMATS = ["Large Fine JPEG", "RAW + Large Fine JPEG", "RAW"]


def radio(value: str, *choices: str, readonly: bool = False) -> dict[str, Any]:
    return {"value": value, "choices": list(choices), "readonly": readonly}


def eos_650d() -> dict[str, Any]:
    return {
        "manufacturer": radio("Canon Inc."),
        "cameramodel": radio("Canon EOS 650D"),
        "deviceversion": radio("3-1.0.1"),
        "serialnumber": radio("dd08de12"),
        "eosserialnumber": radio("53123456789"),
        "lensname": radio("EF-S18-55mm f/3.5-5.6 IS II"),
        "batterylevel": radio("100%"),
        "availableshots": radio("412"),
        "autoexposuremode": radio("Manual", "P", "TV", "AV", "Manual", readonly=True),
        "shutterspeed": radio("1/60", *TIMES),
        "iso": radio("Auto", "Auto", "100", "200", "400", "12800"),
        "imageformat": radio("Large Fine JPEG", *FORMATS),
        "capturetarget": radio("Internal RAM", "Internal RAM", "Memory card"),
        "aperture": radio("implicit auto", "implicit auto"),
        "focusmode": radio("Manual", "One Shot", "AI Focus", "AI Servo", "Manual", readonly=True),
        "drivemode": radio("Timer 2 sec", "Single", "Continuous", "Timer 2 sec"),
        "aeb": radio("off", "off", "+/- 1"),
        "eosremoterelease": radio("None", "None", "Press Half AF", "Press Full AF", "Press Full MF", "Release Full"),
        "viewfinder": radio("0"),
        "datetime": {"value": 1344531602, "choices": [], "readonly": False},
    }


class ScriptedCamera:
    """Answers one request after the other."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rules: list[dict[str, Any]] = json.loads((folder / "rules.json").read_text())
        self._calls = folder / "calls.jsonl"
        self._widgets = eos_650d()
        for rule in self._rules:
            if rule["op"] == "widget":
                self._widgets[rule["name"]] = rule.get("widget")
        self._events: list[dict[str, Any]] = []

    def _count(self, request: dict[str, Any]) -> int:
        with self._calls.open("a") as stream:
            stream.write(json.dumps({**request, "pid": os.getpid()}) + "\n")
        calls = map(json.loads, self._calls.read_text().splitlines())
        return sum(call["op"] == request["op"] and call.get("name") == request.get("name") for call in calls)

    def _total(self, op: str) -> int:
        return sum(json.loads(line)["op"] == op for line in self._calls.read_text().splitlines())

    def _releases(self) -> int:
        calls = map(json.loads, self._calls.read_text().splitlines())
        return sum(call["op"] in ("trigger", "press") for call in calls)

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        op, count = request["op"], self._count(request)
        total = self._total(op)
        for rule in self._rules:
            number = count if "name" in rule else total
            named = rule.get("name") in (None, request.get("name"))
            if rule["op"] == op and named and rule.get("first", 1) <= number <= rule.get("last", 10**9):
                answer = self._fail(rule, request)
                if answer is not None:
                    return answer
        result = getattr(self, f"do_{op}")(**{k: v for k, v in request.items() if k not in ("id", "op")})
        return {"ok": result}

    def _fail(self, rule: dict[str, Any], request: dict[str, Any]) -> dict[str, Any] | None:
        match rule["do"]:
            case "error":
                error = {"code": rule["code"], "text": rule.get("text", "said so"), "log": rule.get("log", [])}
                return {"error": error}
            case "hang":
                time.sleep(600)
            case "crash":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "garbage":
                os.write(1, b"\xff" * 64)
                time.sleep(600)
            case "answer":
                return {"ok": rule["ok"]}
            case "events":
                self._events += rule["events"]
                return {"ok": None}
            case "content":
                return {"ok": self._write(request["path"], bytes.fromhex(rule["hex"]))}
        return None

    def do_hello(self) -> dict[str, Any]:
        return {"pid": os.getpid(), "library": "2.5.34", "binding": "2.6.4"}

    def do_list(self) -> list[list[str]]:
        return [["Canon EOS 650D", "usb:001,005"]]

    def do_open(self, model: str, port: str) -> None:
        self._events = []

    def do_close(self) -> None:
        self._events = []

    def do_config(self) -> dict[str, Any]:
        return {name: widget for name, widget in self._widgets.items() if widget is not None}

    def do_get(self, name: str) -> dict[str, Any]:
        return dict(self._widgets[name])

    def do_set(self, name: str, value: Any) -> dict[str, Any]:
        self._widgets[name]["value"] = value
        return dict(self._widgets[name])

    def do_press(self, name: str, values: list[str]) -> None:
        assert set(values) <= set(self._widgets[name]["choices"])
        self.do_trigger()

    def do_trigger(self) -> None:
        number = self._releases()
        self._events += [
            {"event": "other", "text": "PTP Property d101 changed"},
            {"event": "file", "folder": CARD, "name": f"IMG_{number:04}.CR2"},
            {"event": "complete"},
        ]

    def do_wait(self, timeout_s: float) -> dict[str, Any]:
        if not self._events:
            time.sleep(min(timeout_s, 0.01))
            return {"event": "timeout"}
        event = self._events.pop(0)
        if event["event"] == "pause":
            time.sleep(min(timeout_s, event["s"]))
            return {"event": "timeout"}
        return event

    def do_size(self, folder: str, name: str) -> int:
        return len(content(folder, name))

    def do_download(self, folder: str, name: str, path: str) -> dict[str, Any]:
        return self._write(path, content(folder, name))

    def _write(self, path: str, data: bytes) -> dict[str, Any]:
        Path(path).write_bytes(data)
        return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}

    def do_discard(self, folder: str, name: str) -> None:
        pass

    def do_delete(self, folder: str, name: str) -> None:
        pass

    def do_preview(self) -> str:
        return "/9j/2Q=="

    def do_storage(self) -> list[dict[str, Any]]:
        return [{"free_kb": 8_000_000, "total_kb": 16_000_000, "free_images": 321}]


def content(folder: str, name: str) -> bytes:
    """What a file in the camera holds."""
    return hashlib.sha256(f"{folder}/{name}".encode()).digest() * 50


def main() -> None:
    camera, unpacker = ScriptedCamera(Path(sys.argv[1])), Unpacker()
    while data := os.read(0, 1 << 16):
        for request in unpacker.feed(data):
            os.write(1, pack({"id": request["id"], **camera.answer(request)}))


if __name__ == "__main__":
    main()
