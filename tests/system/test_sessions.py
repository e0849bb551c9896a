"""Sessions that are interrupted, killed, spoilt, and go on."""

from __future__ import annotations

import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import FEW, arguments, call, done, listing, refused

from rigs.errors import NotAcknowledgedError
from rigs.protocols import CaptureResult, Exposure
from rigs.simulated.devices import SimulatedCamera, SimulatedPanel

SHOTS = 8


@pytest.fixture
def root(tmp_path: Path) -> Path:
    done("init", tmp_path / "project")
    return tmp_path / "project"


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "copied"))


def _interrupt_at(patch: pytest.MonkeyPatch, capture: int, *, after: bool) -> None:
    """Press Ctrl-C before or after the camera's n-th frame."""
    real, count = SimulatedCamera.capture, iter(range(1, 1000))

    def captured(self: SimulatedCamera, exposure: Exposure, destination: Path) -> CaptureResult:
        now = next(count) == capture
        if now and not after:
            raise KeyboardInterrupt
        result = real(self, exposure, destination)
        if now:
            raise KeyboardInterrupt
        return result

    patch.setattr(SimulatedCamera, "capture", captured)


@pytest.mark.parametrize(("capture", "after"), [(4, True), (9, False)])
def test_an_interrupted_session_resumes_to_the_same_bank(
    root: Path, wanted: str, capture: int, after: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        _interrupt_at(patch, capture, after=after)
        stopped = call("-C", root, "calibrate", *FEW, "--json")
    assert stopped.code == 130
    assert stopped.out == ""
    assert "resume" in stopped.err.splitlines()[-1]
    assert "Traceback" not in stopped.err
    assert not (root / "banks").exists()
    resumed = done("-C", root, "resume", "--json")
    assert resumed.only["id"] == wanted
    assert not list((root / "sessions").rglob(".*"))


def test_a_frame_during_which_the_panel_went_dark_is_taken_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looks = iter(range(1, 1000))

    def asleep_once(_: SimulatedPanel) -> None:
        if next(looks) == 5:
            raise NotAcknowledgedError("panel: not seen to the end of the exposure: the page is hidden")

    monkeypatch.setattr(SimulatedPanel, "check_shown", asleep_once)
    outcome = done("-C", root, "calibrate", *FEW, "--json")
    assert "the page is hidden; trying again (1 of 2)" in outcome.err
    assert '"type":"event"' in (root / "sessions" / "s0001" / "journal.jsonl").read_text()


def _wait_for_shot(root: Path, process: subprocess.Popen[str], shots: int) -> None:
    journal = root / "sessions" / "s0001" / "journal.jsonl"
    for _ in range(2000):
        if journal.is_file() and journal.read_bytes().count(b'"type":"shot"') >= shots:
            return
        assert process.poll() is None, "the session ended before it could be stopped"
        time.sleep(0.02)
    raise AssertionError("the session takes too long")


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_process_that_is_stopped_resumes_to_the_same_bank(root: Path, wanted: str, kind: signal.Signals) -> None:
    process = subprocess.Popen(
        arguments("-C", root, "calibrate", *FEW, "--json"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        _wait_for_shot(root, process, 2)
        process.send_signal(kind)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert out == ""
    assert process.returncode == (-signal.SIGKILL if kind == signal.SIGKILL else 130)
    if kind != signal.SIGKILL:
        assert err.splitlines()[-1].startswith("workbench: interrupted")
        assert "Traceback" not in err
    assert f"session s0001 1/{SHOTS}" in err
    assert "\x1b" not in err
    resumed = done("-C", root, "resume", "s0001", "--json")
    assert resumed.only["id"] == wanted
    assert f"{SHOTS}/{SHOTS}" in resumed.err


def test_a_session_that_lost_or_changed_frames_takes_them_again(copied: Path, wanted: str) -> None:
    frames = copied / "sessions" / "s0001" / "frames"
    before = {path.name: path.read_bytes() for path in frames.iterdir()}
    (frames / "point-08000-1.dng").unlink()
    changed = bytearray(before["off-13000-1.dng"])
    changed[-1000] ^= 1
    (frames / "off-13000-1.dng").write_bytes(changed)
    (frames / "point-18000-1.dng").write_bytes(before["point-18000-1.dng"][:1000])
    resumed = done("-C", copied, "resume", "--json")
    assert resumed.only["id"] == wanted
    assert resumed.err.count("taken again") == 3
    assert {path.name: path.read_bytes() for path in frames.iterdir()} == before


def test_a_finished_session_that_is_resumed_takes_nothing_and_makes_the_same_bank(
    copied: Path, wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SimulatedCamera, "capture", None)
    resumed = done("-C", copied, "resume", "--json").only
    assert (resumed["id"], resumed["version"]) == (wanted, 1)


def test_a_torn_last_record_is_taken_again(copied: Path, wanted: str) -> None:
    journal = copied / "sessions" / "s0001" / "journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    cut = max(k for k, line in enumerate(lines) if b'"type":"shot"' in line)
    journal.write_bytes(b"".join(lines[:cut]) + lines[cut][:40])
    resumed = done("-C", copied, "resume", "--json")
    assert resumed.only["id"] == wanted


def _damaged(lines: list[bytes]) -> Iterator[list[bytes]]:
    yield [*lines[:3], b"nonsense\n", *lines[4:]]
    yield [*lines[:3], *lines[4:]]
    yield [*lines[:3], lines[3].replace(b'"type":"', b'"type":"x'), *lines[4:]]
    yield [lines[1], lines[0], *lines[2:]]
    yield [b"\xff\xfe\n", *lines[1:]]
    yield [b"[]\n", *lines[1:]]
    yield [*lines[:-1], lines[-1].replace(b'"shots":8', b'"shots":9')]


def test_a_damaged_journal_is_refused_and_left_alone(copied: Path) -> None:
    journal = copied / "sessions" / "s0001" / "journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    for damaged in _damaged(lines):
        journal.write_bytes(b"".join(damaged))
        before = listing(copied)
        refused(call("-C", copied, "resume"), "journal.jsonl", "record", "calibrate")
        assert listing(copied) == before


def test_a_plan_that_was_changed_or_broken_is_refused(copied: Path) -> None:
    plan = copied / "sessions" / "s0001" / "plan.json"
    text = plan.read_text()
    for changed in (text.replace("800.0", "810.0"), text[:100], "", "[]", "\x00"):
        plan.write_text(changed)
        before = listing(copied)
        refused(call("-C", copied, "resume"), "plan")
        assert listing(copied) == before


def test_a_session_that_does_not_exist_is_named(copied: Path, tmp_path: Path) -> None:
    before = listing(copied)
    for name in ("s0009", "nonsense", "../s0001", ""):
        refused(call("-C", copied, "resume", name), name or "session")
    assert listing(copied) == before
    done("init", tmp_path / "fresh")
    refused(call("-C", tmp_path / "fresh", "resume"), "no session", "calibrate")


def test_a_session_of_another_camera_is_refused(copied: Path) -> None:
    rig = copied / "rig.yaml"
    rig.write_text(rig.read_text().replace("seed: 1", "seed: 2"))
    (copied / "sessions" / "s0001" / "frames" / "point-08000-1.dng").unlink()
    before = listing(copied)
    refused(call("-C", copied, "resume"), "SIM000001", "SIM000002")
    assert listing(copied) == before


@pytest.mark.parametrize(
    ("wishes", "words"),
    [
        (("--from", "10 stone"), ("--from", "unit")),
        (("--from", "300cm", "--to", "100cm"), ("ascending",)),
        (("--from", "80cm", "--to", "100cm", "--step", "50cm"), ("at least 3",)),
        (("--step", "0cm"), ("--step",)),
        (("--from", "0.6", "--to", "3.5", "--step", "0.1"), ("unit",)),
        (("--repeats", "0"), ("--repeats",)),
        (("--from", "30cm", "--to", "200cm"), ("out of reach", "--from")),
        (("--to", "900cm"), ("out of reach", "--to")),
    ],
)
def test_depths_that_cannot_be_start_no_session(root: Path, wishes: tuple[str, ...], words: tuple[str, ...]) -> None:
    before = listing(root)
    refused(call("-C", root, "calibrate", *wishes), *words)
    assert listing(root) == before


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("repeats: 2", "repeets: 2", ("calibration", "'repeets'", "'repeats'")),
        ("repeats: 2", "repeats: two", ("calibration.repeats", "'two'")),
        ("from: 60 cm", "from: 60 kg", ("calibration.from", "'kg'")),
        ("from: 60 cm", "from: 60", ("calibration.from", "no unit")),
        ("camera:\n  kind: simulated", "camera:\n  kind: film", ("camera.kind", "'film'")),
        ("seed: 1", "seed: [1", ("YAML",)),
        ("optics:", "optic:", ("'optic'", "'optics'")),
        ("scene: four-objects", "scene: five-objects", ("scene", "five-objects")),
        ("focus: 160 cm", "focus: -160 cm", ("simulation.focus",)),
        ("focal_length: 50 mm", "focal_length: 0 mm", ("optics.focal_length",)),
        ("size: auto", "size: -3", ("panel.dot.size",)),
        ("pixel_pitch: 4.3 um", "pixel_pitch: 0 um", ("camera.pixel_pitch",)),
    ],
)
def test_a_wrong_rig_file_is_refused_by_every_command_that_reads_it(
    project: Path, old: str, new: str, words: tuple[str, ...]
) -> None:
    rig = project / "rig.yaml"
    assert old in rig.read_text()
    rig.write_text(rig.read_text().replace(old, new))
    before = listing(project)
    commands = (("capture", "--whole"),) if "scene:" in old else (("plan",), ("calibrate",), ("capture", "--whole"))
    for command in commands:
        refused(call("-C", project, *command), *words)
    assert listing(project) == before
