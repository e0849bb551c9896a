"""What a GRBL controller's ``$$`` and ``$I`` say about the machine it drives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rigs.errors import ConfigError, ProtocolError, StageError
from rigs.grbl_controller import GrblController
from rigs.grbl_protocol import Message, Setting
from rigs.motion import range_within

_SLOW_SEEK_MM_MIN = 300.0
"""Homing speed assumed where the controller doesn't tell ($24, $25 are missing in FluidNC): only for the deadline."""
_SEARCH_SCALE = 1.5
_LOCATE_SCALE = 5.0
"""GRBL searches 1.5 times the travel for a switch and 5 times the pull-off when it closes in (limits.c)."""


@dataclass(frozen=True, slots=True)
class GrblMachine:
    """One axis of the machine; lengths mm, seconds.

    Attributes
    ----------
    limits_mm
        Machine positions within the soft limits, less the pull-off at the switch.
    homing_time_s
        Longest time that homing can take: a search over the whole travel that finds nothing.
    report_unit_mm
        Millimetres per unit of a status report (25.4 with ``$13=1``).
    resolution_mm
        One step and the last digit of a report: two positions nearer than this can't be told apart.
    """

    model: str
    firmware: str
    settings: Mapping[int, str]
    homing: bool
    soft_limits: bool
    hard_limits: bool
    limits_mm: tuple[float, float]
    pull_off_mm: float
    max_speed_mm_s: float
    acceleration_mm_s2: float
    homing_time_s: float
    report_unit_mm: float
    resolution_mm: float

    def require_safety(self, allow_without_homing: bool, allow_without_soft_limits: bool) -> None:
        """Refuse a controller that doesn't protect its machine, unless the configuration says so in words.

        Raises
        ------
        StageError
            Homing or soft limits are off.
        """
        if not self.homing and not allow_without_homing:
            raise StageError(
                "stage: homing is off in the controller: fit a switch and set $22=1, or write "
                "stage.allow_without_homing: true"
            )
        if not self.soft_limits and not allow_without_soft_limits:
            raise StageError(
                "stage: soft limits are off in the controller: set $130 to the travel and $20=1, or write "
                "stage.allow_without_soft_limits: true"
            )

    def usable_mm(self, wanted_mm: tuple[float, float] | None) -> tuple[float, float]:
        """Machine positions that may be commanded.

        Parameters
        ----------
        wanted_mm
            ``stage.limits`` of the configuration; None: all of the travel.

        Raises
        ------
        ConfigError
            The wanted range reaches beyond the controller's travel; or there is none, and without homing the
            controller's says nothing.
        """
        if not self.homing:
            if wanted_mm is None:
                raise ConfigError("stage.limits is missing: without homing the controller's travel says nothing")
            return wanted_mm
        return range_within(
            wanted_mm,
            self.limits_mm,
            slack_mm=self.resolution_mm,
            whose="the controller's travel ($130, less the pull-off $27)",
            mend="$130 in the controller",
        )

    def facts(self) -> dict[str, str]:
        """What belongs into the provenance of a frame."""
        low, high = self.limits_mm
        return {
            "homing": "on" if self.homing else "off",
            "soft limits": "on" if self.soft_limits else "off",
            "hard limits": "on" if self.hard_limits else "off",
            "limits": f"{low:g} to {high:g} mm",
            "max speed": f"{self.max_speed_mm_s:g} mm/s",
            "acceleration": f"{self.acceleration_mm_s2:g} mm/s²",
            "settings": " ".join(f"${number}={value}" for number, value in sorted(self.settings.items())),
        }


