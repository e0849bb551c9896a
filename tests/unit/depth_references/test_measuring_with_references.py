"""Reference methods through the measuring layer: files named in settings, provenance, reports without intervals."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from simulated_views import ELL, SEVEN, bank_through, photograph, textured

from calibration.errors import CalibrationError
from workbench.banks import store_bank
from workbench.depth.estimate import DepthEstimate
from workbench.errors import InputError
from workbench.measure import MeasureOptions, measure, open_second_view, save
from workbench.project import Project

FEW_MM = (1000.0, 1200.0, 1400.0, 1600.0, 1900.0, 2300.0, 2900.0)
SIDE = 128


@pytest.fixture
def project(tmp_path: Path) -> Project:
    project = Project(tmp_path)
    project.banks.mkdir()
    store_bank(project, bank_through(ELL, FEW_MM))
    store_bank(project, bank_through(SEVEN, FEW_MM))
    for name, pupil, shot in (("seven", SEVEN, 1), ("ell", ELL, 2)):
        np.save(tmp_path / f"{name}.npy", photograph(textured("leaves", 1200.0), pupil, SIDE, shot=shot).planes)
    return project


def test_second_photograph_and_bank_are_opened_by_name(project: Project) -> None:
    settings = open_second_view(
        project, "pair", (("second_image", str(project.root / "ell.npy")), ("second_bank", "v1"))
    )
    options = MeasureOptions("pair", settings, whole=True)
    bank = bank_through(SEVEN, FEW_MM)
    measured = save(measure(project.root / "seven.npy", bank, "active", options), bank, project)
    assert measured.estimates[1].depth_mm == 1200.0
    stored = json.loads((measured.files["report"].parent / "measurement.json").read_text())
    assert stored["regions"][0]["interval_mm"] == [None, None]
    assert stored["options"]["method_options"]["second_bank"] == bank_through(ELL, FEW_MM).id
    assert stored["options"]["method_options"]["second_image"]["path"].endswith("ell.npy")


def test_report_of_a_method_without_side_of_focus(project: Project) -> None:
    bank = bank_through(SEVEN, FEW_MM)
    options = MeasureOptions("zhuo-sim", whole=True)
    measured = save(measure(project.root / "seven.npy", bank, "active", options), bank, project)
    assert "can't tell the side of focus" in measured.estimates[1].reason
    assert measured.files["report"].stat().st_size > 1000


def test_what_is_missing_or_unknown_is_said_before_anything_is_measured(project: Project) -> None:
    with pytest.raises(InputError, match="second_image=FILE"):
        open_second_view(project, "pentland", ())
    with pytest.raises(InputError, match="second_bank=REF"):
        open_second_view(project, "pair", (("second_image", "ell.npy"),))
    with pytest.raises(CalibrationError, match="v7"):
        open_second_view(project, "pair", (("second_image", "ell.npy"), ("second_bank", "v7")))
    assert open_second_view(project, "levin", (("tiles", "1"),)) == (("tiles", "1"),)


@pytest.mark.parametrize(
    ("chosen", "found"),
    [({}, True), ({"segment": "colour"}, True), ({"whole": True}, False), ({"roi": (0, 0, 96, 96)}, False),
     ({"labels": "labels.png"}, False)],
)  # fmt: skip
def test_the_estimator_is_told_whether_outlines_were_found(
    project: Project, monkeypatch: pytest.MonkeyPatch, chosen: dict[str, object], found: bool
) -> None:
    told: list[bool] = []

    def estimates(*_: object, outlines_found: bool = False, **__: object) -> dict[int, DepthEstimate]:
        told.append(outlines_found)
        return {}

    monkeypatch.setattr("workbench.measure.estimate_depths", estimates)
    if "labels" in chosen:
        chosen = {"labels": project.root / "labels.png"}
        cv2.imwrite(str(chosen["labels"]), np.ones((SIDE, SIDE), np.uint8))
    measure(project.root / "seven.npy", bank_through(SEVEN, FEW_MM), "active", MeasureOptions(**chosen))
    assert told == [found]
