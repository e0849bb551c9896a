"""A whole rig, described by the project in WORKBENCH_TEST_PROJECT: checked, and calibrated at five depths."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PROJECT = os.environ.get("WORKBENCH_TEST_PROJECT", "")
pytestmark = [
    pytest.mark.hardware,
    pytest.mark.skipif(not PROJECT, reason="WORKBENCH_TEST_PROJECT names no project directory with a rig.yaml"),
]
HOURS_S = 3600.0


def workbench(*arguments: str) -> tuple[int, list[dict[str, Any]], str]:
    """Run the command line on the rig; the operator sees what it says as it comes."""
    command = [sys.executable, "-c", "from workbench.cli import main; main()", "-C", PROJECT, *arguments, "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=HOURS_S, check=False)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()], done.stdout


def test_doctor_finds_nothing_that_would_stop_a_calibration() -> None:
    code, (report,), _ = workbench("doctor", "--panel-wait", "2min")
    assert code == 0, [finding for finding in report["findings"] if finding["severity"] == "error"]


def test_five_depths_make_a_good_bank() -> None:
    before = {path.name for path in (Path(PROJECT) / "banks").glob("*")}
    code, (bank,), said = workbench("calibrate", "--from", "100cm", "--to", "260cm", "--step", "40cm", "--repeats", "2")
    assert code == 0, said
    assert bank["quality"]["verdict"] in ("good", "suspect")
    assert bank["lens"]["rms_residual_px"] < 0.5
    assert bank["id"] not in before
