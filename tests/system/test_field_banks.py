"""A bank over the field, through the command line: planned, taken, shown, measured with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import FEW, call, done

from calibration.bank import load_bank


@pytest.fixture(scope="module")
def field_project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("field") / "project"
    done("init", root)
    rig = root / "rig.yaml"
    rig.write_text(rig.read_text().replace("  stage_zero:", "  coma: 1.0\n  vignetting: 1.0\n  stage_zero:"))
    done("-C", root, "calibrate", *FEW, "--field", "2x2")
    return root


def test_a_grid_of_points_becomes_a_bank_with_a_set_per_place(field_project: Path) -> None:
    shown = done("-C", field_project, "bank", "show", "--json").only
    assert shown["fields"] == 4
    bank = load_bank(field_project / "banks" / shown["id"])
    assert bank.extras["place_yx"].shape == (4, 4, 2)
    assert sorted(tuple(np.sign(bank.field_yx[k])) for k in range(4)) == [(-1, -1), (-1, 1), (1, -1), (1, 1)]


def test_vignetting_makes_the_places_psfs_differ(field_project: Path) -> None:
    shown = done("-C", field_project, "bank", "show", "--json").only
    psf = load_bank(field_project / "banks" / shown["id"]).psf[:, 0]
    assert abs(psf[0] - psf[3]).sum() > 0.05


def test_regions_are_measured_with_a_bank_over_the_field(field_project: Path) -> None:
    done("-C", field_project, "capture", "--roi", "20,20,96,96", "--method", "sharpness")


def test_only_a_bank_over_the_field_is_compared_with_its_centre(lab: Path, project: Path) -> None:
    refused = call("-C", project, "bench", "field")
    assert refused.code == 2
    assert "--field 3x3" in refused.err


def test_a_field_that_cant_be_is_refused(project: Path) -> None:
    assert call("-C", project, "plan", "--field", "3").code == 2
    assert "0x3" in call("-C", project, "plan", "--field", "0x3").err
