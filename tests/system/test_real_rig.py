"""Whole sessions through the real drivers: libgphoto2 with its virtual camera, GRBL on a tty, a panel in Chromium."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import arguments, call, done

from rigs.protocols import Pattern
from rigs.simulated.scene import Scene
from rigs.simulated.scenes import scene_by_name
from tests.browser.conftest import ARGUMENTS, CHROMIUM
from tests.standins.dark_room import DarkRoom
from tests.standins.grbl_firmware import GrblFirmware
from tests.standins.pty_server import PtyServer
from tests.standins.rail import Rail
from tests.standins.tablet import PIXEL_RATIO, VIEWPORT, Tablet
from workbench import devices
from workbench.config import load_rig_config
from workbench.devices import simulated_world

DEPTHS = ("--from", "80cm", "--to", "280cm", "--step", "50cm")
"""Five: the fewest from which the stage's zero is found."""
CAMERA = "  kind: gphoto2\n  model: d750\n  pixel_pitch: 4.3 um\n  restart_every: 20\n"
FAST = {110: 600000.0, 120: 100000.0, 24: 60000.0, 25: 600000.0, 26: 2}
"""10 m/s: a rail on which moves take milliseconds."""
OFFSET_MM = 3405.0
PARKED_MM = 2905.0
"""Where the carriage is at machine position 0."""


def choose(project: Path, section: str, text: str) -> None:
    """Write another section into the project's rig.yaml."""
    path = project / "rig.yaml"
    before, _, rest = path.read_text().partition(f"\n{section}:\n")
    after = rest.partition("\n\n")[2]
    path.write_text(f"{before}\n{section}:\n{text}\n{after}")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def records(project: Path, kind: str = "") -> list[dict[str, Any]]:
    lines = (project / "sessions" / "s0001" / "journal.jsonl").read_text().splitlines()
    return [record for record in map(json.loads, lines) if not kind or record["type"] == kind]


@pytest.fixture
def card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Card of the virtual camera, which is the only one plugged in."""
    monkeypatch.setenv("VCAMERADIR", str(tmp_path / "virtual"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "xdg"))
    return tmp_path / "virtual" / "DCIM" / "100NIKON"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project with a camera on USB, and else simulated devices."""
    root = tmp_path / "project"
    done("init", root)
    choose(root, "camera", CAMERA)
    return root


@pytest.fixture
def room(card: Path, project: Path, monkeypatch: pytest.MonkeyPatch) -> DarkRoom:
    """Simulated stage and panel, photographed by the virtual camera."""
    world = simulated_world(load_rig_config(project / "rig.yaml"))
    made = DarkRoom(card, world)
    made.look_through_every_shutter(monkeypatch)
    monkeypatch.setattr(devices, "simulated_world", lambda _: world)
    return made