def read_machine(controller: GrblController, axis: str) -> GrblMachine:
    """Ask the controller for its settings.

    Parameters
    ----------
    controller
        Awake, not moving.
    axis
        ``X``, ``Y`` or ``Z``.

    Raises
    ------
    StageError
        A setting that moves depend on is missing or makes no sense.
    ProtocolError
        It says something else each time.
    """
    doing = "reading its settings"
    settings = _settings_read_twice(controller, doing)
    build = [reply for reply in controller.command("$I", doing=doing, retries=1) if isinstance(reply, Message)]
    index = "XYZ".index(axis)
    steps_per_mm = _positive(settings, 100 + index)
    max_rate = _positive(settings, 110 + index)
    acceleration = _positive(settings, 120 + index)
    travel = _positive(settings, 130 + index)
    pull_off = _number(settings, 27, 1.0)
    report_unit_mm, last_digit = (25.4, 0.0001) if _number(settings, 13, 0) else (1.0, 0.001)
    homing_flags = int(_number(settings, 22, 0))
    return GrblMachine(
        model=_model(controller.banner, build),
        firmware=next((m.text.rstrip(":") for m in build if m.kind == "VER"), ""),
        settings=settings,
        homing=bool(homing_flags & 1),
        soft_limits=bool(_number(settings, 20, 0)),
        hard_limits=bool(_number(settings, 21, 0)),
        limits_mm=_limits_mm(settings, index, travel, pull_off, build),
        pull_off_mm=pull_off,
        max_speed_mm_s=max_rate / 60,
        acceleration_mm_s2=acceleration,
        homing_time_s=_homing_time_s(settings, pull_off),
        report_unit_mm=report_unit_mm,
        resolution_mm=1.0 / steps_per_mm + report_unit_mm * last_digit + 0.0005,
    )


def _settings_read_twice(controller: GrblController, doing: str) -> dict[int, str]:
    """Settings from two equal answers: travel and speed hang on them, and noise may lose a line or a digit."""
    previous: dict[int, str] = {}
    for _ in range(4):
        replies = controller.command("$$", doing=doing, retries=1)
        settings = {reply.number: reply.value for reply in replies if isinstance(reply, Setting)}
        if settings and settings == previous:
            return settings
        previous = settings
    raise ProtocolError(
        "stage: the controller's settings ($$) read otherwise each time; check cable, ground and baud rate, then try "
        "again"
        if previous
        else "stage: the controller tells no settings ($$); GRBL 1.1 is needed"
    )


def _limits_mm(
    settings: Mapping[int, str], index: int, travel: float, pull_off: float, build: list[Message]
) -> tuple[float, float]:
    at_low_end = bool(int(_number(settings, 23, 0)) >> index & 1)
    options = next((message.text.split(",")[0] for message in build if message.kind == "OPT"), "")
    # Built with (GRBL) or set to ($22 bit 3, grblHAL) zero at the switch; else machine space is negative.
    zero_at_switch = "Z" in options or bool(int(_number(settings, 22, 0)) & 8)
    if zero_at_switch:
        return (0.0, travel - pull_off) if at_low_end else (pull_off - travel, 0.0)
    return (pull_off - travel, 0.0) if at_low_end else (-travel, -pull_off)


def _homing_time_s(settings: Mapping[int, str], pull_off: float) -> float:
    feed = _number(settings, 24, _SLOW_SEEK_MM_MIN / 5) / 60
    seek = _number(settings, 25, _SLOW_SEEK_MM_MIN) / 60
    travels = [_number(settings, 130 + index, 0.0) for index in range(3)]  # axes may home one after the other
    return _SEARCH_SCALE * sum(travels) / seek + len(travels) * (2 + _LOCATE_SCALE) * pull_off / min(feed, seek)


def _model(banner: str, build: list[Message]) -> str:
    words = " ".join([banner, *(f"{message.kind} {message.text}" for message in build)]).lower()
    return next((name for name in ("FluidNC", "grblHAL") if name.lower() in words), "GRBL")


def _number(settings: Mapping[int, str], number: int, default: float) -> float:
    text = settings.get(number)
    if text is None:
        return default
    try:
        return float(text)
    except ValueError:
        raise StageError(f"stage: the controller's ${number} is {text!r}, no number; correct it") from None


def _positive(settings: Mapping[int, str], number: int) -> float:
    value = _number(settings, number, 0.0)
    if not value > 0:
        raise StageError(f"stage: the controller's ${number} is missing or zero; set it (see `$$`)")
    return value
