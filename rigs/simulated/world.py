"""The world around the simulated camera: where the panel really is, what it shows, what the camera looks at."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rigs.errors import LimitError
from rigs.protocols import Pattern
from rigs.simulated.lens import SEVEN, Lens, Pupil
from rigs.simulated.panel_view import PanelSurface, View, panel_light
from rigs.simulated.scene import Scene, scene_light
from rigs.simulated.sensor import FloatImage, Sensor

_TABLET = PanelSurface()

Preset = Literal["small", "eos650d"]
PRESET_SHAPES: dict[str, tuple[int, int]] = {"small": (1024, 1536), "eos650d": (3456, 5184)}
"""Photosites (height, width); ``small`` is the middle of the same sensor, with the same photosites."""

_NEAREST_MM = 200.0


@dataclass(frozen=True)
class SimulatedRigSettings:
    """The truth of a simulated rig.

    Attributes
    ----------
    preset, seed
        Sensor size; everything random follows from the seed.
    focal_length_mm, focus_mm, pupil
        The lens. Depth is measured from it.
    aberration_um, vignetting, coma, focus_breathing
        See :class:`rigs.simulated.lens.Lens`; coma 1 is 10 micrometres sagittal at the edge of the field.
    stage_offset_mm, stage_sign, stage_scale
        What the operator believes: nominal depth = offset + sign * scale * position.
    stage_zero_mm
        True minus nominal depth.
    stage_travel_mm, stage_repeatability_mm
        Positions 0 to travel; standard deviation of the true position.
    stage_misalignment
        Sideways drift of the carriage (x right, y up) per millimetre of depth: the angle between rail and optical axis.
    stage_aside_mm
        Sideways offset (x, y) of the panel's centre from the axis at depth 0.
    surface
        The panel.
    ambient
        Light of a white sheet in the calibration room, relative to the panel's white.
    scene, scene_illumination
        Name of the scene in front of the camera when it doesn't look at the panel; light of a white sheet in it.
    """

    preset: Preset = "small"
    seed: int = 1
    focal_length_mm: float = 50.0
    focus_mm: float = 1600.0
    pupil: Pupil = SEVEN
    aberration_um: float = 1.5
    vignetting: float = 0.0
    coma: float = 0.0
    focus_breathing: float = 0.0
    stage_offset_mm: float = 500.0
    stage_sign: int = 1
    stage_scale: float = 1.0
    stage_zero_mm: float = 7.0
    stage_travel_mm: float = 3000.0
    stage_repeatability_mm: float = 0.05
    stage_misalignment: tuple[float, float] = (0.0006, -0.0004)
    stage_aside_mm: tuple[float, float] = (1.3, -0.8)
    surface: PanelSurface = _TABLET
    ambient: float = 0.0005
    scene: str = "four-objects"
    scene_illumination: float = 0.5

    def lens(self) -> Lens:
        """The lens that these settings describe."""
        return Lens(
            focal_length_mm=self.focal_length_mm, focus_mm=self.focus_mm, pupil=self.pupil,
            aberration_um=self.aberration_um, vignetting=self.vignetting, coma_um=10.0 * self.coma,
            breathing=self.focus_breathing,
        )  # fmt: skip

    def sensor(self) -> Sensor:
        """The sensor that these settings describe."""
        height, width = PRESET_SHAPES[self.preset]
        return Sensor(height, width, seed=self.seed)


class SimulatedWorld:
    """State that the devices share: the carriage, the panel's pattern, the camera's subject.

    Attributes
    ----------
    pattern
        What the panel shows.
    subject
        ``"panel"``, or the scene that the camera looks at instead.
    commanded_mm
        Stage position as commanded.
    """

    make = "Depth Workbench"

    def __init__(self, settings: SimulatedRigSettings) -> None:
        self.settings = settings
        self.lens = settings.lens()
        self.sensor = settings.sensor()
        self.surface = settings.surface
        self.pattern = Pattern("black")
        self.subject: Literal["panel"] | Scene = "panel"
        self.commanded_mm = 0.0
        self._error_mm = 0.0
        self._visits: dict[float, int] = {}
        self._last: tuple[object, FloatImage] | None = None

    @property
    def model(self) -> str:
        """Name of the camera."""
        return f"Simulated {self.settings.preset}"

    @property
    def serial(self) -> str:
        """Serial number, from the seed."""
        return f"SIM{self.settings.seed:06d}"

    def resize(self, shape: tuple[int, int]) -> None:
        """Give the camera a sensor of another size (height, width; even) about the same axis."""
        self.sensor = replace(self.sensor, height=shape[0], width=shape[1])

    def carry_to(self, position_mm: float) -> None:
        """Move the carriage. Its error follows from seed, target and how often that target was visited before."""
        target = round(position_mm, 6)
        visit = self._visits.get(target, 0)
        self._visits[target] = visit + 1
        digest = hashlib.sha256(f"{self.settings.seed}/{target}/{visit}".encode()).digest()
        generator = np.random.default_rng(int.from_bytes(digest[:8], "little"))
        self._error_mm = float(generator.standard_normal()) * self.settings.stage_repeatability_mm
        self.commanded_mm = position_mm

    @property
    def true_depth_mm(self) -> float:
        """Where the panel really is."""
        s = self.settings
        travelled = s.stage_sign * s.stage_scale * (self.commanded_mm + self._error_mm)
        return s.stage_offset_mm + s.stage_zero_mm + travelled

    def view(self) -> View:
        """The panel as seen from the camera."""
        s, depth = self.settings, self.true_depth_mm
        x, y = (a + m * depth for a, m in zip(s.stage_aside_mm, s.stage_misalignment, strict=True))
        return View(depth, x, y, s.ambient)

    def light(self) -> FloatImage:
        """Light on the sensor now, float32 (height, width), for :func:`sensor.expose`; kept for repeats.

        Raises
        ------
        LimitError
            The panel stands in the lens.
        """
        view = self.view()
        if self.subject == "panel" and view.depth_mm < _NEAREST_MM:
            raise LimitError(
                f"stage: the simulated panel stands {view.depth_mm / 10:.1f} cm from the lens, nearer than "
                f"{_NEAREST_MM / 10:g} cm; move it away, or correct stage.depth.offset in rig.yaml"
            )
        key = (self.subject, self.pattern, view) if self.subject == "panel" else (self.subject, None, None)
        if self._last is None or self._last[0] != key:
            self._last = None  # a full frame is large: let go of the old one before the new one is made
            self._last = (key, self._render(view))
        return self._last[1]

    def _render(self, view: View) -> FloatImage:
        sensor = self.sensor
        if isinstance(self.subject, Scene):
            return scene_light(
                self.subject, self.lens, sensor.shape, sensor.pitch_mm,
                response=sensor.response, illumination=self.settings.scene_illumination,
            )  # fmt: skip
        return panel_light(self.pattern, self.surface, view, self.lens, sensor.shape, sensor.pitch_mm, sensor.response)
