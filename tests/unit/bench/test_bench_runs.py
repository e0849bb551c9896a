"""Whole small runs: cases through processes, speed of methods, memory, the command line's refusals."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from bench_drawings import small_bank

from calibration.bank import save_bank
from calibration.image import FrameInfo, LinearImage
from rigs.simulated.rig import render_scene_frame
from rigs.simulated.world import SimulatedRigSettings
from workbench.bench.accuracy import Run, View, run_cases
from workbench.bench.cases import Case
from workbench.bench.method_speed import SCIKIT_IMAGE, method_rows, peak_memory, six_regions
from workbench.bench.one_thread import in_one_thread
from workbench.cli import workbench
from workbench.cli.common import run as run_command
from workbench.errors import InputError
from workbench.figures.bench import error_and_bound, measured_against_true, rates_by_texture
from workbench.figures.style import to_bytes

QUICK = {"sharpness": {"iterations": "1"}}


def test_a_run_measures_each_case_with_its_methods_in_order() -> None:
    cases = [Case("gravel", 1500.0, True, 1), Case("leaves", 2000.0, False, 2)]
    run = Run(("sharpness",), ("64", "128"), ("normal", "dim"), settings=QUICK)
    steps = []
    outcomes = run_cases(cases, run, View(small_bank(), SimulatedRigSettings()), jobs=1, observer=steps.append)
    assert [(o.texture, o.light, o.size) for o in outcomes] == [
        (texture, light, size)
        for texture in ("gravel", "leaves")
        for light in ("normal", "dim")
        for size in ("64", "128")
    ]
    assert [o.true_mm for o in outcomes[::4]] == [1500.0, 2000.0]
    assert steps[-1].done == steps[-1].total == 2
    by_size = {(o.texture, o.light, o.size): o for o in outcomes}
    small, large = by_size["gravel", "normal", "64"], by_size["gravel", "normal", "128"]
    assert small.bound_mm == pytest.approx(2 * large.bound_mm)
    assert by_size["leaves", "dim", "64"].bound_mm > by_size["leaves", "normal", "64"].bound_mm
    for figure in (measured_against_true, rates_by_texture, error_and_bound):
        assert to_bytes(figure(outcomes, 1600.0), "svg").startswith(b"<?xml")


def test_reference_methods_measure_only_the_first_cases() -> None:
    run = Run(("evidence", "sharpness"), ("64",), ("normal",), first={"sharpness": 3})
    assert run.methods_of(2) == ("evidence", "sharpness")
    assert run.methods_of(3) == ("evidence",)


_LONG_RUN = """
import sys
sys.path.insert(0, sys.argv[1])
if __name__ == "__main__":
    from bench_drawings import small_bank
    from rigs.simulated.world import SimulatedRigSettings
    from workbench.bench.accuracy import Run, View, run_cases
    from workbench.bench.cases import Case
    cases = [Case("gravel", 1500.0, True, seed) for seed in range(1000)]
    run = Run(("sharpness",), ("64",), ("normal",), settings={"sharpness": {"iterations": "1"}})
    view = View(small_bank(), SimulatedRigSettings())
    run_cases(cases, run, view, jobs=1, observer=lambda step: print(step.done, flush=True))
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc to see processes")
def test_processes_end_when_the_run_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "long_run.py"
    script.write_text(_LONG_RUN)
    command = [sys.executable, str(script), str(Path(__file__).parent)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "1\n"
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
        run.kill()
        run.wait()
    deadline = time.monotonic() + 10
    while any(Path(f"/proc/{child}").exists() for child in children) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert children
    assert not [child for child in children if Path(f"/proc/{child}").exists()]


def grey_frame(side: int) -> LinearImage:
    planes = np.random.default_rng(0).uniform(0.1, 0.5, (side, side, 3)).astype(np.float32)
    return LinearImage(planes, np.zeros((side, side), np.bool_), "superpixel", 0.0086, FrameInfo("", ""))


def test_six_regions_fill_the_frame() -> None:
    labels = six_regions((101, 200))
    assert np.unique(labels).tolist() == [1, 2, 3, 4, 5, 6]
    assert np.bincount(labels.ravel())[1:].min() >= 50 * 66


def test_times_of_methods_are_set_against_sharpness() -> None:
    pytest.importorskip("skimage")
    rows = method_rows(grey_frame(192), small_bank(), ["sharpness"], scikit_image_depths=2)
    assert [row.name for row in rows] == ["sharpness", SCIKIT_IMAGE]
    assert rows[0].speed_up == 1.0
    assert rows[0].scaled == 0
    assert rows[1].scaled == 2
    assert rows[1].speed_up == pytest.approx(rows[0].seconds / rows[1].seconds)


def test_peak_memory_is_that_of_a_process_of_its_own(tmp_path: Path) -> None:
    directory = save_bank(small_bank(), tmp_path)
    photograph = tmp_path / "frame.dng"
    render_scene_frame("plane:leaves:150cm", SimulatedRigSettings(), frame_shape=(256, 256)).write(photograph)
    row = peak_memory(directory, photograph, "sharpness")
    assert row.regions >= 1
    assert 50e6 < row.peak_bytes < 2e9


def test_a_photograph_that_cannot_be_measured_says_why(tmp_path: Path) -> None:
    directory = save_bank(small_bank(), tmp_path)
    with pytest.raises(InputError, match="no such file"):
        peak_memory(directory, tmp_path / "none.dng", "sharpness")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--textures", "chart,bricks"], "'bricks': known are chart"),
        (["--methods", "sharpnes"], "'sharpnes': known are"),
        (["--sizes", "100"], "'100': known are 64"),
        (["--set", "sharpness.iteration=3"], "did you mean 'iterations'"),
        (["--set", "iterations=3"], "give method.name=value"),
        (["--raws", "nowhere"], "no such directory"),
        (["--depths", "0"], "0"),
        (["--from", "5m"], "no depth"),
        (["--raws", ".", "--from", "1m"], "--from has no use beside --raws"),
        (["--raws", ".", "--seed", "0"], "--seed has no use"),
        (["--scenes", "1", "--sizes", "64"], "--sizes has no use beside --scenes"),
        (["--raws", ".", "--full"], "--full has no use"),
        (["--bank", "v1", "--bank-step", "20cm"], "--bank-step has no use beside --bank"),
        (["--scenes", "1", "--raws", "."], "--raws and --scenes"),
    ],
)
def test_wrong_wishes_are_refused_before_anything_is_made(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(workbench, ["bench", "accuracy", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_work_in_one_thread_runs_under_limits_that_this_process_keeps_clear_of(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    assert in_one_thread(os.getenv, "OMP_NUM_THREADS") == "1"
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "NUMBA_NUM_THREADS" not in os.environ
    assert in_one_thread(cv2.getNumThreads) == 1
