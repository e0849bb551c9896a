"""rig.yaml as validated models. Every length carries a unit; a misspelt key is an error that names the nearest."""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from rigs.rig import DepthAxis
from workbench.errors import InputError
from workbench.units import duration_s, length_mm, pixel_pitch_mm, speed_mm_s


def _length(value: object) -> float:
    try:
        return length_mm(value)
    except InputError as error:
        raise ValueError(str(error)) from None


def _pitch(value: object) -> float:
    try:
        return pixel_pitch_mm(value)
    except InputError as error:
        raise ValueError(str(error)) from None


def _duration(value: object) -> float:
    try:
        return duration_s(value, default_unit="s")
    except InputError as error:
        raise ValueError(str(error)) from None


def _speed(value: object) -> float:
    try:
        return speed_mm_s(value)
    except InputError as error:
        raise ValueError(str(error)) from None


def _serial_number(value: object) -> object:
    if isinstance(value, int | float):  # 0123 would be read as an octal number
        raise ValueError(f"{value} is read as a number: write the serial number in quotes")
    return value


def _f_number(value: object) -> object:
    return re.sub(r"^\s*[fF]\s*/?\s*", "", value) if isinstance(value, str) else value


Length = Annotated[float, BeforeValidator(_length)]
"""Written with a unit (``60 cm``), held in millimetres."""
Pitch = Annotated[float, BeforeValidator(_pitch)]
"""Of a sensor's pixels: written with a unit (``4.3 um``), held in millimetres."""
Duration = Annotated[float, BeforeValidator(_duration)]
"""Written with or without ``s``, held in seconds."""
Speed = Annotated[float, BeforeValidator(_speed)]
"""Written with a unit (``50 mm/s``), held in millimetres per second."""


class Section(BaseModel):
    """A part of rig.yaml: immutable, and strict about its keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True, strict=False, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys_only(cls, data: Any) -> Any:
        if isinstance(data, dict):
            known = [field.alias or name for name, field in cls.model_fields.items()]
            names = set(known) | set(cls.model_fields)
            for key in data:
                if key not in names:
                    near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.5)
                    hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
                    raise ValueError(f"unknown key {str(key)!r}: {hint}")
        return data


class OpticsConfig(Section):
    """What is known of the lens beforehand; the lens fit measures the rest."""

    focal_length_mm: Length = Field(50.0, alias="focal_length", gt=0)
    aperture_radius_mm: Length = Field(7.0, alias="aperture_radius", gt=0)
    """Radius of the circle about the mask's opening."""
    focus_mm: Length | None = Field(None, alias="focus", gt=0)
    """Distance set on the lens, if known; only starting value and plausibility check of the fit."""


class CameraConfig(Section):
    """The camera and how its RAW files are developed; all after ``iso`` is for a real one."""

    kind: Literal["simulated", "gphoto2"] = "simulated"
    pixel_pitch_mm: Pitch | None = Field(None, alias="pixel_pitch")
    """Photosite pitch; needed where the RAW files don't state it."""
    recipe: Literal["superpixel", "native"] = "superpixel"
    iso: int = Field(100, ge=25, le=409600)
    model: str = ""
    """Part of the model's name (``650D``); with ``serial`` and ``port`` it chooses among several cameras."""
    serial: Annotated[str, BeforeValidator(_serial_number)] = ""
    port: str = Field("", pattern=r"^(usb:\S*)?$")
    """``usb:001,005``, or ``usb:`` for any; the number changes when the cable is plugged in again."""
    image_format: str = ""
    """RAW format by the camera's own name for it; empty: the plain full-size RAW that it offers."""
    capture_target: Literal["auto", "card", "memory"] = "auto"
    keep_on_card: bool = True
    aperture: Annotated[float, Field(gt=0), BeforeValidator(_f_number)] | None = None
    """f-number, for lenses with contacts; without it the aperture is left alone."""
    release: Literal["auto", "trigger", "without-autofocus", "capture"] = "auto"
    may_be_absent: tuple[Literal["iso", "image_format", "capture_target"], ...] = (
        "iso", "image_format", "capture_target",
    )  # fmt: skip
    """Settings that the camera may lack; they are then the operator's to make on the camera."""
    restart_every: int = Field(0, ge=0)
    """Start a fresh camera process after so many frames, for cameras that tire; 0: never."""
    call_timeout_s: Duration = Field(30.0, alias="call_timeout", gt=0)
    """Patience with one call to the camera; then it is broken off and the camera opened again."""
    arrive_timeout_s: Duration = Field(30.0, alias="arrive_timeout", gt=0)
    """How long after the exposure the RAW file may take to appear."""
    download_timeout_s: Duration = Field(90.0, alias="download_timeout", gt=0)
    return_timeout_s: Duration = Field(30.0, alias="return_timeout", gt=0)
    """How long a camera that left USB may take to come back."""
    power_cycle_timeout_s: Duration = Field(120.0, alias="power_cycle_timeout", gt=0)
    """How long the operator has to switch a frozen camera off and on."""


