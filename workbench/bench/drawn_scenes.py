"""Scenes of several objects, drawn at random and photographed by the simulated rig, written with their truth."""

from __future__ import annotations

from pathlib import Path

from rigs.simulated.rig import render_scene_frame
from rigs.simulated.scenes import drawn_objects
from rigs.simulated.world import SimulatedRigSettings
from workbench.files import write_json
from workbench.progress import Observer, Step
from workbench.truth_files import write_scene_truth


def write_drawn_scenes(
    directory: Path,
    count: int,
    seed: int,
    settings: SimulatedRigSettings,
    observer: Observer,
    *,
    frame_shape: tuple[int, int] | None = None,
) -> None:
    """Photograph scenes into a directory that :func:`workbench.bench.truth.read_truth` reads.

    Parameters
    ----------
    directory
        Exists; gets a RAW file per scene, its depth in mm (16-bit PNG), its objects' ids (8-bit PNG), and truth.json.
    count, seed
        How many; scene k is drawn from ``seed + k``.
    settings
        Lens and sensor.
    observer
        Progress.
    frame_shape
        Photosites (height, width); default: the preset's.
    """
    files = {}
    for index in range(count):
        name = f"scene-{seed + index}"
        frame = render_scene_frame(drawn_objects(seed + index), settings, shot=index, frame_shape=frame_shape)
        frame.write(directory / f"{name}.dng")
        truth = frame.truth
        files[f"{name}.dng"] = write_scene_truth(directory, name, truth.depth_mm, truth.object_id, truth.names)
        observer(Step(f"drawing {name}", index + 1, count))
    write_json(directory / "truth.json", {"files": files})
