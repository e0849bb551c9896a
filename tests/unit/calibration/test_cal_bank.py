from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import tifffile
from drawn_points import point_image

from calibration.bank import Bank, check_fits, load_bank, save_bank
from calibration.build import BuiltBank
from calibration.errors import BankError, CalibrationError, DepthListError, MismatchError
from calibration.exchange import diff, export_npz, export_tiff, import_bank
from calibration.image import LinearImage


def test_a_bank_comes_back_from_disk_as_it_was(built: BuiltBank, tmp_path: Path) -> None:
    bank = replace(built.bank, extras={**built.bank.extras, "model_weights": np.arange(5, dtype=np.float32)})
    directory = save_bank(bank, tmp_path)
    assert directory.name == bank.id
    back = load_bank(directory)
    assert back.id == bank.id
    for name in ("depths_mm", "psf", "psf_se", "field_yx"):
        np.testing.assert_array_equal(getattr(back, name), getattr(bank, name))
    np.testing.assert_array_equal(back.extras["model_weights"], np.arange(5))
    assert back.lens.focus_mm == bank.lens.focus_mm
    assert back.lens.suspect == bank.lens.suspect
    assert back.manifest["quality"] == bank.manifest["quality"]
    assert [p.name for p in tmp_path.iterdir()] == [bank.id]


def test_saving_twice_keeps_one_and_content_decides_the_id(built: BuiltBank, tmp_path: Path) -> None:
    assert save_bank(built.bank, tmp_path) == save_bank(built.bank, tmp_path)
    psf = built.bank.psf.copy()
    psf[0, 0, 5, 5] += 1e-6
    assert replace(built.bank, psf=psf).id != built.bank.id
    assert replace(built.bank, recipe="native").id != built.bank.id
    assert replace(built.bank, manifest={**built.bank.manifest, "plan_sha256": "ab"}).id != built.bank.id


@pytest.mark.parametrize("name", ["psf.npy", "depths_mm.npy", "aperture.npy", "manifest.json"])
def test_a_changed_byte_is_found_and_named(built: BuiltBank, tmp_path: Path, name: str) -> None:
    directory = save_bank(built.bank, tmp_path)
    content = bytearray((directory / name).read_bytes())
    position = content.index(b"Body") if name == "manifest.json" else len(content) - 3
    content[position] ^= 1
    (directory / name).write_bytes(content)
    with pytest.raises(BankError, match=name.replace(".", r"\.")):
        load_bank(directory)


def test_missing_files_and_directories_that_are_no_bank_are_refused(built: BuiltBank, tmp_path: Path) -> None:
    with pytest.raises(BankError, match="is no bank"):
        load_bank(tmp_path / "absent")
    directory = save_bank(built.bank, tmp_path)
    (directory / "psf_se.npy").unlink()
    with pytest.raises(BankError, match=r"psf_se\.npy"):
        load_bank(directory)