class DepthConfig(Section):
    """depth = offset + sign * scale * position (see :class:`rigs.rig.DepthAxis`)."""

    offset_mm: Length = Field(0.0, alias="offset")
    sign: Literal[-1, 1] = 1
    scale: float = Field(1.0, gt=0)

    @property
    def axis(self) -> DepthAxis:
        """The map between positions and depths."""
        return DepthAxis(self.offset_mm, self.sign, self.scale)


class StageConfig(Section):
    """The stage and how its coordinate becomes depth."""

    kind: Literal["simulated", "manual", "grbl", "zaber"] = "simulated"
    depth: DepthConfig = DepthConfig()
    limits_mm: tuple[Length, Length] | None = Field(None, alias="limits")
    """Smallest and largest position to use; without it what the controller says (a stage moved by hand: 0 to 3 m)."""
    port: str = ""
    """Device path, ``usb:VID:PID[:SERIAL]``, or a URL (``socket://host:port``, ``rfc2217://host:port``)."""
    baud_rate: int = Field(115200, ge=300, le=4_000_000)
    axis: Literal["X", "Y", "Z"] | Annotated[int, Field(ge=1, le=9)] | None = None
    """GRBL: letter, X where not given. Zaber: number, 1 where not given."""
    speed_mm_s: Speed | None = Field(None, alias="speed", gt=0)
    """Highest speed of moves; without it the controller's own."""
    device: int = Field(1, ge=1, le=99)
    """Zaber: address in the chain."""
    microstep_mm: Length | None = Field(None, alias="microstep", gt=0)
    """Zaber: travel of one microstep as the data sheet states it."""
    allow_without_homing: bool = False
    """GRBL: run although the controller has homing off."""
    allow_without_soft_limits: bool = False
    """GRBL: run although the controller has soft limits off."""

    @model_validator(mode="after")
    def _what_the_driver_needs(self) -> StageConfig:
        if self.kind in ("grbl", "zaber") and not self.port:
            raise ValueError(
                "port is missing: give a device path (/dev/ttyUSB0), usb:VID:PID or a URL such as socket://host:port"
            )
        if self.kind == "grbl" and isinstance(self.axis, int):
            raise ValueError(f"axis {self.axis} is none of X, Y, Z")
        if self.kind == "zaber" and isinstance(self.axis, str):
            raise ValueError(f"axis {self.axis} is no axis number; write 1 to 9")
        if self.kind == "zaber" and self.microstep_mm is None:
            raise ValueError("microstep is missing: a Zaber stage counts in microsteps; its data sheet says their size")
        if self.limits_mm is not None and not self.limits_mm[0] < self.limits_mm[1]:
            low, high = self.limits_mm
            raise ValueError(f"limits: {low:g} to {high:g} mm is no range; give the smaller one first")
        return self


class DotConfig(Section):
    """The point source on the panel."""

    size_px: Annotated[float, Field(gt=0, le=4000)] | Literal["auto"] = Field("auto", alias="size")
    """Diameter in panel pixels; auto: as large as its image may be without widening the PSF."""
    colour: str = Field("#ffffff", pattern=r"^#[0-9a-fA-F]{6}$")

    @field_validator("colour")
    @classmethod
    def _lit(cls, value: str) -> str:
        if value == "#000000":
            raise ValueError("a black dot can't be photographed; use '#ffffff'")
        return value


class PanelConfig(Section):
    """The display on the carriage."""

    kind: Literal["simulated", "browser"] = "simulated"
    pixel_pitch_mm: Length = Field(0.1, alias="pixel_pitch", gt=0, le=10)
    pixels: tuple[Annotated[int, Field(ge=100, le=20000)], Annotated[int, Field(ge=100, le=20000)]] = (1920, 1200)
    """Width and height in device pixels; grids of points stay within."""
    dot: DotConfig = DotConfig()
    host: str = "127.0.0.1"
    port: int = Field(8650, ge=0, le=65535)
    token: str = ""
    ack_timeout_s: Duration = Field(5.0, alias="ack_timeout", gt=0)
    require_fullscreen: bool = True


