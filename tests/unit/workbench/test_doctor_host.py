"""Disk, clock, versions, and the programs that grab cameras."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import NamedTuple

import pytest

from workbench.doctor.findings import Finding
from workbench.doctor.host import computer_findings, newest_file_s, versions
from workbench.doctor.processes import camera_programs, desktop_mounts, running

NOW_S = 1.8e9


class Usage(NamedTuple):
    total: int
    used: int
    free: int


def findings(
    root: Path, need_bytes: float = 1e9, *, installed: dict[str, str] | None = None, newest_file_s: float = NOW_S - 60
) -> dict[str, Finding]:
    made = computer_findings(
        root, need_bytes, installed=installed or versions(), now_s=NOW_S, newest_file_s=newest_file_s
    )
    return {finding.check: finding for finding in made}


@pytest.mark.parametrize(("free", "severity"), [(0.9e9, "error"), (1.2e9, "warning"), (2e9, "ok")])
def test_disk_has_to_hold_the_plans_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: float, severity: str
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**10, 0, int(free)))
    disk = findings(tmp_path)["disk"]
    assert disk.severity.word == severity
    assert "about 1.0 GB" in disk.seen


def test_project_that_cannot_be_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    disk = findings(tmp_path)["disk"]
    assert disk.severity.word == "error"
    assert str(tmp_path) in disk.seen


def test_clock_before_the_newest_file_is_wrong(tmp_path: Path) -> None:
    assert findings(tmp_path, newest_file_s=NOW_S + 30)["clock"].severity.word == "ok"  # within the slack
    clock = findings(tmp_path, newest_file_s=NOW_S + 7200)["clock"]
    assert clock.severity.word == "warning"
    assert "2 h 00 min before" in clock.seen


def test_newest_file_is_looked_for_in_project_and_program(tmp_path: Path) -> None:
    program_s = newest_file_s(tmp_path)
    assert program_s > 1.6e9
    (tmp_path / "rig.yaml").touch()
    os.utime(tmp_path / "rig.yaml", (program_s + 500, program_s + 500))
    assert newest_file_s(tmp_path) == program_s + 500


def test_missing_library_is_an_error_unless_only_a_camera_needs_it(tmp_path: Path) -> None:
    installed = versions()
    assert all(installed[name] for name in ("workbench", "python", "numpy", "pyserial"))
    assert findings(tmp_path, installed=installed | {"gphoto2": ""})["versions"].severity.word == "ok"
    missing = findings(tmp_path, installed=installed | {"rawpy": ""})["versions"]
    assert missing.severity.word == "error"
    assert "rawpy" in missing.seen


def test_programs_are_read_from_the_process_table(tmp_path: Path) -> None:
    for number, command in enumerate((b"/usr/libexec/gvfsd-gphoto2\0--spawner\0", b"/usr/bin/darktable\0", b"")):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "cmdline").write_bytes(command)
    (tmp_path / "99").mkdir()  # has ended meanwhile
    found = running(tmp_path)
    assert found == ("darktable", "gvfsd-gphoto2")
    assert desktop_mounts(found) == ["gvfsd-gphoto2"]
    assert camera_programs(found) == ["darktable"]
