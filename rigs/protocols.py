"""The three small interfaces that a session drives, and the values that pass through them.

A session knows nothing but this module: real and simulated devices are interchangeable, one by one.
Lengths are millimetres, times seconds. Every method may raise :class:`rigs.errors.RigError`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Who a device says it is; goes into the provenance of every frame."""

    kind: str
    """Driver name as in rig.yaml: ``simulated``, ``gphoto2``, ``grbl``, ``zaber``, ``browser``, ``manual``."""
    make: str = ""
    model: str = ""
    serial: str = ""
    firmware: str = ""
    extra: Mapping[str, str] = field(default_factory=dict)
    """Further facts as text: lens name, port, settings of the controller."""


@dataclass(frozen=True, slots=True)
class Exposure:
    """Exposure of one shot."""

    time_s: float
    iso: int


@dataclass(frozen=True, slots=True)
class CaptureResult:
    """One RAW frame that has arrived on disk, complete."""

    path: Path
    sha256: str
    bytes: int
    exposure: Exposure
    """The exposure read back from the camera (not the one asked for)."""
    settings: Mapping[str, str] = field(default_factory=dict)
    """Every setting read back at capture time."""


@runtime_checkable
class Camera(Protocol):
    """A camera that delivers RAW frames."""

    def identify(self) -> DeviceIdentity:
        """Make, model, serial number; lens in ``extra['lens']`` where known."""
        ...

    def exposure_times_s(self) -> tuple[float, ...]:
        """Offered exposure times, ascending; a session chooses from these."""
        ...

    def isos(self) -> tuple[int, ...]:
        """Offered ISO values, ascending."""
        ...

    def capture(self, exposure: Exposure, destination: Path) -> CaptureResult:
        """Expose once and deliver the RAW file at ``destination`` (written under a temporary name, renamed).

        A file whose kind has another suffix keeps that one: the result's ``path`` is where it is.
        """
        ...

    def preview(self) -> bytes:
        """One JPEG for focusing and alignment; raises CameraError where the camera has none."""
        ...

    def close(self) -> None:
        """Release the device; safe to call twice."""
        ...


@runtime_checkable
class Stage(Protocol):
    """A linear stage, in its own coordinate (mm). :class:`rigs.rig.DepthAxis` maps it to depth."""

    def identify(self) -> DeviceIdentity:
        """Controller, firmware, serial number."""
        ...

    def homed(self) -> bool:
        """Whether the position is known; False after power-up, alarm or a lost position."""
        ...

    def home(self) -> None:
        """Find the reference switch; returns when done."""
        ...

    def position_mm(self) -> float:
        """Position now; raises NotHomedError where it isn't known."""
        ...

    def limits_mm(self) -> tuple[float, float]:
        """Smallest and largest position that may be commanded."""
        ...

    def move_to_mm(self, position_mm: float) -> float:
        """Move, wait until truly settled, return the confirmed position.

        Checks limits before anything moves (LimitError); never moves unhomed or in alarm; the deadline
        follows from distance, speed and acceleration.
        """
        ...

    def travel_time_s(self, distance_mm: float) -> float:
        """Expected duration of a move, for plans and deadlines."""
        ...

    def stop(self) -> None:
        """Stop now; callable from any thread at any time."""
        ...

    def close(self) -> None:
        """Release the device; safe to call twice."""
        ...


PatternKind = Literal["black", "dot", "grid", "crosshair", "white", "picture"]


@dataclass(frozen=True, slots=True)
class Pattern:
    """What the panel shows. Positions and sizes are panel device pixels, origin at the panel's centre, y down."""

    kind: PatternKind = "black"
    size_px: float = 1.0
    """Diameter of a dot (side of a square for 1 px dots)."""
    colour: str = "#ffffff"
    brightness: float = 1.0
    """0 to 1, multiplies the colour in linear light as far as the panel's gamma is known."""
    x_px: float = 0.0
    y_px: float = 0.0
    points_px: tuple[tuple[float, float], ...] = ()
    """Positions (x, y) of a ``grid``'s dots."""
    picture: str = ""
    """Name of a built-in picture (``chart``, ...) or path of an image file, for ``picture``."""


@dataclass(frozen=True, slots=True)
class PanelAck:
    """The panel's word that a pattern is painted."""

    pattern: Pattern
    width_px: int
    height_px: int
    device_pixel_ratio: float
    fullscreen: bool
    painted_after_s: float
    """From request to confirmation."""


@runtime_checkable
class Panel(Protocol):
    """A display that shows patterns and confirms that they are painted."""

    def identify(self) -> DeviceIdentity:
        """Kind, size and pixel ratio as text in ``extra``."""
        ...

    def show(self, pattern: Pattern) -> PanelAck:
        """Paint; returns after the confirmation; raises NotAcknowledgedError when it doesn't come in time."""
        ...

    def check_shown(self) -> None:
        """After an exposure: raises NotAcknowledgedError where what was painted last may have gone meanwhile."""
        ...

    def close(self) -> None:
        """Release the device; safe to call twice."""
        ...
