"""Banks and photographs of flat scenes by the simulated lens and sensor, through any pupil."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank, LensFit
from calibration.image import FrameInfo, LinearImage
from rigs.simulated.lens import SEVEN as LENS_SEVEN
from rigs.simulated.lens import Lens, MaskPupil, PolygonPupil, Pupil, point_image
from rigs.simulated.scene import Scene, SceneObject, scene_light
from rigs.simulated.scenes import plane_scene, rectangle
from rigs.simulated.sensor import Sensor, expose

PITCH_MM = 0.0043
FOCUS_MM = 1600.0
DEPTHS_MM = tuple(float(z) for z in range(800, 3501, 100))
_BACKDROP = rectangle(-5.0, -5.0, 6.0, 6.0)


def gaussian_pupil() -> MaskPupil:
    """A soft apodised opening whose blur is nearly Gaussian."""
    side = 15.0
    y, x = (np.mgrid[:75, :75] + 0.5) / 75 * side - side / 2
    soft = np.exp(-0.5 * (x**2 + y**2) / 2.2**2)
    return MaskPupil(np.where(np.hypot(x, y) < 7.0, soft, 0.0), side)


def round_pupil(radius_mm: float, centre_mm: tuple[float, float] = (0.0, 0.0)) -> PolygonPupil:
    turns = [2 * math.pi * k / 48 for k in range(48)]
    return PolygonPupil(
        (tuple((centre_mm[0] + radius_mm * math.cos(t), centre_mm[1] + radius_mm * math.sin(t)) for t in turns),)
    )


def within(pupil: PolygonPupil, radius_mm: float = 7.5) -> PolygonPupil:
    """The same opening with a speck of no area at a radius.

    A scene's texture is drawn as large as the pupil's blur reaches, and another size is another drawing: pupils of one
    radius see the same scene.
    """
    speck = ((radius_mm, 0.0), (radius_mm, 1e-5), (radius_mm - 1e-5, 0.0))
    return PolygonPupil((*pupil.loops_mm, speck))


_ELL = PolygonPupil((((-5.0, 5.0), (-2.0, 5.0), (-2.0, -2.0), (5.0, -2.0), (5.0, -5.0), (-5.0, -5.0)),))
SEVEN, ELL, SMALL = within(LENS_SEVEN), within(_ELL), within(round_pupil(1.0))
"""The seven, a second mask beside it, and a small round aperture; all three see the same scene."""


def lens_through(pupil: Pupil) -> Lens:
    return Lens(focus_mm=FOCUS_MM, pupil=pupil)


@lru_cache(maxsize=8)
def bank_through(pupil: Pupil, depths_mm: Sequence[float] = DEPTHS_MM) -> Bank:
    """The bank that a faultless calibration through this pupil would make."""
    lens, pitch = lens_through(pupil), 2 * PITCH_MM
    depths = np.array(depths_mm)
    scale = pupil.radius_mm * lens.focal_length_mm / (lens.focus_mm - lens.focal_length_mm) / pitch
    radii = scale * (1 - lens.focus_mm / depths)
    images = [point_image(lens, float(z), pitch) for z in depths]
    side = max(len(image) for image in images)
    psf = np.stack([np.pad(image, (side - len(image)) // 2) for image in images])[None].astype(np.float32)
    zeros = np.zeros(len(depths))
    fit = LensFit(lens.focus_mm, 1.0, scale, 0.01, 0.0, 1.0, radii, zeros + 0.05, zeros)
    return Bank(depths, psf, np.zeros_like(psf), np.zeros((1, 2)), fit, "superpixel", pitch)


def photograph(scene: Scene, pupil: Pupil, side: int, shot: int = 1, brightness: float = 0.6) -> LinearImage:
    """What the camera sees of a scene, developed to side x side superpixels."""
    sensor = Sensor(2 * side, 2 * side, pitch_mm=PITCH_MM)
    light = scene_light(scene, lens_through(pupil), sensor.shape, PITCH_MM)
    raw = expose(light, sensor, time_s=brightness * sensor.saturating_time_s, iso=100, shot=shot)
    linear = (raw.astype(np.float32) - sensor.black) / (sensor.white - sensor.black)
    r, g, b = linear[::2, ::2], (linear[::2, 1::2] + linear[1::2, ::2]) / 2, linear[1::2, 1::2]
    clipped = (raw >= sensor.white).reshape(side, 2, side, 2).any(axis=(1, 3))
    planes = np.stack([r, g, b], axis=2).astype(np.float32)
    return LinearImage(planes, clipped, "superpixel", 2 * PITCH_MM, FrameInfo("simulated", ""))


def textured(texture: str, depth_mm: float, seed: int = 3) -> Scene:
    return plane_scene(texture, depth_mm, seed=seed)


def step_edges(depth_mm: float) -> Scene:
    """A chart of a few large patches with straight edges, far apart."""

    def patch(level: float, outline: tuple[tuple[float, float], ...]) -> SceneObject:
        return SceneObject("patch", "blank", outline, (depth_mm,) * 3, dark=(level,) * 3, light=(level,) * 3)

    return Scene(
        "edges",
        (
            patch(0.2, _BACKDROP),
            patch(0.8, ((0.2, 0.25), (0.75, 0.2), (0.8, 0.75), (0.25, 0.8))),
        ),
    )


def labels_of(image: LinearImage) -> NDArray[np.int32]:
    return np.ones(image.shape, np.int32)