@pytest.fixture
def rail() -> Iterator[PtyServer]:
    with PtyServer(GrblFirmware(Rail(carriage_mm=60.0), FAST)) as line:
        yield line


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The bank that simulated devices make of the same plan."""
    root = tmp_path_factory.mktemp("simulated") / "project"
    done("init", root)
    return done("-C", root, "calibrate", *DEPTHS, "--repeats", "1", "--json").only


def assert_as_good(bank: dict[str, Any], wanted: dict[str, Any]) -> None:
    """The same lens and stage are found, within their standard errors, and from as good PSFs."""
    lens, lens_wanted = bank["lens"], wanted["lens"]
    for name in ("focus", "zero"):
        se = (lens[f"{name}_se_mm"] ** 2 + lens_wanted[f"{name}_se_mm"] ** 2) ** 0.5
        assert lens[f"{name}_mm"] == pytest.approx(lens_wanted[f"{name}_mm"], abs=2 * se)
        assert lens[f"{name}_se_mm"] < 2 * lens_wanted[f"{name}_se_mm"]
    assert lens["zero_mm"] == pytest.approx(7.0, abs=2 * lens["zero_se_mm"])
    assert bank["quality"]["verdict"] == "good"
    assert bank["quality"]["figures"]["residual_rms_px"] < 2 * wanted["quality"]["figures"]["residual_rms_px"] + 0.01
    assert bank["depths_mm"] == pytest.approx(wanted["depths_mm"], abs=1.0)


def test_calibration_through_the_virtual_camera_equals_the_simulated_one(
    project: Path, room: DarkRoom, simulated: dict[str, Any]
) -> None:
    bank = done("-C", project, "calibrate", *DEPTHS, "--repeats", "3", "--json").only
    assert room.frames > 27  # more than one process of the virtual camera takes
    assert_as_good(bank, simulated)
    assert bank["camera"]["serial"] == "0.1"
    shots = records(project, "shot")
    assert len(shots) == 20
    assert {shot["settings"]["capture_target"] for shot in shots} == {"Memory card"}
    assert {shot["time_s"] for shot in shots} <= {0.05, 0.1, 1.0}
    assert records(project, "started")[0]["devices"]["camera"]["model"] == "Nikon DSC D750"
    assert not list(project.rglob(".part*"))


def test_calibration_through_all_real_drivers_equals_the_simulated_one(
    project: Path, card: Path, rail: PtyServer, simulated: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("playwright.sync_api", reason="playwright isn't installed (pip install playwright)")
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine (Debian: apt install chromium)")
    firmware, port = rail.device, free_port()
    assert isinstance(firmware, GrblFirmware)
    choose(project, "stage", f"  kind: grbl\n  port: {rail.path}\n  depth: {{offset: {OFFSET_MM} mm}}\n")
    choose(project, "panel", f"  kind: browser\n  port: {port}\n  pixel_pitch: 0.1 mm\n")
    world = simulated_world(load_rig_config(project / "rig.yaml"))
    monkeypatch.setattr(devices, "simulated_world", None)  # real devices need no simulated world
    with Tablet(f"http://127.0.0.1:{port}/panel", CHROMIUM, ARGUMENTS) as tablet:
        room = DarkRoom(card, world)
        room.position_mm = lambda: firmware.rail.carriage_mm - PARKED_MM
        room.pattern = tablet.pattern
        room.look_through_every_shutter(monkeypatch)
        transcript = done("-C", project, "calibrate", *DEPTHS, "--repeats", "1")
    print(transcript.err + transcript.out)  # docs/reference/real-rig-transcript.md shows it: pytest -rP
    bank = done("-C", project, "bank", "show", "--json").only
    assert_as_good(bank, simulated)
    assert firmware.machine_mm == pytest.approx(2800 - OFFSET_MM, abs=0.02)
    said = records(project, "started")[0]["devices"]
    assert [said[name]["kind"] for name in ("camera", "stage", "panel")] == ["gphoto2", "grbl", "browser"]
    width, height = (PIXEL_RATIO * VIEWPORT[side] for side in ("width", "height"))
    assert said["panel"]["extra"]["size_px"] == f"{width}x{height}"


def test_a_damaged_frame_is_taken_again_and_the_journal_says_so(project: Path, room: DarkRoom) -> None:
    room.spoil = lambda number, data: data[: len(data) // 2] + bytes(len(data) // 2) if number == 4 else data
    outcome = done("-C", project, "calibrate", "--from", "130cm", "--to", "230cm", "--step", "50cm", "--repeats", "1")
    (again, anew) = records(project, "event")
    assert again["fault"] == anew["fault"] == "frame is damaged"
    assert (again["remedy"], anew["remedy"]) == ("trying again", "taking the frame again")
    assert again["message"] in outcome.err.splitlines()
    assert len(records(project, "shot")) == 6


def test_a_camera_that_stays_broken_ends_the_session_with_the_way_out_and_it_is_resumed(
    project: Path, room: DarkRoom
) -> None:
    plan = ("--from", "130cm", "--to", "230cm", "--step", "50cm", "--repeats", "1")
    room.spoil = lambda number, data: bytes(len(data)) if number >= 4 else data
    stopped = call("-C", project, "calibrate", *plan)
    assert stopped.code == 4
    last = stopped.err.splitlines()[-1]
    assert last.startswith(
        "workbench: camera: the frame that arrived can't be used: check cable, card and image format"
    )
    assert last.endswith(", then `workbench resume`")
    assert "Traceback" not in stopped.err
    assert records(project)[-1]["type"] == "failed"
    taken = len(records(project, "shot"))
    assert 0 < taken < 6
    room.spoil = lambda _, data: data
    done("-C", project, "resume")
    assert len(records(project, "shot")) == 6


def test_another_camera_than_the_one_named_is_refused_before_anything_moves(
    project: Path, room: DarkRoom, rail: PtyServer
) -> None:
    choose(project, "camera", CAMERA.replace("d750", "650D"))
    choose(project, "stage", f"  kind: grbl\n  port: {rail.path}\n  depth: {{offset: {OFFSET_MM} mm}}\n")
    stopped = call("-C", project, "calibrate", *DEPTHS)
    assert stopped.code == 4
    assert "no '650D'; found Nikon DSC D750 at usb:001,001; correct camera.model" in stopped.err
    assert not (project / "sessions").exists()
    assert rail.sent == b""


def test_a_camera_that_is_set_up_wrongly_is_told_before_anything_moves(
    project: Path, room: DarkRoom, rail: PtyServer
) -> None:
    choose(project, "camera", CAMERA + "  aperture: 1.2\n")
    choose(project, "stage", f"  kind: grbl\n  port: {rail.path}\n  depth: {{offset: {OFFSET_MM} mm}}\n")
    stopped = call("-C", project, "calibrate", *DEPTHS)
    assert stopped.code == 4
    assert "no aperture f/1.2; set camera.aperture to one that it offers: f/2.8" in stopped.err
    assert not (project / "sessions").exists()
    assert b"$H" not in rail.sent


def test_a_plan_for_a_real_camera_needs_no_camera(project: Path) -> None:
    choose(project, "camera", CAMERA.replace("d750", "650D"))
    cost = done("-C", project, "plan", *DEPTHS, "--repeats", "1", "--json").only
    assert len(cost["shots"]) == 10
    assert cost["bytes"] == pytest.approx(22.5 * 5184 * 3456 * 1.2, rel=1e-3)


def test_capture_photographs_and_measures_without_a_simulated_world(
    lab: Path, tmp_path: Path, card: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = tmp_path / "lab"
    shutil.copytree(lab / "banks", project / "banks")
    shutil.copy(lab / "rig.yaml", project)
    choose(project, "camera", CAMERA)
    world = simulated_world(load_rig_config(project / "rig.yaml"))
    world.subject = scene_by_name("four-objects", 1)
    assert isinstance(world.subject, Scene)
    DarkRoom(card, world).look_through_every_shutter(monkeypatch)
    monkeypatch.setattr(devices, "simulated_world", None)
    outcome = done("-C", project, "capture", "--roi", "20,20,96,96", "--method", "sharpness", "--json")
    (path,) = (project / "photographs").iterdir()
    assert path.name in outcome.err
    assert outcome.only["image"].endswith(path.name)
    assert len(outcome.only["regions"]) == 1


def child_of(process: int) -> int:
    """Process id of the camera's process."""
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            text, command = status.read_text(), (status.parent / "cmdline").read_bytes()
        except OSError:  # it has just ended
            continue
        if int(text.rpartition(")")[2].split()[1]) == process and b"gphoto2_worker" in command:
            return int(status.parent.name)
    raise AssertionError("no camera process")


