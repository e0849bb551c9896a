"""Entry points: a whole simulated rig, and frames of scenes without one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigs.protocols import Exposure
from rigs.rig import DepthAxis, Rig
from rigs.simulated.devices import EXPOSURE_TIMES_S, SimulatedCamera, SimulatedPanel, SimulatedStage, frame_tags
from rigs.simulated.dng import write_dng
from rigs.simulated.scene import Scene, SceneTruth, scene_light, scene_truth
from rigs.simulated.scenes import scene_by_name
from rigs.simulated.sensor import FloatImage, RawImage, expose
from rigs.simulated.world import SimulatedRigSettings, SimulatedWorld


@dataclass(frozen=True)
class SimulatedRig:
    """Camera, stage and panel around one world.

    Real devices may stand beside simulated ones, each of which works without the others: the camera
    photographs whatever the world holds.
    """

    camera: SimulatedCamera
    stage: SimulatedStage
    panel: SimulatedPanel
    world: SimulatedWorld

    def rig(self) -> Rig:
        """The three devices with the axis that the operator believes in."""
        s = self.world.settings
        return Rig(self.camera, self.stage, self.panel, DepthAxis(s.stage_offset_mm, s.stage_sign, s.stage_scale))

    @contextmanager
    def scene_in_view(self, scene: Scene | None = None) -> Iterator[SceneTruth]:
        """Turn the camera to a scene (default: that of the settings) and back to the panel at the end.

        Yields
        ------
        SceneTruth
            What a measurement should find.
        """
        chosen = scene or scene_by_name(self.world.settings.scene, self.world.settings.seed)
        before = self.world.subject
        self.world.subject = chosen
        try:
            yield scene_truth(chosen, self.world.sensor.shape)
        finally:
            self.world.subject = before


def make_rig(settings: SimulatedRigSettings | None = None) -> SimulatedRig:
    """Build a simulated rig; default settings are the small preset."""
    world = SimulatedWorld(settings or SimulatedRigSettings())
    return SimulatedRig(SimulatedCamera(world), SimulatedStage(world), SimulatedPanel(world), world)


@dataclass(frozen=True)
class SceneFrame:
    """A photograph of a scene: raw values (height, width) RGGB, its exposure, and the truth."""

    mosaic: RawImage
    exposure: Exposure
    truth: SceneTruth
    world: SimulatedWorld

    def write(self, path: Path) -> tuple[str, int]:
        """Write it as a DNG file; SHA-256 and number of bytes (see :func:`rigs.simulated.dng.write_dng`)."""
        tags = frame_tags(self.world, self.exposure.time_s, self.exposure.iso)
        return write_dng(path, self.mosaic, tags)


def render_scene_frame(
    scene: Scene | str,
    settings: SimulatedRigSettings | None = None,
    *,
    exposure: Exposure | None = None,
    shot: int = 0,
    frame_shape: tuple[int, int] | None = None,
) -> SceneFrame:
    """Photograph a scene with the camera of these settings.

    Parameters
    ----------
    scene
        A scene, or the name of one (see :func:`rigs.simulated.scenes.scene_by_name`).
    settings
        Lens and sensor; default: the small preset.
    exposure
        Default: ISO 100 and the longest offered time that saturates no more than 0.1 % of the photosites.
    shot
        Determines the noise, with the seed.
    frame_shape
        (height, width) of a smaller or larger sensor of the same kind, even numbers; default: the preset's.
    """
    world = SimulatedWorld(settings or SimulatedRigSettings())
    if frame_shape is not None:
        world.resize(frame_shape)
    chosen = scene_by_name(scene, world.settings.seed) if isinstance(scene, str) else scene
    sensor = world.sensor
    light = scene_light(
        chosen, world.lens, sensor.shape, sensor.pitch_mm,
        response=sensor.response, illumination=world.settings.scene_illumination,
    )  # fmt: skip
    exposure = exposure or auto_exposure(light, world)
    mosaic = expose(light, sensor, time_s=exposure.time_s, iso=exposure.iso, shot=shot)
    return SceneFrame(mosaic, exposure, scene_truth(chosen, sensor.shape), world)


def auto_exposure(light: FloatImage, world: SimulatedWorld) -> Exposure:
    """ISO 100 and the longest offered time at which 99.9 % of the photosites stay below 90 % of white."""
    bright = float(np.percentile(light, 99.9))
    fitting = [t for t in EXPOSURE_TIMES_S if t * bright <= 0.9 * world.sensor.saturating_time_s]
    return Exposure(fitting[-1] if fitting else EXPOSURE_TIMES_S[0], 100)
