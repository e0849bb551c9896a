"""A full disk: exit code 2, one line, and the project as it was."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import Outcome, arguments, call, done, listing, refused

from calibration.build import PointFrame
from workbench import calibrate

QUICK = ("--roi", "0,0,64,64", "--method", "sharpness", "--set", "iterations=2")
FEW = ("--from", "80cm", "--to", "180cm", "--step", "50cm", "--repeats", "1")


def _full_after(patch: pytest.MonkeyPatch, good_syncs: int) -> Callable[[], int]:
    """Let the disk be full from the n-th sync to disk on; how often that was met."""
    real, count, met = os.fsync, 0, 0

    def fsync(descriptor: int) -> None:
        nonlocal count, met
        count += 1
        if count > good_syncs:
            met += 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor)

    patch.setattr(os, "fsync", fsync)
    return lambda: met


@pytest.mark.parametrize(
    "command",
    [
        ("-C", "{tmp}/fresh/deep", "init", "."),
        ("-C", "{project}", "bank", "certify", "v1", "--note", "x"),
        ("-C", "{project}", "bank", "activate", "v1"),
        ("-C", "{project}", "bank", "revoke", "v1", "--reason", "x", "--yes"),
        ("-C", "{project}", "bank", "export", "v1", "{tmp}/out/bank.npz"),
        ("-C", "{project}", "bank", "export", "v1", "{tmp}/bank.tif"),
        ("-C", "{project}", "measure", "{photograph}", *QUICK),
        ("-C", "{project}", "measure", "{photograph}", *QUICK, "--out", "{tmp}/out/deep"),
    ],
    ids=lambda command: " ".join(command[2:4]),
)
def test_wherever_the_disk_fills_up_nothing_is_left_behind(
    project: Path, photograph: Path, tmp_path: Path, command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    argv = [part.format(project=project, photograph=photograph, tmp=tmp_path) for part in command]
    before = listing(tmp_path)
    for good in range(100):
        with monkeypatch.context() as patch:
            met = _full_after(patch, good)
            outcome = call(*argv)
        if outcome.code == 0:  # only a directory's entry was left to sync
            break
        refused(outcome, "no space left" if "full" not in outcome.err else "full")
        assert met()
        assert listing(tmp_path) == before
    else:
        raise AssertionError("the command never ended well")
    assert good > 0
    assert listing(tmp_path) != before


@pytest.mark.parametrize(
    ("limit", "command"),
    [
        (0, ("init", "{tmp}/fresh")),
        (0, ("-C", "{project}", "bank", "certify", "v1", "--note", "x")),
        (8192, ("-C", "{project}", "bank", "export", "v1", "{tmp}/out/bank.npz")),
        (8192, ("-C", "{project}", "bank", "export", "v1", "{tmp}/out/bank.tif")),
        (8192, ("-C", "{project}", "measure", "{photograph}", *QUICK)),
    ],
    ids=lambda value: value if isinstance(value, int) else " ".join(value[:4:3] + value[2:3]),
)
def test_a_limit_on_the_size_of_files_is_told_like_a_full_disk(
    project: Path, photograph: Path, tmp_path: Path, limit: int, command: tuple[str, ...]
) -> None:
    argv = [part.format(project=project, photograph=photograph, tmp=tmp_path) for part in command]
    before = listing(tmp_path)
    finished = subprocess.run(
        arguments(*argv), capture_output=True, text=True, timeout=200, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )  # fmt: skip
    refused(Outcome(finished.returncode, finished.stdout, finished.stderr), "file too large")
    assert listing(tmp_path) == before


def test_a_bank_made_from_frames_is_stored_whole_or_not_at_all(
    project: Path, frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = listing(project)
    built = calibrate.build_bank([PointFrame(float(p.stem[4:7]) * 10, (p,)) for p in frames.glob("psf_*")])
    monkeypatch.setattr(calibrate, "build_bank", lambda *_: built)
    for good in (*range(12), 14, 16, 18):
        with monkeypatch.context() as patch:
            met = _full_after(patch, good)
            outcome = call("-C", project, "calibrate", "--frames", frames)
        if outcome.code == 0:
            break
        assert met()
        refused(outcome, "space")
        assert listing(project) == before
    assert good > 10


def test_a_session_on_a_disk_that_fills_up_can_be_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done("init", tmp_path)
    with monkeypatch.context() as patch:
        _full_after(patch, 9)
        outcome = call("-C", tmp_path, "calibrate", *FEW, "--json")
    assert outcome.code == 2
    assert outcome.out == ""
    assert outcome.err.splitlines()[-1].startswith("workbench: ")
    assert "no space" in outcome.err.splitlines()[-1].lower()
    assert "Traceback" not in outcome.err
    assert not [path for path in tmp_path.rglob("*") if path.name.endswith((".part", ".tmp"))]
    done("-C", tmp_path, "resume")


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 400 kB."""
    mount = shutil.which("mount")
    if os.geteuid() != 0 or mount is None:
        pytest.skip("only root can mount a small disk")
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run([mount, "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(place)], check=False)
    if mounted.returncode:
        pytest.skip("a small disk can't be mounted here")
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


def test_a_real_disk_that_is_full_is_named(
    project: Path, photograph: Path, tiny_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_it = tiny_disk / "project"
    done("init", on_it)
    before = listing(tiny_disk)
    outcome = call("-C", on_it, "calibrate", *FEW)
    assert outcome.code == 2
    assert "no space left" in outcome.err.splitlines()[-1].lower()
    assert str(on_it) in outcome.err.splitlines()[-1]
    shutil.rmtree(on_it / "sessions")
    assert listing(tiny_disk) == before
    (tiny_disk / "filler").write_bytes(bytes(os.statvfs(tiny_disk).f_bavail * os.statvfs(tiny_disk).f_frsize))
    before = listing(tiny_disk)
    refused(call("-C", on_it, "calibrate", *FEW), str(on_it), "no space left")
    refused(call("-C", project, "bank", "export", "v1", tiny_disk / "bank.npz"), str(tiny_disk), "no space left")
    refused(call("-C", project, "measure", photograph, *QUICK, "--out", tiny_disk / "out"), "no space left")
    refused(call("init", tiny_disk / "another"), str(tiny_disk), "no space left")
    assert listing(tiny_disk) == before
