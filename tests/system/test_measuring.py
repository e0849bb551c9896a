"""One photograph in, depths and files out."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from command_line import SENSOR, TAGS, call, dng, done, listing, refused, spots

from calibration.raw import develop

QUICK = ("--method", "sharpness", "--set", "iterations=4")
FIELDS = {
    "id", "depth_mm", "interval_mm", "confidence", "mirror_mm", "mirror_probability", "second_mm", "pixels", "status",
    "reason",
}  # fmt: skip


def test_a_measurement_says_where_its_files_lie_and_they_hold_what_is_promised(project: Path, photograph: Path) -> None:
    found = done("--json", "-C", project, "measure", photograph, "--roi", "30,40,120,90", *QUICK).only
    assert set(found) == {"image", "bank", "bank_quality", "method", "regions", "files", "options"}
    (region,) = found["regions"]
    assert set(region) == FIELDS
    assert 0 < region["pixels"] <= 120 * 90  # only the inner part counts
    assert set(found["files"]) == {"depth_png", "depth_tiff", "all_focus", "labels", "report"}
    files = {role: project / name for role, name in found["files"].items()}
    height, width = develop(photograph).shape
    depth_png = cv2.imread(str(files["depth_png"]), cv2.IMREAD_UNCHANGED)
    depth_tiff = tifffile.imread(files["depth_tiff"])
    labels = cv2.imread(str(files["labels"]), cv2.IMREAD_UNCHANGED)
    assert (depth_png.dtype, depth_tiff.dtype, labels.dtype) == (np.uint16, np.float32, np.uint16)
    assert depth_png.shape == depth_tiff.shape == labels.shape == (height, width)
    inside = np.zeros((height, width), bool)
    inside[40:130, 30:150] = True
    assert np.array_equal(labels > 0, inside)
    known = np.isfinite(depth_tiff)
    assert np.array_equal(depth_png, np.where(known, np.rint(np.nan_to_num(depth_tiff)), 0))
    if region["status"] in ("ok", "ambiguous"):
        assert np.array_equal(known, inside)
        assert depth_tiff[known] == pytest.approx(region["depth_mm"], abs=0.1)
    picture = cv2.imread(str(files["all_focus"]), cv2.IMREAD_UNCHANGED)
    assert (picture.dtype, picture.shape) == (np.uint8, (height, width, 3))
    kept = json.loads((files["report"].parent / "measurement.json").read_text())
    assert kept == found


def test_no_more_pixels_are_used_than_a_region_has_and_outside_of_it_the_photograph_stays(
    project: Path, photograph: Path
) -> None:
    found = done("--json", "-C", project, "measure", photograph, "--roi", "60,40,96,128", "--set", "window_px=64").only
    (region,) = found["regions"]
    assert 0 < region["pixels"] <= 96 * 128
    picture = cv2.imread(str(project / found["files"]["all_focus"]), cv2.IMREAD_UNCHANGED)[:, :, ::-1]
    photographed = develop(photograph).planes
    outside = np.ones(photographed.shape[:2], bool)
    outside[36:172, 56:160] = False  # the blend reaches a few pixels across the border
    linear = np.where(picture <= 10, picture / 255 / 12.92, ((picture / 255 + 0.055) / 1.055) ** 2.4)
    unclipped = outside[:, :, np.newaxis] & (picture < 250) & (picture > 20)
    gain = np.median(linear[unclipped] / photographed[unclipped])
    np.testing.assert_allclose(linear[unclipped], gain * photographed[unclipped], rtol=0.05)


def test_the_same_measurement_lands_in_the_same_place_and_another_beside_it(project: Path, photograph: Path) -> None:
    whole = done("-C", project, "measure", photograph, "--whole", *QUICK, "--json").only
    assert done("-C", project, "measure", photograph, "--whole", *QUICK, "--json").only == whole
    part = done("-C", project, "measure", photograph, "--roi", "0,0,64,64", *QUICK, "--json").only
    assert part["files"]["report"] != whole["files"]["report"]
    assert len(list((project / "measurements").iterdir())) == 2


def test_labels_that_the_operator_drew_are_measured_one_by_one(project: Path, photograph: Path, tmp_path: Path) -> None:
    labels = np.zeros(develop(photograph).shape, np.uint16)
    labels[20:100, 20:100], labels[20:100, 150:250] = 7, 300
    cv2.imwrite(str(tmp_path / "labels.png"), labels)
    found = done("-C", project, "measure", photograph, "--labels", tmp_path / "labels.png", *QUICK, "--json").only
    assert [region["id"] for region in found["regions"]] == [7, 300]
    written = cv2.imread(str(project / found["files"]["labels"]), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(written, labels)


def test_regions_are_found_where_none_are_given(project: Path, photograph: Path) -> None:
    by_default = done("-C", project, "measure", photograph, "--json").only
    assert by_default["regions"]
    assert by_default["method"] == "evidence"
    by_colour = done("-C", project, "measure", photograph, "--segment", "colour", *QUICK, "--json").only
    assert len(by_colour["regions"]) > 1


def test_several_photographs_give_one_object_a_line_and_one_directory_each(
    project: Path, photograph: Path, tmp_path: Path
) -> None:
    second = shutil.copy(photograph, tmp_path / "second one.dng")
    out = tmp_path / "out"
    outcome = done(
        "-C", project, "measure", photograph, second, "--roi", "0,0,64,64", *QUICK, "--out", out, "--json"
    )  # fmt: skip
    assert [Path(found["image"]).name for found in outcome.objects] == ["photograph-0001.dng", "second one.dng"]
    for found in outcome.objects:
        assert Path(found["files"]["report"]).parent == out / Path(found["image"]).stem
        assert Path(found["files"]["report"]).is_file()
    assert not (project / "measurements").exists()


def test_photographs_of_one_name_would_overwrite_each_other(project: Path, photograph: Path, tmp_path: Path) -> None:
    second = shutil.copy(photograph, tmp_path / photograph.name)
    refused(
        call("-C", project, "measure", photograph, second, "--whole", "--out", tmp_path / "out"),
        photograph.name, "--out",
    )  # fmt: skip
    assert not (tmp_path / "out").exists()


def test_other_files_in_the_directory_of_results_stay(project: Path, photograph: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    done("-C", project, "measure", photograph, "--roi", "0,0,64,64", *QUICK, "--out", tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert (tmp_path / "report.html").is_file()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def _refused(project: Path, scene: Path, *more: str, words: tuple[str, ...] = ()) -> None:
    before = listing(project)
    refused(call("-C", project, "measure", scene, *more), *words)
    assert listing(project) == before


def _spoil(path: Path, how: str) -> Path:
    data = path.read_bytes()
    match how:
        case "missing":
            path.unlink()
        case "empty":
            path.write_bytes(b"")
        case "cut":
            path.write_bytes(data[: len(data) // 3])
        case "zero bytes":
            path.write_bytes(bytes(len(data)))
        case "text":
            path.write_text("no photograph\n" * 1000)
        case "all zero":
            dng(path, np.zeros(SENSOR))
        case "constant":
            dng(path, np.full(SENSOR, 9000))
    return path


@pytest.mark.parametrize("how", ["missing", "empty", "cut", "zero bytes", "text", "all zero", "constant"])
@pytest.mark.parametrize("suffix", [".dng", ".CR2", ".tif", ".npy"])
def test_a_file_that_is_no_photograph_is_named(
    project: Path, photograph: Path, tmp_path: Path, how: str, suffix: str
) -> None:
    scene = Path(shutil.copy(photograph, tmp_path / f"scene{suffix}"))
    _refused(project, _spoil(scene, how), words=(f"scene{suffix}",))


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        ({"pitch_mm": 0.0037}, ("pixel pitch", "7.40", "8.60")),
        ({"model": "Simulated big"}, ("camera", "Simulated big", "Simulated small")),
        ({"focal_length_mm": 85.0}, ("focal length", "85", "50")),
        ({"f_number": 8.0}, ("f-number", "8", "3.6")),
    ],
)
def test_a_photograph_of_another_camera_or_lens_is_refused(
    project: Path, tmp_path: Path, tags: dict[str, object], words: tuple[str, ...]
) -> None:
    scene = dng(tmp_path / "scene.dng", spots([(0.5, 0.5)]), tags=replace(TAGS, **tags))  # type: ignore[arg-type]
    _refused(project, scene, words=("scene.dng", *words))


def test_a_photograph_with_another_colour_pattern_or_size_is_refused(project: Path, tmp_path: Path) -> None:
    mosaic = spots([(0.5, 0.5)])
    scene = dng(tmp_path / "scene.dng", mosaic, cfa=bytes([2, 1, 1, 0]))
    _refused(project, scene, words=("scene.dng", "BGGR", "RGGB"))
    dng(scene, mosaic[:320, :480])
    _refused(project, scene, words=("scene.dng", "480 x 320", "624 x 416"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--roi", "0,0,400,400"), ("--roi", "312 x 208")),
        (("--roi", "-5,0,40,40"), ("--roi", "312 x 208")),
        (("--roi", "10,10,0,40"), ("--roi", "312 x 208")),
        (("--roi", "10,10,40"), ("--roi", "x,y,width,height")),
        (("--roi", "a,b,c,d"), ("--roi", "x,y,width,height")),
        (("--roi", "1.5,0,10,10"), ("--roi", "x,y,width,height")),
        (("--roi", "0,0,64,64", "--whole"), ("--roi and --whole",)),
        (("--method", "magic"), ("--method", "magic", "sharpness")),
        (("--method", "sharpness", "--set", "iteration=5"), ("iteration", "'iterations'")),
        (("--method", "sharpness", "--set", "iterations=many"), ("iterations", "many")),
        (("--method", "sharpness", "--set", "iterations"), ("iterations", "name=value")),
        (("--method", "sharpness", "--set", "iterations=-1"), ("iterations",)),
        (("--bank", "v7"), ("'v7'", "v1")),
        (("--bank", "certified"), ("'certified'", "v1")),
        (("--q", "0"), ("--q",)),
        (("--q", "lots"), ("--q",)),
        (("--speed", "9"), ("--speed",)),
        (("--labels", "nowhere.png"), ("nowhere.png",)),
        (("--labels", "."), ("label",)),
    ],
)
def test_wishes_that_cannot_be_are_refused(
    project: Path, photograph: Path, options: tuple[str, ...], words: tuple[str, ...]
) -> None:
    _refused(project, photograph, *options, words=words)


def test_label_images_that_do_not_fit_are_refused(project: Path, photograph: Path, tmp_path: Path) -> None:
    height, width = develop(photograph).shape
    one = np.ones((height, width), np.uint8)
    pictures = {
        "other size.png": np.ones((2 * height, 2 * width), np.uint8),
        "colour.png": np.dstack([one, one, one]),
        "nothing.png": 0 * one,
    }
    for name, pixels in pictures.items():
        cv2.imwrite(str(tmp_path / name), pixels)
    tifffile.imwrite(tmp_path / "float.tif", one.astype(np.float32))
    tifffile.imwrite(tmp_path / "huge.tif", one.astype(np.int32) * 70_000)
    tifffile.imwrite(tmp_path / "negative.tif", -one.astype(np.int32))
    (tmp_path / "text.png").write_text("not a picture")
    (tmp_path / "empty.png").write_bytes(b"")
    for path in sorted(tmp_path.glob("*.*")):
        _refused(project, photograph, "--labels", str(path), words=(path.name,))


def test_the_directory_of_results_must_not_be_a_file(project: Path, photograph: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("x")
    _refused(project, photograph, "--out", str(tmp_path / "taken"), words=("taken",))
    _refused(project, photograph, *QUICK, "--out", str(tmp_path / "taken" / "deep"), words=("taken",))


def test_a_photograph_that_fails_leaves_those_before_it_done(project: Path, photograph: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.dng"
    broken.write_bytes(b"nothing")
    outcome = call("-C", project, "measure", photograph, broken, "--roi", "0,0,64,64", *QUICK, "--json")
    assert outcome.code == 2
    assert [Path(found["image"]).name for found in outcome.objects] == ["photograph-0001.dng"]
    assert len(list((project / "measurements").iterdir())) == 1
    assert outcome.err.splitlines()[-1].startswith("workbench: ")
    assert "broken.dng" in outcome.err.splitlines()[-1]


def test_capture_numbers_its_photographs_and_leaves_no_metering_frames(project: Path) -> None:
    for number in (1, 2):
        found = done("-C", project, "capture", "--roi", "0,0,64,64", *QUICK, "--json").only
        assert Path(found["image"]).name == f"photograph-{number:04d}.dng"
    names = sorted(path.name for path in (project / "photographs").iterdir())
    assert names == ["photograph-0001.dng", "photograph-0002.dng"]
