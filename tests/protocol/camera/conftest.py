"""Cameras for the tests: the virtual PTP camera behind the real library, and a scripted process that fails to order."""

from __future__ import annotations

import json
import random
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from rigs.gphoto2_camera import Gphoto2Camera
from rigs.gphoto2_config import CameraEvent, Gphoto2Settings
from rigs.gphoto2_faults import Fault
from rigs.protocols import Exposure

FRAME_BYTES = 300_000
EXPOSURE = Exposure(0.02, 100)


@dataclass
class VirtualCamera:
    """The virtual PTP camera of python-gphoto2: a capture copies :attr:`frame`, whatever it holds."""

    frame: Path
    settings: Gphoto2Settings

    def next_frame(self, seed: int) -> bytes:
        """Change what the next capture delivers."""
        data = random.Random(seed).randbytes(FRAME_BYTES)
        self.frame.write_bytes(data)
        return data


@pytest.fixture
def virtual(tmp_path: Path) -> VirtualCamera:
    folder = tmp_path / "virtual" / "DCIM" / "100NIKON"
    folder.mkdir(parents=True)
    environment = {"VCAMERADIR": str(tmp_path / "virtual"), "XDG_CONFIG_HOME": str(tmp_path / "xdg")}
    settings = Gphoto2Settings(
        environment=environment, arrive_timeout_s=3.0, return_timeout_s=5.0, power_cycle_timeout_s=5.0, backoff_s=0.02
    )
    camera = VirtualCamera(folder / "a.jpg", settings)
    camera.next_frame(0)
    return camera


@dataclass
class Recorder:
    """What a camera reported."""

    events: list[CameraEvent] = field(default_factory=list)
    then: Callable[[], object] = lambda: None
    """Done at each report."""

    def __call__(self, event: CameraEvent) -> None:
        self.events.append(event)
        self.then()

    @property
    def faults(self) -> list[Fault | None]:
        return [event.fault for event in self.events]


Opened = Callable[..., Gphoto2Camera]


@pytest.fixture
def reported() -> Recorder:
    return Recorder()


@pytest.fixture
def open_camera(reported: Recorder) -> Iterator[Opened]:
    """Open a camera; it is closed after the test."""
    opened: list[Gphoto2Camera] = []

    def open_it(settings: Gphoto2Settings, **more: Any) -> Gphoto2Camera:
        camera = Gphoto2Camera(settings, on_event=reported, **more)
        opened.append(camera)
        return camera

    yield open_it
    for camera in opened:
        camera.close()


@dataclass
class Scripted:
    """A camera behind a scripted process."""

    camera: Gphoto2Camera
    folder: Path

    def calls(self, op: str) -> list[dict[str, Any]]:
        lines = (self.folder / "calls.jsonl").read_text().splitlines()
        return [call for call in map(json.loads, lines) if call["op"] == op]


Script = Callable[..., Scripted]

QUICK = Gphoto2Settings(
    call_timeout_s=1.5,
    arrive_timeout_s=0.3,
    download_timeout_s=1.5,
    return_timeout_s=1.0,
    power_cycle_timeout_s=1.0,
    backoff_s=0.01,
)


@pytest.fixture
def script(tmp_path: Path, open_camera: Opened) -> Script:
    """Open a camera whose process follows these rules (see ``tests/standins/scripted_camera.py``)."""

    def run(*rules: dict[str, Any], validate: Any = None, **settings: Any) -> Scripted:
        folder = tmp_path / "script"
        folder.mkdir()
        (folder / "rules.json").write_text(json.dumps(rules))
        command = (sys.executable, "-m", "tests.standins.scripted_camera", str(folder))
        more = {} if validate is None else {"validate": validate}
        return Scripted(open_camera(replace(QUICK, **settings), worker=command, **more), folder)

    return run
