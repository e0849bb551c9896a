"""Scenes of several objects, drawn at random and photographed by the simulated rig, written with their truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from rigs.simulated.rig import render_scene_frame
from rigs.simulated.scenes import drawn_objects
from rigs.simulated.world import SimulatedRigSettings
from workbench.files import write_json
from workbench.progress import Observer, Step


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
        cv2.imwrite(str(directory / f"{name}_depth_mm.png"), np.rint(frame.truth.depth_mm).astype(np.uint16))
        cv2.imwrite(str(directory / f"{name}_id.png"), frame.truth.object_id)
        files[f"{name}.dng"] = {
            "kind": "scene",
            "depth": f"{name}_depth_mm.png",
            "ids": f"{name}_id.png",
            "objects": {item: {"id": number} for number, item in enumerate(frame.truth.names, start=1)},
        }
        observer(Step(f"drawing {name}", index + 1, count))
    write_json(directory / "truth.json", {"files": files})
