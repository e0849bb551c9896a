"""Truth of a photographed scene as files: depth and object of every developed pixel, and its entry in truth.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.display import png_bytes
from workbench.files import write_bytes


def write_truth_images(
    directory: Path, stem: str, depth_mm: NDArray[np.floating], object_id: NDArray[np.integer]
) -> tuple[str, str]:
    """Write ``STEM_depth_mm.png`` (16 bits, 0 where nothing is) and ``STEM_id.png`` (8 bits); returns their names.

    Parameters
    ----------
    directory, stem
        Where, and the beginning of the names, relative to the directory.
    depth_mm
        float (H, W), infinite where nothing is.
    object_id
        Whole numbers (H, W), 0 to 255; 0 is no object.
    """
    depth = np.where(np.isfinite(depth_mm), np.rint(depth_mm), 0).astype(np.uint16)
    names = f"{stem}_depth_mm.png", f"{stem}_id.png"
    write_bytes(directory / names[0], png_bytes(depth))
    write_bytes(directory / names[1], png_bytes(object_id.astype(np.uint8)))
    return names


def write_scene_truth(
    directory: Path, stem: str, depth_mm: NDArray[np.floating], object_id: NDArray[np.integer], names: Sequence[str]
) -> dict[str, Any]:
    """Write both images; returns what ``truth.json`` says of the scene, object k being the k-th name, from 1 on."""
    depth, ids = write_truth_images(directory, stem, depth_mm, object_id)
    objects = {name: {"id": number} for number, name in enumerate(names, start=1)}
    return {"kind": "scene", "depth": depth, "ids": ids, "objects": objects}