def test_ctrl_c_while_a_call_to_the_camera_hangs_ends_the_session_and_stops_the_stage(
    project: Path, card: Path, rail: PtyServer
) -> None:
    choose(project, "stage", f"  kind: grbl\n  port: {rail.path}\n  depth: {{offset: {OFFSET_MM} mm}}\n")
    world = simulated_world(load_rig_config(project / "rig.yaml"))
    world.carry_to(800.0)
    world.pattern = Pattern("dot")
    DarkRoom(card, world).hand_over(0.1)  # this frame is delivered over and over
    process = subprocess.Popen(
        arguments("-C", project, "calibrate", *DEPTHS), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        journal = project / "sessions" / "s0001" / "journal.jsonl"
        for _ in range(1000):
            assert process.poll() is None, process.communicate()[1][-2000:]
            if journal.is_file() and journal.read_bytes().count(b'"type":"shot"') >= 2:
                break
            time.sleep(0.02)
        camera = child_of(process.pid)
        os.kill(camera, signal.SIGSTOP)  # as a call does that never comes back from the library
        time.sleep(0.5)
        sent_before = len(rail.sent)
        started = time.monotonic()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130
    assert time.monotonic() - started < 15  # call_timeout is 30 s
    assert err.splitlines()[-1].startswith("workbench: interrupted; `workbench resume`")
    assert "Traceback" not in err
    assert out == ""
    assert records(project)[-1]["type"] == "interrupted"
    assert b"!" in rail.sent[sent_before:]
    with pytest.raises(ProcessLookupError):
        os.kill(camera, 0)
