"""A newcomer's way: init, plan, calibrate, look at the bank."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import FEW, PLAN, call, done, listing


def test_the_lens_fit_finds_focus_and_stage_zero_of_the_simulated_rig(lab: Path) -> None:
    bank = done("-C", lab, "bank", "show", "active", "--json").only
    assert bank["lens"]["focus_mm"] == pytest.approx(1600.0, rel=0.01)
    assert bank["lens"]["zero_mm"] == pytest.approx(7.0, abs=5.0)
    assert bank["lens"]["zero_applied"]
    assert bank["depths_mm"][0] == pytest.approx(800 + bank["lens"]["zero_mm"], abs=0.01)
    assert (bank["version"], bank["state"], len(bank["depths_mm"])) == (1, "active", 9)
    assert bank["camera"]["sensor_size"] == [416, 624]


def test_init_from_another_directory_makes_the_project_that_C_names(tmp_path: Path) -> None:
    done("-C", "P", "init", ".", cwd=tmp_path)
    assert (tmp_path / "P" / "rig.yaml").is_file()
    assert "already" in call("-C", "P", "init", ".", cwd=tmp_path).err


def test_a_plan_touches_nothing(lab: Path) -> None:
    before = listing(lab)
    plan = done("--json", "-C", lab, "plan", *PLAN).only
    assert [shot["id"] for shot in plan["shots"]][:3] == ["point-08000-1", "off-08000-1", "point-10500-1"]
    assert len(plan["shots"]) == 18
    assert plan["seconds"] > 0
    assert plan["bytes"] > 1e6
    assert listing(lab) == before


def test_the_same_seed_gives_the_same_bank_in_another_project_and_another_session(
    finished: Path, wanted: str, tmp_path: Path
) -> None:
    other = tmp_path / "other place"
    done("init", other)
    made = done("-C", other, "calibrate", *FEW, "--json").only
    assert made["id"] == wanted
    again = done("-C", other, "calibrate", *FEW, "--json").only
    assert (again["id"], again["version"]) == (wanted, 1)
    assert (made["session"], again["session"]) == ("s0001", "s0002")
    assert wanted in (other / made["report"]).read_text()


def test_another_seed_gives_another_bank(wanted: str, tmp_path: Path) -> None:
    done("init", tmp_path, "--seed", "2")
    assert done("-C", tmp_path, "calibrate", *FEW, "--json").only["id"] != wanted


def test_frames_taken_elsewhere_give_a_bank_whose_zero_is_only_reported(project: Path, frames: Path) -> None:
    made = done("-C", project, "calibrate", "--frames", frames, "--json").only
    assert made["version"] == 2
    assert made["depths_mm"] == [800.0, 1050.0, 1300.0, 2050.0, 2550.0]
    assert not made["lens"]["zero_applied"]
    applied = done("-C", project, "calibrate", "--frames", frames, "--apply-zero", "--json").only
    assert applied["depths_mm"][0] == pytest.approx(800.0 + applied["lens"]["zero_mm"], abs=0.01)


def test_a_table_of_frames_says_the_same_as_file_names(project: Path, frames: Path) -> None:
    by_name = done("-C", project, "calibrate", "--frames", frames, "--json").only
    lines = ["file,depth_cm,kind", "dark.dng,,dark"]
    for number, depth_cm in enumerate((80, 105, 130, 205, 255)):
        (frames / f"psf_{depth_cm:03d}cm.dng").rename(frames / f"IMG_{number}.dng")
        lines.append(f"IMG_{number}.dng,{depth_cm},psf")
    (frames / "frames.csv").write_text("\n".join(lines) + "\n")
    by_table = done("-C", project, "calibrate", "--frames", frames, "--json").only
    assert by_table["lens"] == by_name["lens"]


def test_pathtraced_frames_give_focus_and_aperture(project: Path, shared: Path) -> None:
    made = done("-C", project, "calibrate", "--frames", shared / "psf", "--json").only
    assert made["lens"]["focus_mm"] == pytest.approx(1600.0, rel=0.01)
    assert len(made["depths_mm"]) == 30
    pitch_mm, focal_mm = 0.0086, 50.0
    image_mm = focal_mm * 1600.0 / (1600.0 - focal_mm)
    aperture_mm = made["lens"]["scale_px"] * pitch_mm * 1600.0 / image_mm
    assert aperture_mm == pytest.approx(7.0, rel=0.01)
    quick = ("--method", "sharpness", "--set", "iterations=4")
    found = done(
        "-C", project, "measure", shared / "chart" / "chart_290cm.dng", "--whole", *quick, "--json"
    ).only  # fmt: skip
    (region,) = found["regions"]
    assert region["status"] in ("ok", "ambiguous")
    assert region["depth_mm"] in made["depths_mm"]
    scene = done(
        "-C", project, "measure", shared / "scenes" / "four_b.dng", "--segment", "colour", *quick, "--json"
    ).only  # fmt: skip
    assert len(scene["regions"]) > 3
