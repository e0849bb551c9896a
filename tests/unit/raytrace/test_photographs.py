"""Directories of traced RAW files: what the accuracy command reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.raw import develop
from workbench.bench.truth import read_truth
from workbench.raytrace.drawings import DRAWINGS, draw
from workbench.raytrace.photographs import write_photographs
from workbench.raytrace.stills import PLANES, THINGS, still_life
from workbench.raytrace.tracing import trace_point
from workbench.raytrace.world import Camera

CAMERA = Camera(height=256, width=384)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("traced")
    depths_mm = (600.0, 3500.0)
    write_photographs(
        path, scenes=1, planes=2, seed=7, rays=4, observer=lambda _: None, camera=CAMERA, point_depths_mm=depths_mm
    )
    return path


def test_the_accuracy_command_reads_what_was_written(directory: Path) -> None:
    files = read_truth(directory)
    assert [plane.kind for plane in files.planes] == list(PLANES[:2])
    assert all(600.0 <= plane.true_mm <= 3500.0 for plane in files.planes)
    (scene,) = files.scenes
    assert scene.truth.object_id.shape == (128, 192)
    assert scene.truth.names[-1] == "wall"
    wall = scene.truth.depth_mm[scene.truth.object_id == len(scene.truth.names)]
    assert 2850.0 <= wall.min() == wall.max() <= 3450.0


def test_photographs_are_exposed_to_most_of_the_range(directory: Path) -> None:
    for item in read_truth(directory).planes:
        image = develop(item.path)
        assert 0.75 < np.quantile(image.planes, 0.999) < 1.0
        assert image.saturated.mean() < 0.01


def test_points_are_in_the_middle_of_their_frames(directory: Path) -> None:
    planes = develop(directory / "psf/psf_060cm.dng").planes.sum(axis=2)
    y, x = np.mgrid[: planes.shape[0], : planes.shape[1]]
    light = np.maximum(planes - 0.02, 0.0)
    middle = (light * y).sum() / light.sum(), (light * x).sum() / light.sum()
    spot = trace_point(replace(CAMERA, height=512, width=512), 600.0, rays=1 << 14, seed=1)
    own = [float((spot.sum(axis=1 - axis) * (np.arange(512) + 0.5)).sum() / 2 - 0.5) for axis in (0, 1)]
    assert middle == pytest.approx(own, abs=1.0)


@pytest.mark.parametrize("kind", DRAWINGS)
def test_every_drawing_has_texture_and_follows_its_seed(kind: str) -> None:
    first, again, other = (draw(kind, 300, 420, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.shape == (300, 420, 3)
    assert first.dtype == np.uint8
    assert first.std() > 2.0
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_still_lifes_hold_three_to_five_things_before_a_wall() -> None:
    kinds = set()
    for seed in range(12):
        *things, wall = [item for item in still_life(CAMERA, seed) if item.name != "ground"]
        assert 3 <= len(things) <= 5
        assert len({item.name for item in things}) == len(things)
        assert all(item.corner[2] < wall.corner[2] for item in things)
        kinds |= {item.name.split()[0] for item in things}
    assert kinds <= set(THINGS)
    assert len(kinds) > 6
