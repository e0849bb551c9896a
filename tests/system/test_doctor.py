"""What the operator reads of a rig's trouble before a calibration is started."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from command_line import Outcome, call, done, listing

from tests.standins.grbl_firmware import GrblFirmware
from tests.standins.pty_server import PtyServer
from tests.standins.rail import Rail

GRBL = "  kind: grbl\n  port: {port}\n  depth: {{offset: 3505 mm}}\n"


def found(outcome: Outcome) -> dict[str, dict[str, str]]:
    """Findings by id."""
    return {finding["id"]: finding for finding in outcome.only["findings"]}


def rewrite(project: Path, section: str, lines: str) -> None:
    """Write a section of rig.yaml anew."""
    text = (project / "rig.yaml").read_text()
    before, rest = text.split(f"\n{section}:\n")
    after = rest.split("\n\n", 1)[1]
    (project / "rig.yaml").write_text(f"{before}\n{section}:\n{lines}\n{after}")


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A new project on the simulated rig."""
    done("init", tmp_path / "rig")
    return tmp_path / "rig"


OnGrbl = Callable[..., AbstractContextManager[tuple[PtyServer, Path]]]


@pytest.fixture
def on_grbl(rig: Path) -> OnGrbl:
    """Plug a GRBL rail into the project."""

    @contextmanager
    def plug_in(more: str = "", **settings: Any) -> Iterator[tuple[PtyServer, Path]]:
        numbers = {130: 3000.0} | {int(name[1:]): value for name, value in settings.items()}
        with PtyServer(GrblFirmware(Rail(carriage_mm=60.0), numbers)) as line:
            rewrite(rig, "stage", GRBL.format(port=line.path) + more)
            yield line, rig

    return plug_in


def unmoved(line: PtyServer) -> bool:
    firmware = line.device
    assert isinstance(firmware, GrblFirmware)
    asked = bytes(line.sent).replace(b"?", b"")
    return firmware.rail.carriage_mm == 60.0 and not any(word in asked for word in (b"$H", b"$X", b"$J", b"G"))


def test_simulated_rig_is_ready_and_says_what_is_missing(rig: Path) -> None:
    before = listing(rig)
    outcome = done("-C", rig, "doctor")
    assert outcome.out.splitlines()[-1].endswith("Ready to calibrate.")
    assert "none is active" in outcome.out
    assert "`workbench calibrate` makes one" in outcome.out
    assert listing(rig) == before


def test_json_is_one_object_in_a_fixed_form(rig: Path) -> None:
    answer = done("-C", rig, "doctor", "--json").only
    assert list(answer) == ["ready", "worst", "counts", "devices", "plugged_in", "findings"]
    assert answer["ready"] is True
    assert answer["worst"] == "note"
    assert answer["devices"] == {"camera": "simulated", "stage": "simulated", "panel": "simulated"}
    assert set(answer["plugged_in"]) == {"cameras", "serial_ports", "browsers"}
    words = ["ok", "note", "warning", "error"]
    assert list(answer["counts"]) == words
    for finding in answer["findings"]:
        assert list(finding) == ["id", "severity", "seen", "mend"]
        assert finding["severity"] in words
        assert finding["seen"]
        assert finding["mend"] or finding["severity"] in ("ok", "note")
    assert sum(answer["counts"].values()) == len(answer["findings"])
    subjects = [finding["id"].split(".")[0] for finding in answer["findings"]]
    assert list(dict.fromkeys(subjects)) == ["project", "computer", "camera", "stage", "panel"]


def test_calibrated_project_has_its_bank_verified(project: Path) -> None:
    bank = found(done("-C", project, "doctor", "--json"))["project.bank"]
    assert bank["severity"] == "ok"
    assert "every byte" in bank["seen"]
    psf = next((project / "banks").rglob("psf.npy"))
    psf.write_bytes(psf.read_bytes()[:-1] + b"x")
    bank = found(done("-C", project, "doctor", "--json"))["project.bank"]
    assert bank["severity"] == "warning"
    assert "psf.npy" in bank["seen"]


def test_rail_after_power_up_is_ready_and_nothing_moves(on_grbl: OnGrbl) -> None:
    with on_grbl() as (line, rig):
        findings = found(done("-C", rig, "doctor", "--json"))
        assert unmoved(line)
    assert findings["stage.connection"]["seen"].startswith("GRBL, firmware 1.1h")
    assert findings["stage.state"]["severity"] == "note"
    assert "locked until it is homed" in findings["stage.state"]["seen"]
    assert findings["stage.homing"]["severity"] == findings["stage.soft-limits"]["severity"] == "ok"
    assert findings["stage.travel"]["seen"] == "reaches 51 cm to 350 cm; the plan needs 60 cm to 350 cm"


def test_rail_deaf_in_an_alarm_is_told(on_grbl: OnGrbl) -> None:
    with on_grbl() as (line, rig):
        assert isinstance(line.device, GrblFirmware)
        with line.lock:
            line.device._kill("Alarm", 1)
        findings = found(call("-C", rig, "doctor", "--json"))
        assert unmoved(line)
    assert "deaf until it was reset" in findings["stage.last-alarm"]["seen"]
    assert "look why" in findings["stage.last-alarm"]["mend"]
