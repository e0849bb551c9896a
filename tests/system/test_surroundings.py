"""Odd places and surroundings: names, directories, pipes, missing homes, no terminal."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import arguments, call, done, listing, refused, spawn

from workbench.project import Project, create_project

QUICK = ("--roi", "0,0,64,64", "--method", "sharpness", "--set", "iterations=2")


def test_paths_with_spaces_and_accents(lab: Path, photograph: Path, tmp_path: Path) -> None:
    root = tmp_path / "Prüfstand Nº 1"
    done("-C", root, "init", ".")
    shutil.copytree(lab / "banks", root / "banks")
    scene = Path(shutil.copy(photograph, root / "Vase & Käse.dng"))
    outcome = spawn("-C", root.name, "--json", "measure", scene.name, *QUICK, cwd=tmp_path)
    assert outcome.code == 0, outcome.err
    found = outcome.only
    assert "Käse" in found["image"]
    assert (root / found["files"]["report"]).is_file()
    assert "Käse" in (root / found["files"]["report"]).read_text(encoding="utf-8")


def test_global_options_stand_before_or_after_the_command(lab: Path, tmp_path: Path) -> None:
    first = done("--json", "-C", lab, "bank", "show").only
    assert done("bank", "show", "--json", "-C", lab, cwd=tmp_path).only == first
    assert done("-C", lab, "bank", "--json", "show").only == first
    assert done("bank", "-C", lab, "show", "--json").only == first


def test_files_are_looked_for_here_and_then_in_the_project(lab: Path, project: Path, photograph: Path) -> None:
    shutil.copytree(photograph.parent, project / "photographs")
    found = done("-C", project.name, "measure", "photographs/photograph-0001.dng", *QUICK, "--json", cwd=project.parent)
    assert found.only["files"]["report"].startswith("measurements/")
    (project.parent / "elsewhere").mkdir()
    refused(call("-C", project.name, "measure", "nowhere.dng", cwd=project.parent), "nowhere.dng", "no such")


@pytest.mark.parametrize(
    "command",
    [
        ("plan",), ("calibrate",), ("resume",), ("measure", "x.dng"), ("capture",), ("bank", "list"), ("bank", "show"),
        ("bank", "import", "x.npy"), ("bank", "export", "v1", "x.npz"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_a_directory_that_is_no_project_is_named_with_the_way_out(tmp_path: Path, command: tuple[str, ...]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    before = listing(tmp_path)
    for name in ("empty", "absent", "file"):
        refused(call("-C", name, *command, cwd=tmp_path), name, "workbench init")
    assert listing(tmp_path) == before


def test_a_project_without_a_bank_says_how_to_get_one(photograph: Path, tmp_path: Path) -> None:
    done("init", tmp_path)
    before = listing(tmp_path)
    for command in (("measure", photograph), ("capture",), ("bank", "show"), ("bank", "export", "active", "x.npz")):
        refused(call("-C", tmp_path, *command), "no bank", "calibrate")
    assert listing(tmp_path) == before
    assert done("-C", tmp_path, "bank", "list", "--json").out == ""


def test_unknown_commands_and_options_are_one_line(tmp_path: Path) -> None:
    refused(call("mesure"), "mesure", "help")
    refused(call("plan", "--speed", "fast"), "--speed")
    refused(call("measure"), "RAW")
    refused(call("bank", "frobnicate"), "frobnicate")
    refused(call("init"), "DIR")


def test_a_reader_that_leaves_early_is_no_error(lab: Path) -> None:
    for command in (("bank", "show"), ("--json", "bank", "list"), ("--help",)):
        process = subprocess.Popen(
            arguments("-C", lab, *command), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        said = process.stderr.read()
        assert process.wait() == 0, said
        assert said == ""


def test_without_a_home_or_a_place_for_caches(lab: Path, project: Path, photograph: Path) -> None:
    nowhere = "/nonexistent"
    bare = {"HOME": nowhere, "XDG_CACHE_HOME": nowhere, "MPLCONFIGDIR": nowhere, "NUMBA_CACHE_DIR": nowhere}
    outcome = spawn("-C", project, "measure", photograph, "--roi", "0,0,64,64", "--json", env=bare)
    assert outcome.code == 0, outcome.err
    assert outcome.only["regions"]
    assert "Traceback" not in outcome.err


def test_no_colours_and_no_carriage_returns_where_there_is_no_terminal(project: Path, photograph: Path) -> None:
    for command in (("bank", "show"), ("measure", photograph, *QUICK), ("plan",), ("--help",)):
        outcome = spawn("-C", project, *command, env={"TERM": "xterm-256color"})
        assert outcome.code == 0, outcome.err
        assert "\x1b" not in outcome.out + outcome.err
        assert "\r" not in outcome.out + outcome.err


@pytest.mark.parametrize("how", ["cut", "text", "empty"])
def test_decoders_do_not_talk_past_the_one_line(project: Path, photograph: Path, tmp_path: Path, how: str) -> None:
    scene = tmp_path / "scene.dng"
    data = photograph.read_bytes()
    scene.write_bytes({"cut": data[: len(data) // 2], "text": b"hello\n" * 999, "empty": b""}[how])
    refused(spawn("-C", project, "measure", scene), "scene.dng")
    labels = tmp_path / "labels.png"
    drawn = cv2.imencode(".png", np.random.default_rng(0).integers(1, 9, (208, 312), np.uint8))[1].tobytes()
    labels.write_bytes({"cut": drawn[: len(drawn) // 2], "text": b"hello\n" * 999, "empty": b""}[how])
    refused(spawn("-C", project, "measure", photograph, "--labels", labels), "labels.png")


def test_directories_that_cannot_be_written_are_named(project: Path, photograph: Path) -> None:
    if os.geteuid() == 0:
        place = Path("/proc")  # even root can't write there
    else:
        place = project / "closed"
        place.mkdir(mode=0o500)
    refused(call("-C", project, "measure", photograph, *QUICK, "--out", place / "out"), str(place))
    refused(call("-C", project, "bank", "export", "v1", place / "bank.npz"), str(place))
    refused(call("init", place / "project"), str(place))


def test_the_version_and_the_help_do_not_wait_for_numerics() -> None:
    code = "import sys; from workbench.cli import main; sys.argv = ['workbench', '--version']\n"
    code += "try: main()\nfinally: sys.stderr.write(','.join(m for m in ('numpy', 'scipy', 'cv2') if m in sys.modules))"
    outcome = subprocess.run([arguments()[0], "-c", code], capture_output=True, text=True, check=True)
    assert outcome.stdout.startswith("workbench")
    assert outcome.stderr == ""


def _coarse(root: Path, **chosen: Any) -> Project:
    """A project whose plan takes seconds instead of a minute."""
    project = create_project(root, **chosen)
    text = project.rig_file.read_text()
    for old, new in (("step: 10 cm", "step: 45 cm"), ("repeats: 2", "repeats: 1")):
        assert old in text
        text = text.replace(old, new)
    project.rig_file.write_text(text)
    return project


def test_a_demo_in_an_empty_directory_and_again_in_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workbench.cli.demo.create_project", _coarse)
    first = done("demo", "--json", cwd=tmp_path)
    measured, truth = first.objects[-2:]
    assert measured["regions"]
    assert len(truth["objects"]) >= 4
    assert {"name", "true_mm", "measured_mm", "status"} <= set(truth["objects"][0])
    again = done("demo", cwd=tmp_path)
    assert "What is true" in again.out
    root = tmp_path / "workbench-demo"
    for line in again.out.splitlines():
        if line.startswith(("bank report:", "measurement report:")):
            assert (tmp_path / line.split(":", 1)[1].strip()).is_file()
    assert sorted(path.name for path in (root / "sessions").iterdir()) == ["s0001", "s0002"]
    assert len(done("-C", root, "bank", "list", "--json").objects) == 1


def test_without_a_command_the_help_is_shown_line_by_line() -> None:
    for argv in ((), ("bank",)):
        outcome = call(*argv)
        assert (outcome.code, outcome.out) == (2, "")
        lines = outcome.err.splitlines()
        assert lines[0].startswith("Usage: ")
        assert any(line.strip().startswith(("calibrate", "activate")) for line in lines)
