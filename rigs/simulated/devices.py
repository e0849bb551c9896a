"""The simulated devices: what a session drives, around one world."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import cv2
import numpy as np

from rigs.errors import CameraError, LimitError, NotHomedError, PanelError, SettingError
from rigs.motion import range_within
from rigs.protocols import CaptureResult, DeviceIdentity, Exposure, PanelAck, Pattern
from rigs.simulated.dng import Compression, FrameTags, write_dng
from rigs.simulated.panel_view import check_pattern
from rigs.simulated.sensor import expose
from rigs.simulated.world import SimulatedWorld

EXPOSURE_TIMES_S: tuple[float, ...] = (
    1 / 4000, 1 / 3200, 1 / 2500, 1 / 2000, 1 / 1600, 1 / 1250, 1 / 1000, 1 / 800, 1 / 640, 1 / 500, 1 / 400, 1 / 320,
    1 / 250, 1 / 200, 1 / 160, 1 / 125, 1 / 100, 1 / 80, 1 / 60, 1 / 50, 1 / 40, 1 / 30, 1 / 25, 1 / 20, 1 / 15, 1 / 13,
    1 / 10, 1 / 8, 1 / 6, 1 / 5, 1 / 4, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.0, 8.0,
    10.0, 13.0, 15.0, 20.0, 25.0, 30.0,
)  # fmt: skip
"""Shutter speeds of an EOS 650D in thirds of a stop."""
ISOS: tuple[int, ...] = (100, 200, 400, 800, 1600, 3200, 6400, 12800)
"""ISO values of an EOS 650D."""

_SPEED_MM_S, _ACCELERATION_MM_S2 = 50.0, 100.0


class SimulatedCamera:
    """A camera that photographs the world's subject.

    Frames of the small preset are not compressed unless asked for: coding and decoding would take longer than all else.
    """

    def __init__(self, world: SimulatedWorld, *, compression: Compression | None = None) -> None:
        self._world = world
        self._compression: Compression = compression or ("none" if world.settings.preset == "small" else "ljpeg")
        self._taken: dict[str, int] = {}
        self._open = True

    def identify(self) -> DeviceIdentity:
        """Make, model, size of the sensor, and a serial number that follows from the seed."""
        lens, sensor = self._world.lens, self._world.sensor
        return DeviceIdentity(
            kind="simulated", make=self._world.make, model=self._world.model, serial=self._world.serial, firmware="1",
            extra={"lens": f"simulated {lens.focal_length_mm:g} mm", "sensor": f"{sensor.width}x{sensor.height}"},
        )  # fmt: skip

    def exposure_times_s(self) -> tuple[float, ...]:
        """Offered exposure times, ascending."""
        return EXPOSURE_TIMES_S

    def isos(self) -> tuple[int, ...]:
        """Offered ISO values, ascending."""
        return ISOS

    def capture(self, exposure: Exposure, destination: Path) -> CaptureResult:
        """Expose once and write a DNG file.

        The noise follows from the camera's seed, the destination's name and how often this camera has taken a frame
        of that name: a session that is taken again, or resumed after a crash, gets the same bytes.

        Raises
        ------
        SettingError
            The exposure isn't offered.
        CaptureError
            The file can't be written.
        CameraError
            The camera was closed.
        """
        if not self._open:
            raise CameraError("camera: simulated camera is closed; open the rig again")
        time_s = _offered(exposure.time_s, EXPOSURE_TIMES_S, "exposure time", "s")
        iso = int(_offered(exposure.iso, ISOS, "ISO", ""))
        count = self._taken.get(destination.name, 0)
        self._taken[destination.name] = count + 1
        digest = hashlib.sha256(f"{destination.name}#{count}".encode()).digest()
        mosaic = expose(
            self._world.light(), self._world.sensor, time_s=time_s, iso=iso, shot=int.from_bytes(digest[:8], "little")
        )
        tags = frame_tags(self._world, time_s, iso)
        sha256, size = write_dng(destination, mosaic, tags, compression=self._compression)
        settings = {"shutterspeed": f"{time_s:.6g}", "iso": str(iso), "imageformat": "RAW"}
        return CaptureResult(destination, sha256, size, Exposure(time_s, iso), settings)

    def preview(self) -> bytes:
        """One JPEG of what the camera sees, brightened until its brightest part is white."""
        light = self._world.light()
        height, width = (n // 2 * 2 for n in light.shape)
        light = light[:height, :width]
        red, blue = light[0::2, 0::2], light[1::2, 1::2]
        green = 0.5 * (light[0::2, 1::2] + light[1::2, 0::2])
        picture = np.stack([blue, green, red], axis=2)
        picture = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        shown = np.clip(picture / max(float(np.percentile(picture, 99.9)), 1e-9), 0.0, 1.0) ** (1 / 2.2)
        done, data = cv2.imencode(".jpg", np.round(255.0 * shown).astype(np.uint8))
        if not done:
            raise CameraError("camera: the preview can't be encoded; try again")
        return bytes(data)

    def close(self) -> None:
        """Release the camera."""
        self._open = False


def frame_tags(world: SimulatedWorld, time_s: float, iso: int) -> FrameTags:
    """What a frame of this world's camera says about itself."""
    lens, sensor = world.lens, world.sensor
    return FrameTags(
        exposure_s=time_s, iso=iso, focal_length_mm=lens.focal_length_mm,
        f_number=round(lens.focal_length_mm / (2 * lens.pupil.radius_mm), 1), pitch_mm=sensor.pitch_mm,
        make=world.make, model=world.model, serial=world.serial, black=sensor.black, white=sensor.white,
    )  # fmt: skip


