"""workbench align on the simulated rig, and with a camera's live view."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from command_line import call, done

from calibration.raw import develop
from rigs.protocols import Exposure, Pattern
from rigs.simulated.rig import make_rig
from rigs.simulated.world import SimulatedRigSettings
from workbench.alignment import look, panel_mm_per_px


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


def test_distance_on_the_panel_is_what_the_dot_was_moved_by(tmp_path: Path) -> None:
    """The scale is the estimator's thin lens; the frames are the simulator's."""
    settings = SimulatedRigSettings()
    rig = make_rig(settings)
    rig.stage.home()
    rig.stage.move_to_mm(2000.0)
    depth_mm = settings.stage_offset_mm + settings.stage_zero_mm + 2000.0
    centroids = []
    for x_px in (0.0, 150.0):
        rig.panel.show(Pattern("dot", size_px=4.0, x_px=x_px))
        sample = look(develop(rig.camera.capture(Exposure(1.0, 100), tmp_path / f"{x_px:g}.dng").path), None)
        assert sample.centroid_px is not None
        centroids.append(sample.centroid_px[0])
    scale = panel_mm_per_px(0.0086, depth_mm, 50.0, 1600.0)
    assert (centroids[1] - centroids[0]) * scale == pytest.approx(150.0 * settings.surface.pitch_mm, rel=0.01)


def test_distance_on_the_panel_needs_its_depth(project: Path) -> None:
    here = done("-C", project, "align", "--at", "200cm", "--frames", "2", "--port", "0", "--json").objects[-1]
    assert here["offset_mm"][0] == pytest.approx(here["offset_px"][0] * 0.332, rel=0.05, abs=0.01)
    anywhere = done("-C", project, "align", "--frames", "2", "--port", "0", "--json").objects[-1]
    assert anywhere["offset_px"]
    assert anywhere["offset_mm"] is None


def test_stage_is_left_alone_unless_a_depth_is_given(project: Path, tmp_path: Path) -> None:
    text = (project / "rig.yaml").read_text()
    lab = tmp_path / "lab"
    done("init", lab)
    stage = "stage:\n  kind: grbl\n  port: /dev/no-such-port\n  depth:\n    offset: 200 cm\n"
    (lab / "rig.yaml").write_text(re.sub(r"stage:\n(?: .*\n|\n)*", stage, text, count=1))
    done("-C", lab, "align", "--frames", "1", "--port", "0")
    assert "no-such-port" in call("-C", lab, "align", "--at", "1m", "--frames", "1", "--port", "0").err


def test_exposure_that_the_camera_does_not_offer_is_said(project: Path) -> None:
    result = done("-C", project, "align", "--exposure", "0.07s", "--frames", "1", "--port", "0", "--json")
    assert "offers no 0.07 s; taking 1/15 s" in result.err
    assert result.only["exposure_s"] == pytest.approx(1 / 15, rel=0.01)


def test_fixed_exposure_is_kept_and_its_fault_named(project: Path) -> None:
    result = done("-C", project, "align", "--exposure", "30s", "--frames", "2", "--port", "0", "--json")
    assert [line["exposure_s"] for line in result.objects] == [30, 30]
    assert result.objects[-1]["findings"][0]["text"].startswith("saturated: shorten the exposure")


def test_cross_hair_is_shown_and_not_measured(project: Path) -> None:
    result = done("-C", project, "align", "--show", "cross-hair", "--frames", "1", "--port", "0", "--json")
    assert result.only["centroid_px"] is None
    assert result.only["findings"] == [
        {
            "aspect": "pattern",
            "level": "info",
            "text": "cross-hair: turn the camera until the cross stands in the middle",
        }
    ]


def test_white_panel_that_saturates_every_pixel_is_exposed_shorter(project: Path) -> None:
    result = done("-C", project, "align", "--at", "60cm", "--show", "white", "--frames", "6", "--port", "0", "--json")
    peaks = [line["peak"] for line in result.objects]
    assert peaks[0] == 1.0
    assert 0.4 < peaks[-1] < 0.86
    assert result.objects[-1]["saturated_px"] == 0


def test_live_view_is_measured_too(project: Path) -> None:
    result = done("-C", project, "align", "--live-view", "--frames", "1", "--port", "0", "--json")
    assert result.only["frame_px"][0] > 100


def test_depth_out_of_reach_is_refused(project: Path) -> None:
    result = call("-C", project, "align", "--at", "9m", "--frames", "1", "--port", "0")
    assert result.code == 4
    assert "out of reach" in result.err


def test_nothing_is_left_in_the_project(project: Path) -> None:
    assert {path.name for path in project.iterdir()} <= {"rig.yaml", ".rig.lock"}
