"""workbench align on the simulated rig, and with a camera's live view."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import call, done


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("align") / "project"
    done("init", made)
    return made


def test_exposure_follows_the_point_until_it_is_well_exposed(project: Path) -> None:
    result = done("-C", project, "align", "--at", "120cm", "--frames", "4", "--port", "0", "--json")
    last = result.objects[-1]
    assert len(result.objects) == 4
    assert 0.4 < last["peak"] < 0.86
    assert last["distance_px"] < 25
    assert last["pattern"] == "dot"
    assert {finding["aspect"] for finding in last["findings"]} == {"centre", "exposure", "focus"}


def test_the_point_is_narrowest_at_the_focus(project: Path) -> None:
    widths = {}
    for depth in ("100cm", "160cm", "250cm"):
        result = done("-C", project, "align", "--at", depth, "--frames", "3", "--port", "0", "--json")
        widths[depth] = result.objects[-1]["width_px"]
    assert widths["160cm"] < 4 < widths["250cm"] < widths["100cm"]


def test_fixed_exposure_is_kept_and_its_fault_named(project: Path) -> None:
    result = done("-C", project, "align", "--exposure", "30s", "--frames", "2", "--port", "0", "--json")
    assert [line["exposure_s"] for line in result.objects] == [30, 30]
    assert result.objects[-1]["findings"][0]["text"].startswith("saturated: shorten the exposure")


def test_cross_hair_is_shown_and_not_measured(project: Path) -> None:
    result = done("-C", project, "align", "--show", "cross-hair", "--frames", "1", "--port", "0", "--json")
    assert result.only["centroid_px"] is None
    assert "press Dot" in result.only["note"]


def test_live_view_is_measured_too(project: Path) -> None:
    result = done("-C", project, "align", "--live-view", "--frames", "1", "--port", "0", "--json")
    assert result.only["frame_px"][0] > 100


def test_depth_out_of_reach_is_refused(project: Path) -> None:
    result = call("-C", project, "align", "--at", "9m", "--frames", "1", "--port", "0")
    assert result.code == 4
    assert "out of reach" in result.err


def test_nothing_is_left_in_the_project(project: Path) -> None:
    assert {path.name for path in project.iterdir()} <= {"rig.yaml", ".rig.lock"}
