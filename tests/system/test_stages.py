"""A calibration through a real stage driver, to firmware on a pseudo-terminal."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import FEW, call, done

from tests.standins.grbl_firmware import GrblFirmware
from tests.standins.pty_server import PtyServer
from tests.standins.rail import Rail
from tests.standins.zaber_device import ZaberChain

FAST = {110: 600000.0, 120: 100000.0, 24: 60000.0, 25: 600000.0, 26: 2}
"""10 m/s: a rail on which moves take milliseconds."""
OFFSET_MM = 3405.0
"""Depth at machine position 0; the simulated stage of the same project has 500 mm at its own 0."""


def choose_stage(project: Path, stage: str) -> None:
    """Write another stage into the project's rig.yaml."""
    text = (project / "rig.yaml").read_text()
    before, rest = text.split("\nstage:\n")
    (project / "rig.yaml").write_text(f"{before}\nstage:\n{stage}\npanel:{rest.partition('panel:')[2]}")


def lens_of(project: Path) -> dict[str, float]:
    lens: dict[str, float] = done("-C", project, "bank", "show", "active", "--json").only["lens"]
    return lens


@pytest.fixture
def rail() -> Iterator[PtyServer]:
    with PtyServer(GrblFirmware(Rail(carriage_mm=60.0), FAST)) as line:
        yield line


@pytest.fixture
def on_grbl(rail: PtyServer, tmp_path: Path) -> Path:
    """A project whose stage is plugged in under a name of its own, as udev gives one."""
    (tmp_path / "rail").symlink_to(rail.path)
    project = tmp_path / "project"
    done("init", project)
    choose_stage(project, f"  kind: grbl\n  port: {tmp_path / 'rail'}\n  depth: {{offset: {OFFSET_MM} mm}}\n")
    return project


def test_calibration_on_grbl_equals_the_simulated_stage(on_grbl: Path, rail: PtyServer, finished: Path) -> None:
    done("-C", on_grbl, "calibrate", *FEW)
    firmware = rail.device
    assert isinstance(firmware, GrblFirmware)
    assert firmware.machine_mm == pytest.approx(2300 - OFFSET_MM, abs=0.02)
    assert firmware.rail.carriage_mm == pytest.approx(firmware.machine_mm + 2905, abs=0.02)
    lens, wanted = lens_of(on_grbl), lens_of(finished)
    assert lens["focus_mm"] == pytest.approx(wanted["focus_mm"], rel=0.002)
    assert lens["zero_mm"] == pytest.approx(wanted["zero_mm"], abs=1.0)


def test_unplugged_rail_ends_the_session_and_replugged_it_is_homed_and_finished(
    on_grbl: Path, rail: PtyServer, tmp_path: Path
) -> None:
    moves = iter(range(1, 100))

    def pulled_at_the_third_move(data: bytes) -> bytes:
        if b"G53" in data and next(moves) == 3:
            rail.unplug()
        return data

    rail.corrupt_input = pulled_at_the_third_move
    stopped = call("-C", on_grbl, "calibrate", *FEW)
    assert stopped.code == 4
    last = stopped.err.splitlines()[-1]
    assert "connection to" in last
    assert "plug it in" in last
    assert "Traceback" not in stopped.err

    firmware = GrblFirmware(Rail(carriage_mm=1500.0), FAST)  # powered off and on: it doesn't know where it stands
    with PtyServer(firmware) as again:
        (tmp_path / "rail").unlink()
        (tmp_path / "rail").symlink_to(again.path)
        done("-C", on_grbl, "resume")
        assert b"$H" in again.sent
        assert again.sent.count(b"G53") == 2  # the two depths before the unplugging are on disk
    assert lens_of(on_grbl)["focus_mm"] == pytest.approx(1600, rel=0.02)


def test_dead_reference_switch_stops_before_the_first_shot(on_grbl: Path, rail: PtyServer) -> None:
    assert isinstance(rail.device, GrblFirmware)
    rail.device.rail.dead_switch = True
    stopped = call("-C", on_grbl, "calibrate", *FEW)
    assert stopped.code == 4
    assert "ALARM:9" in stopped.err.splitlines()[-1]
    assert not list(on_grbl.rglob("*.dng"))
    assert b"G53" not in rail.sent


def test_depths_beyond_the_rail_are_refused_before_it_is_homed(on_grbl: Path, rail: PtyServer) -> None:
    stopped = call("-C", on_grbl, "calibrate", "--from", "40cm", "--to", "100cm", "--step", "10cm")
    assert stopped.code == 2
    assert "40 cm is out of reach (51 to 340.5 cm)" in stopped.err
    assert b"$H" not in rail.sent


def test_calibration_on_zaber_counts_microsteps(tmp_path: Path, finished: Path) -> None:
    chain = ZaberChain()
    project = tmp_path / "project"
    done("init", project)
    with PtyServer(chain) as line:
        choose_stage(project, f"  kind: zaber\n  port: {line.path}\n  microstep: 0.5 um\n  depth: {{offset: 50 cm}}\n")
        done("-C", project, "calibrate", *FEW)
    assert chain.devices[0].position == pytest.approx((2300 - 500) / 0.0005, abs=1)
    assert lens_of(project)["zero_mm"] == pytest.approx(lens_of(finished)["zero_mm"], abs=1.0)


def by_hand(project: Path) -> Path:
    """A project whose panel is moved along a tape measure, which begins at the lens."""
    done("init", project)
    choose_stage(project, "  kind: manual\n  depth: {offset: 0 cm}\n")
    return project


FIVE = ("--from", "80cm", "--to", "280cm", "--step", "50cm", "--repeats", "1")


def test_where_a_panel_moved_by_hand_really_stands_is_its_depth_in_the_bank(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = by_hand(tmp_path / "project")
    answers = ["", "1284 mm", "soon", "9 m", "181.7", "", ""]
    monkeypatch.setattr("sys.stdin", io.StringIO("".join(f"{answer}\n" for answer in answers)))
    outcome = done("-C", project, "calibrate", *FIVE, "--json")
    assert "Move the panel to 130.0 cm and press Enter" in outcome.err
    assert "'soon' is no length; press Enter for 180.0 cm" in outcome.err
    assert "9 m isn't between 0.0 cm and 300.0 cm" in outcome.err
    zero_mm = outcome.only["lens"]["zero_mm"]
    assert zero_mm == pytest.approx(7.0, abs=2 * outcome.only["lens"]["zero_se_mm"])
    depths = [800.0, 1284.0, 1817.0, 2300.0, 2800.0]
    assert outcome.only["depths_mm"] == pytest.approx([depth + zero_mm for depth in depths], abs=0.01)


def test_a_stage_moved_by_hand_without_a_hand_says_so_and_can_be_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = by_hand(tmp_path / "project")
    monkeypatch.setattr("sys.stdin", io.StringIO("\n\n"))
    stopped = call("-C", project, "calibrate", *FIVE)
    assert stopped.code == 4
    assert stopped.err.splitlines()[-1].startswith("workbench: stage: nobody answers here (end of input)")
    monkeypatch.setattr("sys.stdin", io.StringIO("\n\n\n"))
    done("-C", project, "resume")