def _offered(value: float, offered: tuple[float, ...], what: str, unit: str) -> float:
    nearest = min(offered, key=lambda choice: abs(math.log(choice / value)) if value > 0 else choice)
    if value <= 0 or abs(nearest / value - 1.0) > 0.01:
        raise SettingError(f"camera: {what} {value:g}{unit} is not offered; the nearest is {nearest:g}{unit}")
    return nearest


class SimulatedStage:
    """A rail that has to be homed, and then carries the panel nearly where it is told to."""

    def __init__(self, world: SimulatedWorld, limits_mm: tuple[float, float] | None = None) -> None:
        self._world = world
        self._homed = False
        self._limits_mm = range_within(
            limits_mm,
            (0.0, world.settings.stage_travel_mm),
            slack_mm=1e-6,
            whose="the simulated rail",
            mend="leave them out",
        )

    def identify(self) -> DeviceIdentity:
        """Kind and travel."""
        return DeviceIdentity(
            kind="simulated", make=self._world.make, model="rail", serial=self._world.serial,
            extra={"travel_mm": f"{self._world.settings.stage_travel_mm:g}"},
        )  # fmt: skip

    def homed(self) -> bool:
        """Whether the position is known; False after power-up."""
        return self._homed

    def home(self) -> None:
        """Find the reference at position 0."""
        self._world.carry_to(0.0)
        self._homed = True

    def position_mm(self) -> float:
        """Position as the controller counts it; it doesn't know the true one.

        Raises
        ------
        NotHomedError
            Not homed yet.
        """
        if not self._homed:
            raise NotHomedError("stage: the position isn't known after power-up; home the stage")
        return self._world.commanded_mm

    def limits_mm(self) -> tuple[float, float]:
        """Travel, or the part of it that is to be used."""
        return self._limits_mm

    def move_to_mm(self, position_mm: float) -> float:
        """Move and return the confirmed position.

        Raises
        ------
        LimitError
            Outside the travel; nothing moved.
        NotHomedError
            Not homed yet.
        """
        low, high = self.limits_mm()
        if not low - 1e-6 <= position_mm <= high + 1e-6:
            raise LimitError(
                f"stage: {position_mm:g} mm is outside its travel of {low:g} to {high:g} mm; stay within it"
            )
        self.position_mm()
        self._world.carry_to(min(max(position_mm, low), high))
        return self._world.commanded_mm

    def travel_time_s(self, distance_mm: float) -> float:
        """Duration of a move with a trapezoidal speed profile; the simulation doesn't wait for it."""
        distance = abs(distance_mm)
        ramp = _SPEED_MM_S**2 / _ACCELERATION_MM_S2
        if distance < ramp:
            return 2.0 * math.sqrt(distance / _ACCELERATION_MM_S2)
        return distance / _SPEED_MM_S + _SPEED_MM_S / _ACCELERATION_MM_S2

    def stop(self) -> None:
        """Nothing to do: moves take no time."""

    def close(self) -> None:
        """Release the stage; it doesn't know its position any more."""
        self._homed = False


class SimulatedPanel:
    """A display on the carriage."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._open = True

    def identify(self) -> DeviceIdentity:
        """Size in device pixels."""
        surface = self._world.surface
        return DeviceIdentity(
            kind="simulated", make=self._world.make, model="panel", serial=self._world.serial,
            extra={"size": f"{surface.width_px} x {surface.height_px}", "device_pixel_ratio": "1"},
        )  # fmt: skip

    def show(self, pattern: Pattern) -> PanelAck:
        """Paint; confirmed at once.

        Raises
        ------
        PanelError
            The pattern can't be shown, or the panel was closed.
        """
        if not self._open:
            raise PanelError("panel: simulated panel is closed; open the rig again")
        surface = self._world.surface
        check_pattern(pattern, surface)
        self._world.pattern = pattern
        return PanelAck(pattern, surface.width_px, surface.height_px, 1.0, True, 0.0)

    def check_shown(self) -> None:
        """Nothing to check: it never goes dark by itself."""

    def close(self) -> None:
        """Release the panel."""
        self._open = False
