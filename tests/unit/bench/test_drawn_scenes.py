"""Scenes drawn for the bench: read back as they were written, the same from the same seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.raw import develop
from rigs.simulated.scenes import drawn_objects
from rigs.simulated.world import SimulatedRigSettings
from workbench.bench.drawn_scenes import write_drawn_scenes
from workbench.bench.truth import read_truth


def test_drawn_scenes_are_read_back_with_their_truth(tmp_path: Path) -> None:
    steps: list[int] = []
    settings = SimulatedRigSettings()
    write_drawn_scenes(tmp_path, 2, 40, settings, lambda step: steps.append(step.done), frame_shape=(192, 288))
    files = read_truth(tmp_path)
    assert steps == [1, 2]
    assert not files.planes
    for number, scene in enumerate(files.scenes):
        drawn = drawn_objects(40 + number)
        assert scene.truth.names == tuple(item.name for item in drawn.objects)
        assert develop(scene.path).shape == scene.truth.object_id.shape == (96, 144)
        for item, place in zip(drawn.objects, range(1, 6), strict=True):
            seen = scene.truth.depth_mm[scene.truth.object_id == place]
            np.testing.assert_allclose(seen, item.depths_mm[0], atol=0.5)


def test_objects_are_drawn_from_the_seed_within_the_rails_reach() -> None:
    for seed in range(20):
        scene, again = drawn_objects(seed), drawn_objects(seed)
        assert scene == again
        depths = [item.depths_mm[0] for item in scene.objects]
        assert depths == sorted(depths, reverse=True)
        assert depths[-1] >= 750 and depths[1] <= 2700 and 2800 <= depths[0] <= 3400  # noqa: PT018
    assert drawn_objects(1) != drawn_objects(2)