def test_a_full_disk_leaves_nothing_behind(built: BuiltBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(BankError, match="no space left"):
        save_bank(built.bank, tmp_path)
    assert list(tmp_path.iterdir()) == []


def _changed(image: LinearImage, **info: object) -> LinearImage:
    return replace(image, info=replace(image.info, **info))


def test_a_scene_of_the_same_camera_fits_whatever_its_crop(built: BuiltBank) -> None:
    scene = point_image(1000.0)
    check_fits(built.bank, scene)
    check_fits(built.bank, _changed(scene, raw_size=(1280, 1920)))
    check_fits(built.bank, replace(scene, recipe="linear", pixel_pitch_mm=None))


def test_a_scene_that_does_not_fit_is_refused_with_what_differs(built: BuiltBank) -> None:
    scene = point_image(1000.0)
    bank = replace(built.bank, pixel_pitch_mm=0.0086)
    cases: list[tuple[Bank, LinearImage, str]] = [
        (bank, replace(scene, recipe="native", pixel_pitch_mm=0.0043), "developed as native"),
        (bank, replace(scene, pixel_pitch_mm=0.0088), "pixel pitch is 8.80 um"),
        (bank, replace(scene, recipe="linear", pixel_pitch_mm=0.0043), "pixel pitch"),
        (bank, _changed(scene, cfa="BGGR"), "colour pattern is BGGR"),
        (bank, _changed(scene, model="Another"), "camera is Another"),
        (bank, _changed(scene, focal_length_mm=35.0), "focal length is 35"),
    ]
    sized = {**bank.manifest, "camera": {**bank.manifest["camera"], "sensor_size": [192, 192]}}
    cases.append((replace(bank, manifest=sized), _changed(scene, raw_size=(1280, 1920)), "sensor size is 1920 x 1280"))
    for case, image, expected in cases:
        with pytest.raises(MismatchError, match=expected):
            check_fits(case, image)


def test_npz_brings_the_whole_bank_back(built: BuiltBank, tmp_path: Path) -> None:
    back = import_bank(export_npz(built.bank, tmp_path / "bank.npz"))
    assert back.id == built.bank.id
    assert back.manifest["quality"] == built.bank.manifest["quality"]
    assert back.lens.zero_applied == built.bank.lens.zero_applied
    np.testing.assert_array_equal(back.psf_se, built.bank.psf_se)


def test_npz_that_was_changed_is_another_bank_of_unknown_quality(built: BuiltBank, tmp_path: Path) -> None:
    with np.load(export_npz(built.bank, tmp_path / "bank.npz")) as archive:
        arrays = dict(archive)
    arrays["psf"] = np.roll(arrays["psf"], 1, axis=3)
    np.savez(tmp_path / "changed.npz", **arrays)
    back = import_bank(tmp_path / "changed.npz")
    assert back.id != built.bank.id
    assert back.manifest["kind"] == "imported"
    assert back.manifest["source"]["exported_from"] == built.bank.id
    assert back.manifest["camera"] == built.bank.manifest["camera"]
    assert back.manifest["quality"]["verdict"] == "unknown"
    assert (back.recipe, back.pixel_pitch_mm) == (built.bank.recipe, built.bank.pixel_pitch_mm)


def test_imagej_stack_round_trip_is_exact_and_labelled_in_cm(built: BuiltBank, tmp_path: Path) -> None:
    path = export_tiff(built.bank, tmp_path / "bank.tif")
    with tifffile.TiffFile(path) as tif:
        assert tif.is_imagej
        assert tif.imagej_metadata["Labels"][:2] == ["60 cm", "80 cm"]
    back = import_bank(path)
    np.testing.assert_array_equal(back.central, built.bank.central)
    np.testing.assert_array_equal(back.depths_mm, built.bank.depths_mm)
    assert back.manifest["camera"] == built.bank.manifest["camera"]
    assert back.manifest["source"]["exported_from"] == built.bank.id
    assert "standard errors are taken as 2 %" in back.manifest["quality"]["reasons"][0]


def test_matlab_and_npy_stacks_are_taken_with_a_list_of_depths(built: BuiltBank, tmp_path: Path) -> None:
    stack = built.bank.central
    depths = built.bank.depths_mm
    scipy.io.savemat(tmp_path / "a.mat", {"h": np.moveaxis(stack, 0, 2), "note": "x"})
    np.save(tmp_path / "a.npy", 7.0 * stack[::-1, 1:, :])
    from_mat = import_bank(tmp_path / "a.mat", depths.tolist())
    np.testing.assert_array_equal(from_mat.central, stack)
    from_npy = import_bank(tmp_path / "a.npy", depths[::-1].tolist())
    np.testing.assert_array_equal(from_npy.depths_mm, depths)
    np.testing.assert_allclose(from_npy.psf.sum(axis=(2, 3)), 1.0, atol=1e-5)
    scipy.io.savemat(tmp_path / "b.mat", {"psf": np.moveaxis(stack, 0, 2), "depths_cm": depths / 10})
    np.testing.assert_allclose(import_bank(tmp_path / "b.mat").depths_mm, depths)


@pytest.mark.parametrize(
    ("depths", "error", "expected"),
    [
        (None, DepthListError, "holds no depths"),
        ([600.0, 700.0, 800.0], DepthListError, "3 depths for a stack"),
        ([600.0, 700.0, 650.0, 800.0, 900.0, 1000.0, 1100.0, 1200.0, 1300.0], DepthListError, "out of order"),
    ],
)
def test_stacks_with_impossible_depths_are_refused(
    built: BuiltBank, tmp_path: Path, depths: list[float] | None, error: type[CalibrationError], expected: str
) -> None:
    np.save(tmp_path / "a.npy", built.bank.central)
    with pytest.raises(error, match=expected):
        import_bank(tmp_path / "a.npy", depths)


def test_broken_stacks_are_named(tmp_path: Path) -> None:
    for name, expected in (("x.npy", "can't be read"), ("x.mat", "can't be read"), ("x.doc", "can't import")):
        (tmp_path / name).write_bytes(b"not a stack at all")
        with pytest.raises(BankError, match=expected):
            import_bank(tmp_path / name, [600.0, 700.0, 800.0])
    with pytest.raises(BankError, match="no such file"):
        import_bank(tmp_path / "absent.npz")


def test_diff_says_where_two_banks_differ(built: BuiltBank) -> None:
    same = diff(built.bank, built.bank)
    assert same["same"]
    assert all(d["psf_distance"] == 0 for d in same["depths"])
    psf = np.pad(built.bank.psf, ((0, 0), (0, 0), (2, 2), (2, 2)))
    psf[0, 3] = np.roll(psf[0, 3], 1, axis=0)
    other = replace(built.bank, psf=psf, depths_mm=built.bank.depths_mm + np.r_[np.zeros(8), 40.0])
    found = diff(built.bank, other)
    assert not found["same"]
    assert [d["depth_mm"] for d in found["depths"] if d["psf_distance"] > 0] == [1300.0]
    assert (found["only_a"], found["only_b"]) == ([3500.0], [3540.0])
    json.dumps(found)
