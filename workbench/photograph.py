"""Photograph the scene with the rig's camera: exposure metered on the scene, one frame kept."""

from __future__ import annotations

import re
from pathlib import Path

from calibration.image import LinearImage
from rigs.protocols import Camera, CaptureResult, Exposure
from workbench.metering import meter
from workbench.session import FrameCheck

METER_SHOTS = 8


def next_photograph(directory: Path) -> Path:
    """Path of the next photograph, ``photograph-0001.dng`` and on."""
    taken = [
        int(match.group(1))
        for path in (directory.iterdir() if directory.exists() else ())
        if (match := re.fullmatch(r"photograph-(\d+)\.\w+", path.name))
    ]
    return directory / f"photograph-{max(taken, default=0) + 1:04d}.dng"


def photograph(camera: Camera, destination: Path, *, base_iso: int, read: FrameCheck) -> CaptureResult:
    """Meter the scene, expose once, keep that frame only.

    Parameters
    ----------
    camera
        Looks at the scene.
    destination
        Path of the photograph.
    base_iso
        ISO preferred.
    read
        Develops a metering frame.

    Raises
    ------
    RigError
        The camera fails, or the scene is too bright for its shortest exposure.
    """
    destination.parent.mkdir(parents=True, exist_ok=True)
    meters: list[Path] = []

    def expose(exposure: Exposure, path: Path) -> LinearImage:
        result = camera.capture(exposure, path)
        meters.append(result.path)
        return read(result.path)

    try:
        stem = destination.with_name(f".{destination.stem}-meter")
        chosen = meter(expose, camera, stem, start=None, base_iso=base_iso, max_shots=METER_SHOTS)
    finally:
        for path in meters:
            path.unlink(missing_ok=True)
    return camera.capture(chosen.exposure, destination)