class CalibrationConfig(Section):
    """Defaults of ``workbench calibrate``."""

    from_mm: Length = Field(600.0, alias="from", gt=0)
    to_mm: Length = Field(3500.0, alias="to", gt=0)
    step_mm: Length = Field(100.0, alias="step", gt=0)
    repeats: int = Field(2, ge=1, le=100)
    off_frames: int = Field(1, ge=1, le=20)
    """Panel-off frames per depth; subtracted from the point frames."""
    field: tuple[int, int] = (1, 1)
    """Points across and down the panel; (1, 1) is one central point."""


class SimulationConfig(Section):
    """The simulated rig's truth; used by the devices whose kind is ``simulated``."""

    preset: Literal["small", "eos650d"] = "small"
    seed: int = Field(1, ge=0)
    scene: str = "four-objects"
    focus_mm: Length = Field(1600.0, alias="focus", gt=0)
    stage_zero_mm: Length = Field(7.0, alias="stage_zero")
    """True minus nominal depth; calibration has to find it."""
    stage_repeatability_mm: Length = Field(0.05, alias="stage_repeatability", ge=0)
    ambient: float = Field(0.0005, ge=0, le=1)
    vignetting: float = Field(0.0, ge=0, le=1)
    coma: float = Field(0.0, ge=-1, le=1)
    focus_breathing: float = Field(0.0, ge=-1, le=1)


class RigConfig(Section):
    """The whole of rig.yaml."""

    optics: OpticsConfig = OpticsConfig()
    camera: CameraConfig = CameraConfig()
    stage: StageConfig = StageConfig()
    panel: PanelConfig = PanelConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    simulation: SimulationConfig = SimulationConfig()

    @model_validator(mode="after")
    def _focus_beyond_focal_length(self) -> RigConfig:
        nearest = 2.0 * self.optics.focal_length_mm  # nearer than that an image is larger than life
        simulated_mm = self.simulation.focus_mm if self.camera.kind == "simulated" else None
        for key, focus_mm in (("optics", self.optics.focus_mm), ("simulation", simulated_mm)):
            if focus_mm is not None and focus_mm < nearest:
                raise ValueError(
                    f"{key}.focus: {focus_mm:g} mm is too near for a lens of {self.optics.focal_length_mm:g} mm; "
                    f"give at least {nearest:g} mm"
                )
        return self


class _EachKeyOnce(yaml.SafeLoader):
    """YAML lets the last of two equal keys win, and a real device become a simulated one unnoticed."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.MarkedYAMLError(problem=f"{key.value}: is there twice", problem_mark=key.start_mark)
                seen.add(key.value)
        return dict(super().construct_mapping(node, deep))


def load_rig_config(path: Path) -> RigConfig:
    """Read and check rig.yaml.

    Raises
    ------
    InputError
        Unreadable, not YAML, or a key, type, unit or value is wrong; names file, key and the way out.
    """
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _EachKeyOnce)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: can't be read ({error})") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark else ""
        raise InputError(f"{path}{where}: not valid YAML ({getattr(error, 'problem', error)})") from None
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected sections such as camera:, stage:, panel:, found {type(data).__name__}")
    try:
        return RigConfig.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{path}: {_first_problem(error)}") from None


_UNION_TAG = re.compile(r"[\[-]")
"""pydantic names the branches of a union in a place's path: ``literal['auto']``, ``constrained-float``."""
_SAYS_MORE = {
    "panel.dot.size": "a diameter above 0 in panel pixels, at most 4000, or auto",
    "stage.limits": "the smallest and the largest position, e.g. [0 mm, 2900 mm]",
    "panel.pixels": "width and height in device pixels, e.g. [1280, 800]",
    "calibration.field": "points across and down, e.g. [3, 3]",
}


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    parts = [str(part) for part in problem["loc"] if not _UNION_TAG.search(str(part))]
    key = ".".join(parts)
    message = problem["msg"].removeprefix("Value error, ")
    if key in _SAYS_MORE or problem["type"] != "value_error":
        message = f"{_SAYS_MORE.get(key, message[0].lower() + message[1:])} (found {problem['input']!r})"
    if problem["type"] == "string_type":
        message = f"{message}; write it in quotes"
    return f"{key}: {message}" if key else message
