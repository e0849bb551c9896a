"""`bench raytrace`: a directory of traced photographs, whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.system.command_line import call
from workbench.bench.truth import read_truth
from workbench.raytrace import photographs


@pytest.fixture
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photographs, "_POINT_RAYS", 256)
    monkeypatch.setattr(photographs, "_PLANE_FRAME", 128)


@pytest.mark.usefixtures("_quick")
def test_files_are_written_and_listed_the_same_for_the_same_seed(tmp_path: Path) -> None:
    for name in ("first", "again"):
        done = call(
            "--json", "bench", "raytrace", tmp_path / name, "--scenes", 0, "--planes", 1, "--rays", 1, "--seed", 3
        )
        assert done.code == 0
        assert done.only["directory"] == str(tmp_path / name)
    first = tmp_path / "first"
    listed = json.loads((first / "truth.json").read_text())["files"]
    written = {path.relative_to(first).as_posix() for path in first.rglob("*") if path.is_file()}
    assert written == {*listed, "truth.json"}
    assert len([name for name in written if name.startswith("psf/psf_")]) == 30
    (plane,) = read_truth(first).planes
    assert 600.0 <= plane.true_mm <= 3500.0
    for name in written:
        assert (first / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


@pytest.mark.usefixtures("_quick")
def test_what_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(photographs, "plane", fail)
    done = call("bench", "raytrace", tmp_path / "out", "--scenes", 0, "--planes", 1, "--rays", 1)
    assert done.code == 2
    assert "free some space and run again" in done.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--scenes", 0), "nothing to trace"),
        (("--rays", 100), "power of two"),
        (("--rays", "²"), "not a valid integer"),
        (("--scenes", 1), "is not empty"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(
    tmp_path: Path, arguments: tuple[object, ...], message: str
) -> None:
    (tmp_path / "mine").write_text("kept")
    done = call("bench", "raytrace", tmp_path, *arguments)
    assert done.code == 2
    assert message in done.err
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
