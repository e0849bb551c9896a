"""Directories of files with a truth.json: planes whole, objects by their inner part and through merging."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from bench_drawings import grey_is_depth, small_bank

from workbench.bench.truth import read_truth, run_truth
from workbench.depth import methods
from workbench.depth.methods import Method
from workbench.depth.sharpness import SharpnessOptions
from workbench.errors import InputError

SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "pathtraced"


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """A plane at 130 cm and a scene with a box at 120 cm, a wall at 240 cm and a slanted floor; grey is depth."""
    generator = np.random.default_rng(0)

    def save(name: str, grey: np.ndarray) -> None:
        np.save(tmp_path / name, (grey + generator.normal(0, 1e-4, grey.shape)).astype(np.float32))

    save("plane.npy", np.full((64, 64), 0.131))
    depth = np.full((96, 128), 2400, np.uint16)
    depth[20:70, 20:70] = 1200
    depth[80:] = np.linspace(1000, 2400, 128).astype(np.uint16)
    ids = np.zeros(depth.shape, np.uint8)
    ids[20:70, 20:70], ids[80:] = 4, 9
    save("scene.npy", depth / 10_000.0)
    cv2.imwrite(str(tmp_path / "ids.png"), ids)
    cv2.imwrite(str(tmp_path / "depth.png"), depth)
    files = {
        "psf/psf_100cm.npy": {"kind": "psf", "z_mm": 1000},
        "plane.npy": {"kind": "chart", "z_mm": 1300},
        "scene.npy": {"kind": "scene", "ids": "ids.png", "depth": "depth.png",
                      "objects": {"wall": {"id": 0}, "box": {"id": 4}, "floor": {"id": 9}}},
    }  # fmt: skip
    (tmp_path / "truth.json").write_text(json.dumps({"files": files}))
    return tmp_path


@pytest.fixture
def grey(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setitem(methods.METHODS, "grey", Method("grey", "test", grey_is_depth, SharpnessOptions))
    return "grey"


def test_each_plane_and_object_is_compared_with_its_own_truth(directory: Path, grey: str) -> None:
    steps: list[str] = []
    singles = run_truth(
        read_truth(directory), small_bank("linear"), [grey], {}, lambda step: steps.append(step.message)
    )
    found = {(s.name, s.outcome.size): s.outcome for s in singles}
    plane = found["plane", "whole"]
    assert plane.true_mm == 1300
    assert plane.depth_mm == pytest.approx(1310, abs=1)
    for size in ("object", "merged"):
        assert found["scene: box", size].true_mm == 1200
        assert found["scene: box", size].depth_mm == pytest.approx(1200, abs=60)
        assert found["scene: wall", size].true_mm == 2400
    assert found["scene: box", "object"].depth_mm == pytest.approx(1200, abs=1)
    assert steps == ["plane.npy, grey", "scene.npy, grey"]


def test_what_has_no_single_depth_is_left_out(directory: Path, grey: str) -> None:
    singles = run_truth(read_truth(directory), small_bank("linear"), [grey], {}, lambda _: None)
    assert not [s for s in singles if "floor" in s.name]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: (d / "truth.json").unlink(), "no such file"),
        (lambda d: (d / "truth.json").write_text("{"), "can't be used"),
        (lambda d: (d / "truth.json").write_text('{"files": {"a.dng": {"kind": "chart"}}}'), "z_mm"),
        (lambda d: (d / "truth.json").write_text('{"files": {"a": {"kind": "psf"}}}'), "no photograph"),
        (lambda d: (d / "plane.npy").unlink(), "plane.npy, which isn't there"),
        (lambda d: (d / "ids.png").unlink(), "ids.png: no such image"),
        (lambda d: cv2.imwrite(str(d / "ids.png"), np.zeros((5, 5), np.uint8)), "ids.png"),
    ],
)
def test_a_truth_that_cannot_be_used_is_named(directory: Path, damage: object, message: str) -> None:
    assert callable(damage)
    damage(directory)
    with pytest.raises(InputError, match=message):
        read_truth(directory)


def test_a_truth_of_another_size_than_the_photograph_is_refused(directory: Path, grey: str) -> None:
    for name in ("ids.png", "depth.png"):
        cv2.imwrite(str(directory / name), np.ones((50, 60), np.uint16 if name == "depth.png" else np.uint8))
    with pytest.raises(InputError, match="128 x 96"):
        run_truth(read_truth(directory), small_bank("linear"), [grey], {}, lambda _: None)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the path-traced images aren't beside this checkout")
def test_the_path_traced_truth_is_read() -> None:
    files = read_truth(SHARED)
    assert {p.kind for p in files.planes} == {"chart", "photo"}
    (scene,) = files.scenes
    page = scene.truth.names.index("page") + 1
    assert np.median(scene.truth.depth_mm[scene.truth.object_id == page]) == 800
