"""The doctor's look at a camera: through its process, with the troubles that keep it from being opened."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from tests.protocol.camera.conftest import QUICK, VirtualCamera
from workbench.doctor.camera import permission_findings, usb_camera_findings
from workbench.doctor.camera_facts import Demand
from workbench.doctor.findings import Finding

NOW = datetime(2026, 5, 4, 12, 0)
DEMAND = Demand(frames=120, bytes=2e9, iso=100)
Look = Callable[..., dict[str, Finding]]


@pytest.fixture
def look(tmp_path: Path) -> Look:
    """Check a camera whose process follows these rules."""

    def at(*rules: dict[str, Any], programs: tuple[str, ...] = ()) -> dict[str, Finding]:
        (tmp_path / "rules.json").write_text(json.dumps(rules))
        worker = (sys.executable, "-m", "tests.standins.scripted_camera", str(tmp_path))
        _, found = usb_camera_findings(QUICK, DEMAND, now=NOW, programs=programs, worker=worker)
        return {finding.check: finding for finding in found}

    return at


def calls(tmp_path: Path) -> list[str]:
    return [json.loads(line)["op"] for line in (tmp_path / "calls.jsonl").read_text().splitlines()]


def test_camera_is_read_and_left_as_it_was(look: Look, tmp_path: Path) -> None:
    found = look()
    assert found["mode dial"].seen == "Manual"
    assert found["image format"].seen == "RAW is offered, and will be set (now Large Fine JPEG)"
    assert found["iso"].seen == "100 is offered (100 to 12800)"
    assert not any(finding.severity.word == "error" for finding in found.values())
    assert set(calls(tmp_path)) <= {"list", "open", "config", "hello", "storage", "close"}


def test_camera_held_by_the_desktop_names_the_program_and_the_command(look: Look) -> None:
    held = {"op": "open", "do": "error", "code": -53, "text": "Could not claim the USB device"}
    found = look(held, programs=("gvfsd-gphoto2", "gvfs-gphoto2-volume-monitor"))
    assert found["connection"].severity.word == "error"
    assert "gio mount -s gphoto2" in found["connection"].mend
    assert found["other programs"].severity.word == "error"
    assert "gvfsd-gphoto2" in found["other programs"].seen
    assert "gio mount -s gphoto2" in found["other programs"].mend


def test_desktop_that_does_not_hold_the_camera_now_is_a_note(look: Look) -> None:
    assert look(programs=("gvfs-gphoto2-volume-monitor",))["other programs"].severity.word == "note"


def test_other_camera_program_is_a_warning(look: Look) -> None:
    found = look(programs=("darktable",))["other programs"]
    assert found.severity.word == "warning"
    assert found.mend == "close it"


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        ({"op": "list", "do": "answer", "ok": []}, "none found"),
        ({"op": "open", "do": "error", "code": -10, "text": "Timeout"}, "doesn't answer any more"),
        ({"op": "config", "do": "hang"}, "hung"),
        ({"op": "open", "do": "crash"}, "crashed"),
    ],
)
def test_camera_that_cannot_be_opened_is_one_finding_with_a_way_out(
    look: Look, rule: dict[str, Any], words: str
) -> None:
    found = look(rule)
    assert words in found["connection"].seen
    assert found["connection"].severity.word == "error"
    assert found["connection"].mend
    assert set(found) == {"connection", "other programs"}


def test_usb_device_without_permission_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = tmp_path / "001" / "005"
    node.parent.mkdir()
    node.touch()
    in_sight = ("Canon EOS 650D at usb:001,005", "Virtual at disk:/tmp", "Gone at usb:001,007")
    assert permission_findings(in_sight, tmp_path) == []
    monkeypatch.setattr("os.access", lambda *_: False)
    (finding,) = permission_findings(in_sight, tmp_path)
    assert finding.seen == f"no permission for {node}"
    assert "udev" in finding.mend


def test_virtual_camera_through_the_real_library(virtual: VirtualCamera) -> None:
    facts, found = usb_camera_findings(virtual.settings, DEMAND, now=datetime.now(), programs=())
    assert facts is not None
    by_check = {finding.check: finding for finding in found}
    assert by_check["connection"].seen.startswith("Nikon DSC D750")
    assert by_check["exposure times"].severity.word == "ok"
    assert by_check["clock"].severity.word == "ok"
    assert by_check["iso"].severity.word == "note"
