"""Banks: exchange, versions, certificates, damage."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import tifffile
from command_line import Outcome, call, done, listing, refused

from calibration.bank import Bank, load_bank
from calibration.exchange import export_npz


def _bank_directory(project: Path) -> Path:
    (directory,) = (path for path in (project / "banks").iterdir() if path.is_dir())
    return directory


def _central(project: Path) -> Bank:
    return load_bank(_bank_directory(project))


def test_an_exported_bank_is_the_same_bank_in_another_project(project: Path, tmp_path: Path) -> None:
    exported = tmp_path / "bank.npz"
    assert "the whole bank" in done("-C", project, "bank", "export", "active", exported).out
    done("init", tmp_path / "other")
    made = done("-C", tmp_path / "other", "bank", "import", exported, "--json").only
    assert made == done("-C", project, "bank", "show", "--json").only
    done("-C", project, "bank", "import", exported)
    assert done("-C", project, "bank", "list", "--json").only["version"] == 1


@pytest.mark.parametrize("suffix", [".npz", ".tif"])
def test_options_that_contradict_the_file_are_refused_and_those_that_agree_are_taken(
    project: Path, tmp_path: Path, suffix: str
) -> None:
    original = _central(project)
    exported = tmp_path / f"bank{suffix}"
    done("-C", project, "bank", "export", "active", exported)
    before = listing(project)
    refused(
        call("-C", project, "bank", "import", exported, "--recipe", "native"), exported.name, "superpixel", "native"
    )
    refused(call("-C", project, "bank", "import", exported, "--pixel-pitch", "4.3um"), exported.name, "8.60 um", "4.30")
    assert listing(project) == before
    depths = ",".join(f"{z}mm" for z in original.depths_mm)
    agreeing = ("--recipe", "superpixel", "--pixel-pitch", "8.6um", "--depths", depths)
    made = done("-C", project, "bank", "import", exported, *agreeing, "--json").only
    if suffix == ".npz":
        assert made["id"] == original.id
    assert (made["recipe"], made["pixel_pitch_mm"]) == ("superpixel", pytest.approx(0.0086))
    other = ",".join(f"{z + 5}mm" for z in original.depths_mm)
    made = done("-C", project, "bank", "import", exported, "--depths", other, "--json").only
    assert made["depths_mm"] == pytest.approx([z + 5 for z in original.depths_mm], abs=0.001)
    assert (made["recipe"], made["pixel_pitch_mm"]) == ("superpixel", pytest.approx(0.0086))
    assert made["camera"] == original.manifest["camera"]


def test_a_pitch_fills_in_what_an_exported_bank_does_not_know(project: Path, tmp_path: Path) -> None:
    exported = tmp_path / "bank.npz"
    export_npz(replace(_central(project), pixel_pitch_mm=None), exported)
    made = done("-C", project, "bank", "import", exported, "--pixel-pitch", "8.6um", "--json").only
    assert made["pixel_pitch_mm"] == pytest.approx(0.0086)
    assert made["quality"]["verdict"] in ("good", "suspect")


@pytest.mark.parametrize("pitch", ["8.6", "8.6mm", "0um", "-4um", "wide"])
def test_a_pitch_that_no_sensor_has_is_refused(project: Path, tmp_path: Path, pitch: str) -> None:
    np.save(tmp_path / "stack.npy", _central(project).central)
    told = ("--depths", "80,100,120", "--pixel-pitch", pitch)
    refused(call("-C", project, "bank", "import", tmp_path / "stack.npy", *told), "--pixel-pitch", pitch, "4.3um")


def test_long_lines_are_not_cut_where_no_terminal_is(project: Path) -> None:
    note = "chart at 100 cm read 100.1 cm; " * 20
    done("-C", project, "bank", "certify", "v1", "--note", note)
    shown = done("-C", project, "bank", "show", "v1").out.splitlines()
    assert any(line.startswith("state") and note.strip() in line for line in shown)
    assert all(line == line.rstrip() for line in shown)


def test_where_psfs_between_the_depths_come_from_is_shown(project: Path) -> None:
    told = done("-C", project, "bank", "show", "--json").only["between_planes"]
    assert told["source"] == "pupil"
    shown = done("-C", project, "bank", "show").out.splitlines()
    row = next(line for line in shown if line.startswith("PSFs between depths"))
    assert row.endswith(f"model of the aperture, residual {told['residual']:.1%}")
    report = next((project / "banks").glob("*/report.html")).read_text(encoding="utf-8")
    assert "of a picture of the aperture, which gives the PSF at any depth" in report


def test_an_exported_stack_comes_back_with_the_same_psfs(project: Path, tmp_path: Path) -> None:
    original = _central(project)
    exported = tmp_path / "bank.tif"
    assert done("-C", project, "bank", "export", "active", exported, "--json").only["file"] == str(exported)
    made = done("-C", project, "bank", "import", exported, "--json").only
    assert made["quality"]["verdict"] == "unknown"
    assert made["camera"] == original.manifest["camera"]
    again = load_bank(project / "banks" / made["id"])
    assert np.array_equal(again.central, original.central)
    np.testing.assert_allclose(again.depths_mm, original.depths_mm)
    assert made["lens"]["focus_mm"] == pytest.approx(1600.0, rel=0.01)
    compared = done("-C", project, "bank", "diff", "v1", "v2", "--json").only
    assert not compared["same"]
    assert max(depth["psf_distance"] for depth in compared["depths"]) < 1e-6


@pytest.mark.parametrize("suffix", [".npy", ".mat"])
def test_a_stack_of_somebody_elses_psfs_becomes_a_bank(project: Path, tmp_path: Path, suffix: str) -> None:
    original = _central(project)
    near_focus = slice(2, 7)
    middle = slice(original.central.shape[1] // 2 - 15, original.central.shape[1] // 2 + 16)
    stack = original.central[near_focus, middle, middle]
    depths = [float(z) for z in original.depths_mm[near_focus]]
    path = tmp_path / f"stack{suffix}"
    if suffix == ".npy":
        np.save(path, stack)
    else:
        scipy.io.savemat(path, {"psf": stack.transpose(1, 2, 0)})
    told = ("--depths", ",".join(f"{z}mm" for z in depths), "--pixel-pitch", "8.6um")
    made = done("-C", project, "bank", "import", path, *told, "--json").only
    assert made["depths_mm"] == pytest.approx(depths, abs=0.001)
    assert made["pixel_pitch_mm"] == pytest.approx(0.0086)
    assert (made["version"], made["state"]) == (2, "active")
    listed = tmp_path / "depths.txt"
    listed.write_text("\n".join(f"{z}mm" for z in depths) + "\n")
    again = done("-C", project, "bank", "import", path, "--depths", listed, *told[2:], "--json").only
    assert (again["version"], again["id"]) == (2, made["id"])


def test_a_long_list_of_depths_is_no_file_name(project: Path, tmp_path: Path) -> None:
    path = tmp_path / "stack.npy"
    np.save(path, _central(project).central)
    many = ",".join(f"{600 + 10 * k}mm" for k in range(100))
    refused(call("-C", project, "bank", "import", path, "--depths", many), "stack.npy", "100 depths")


def test_roll_back_certify_and_revoke(project: Path, tmp_path: Path) -> None:
    exported = tmp_path / "bank.tif"
    done("-C", project, "bank", "export", "v1", exported)
    second = done("-C", project, "bank", "import", exported, "--json").only
    first = _id(project, "v1")
    assert [row["state"] for row in done("-C", project, "bank", "list", "--json").objects] == ["registered", "active"]

    assert done("-C", project, "bank", "activate", "v1", "--json").only["id"] == first
    assert done("-C", project, "bank", "certify", first[:6], "--note", "50 mm at f/3.6", "--json").only["certificate"]
    assert done("-C", project, "bank", "revoke", "v2", "--reason", "test", "--yes", "--json").only["state"] == "revoked"
    states = {row["version"]: row["state"] for row in done("-C", project, "bank", "list", "--json").objects}
    assert states == {1: "active", 2: "revoked"}

    before = listing(project)
    refused(call("-C", project, "bank", "activate", "v2"), "revoked", "test")
    refused(call("-C", project, "bank", "certify", second["id"], "--note", "x"), "revoked")
    assert listing(project) == before

    done("-C", project, "bank", "revoke", "active", "--reason", "lens was moved", "--yes")
    refused(call("-C", project, "bank", "show"), "no bank is active")


@pytest.fixture
def bad_bank(project: Path, frames: Path) -> Outcome:
    """What is said when a bank is made of frames of which one was taken at another depth than its name says."""
    (frames / "psf_205cm.dng").rename(frames / "psf_190cm.dng")
    return call("-C", project, "calibrate", "--frames", frames, "--json")


def test_a_bad_bank_is_kept_but_not_activated_and_the_operator_is_told(project: Path, bad_bank: Outcome) -> None:
    good = _id(project, "active")
    assert bad_bank.code == 3
    assert (bad_bank.only["version"], bad_bank.only["state"]) == (2, "registered")
    assert bad_bank.only["quality"]["verdict"] == "bad"
    said = bad_bank.err.splitlines()[-1]
    for words in ("v2", "not activated", "quality is bad", "190 cm", "workbench bank activate v2 --force"):
        assert words in said
    assert _id(project, "active") == good
    assert call("-C", project, "bank", "verify", "v2").code == 3
    assert call("-C", project, "bank", "certify", "v2", "--note", "x").code == 3


def test_a_bad_bank_is_activated_by_force_only_and_every_measurement_says_so(
    project: Path, bad_bank: Outcome, photograph: Path
) -> None:
    refusal = call("-C", project, "bank", "activate", "v2")
    assert (refusal.code, refusal.out, len(refusal.err.splitlines())) == (3, "", 1)
    assert "--force" in refusal.err
    assert done("-C", project, "bank", "activate", "v2", "--force", "--json").only["state"] == "active"
    quick = ("--roi", "0,0,64,64", "--method", "sharpness", "--set", "iterations=2", "--json")
    by_bad = done("-C", project, "measure", photograph, *quick)
    assert by_bad.only["bank_quality"] == "bad"
    assert "quality of bank" in by_bad.err
    assert "190 cm" in by_bad.err
    assert "The quality of the bank is bad" in (project / by_bad.only["files"]["report"]).read_text(encoding="utf-8")
    by_good = done("-C", project, "measure", photograph, "--bank", "v1", *quick)
    assert by_good.only["bank_quality"] in ("good", "suspect")
    assert "quality" not in by_good.err
    again = done("-C", project, "bank", "activate", "v1", "--json").only
    assert again["state"] == "active"


def _id(project: Path, ref: str) -> str:
    return str(done("-C", project, "bank", "show", ref, "--json").only["id"])


def test_an_unknown_reference_names_the_known_banks(project: Path) -> None:
    known = _id(project, "v1")
    for reference in ("v9", "deadbeef", "latest", ""):
        refused(call("-C", project, "bank", "show", reference), repr(reference), known)


def test_a_sound_bank_is_verified(project: Path) -> None:
    assert done("-C", project, "bank", "verify", "--json").only["sound"]


def _change(path: Path, edit: Callable[[bytes], bytes]) -> None:
    path.write_bytes(edit(path.read_bytes()))


def _flip(position: float) -> Callable[[bytes], bytes]:
    def edit(data: bytes) -> bytes:
        at = int(position * len(data))
        return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]

    return edit


@pytest.mark.parametrize("name", ["psf.npy", "psf_se.npy", "depths_mm.npy", "manifest.json"])
@pytest.mark.parametrize("edit", [_flip(0.5), lambda data: data[: len(data) // 2], lambda data: b""])
def test_a_changed_or_cut_bank_is_refused_by_every_command(
    project: Path, photograph: Path, name: str, edit: Callable[[bytes], bytes]
) -> None:
    _change(_bank_directory(project) / name, edit)
    before = listing(project)
    for command in (
        ("bank", "show"), ("bank", "verify"), ("bank", "list"), ("bank", "activate", "v1"),
        ("bank", "export", "active", project / "out.npz"), ("measure", photograph),
    ):  # fmt: skip
        refused(call("-C", project, *command), name, "restore")
    assert listing(project) == before


def test_a_lost_file_of_a_bank_is_named(project: Path) -> None:
    (_bank_directory(project) / "psf.npy").unlink()
    refused(call("-C", project, "bank", "show"), "psf.npy")
    (_bank_directory(project) / "manifest.json").unlink()
    refused(call("-C", project, "bank", "show"), "manifest.json")


def test_a_changed_registry_is_refused(project: Path, photograph: Path) -> None:
    registry = project / "banks" / "registry.jsonl"
    lines = registry.read_text().splitlines()
    broken = [
        "nonsense\n" + "\n".join(lines[1:]) + "\n",
        lines[0].replace("register", "rejister") + "\n" + lines[1] + "\n",
        "\n".join(lines[1:]) + "\n",
        json.dumps({"act": "register"}) + "\n",
        "[1, 2]\n",
        '{"act": "register", "id": "../../etc", "version": 1}\n',
        "\xff\xfe\n",
    ]
    for text in broken:
        registry.write_text(text, encoding="latin-1")
        before = listing(project)
        for command in (("bank", "list"), ("bank", "show", "v1"), ("bank", "activate", "v1"), ("measure", photograph)):
            refused(call("-C", project, *command), "registry.jsonl", "line")
        assert listing(project) == before


def test_a_torn_last_line_of_the_registry_is_as_if_it_had_not_been_written(project: Path) -> None:
    registry = project / "banks" / "registry.jsonl"
    registry.write_bytes(registry.read_bytes() + b'{"act": "revoke", "id": "')
    assert done("-C", project, "bank", "show", "--json").only["state"] == "active"
    done("-C", project, "bank", "certify", "active", "--note", "after a power cut")
    assert done("-C", project, "bank", "show", "--json").only["certificate"] == "after a power cut"


def test_stacks_that_can_be_no_bank_are_refused(project: Path, tmp_path: Path) -> None:
    psf = _central(project).central[:4]
    three = ("--depths", "80,100,120,140")
    np.save(tmp_path / "good.npy", psf)
    np.save(tmp_path / "flat.npy", psf[0])
    np.save(tmp_path / "nan.npy", np.where(psf > psf.max() / 2, np.nan, psf))
    np.save(tmp_path / "zero.npy", np.zeros_like(psf))
    np.save(tmp_path / "text.npy", np.array(["a", "b"]))
    np.save(tmp_path / "noise.npy", np.random.default_rng(0).random((4, 15, 15)))
    np.savez(tmp_path / "two.npz", a=psf, b=psf)
    tifffile.imwrite(tmp_path / "plain.tif", psf, photometric="minisblack")
    (tmp_path / "broken.npy").write_bytes((tmp_path / "good.npy").read_bytes()[:1000])
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "broken.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(50))
    (tmp_path / "stack.csv").write_text("1,2,3\n")
    before = listing(project)
    for name, depths in (
        ("good.npy", ()), ("good.npy", ("--depths", "80,100,120")), ("good.npy", ("--depths", "80,80,100,120")),
        ("good.npy", ("--depths", "80,120,100,140")), ("good.npy", ("--depths", "0.8,1.0,1.2,1.4")),
        ("flat.npy", three), ("nan.npy", three), ("zero.npy", three), ("text.npy", three), ("noise.npy", three),
        ("two.npz", three), ("plain.tif", ()), ("broken.npy", three), ("empty.npz", three), ("broken.mat", three),
        ("stack.csv", three), ("absent.npy", three),
    ):  # fmt: skip
        refused(call("-C", project, "bank", "import", tmp_path / name, *depths), name)
    for depths in ("80,x,100,120", "80 stone,90,100,120", ",,", str(tmp_path / "good.npy")):
        refused(call("-C", project, "bank", "import", tmp_path / "good.npy", "--depths", depths), "--depths")
    assert listing(project) == before


def test_export_refuses_what_it_cannot_write(project: Path, tmp_path: Path) -> None:
    before = listing(tmp_path)
    refused(call("-C", project, "bank", "export", "active", tmp_path / "bank.txt"), "bank.txt", ".npz")
    refused(call("-C", project, "bank", "export", "active", project / "rig.yaml" / "bank.npz"), "rig.yaml")
    assert listing(tmp_path) == before


def test_revoking_asks_and_no_means_no(project: Path) -> None:
    before = listing(project)
    refused(call("-C", project, "bank", "revoke", "v1", "--reason", "test"), "--yes")
    assert listing(project) == before


def test_bench_measures_crops_of_the_sensor_with_a_projects_bank(project: Path, tmp_path: Path) -> None:
    args = ("--textures", "leaves", "--sizes", "64", "--depths", "1", "--methods", "sharpness", "--jobs", "1")
    found = done("-C", project, "bench", "accuracy", "--bank", "v1", *args, "--out", tmp_path / "out", "--json").only
    assert found["tables"]
    assert (tmp_path / "out" / "accuracy.md").exists()
