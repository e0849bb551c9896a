"""`calibrate --frames` on files that can be no calibration: one line, exit code 2, nothing left behind."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rawpy
from command_line import SENSOR, TAGS, call, dng, done, listing, refused, spots

VICTIM = "psf_130cm.dng"
DARK = "dark.dng"


def _refused(project: Path, frames: Path, *words: str) -> str:
    before = listing(project, frames)
    line = refused(call("-C", project, "calibrate", "--frames", frames), *words)
    assert listing(project, frames) == before
    return line


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _text(path: Path) -> None:
    path.write_text("this is no photograph\n" * 500)


def _zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def _black(path: Path) -> None:
    dng(path, np.zeros(SENSOR))


def _constant(path: Path) -> None:
    dng(path, np.full(SENSOR, 5000))


BROKEN: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "cut in the middle": _cut,
    "header only": lambda path: path.write_bytes(path.read_bytes()[:400]),
    "no RAW file": _text,
    "zero bytes": _zeros,
    "all pixels zero": _black,
    "all pixels equal": _constant,
}


@pytest.mark.parametrize("broken", list(BROKEN))
@pytest.mark.parametrize("name", [VICTIM, DARK])
def test_a_broken_file_is_named(project: Path, frames: Path, name: str, broken: str) -> None:
    BROKEN[broken](frames / name)
    _refused(project, frames, name)


@pytest.mark.parametrize(
    ("mosaic", "words"),
    [
        (spots([]), ("no point",)),
        (spots([(0.5, 0.5), (0.3, 0.7)]), ("more than 1 point",)),
        (spots([(0.5, 0.5)], level=1.5), ("saturated",)),
        (spots([(0.005, 0.5)]), ("border",)),
    ],
    ids=["no point", "two points", "saturated", "clipped"],
)
def test_a_frame_without_one_good_point_is_named_with_the_reason(
    project: Path, frames: Path, mosaic: np.ndarray, words: tuple[str, ...]
) -> None:
    dng(frames / VICTIM, mosaic)
    (frames / DARK).unlink()
    _refused(project, frames, VICTIM, *words)


def _copied_over_itself(path: Path, share: float) -> None:
    """Lay a fainter copy of the point over it, 24 photosites away."""
    with rawpy.imread(str(path)) as raw:
        signal = raw.raw_image_visible.astype(float) - TAGS.black
    both = signal + share * np.roll(signal, (14, -20), (0, 1))
    dng(path, np.clip(TAGS.black + both / (1 + share), 0, TAGS.white))


@pytest.mark.parametrize("share", [1.0, 0.3, 0.15])
def test_a_frame_whose_second_point_lies_within_the_first_ones_light_is_named(
    project: Path, frames: Path, share: float
) -> None:
    _copied_over_itself(frames / "psf_105cm.dng", share)
    _refused(project, frames, "psf_105cm.dng", "twice", "12 px apart")


def test_two_frames_under_each_others_depth_are_both_named(project: Path, frames: Path) -> None:
    (frames / "psf_105cm.dng").rename(frames / "psf.tmp")
    (frames / "psf_205cm.dng").rename(frames / "psf_105cm.dng")
    (frames / "psf.tmp").rename(frames / "psf_205cm.dng")
    _refused(project, frames, str(frames), "psf_105cm.dng (105 cm)", "psf_205cm.dng (205 cm)", "exchanged")


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        (replace(TAGS, model="Simulated big"), ("Simulated big", "one camera")),
        (replace(TAGS, pitch_mm=0.006), ("pixel pitch", "6")),
        (replace(TAGS, focal_length_mm=85.0), ("focal length", "85")),
    ],
    ids=["model", "pitch", "focal length"],
)
def test_a_frame_of_another_camera_or_lens_is_named(
    project: Path, frames: Path, tags: object, words: tuple[str, ...]
) -> None:
    dng(frames / VICTIM, spots([(0.5, 0.5)]), tags=tags)  # type: ignore[arg-type]
    _refused(project, frames, VICTIM, *words)


def test_a_frame_with_another_colour_pattern_is_named(project: Path, frames: Path) -> None:
    dng(frames / VICTIM, spots([(0.5, 0.5)]), cfa=bytes([2, 1, 1, 0]))
    _refused(project, frames, VICTIM, "BGGR")


def test_a_dark_frame_of_another_camera_is_named(project: Path, frames: Path) -> None:
    dng(frames / DARK, spots([]), cfa=bytes([2, 1, 1, 0]))
    _refused(project, frames, DARK, "BGGR")


def test_a_dark_frame_that_is_none_is_named_with_the_reason(project: Path, frames: Path) -> None:
    dng(frames / DARK, spots([]), tags=replace(TAGS, exposure_s=30.0))
    _refused(project, frames, DARK, "exposed 30 s", "point frame")
    dng(frames / DARK, spots([(0.5, 0.5)], level=1.5, radius=200))
    _refused(project, frames, DARK, "saturated")
    shutil.copy(frames / VICTIM, frames / DARK)
    _refused(project, frames, DARK, "point")
    (frames / DARK).unlink()
    shutil.copy(frames / VICTIM, frames / "psf_130cm_2.dng")
    _refused(project, frames, "psf_130cm_2.dng", "copy of psf_130cm.dng")


def _table(frames: Path, *lines: str, header: str = "file,depth_cm,kind") -> None:
    (frames / "frames.csv").write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")


A, B, C, D = (f"psf_{z}cm.dng" for z in ("080", "105", "130", "205"))


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ((f"{A},80,psf", f"{A},105,psf", f"{C},130,psf"), (A, "twice")),
        ((f"{A},80,psf", f"{B},105,psf", f"{C},130,psf", f"{D},80,psf"), ("80 cm", "twice")),
        ((f"{A},80,psf", f"{C},130,psf", f"{B},105,psf", f"{D},205,psf"), ("order",)),
        ((f"{A},0.8,psf", f"{B},1.05,psf", f"{C},1.3,psf"), ("metres", "centimetres")),
        ((f"{A},8000,psf", f"{B},10500,psf", f"{C},13000,psf"), ("millimetres", "centimetres")),
        ((f"{A},80,psf", f"{B},105,psf", f"{C},1300,psf", f"{D},205,psf"), ("order",)),
        ((f"{A},80,psf", "gone.dng,105,psf", f"{C},130,psf"), ("gone.dng",)),
        ((f"{A},80cm,psf", f"{B},105,psf", f"{C},130,psf"), ("depth_cm", "80cm")),
        ((f"{A},80,psf", f"{B},,psf", f"{C},130,psf"), ("line 3", "depth_cm")),
        ((f"{A},80,psf", f"{B},-105,psf", f"{C},130,psf"), ("positive",)),
        ((f"{A},80,psf", f"{B},nan,psf", f"{C},130,psf"), ("positive",)),
        ((f"{A},80,point source", f"{B},105,psf", f"{C},130,psf"), ("kind",)),
        ((f"{A},80,psf", f"{B},105"), ("kind",)),
        ((f"{A},80,psf", f"{B},105,psf"), ("at least 3",)),
        (("dark.dng,,dark",), ("frames.csv",)),
        ((), ("frames.csv",)),
    ],
)
def test_a_bad_table_of_frames_is_refused(
    project: Path, frames: Path, lines: tuple[str, ...], words: tuple[str, ...]
) -> None:
    _table(frames, *lines)
    _refused(project, frames, "frames.csv", *words)


def test_a_table_without_a_column_or_text_is_refused(project: Path, frames: Path) -> None:
    _table(frames, f"{A},80", f"{B},105", f"{C},130", header="file,depth_cm")
    _refused(project, frames, "frames.csv", "'kind'")
    _table(frames, f"{A},80,psf", header="file,depth_mm,kind")
    _refused(project, frames, "frames.csv", "'depth_cm'")
    (frames / "frames.csv").write_bytes(b"\xff\xfe\x00binary")
    _refused(project, frames, "frames.csv")
    (frames / "frames.csv").write_bytes(b"")
    _refused(project, frames, "frames.csv", "'file'")


def test_files_that_belong_to_other_depths_are_no_lens(project: Path, frames: Path) -> None:
    names = sorted(p.name for p in frames.glob("psf_*"))
    for name in names:
        (frames / name).rename(frames / f"_{name}")
    for name, other in zip(names, reversed(names), strict=True):
        (frames / f"_{name}").rename(frames / other)
    _refused(project, frames, str(frames), "depths and files")


def test_too_few_depths_or_none_are_refused(project: Path, frames: Path, tmp_path: Path) -> None:
    for name in (A, B, C):
        (frames / name).unlink()
    _refused(project, frames, str(frames), "at least 3")
    for path in frames.glob("psf_*"):
        path.unlink()
    _refused(project, frames, str(frames), "psf_060cm")
    _refused(project, tmp_path / "nowhere", "nowhere", "directory of frames")
    (tmp_path / "file").write_text("x")
    _refused(project, tmp_path / "file", "file", "directory of frames")


def test_a_name_without_a_depth_is_refused(project: Path, frames: Path) -> None:
    (frames / A).rename(frames / "psf_near.dng")
    _refused(project, frames, "psf_near.dng", "psf_060cm")


def test_depths_on_the_command_line_do_not_go_with_files(project: Path, frames: Path) -> None:
    refused(call("-C", project, "calibrate", "--frames", frames, "--from", "60cm"), "--frames", "--from")
    refused(call("-C", project, "calibrate", "--apply-zero"), "--apply-zero", "--frames")


def test_three_depths_are_a_bank_that_says_why_it_has_no_zero(project: Path, frames: Path) -> None:
    for name in (A, B):
        (frames / name).unlink()
    shown = done("-C", project, "calibrate", "--frames", frames).out
    (zero,) = (line for line in shown.splitlines() if line.startswith("stage zero"))
    assert "3 depths can't tell it, it takes 5" in zero
    assert "nan" not in shown


def test_the_zero_is_not_applied_where_it_cannot_be_found(project: Path, frames: Path) -> None:
    for name in (A, B):
        (frames / name).unlink()
    refused(call("-C", project, "calibrate", "--frames", frames, "--apply-zero"), "--apply-zero", "depths")
