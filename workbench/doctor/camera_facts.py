"""What a camera says about itself, judged: mode, format, lens, battery, card, clock. No camera is needed here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from calibration.exif import known_camera
from rigs.errors import SettingError
from rigs.gphoto2_config import ABSENT, Gphoto2Settings
from rigs.gphoto2_settings import (
    choose_aperture,
    choose_raw_format,
    dial_allows,
    has_no_contacts,
    is_battery_low,
    is_card,
    is_manual_focus,
    is_raw_format,
    is_raw_with_jpeg,
    parse_f_number,
    same_text,
)
from workbench.doctor.findings import Finding, Subject
from workbench.units import bytes_text, exposure_text, seconds_text

CAMERA = Subject("camera")

_CLOCK_SLACK_S = 300.0
_DAY_S = 86400.0
_SPARE = 1.2
_SAME_PITCH = 0.03
_OFF = ("0", "off", "disable", "disabled", "never", "none", "no", "no limit")


@dataclass(frozen=True, slots=True)
class Demand:
    """What the plan asks of the camera.

    Attributes
    ----------
    frames
        Number of frames, metering included.
    bytes
        Their size together.
    iso
        ISO of the point frames.
    """

    frames: int
    bytes: float
    iso: int


def bank_finding(made_with: tuple[str, str], facts: Mapping[str, str]) -> Finding | None:
    """Whether photographs of this camera can be measured with the active bank; None where nobody can tell.

    Parameters
    ----------
    made_with
        Make and model in the bank's frames; empty: not known, or no bank.
    facts
        What the camera said.
    """
    theirs, ours = known_camera("", _plain_name(facts)), known_camera(*made_with)
    simulated = made_with[1].startswith("Simulated")
    if not simulated and (theirs is None or ours is None):
        return None
    name = " ".join(made_with) if not made_with[1].startswith(made_with[0]) else made_with[1]
    if not simulated and theirs == ours:
        return CAMERA.ok("bank", f"the active bank was made with {name}")
    seen = f"the active bank was made with {name}: photographs of this camera will be refused"
    return CAMERA.warning("bank", seen, "`workbench calibrate` makes one with it, or activate one that was")


def _plain_name(facts: Mapping[str, str]) -> str:
    """A camera's name as its files spell it."""
    return facts["identified_as"].replace(" DSC ", " ")


def facts_findings(
    facts: Mapping[str, str], settings: Gphoto2Settings, demand: Demand, *, now: datetime
) -> list[Finding]:
    """Judge what a camera said (see :func:`rigs.gphoto2_inspect.facts_of`)."""
    made = (
        _identity(facts),
        _dial(facts),
        _exposure_time(facts),
        _iso(facts, settings, demand),
        _image_format(facts, settings),
        *_lens(facts, settings),
        _focus(facts),
        _battery(facts),
        *_card(facts, settings, demand),
        _auto_power_off(facts),
        _mirror(facts),
        _clock(facts, now),
    )
    return [finding for finding in made if finding is not None]


def _identity(facts: Mapping[str, str]) -> Finding:
    words = [facts["identified_as"]]
    words += [f"{name} {facts[name]}" for name in ("serial", "firmware") if facts[name] != ABSENT]
    return CAMERA.ok("connection", f"{', '.join(words)} at {facts['port']}")


def _dial(facts: Mapping[str, str]) -> Finding:
    dial = facts["mode_dial"]
    if dial == ABSENT:
        return CAMERA.note("mode dial", "the camera doesn't say", "it has to stand on M")
    if not dial_allows(dial):
        return CAMERA.error("mode dial", dial, "turn it to M, so that exposures can be set")
    if dial.casefold() not in ("m", "manual"):
        return CAMERA.note("mode dial", dial, "M is the safe choice: nothing then changes by itself")
    return CAMERA.ok("mode dial", dial)


def _exposure_time(facts: Mapping[str, str]) -> Finding:
    offered = facts["exposure_times_s"]
    if offered == ABSENT:
        return CAMERA.error("exposure times", "none can be set", "turn the mode dial to M")
    return CAMERA.ok("exposure times", " to ".join(exposure_text(float(time)) for time in offered.split(" to ")))


def _iso(facts: Mapping[str, str], settings: Gphoto2Settings, demand: Demand) -> Finding:
    if facts["isos"] == ABSENT:
        seen, mend = "can't be set from here", f"set ISO {demand.iso} on the camera, and auto ISO off"
        return CAMERA.note("iso", seen, mend) if "iso" in settings.may_be_absent else CAMERA.error("iso", seen, mend)
    offered = facts["isos"].split(", ")
    if str(demand.iso) not in offered:
        return CAMERA.error(
            "iso", f"no ISO {demand.iso}; it offers {facts['isos']}", "set camera.iso to one that is offered"
        )
    return CAMERA.ok("iso", f"{demand.iso} is offered ({offered[0]} to {offered[-1]})")


def _image_format(facts: Mapping[str, str], settings: Gphoto2Settings) -> Finding:
    now = facts["image_format"]
    if facts["image_formats"] == ABSENT:
        if now != ABSENT and is_raw_format(now):
            return CAMERA.ok("image format", now)
        seen, mend = "the camera doesn't say", "set its image quality to RAW; frames that are no RAW files are refused"
        may = "image_format" in settings.may_be_absent
        return CAMERA.warning("image format", seen, mend) if may else CAMERA.error("image format", seen, mend)
    try:
        chosen = choose_raw_format(facts["image_formats"].split(", "), settings.image_format)
    except SettingError as error:
        return CAMERA.failure("image format", error)
    if is_raw_with_jpeg(chosen):
        return CAMERA.note("image format", f"{chosen}: a second file with each frame", "plain RAW is faster")
    if same_text(now, chosen):
        return CAMERA.ok("image format", now)
    return CAMERA.ok("image format", f"{chosen} is offered, and will be set (now {now})")


def _lens(facts: Mapping[str, str], settings: Gphoto2Settings) -> list[Finding]:
    aperture, lens = facts["aperture"], facts["lens"]
    f_number = parse_f_number(aperture)
    name = lens if lens != ABSENT else "a lens"
    if aperture == ABSENT or has_no_contacts(aperture) or f_number is None:
        if settings.aperture is not None:
            return [
                CAMERA.warning(
                    "lens",
                    f"no contacts: f/{settings.aperture:g} of camera.aperture can't be set",
                    "set it on the lens, and remove camera.aperture from rig.yaml",
                )
            ]
        return [
            CAMERA.note(
                "lens", "no contacts: aperture and focus are set by hand", "open the iris fully: the mask is the stop"
            )
        ]
    if settings.aperture is not None:
        try:
            choose_aperture(facts["apertures"].split(", "), settings.aperture)
        except SettingError as error:
            return [CAMERA.failure("lens", error)]
        return [CAMERA.ok("lens", f"{name}, f/{settings.aperture:g} will be set (now f/{f_number:g})")]
    return [
        CAMERA.note(
            "lens",
            f"{name} at f/{f_number:g}, left as it is",
            "right if the iris is fully open: a smaller one cuts the mask; camera.aperture sets it",
        )
    ]


def _focus(facts: Mapping[str, str]) -> Finding | None:
    focus = facts["focus"]
    if focus == ABSENT:
        return CAMERA.note("focus switch", "the camera doesn't say", "lens switch to MF: nothing may refocus")
    if is_manual_focus(focus):
        return CAMERA.ok("focus switch", focus)
    return CAMERA.warning(
        "focus switch",
        f"{focus}: autofocus moves the focus plane, and can't lock on a point in the dark",
        "put the lens switch to MF",
    )


def _battery(facts: Mapping[str, str]) -> Finding:
    level = facts["battery"]
    if level == ABSENT:
        return CAMERA.note("battery", "the camera doesn't say", "look at its display; a mains adapter is best")
    if is_battery_low(level):
        return CAMERA.warning("battery", level, "charge it, or use a mains adapter")
    return CAMERA.ok("battery", level)


def _card(facts: Mapping[str, str], settings: Gphoto2Settings, demand: Demand) -> list[Finding]:
    if settings.capture_target == "memory":
        return [CAMERA.ok("card", "not used (camera.capture_target: memory)")]
    if facts["free_mb"] == ABSENT and facts["free_images"] == ABSENT:
        mend = "put one in, or set camera.capture_target: memory"
        if settings.capture_target == "card":
            return [CAMERA.error("card", "none, or the camera doesn't say", mend)]
        if facts["capture_target"] == ABSENT or is_card(facts["capture_target"]):
            return [CAMERA.note("card", "the camera doesn't say what is free", "look at its display")]
        return [CAMERA.warning("card", "none: a download that breaks costs the frame", mend)]
    frames, size = (demand.frames, demand.bytes) if settings.keep_on_card else (1, demand.bytes / demand.frames)
    seen, lacks = [], 0.0
    if facts["free_mb"] != ABSENT:
        free = 2**20 * float(facts["free_mb"])
        seen.append(f"{bytes_text(free)} free, {bytes_text(size)} needed")
        lacks = max(lacks, size / max(free, 1.0))
    if facts["free_images"] != ABSENT:
        images = int(facts["free_images"])
        seen.append(f"room for {images} images, {frames} needed")
        lacks = max(lacks, frames / max(images, 0.1))
    text = "; ".join(seen)
    if lacks > 1.0:
        mend = "format the card in the camera, or set camera.keep_on_card: false"
        return [CAMERA.error("card", text, mend)]
    if lacks * _SPARE > 1.0:
        return [CAMERA.warning("card", text, "format the card in the camera: repeated frames take space, too")]
    return [CAMERA.ok("card", text)]


def _auto_power_off(facts: Mapping[str, str]) -> Finding:
    setting = facts["auto_power_off"]
    if setting == ABSENT:
        return CAMERA.note("auto power off", "the camera doesn't say", "switch it to `disable` in the camera's menu")
    if setting.casefold() in _OFF:
        return CAMERA.ok("auto power off", "disabled")
    return CAMERA.warning("auto power off", f"set to {setting}", "switch it to `disable` in the camera's menu")


def _mirror(facts: Mapping[str, str]) -> Finding | None:
    setting = facts["mirror_lockup"]
    if setting == ABSENT:
        return None
    if setting.casefold() in _OFF:
        return CAMERA.ok("mirror lock-up", "off")
    return CAMERA.error(
        "mirror lock-up", f"{setting}: the shutter then needs two releases", "switch it off in the camera's menu"
    )


def _clock(facts: Mapping[str, str], now: datetime) -> Finding | None:
    try:
        shown = datetime.fromisoformat(facts["datetime"])
    except ValueError:
        return None
    differs_s = abs((shown.replace(tzinfo=None) - now).total_seconds())
    if differs_s <= _CLOCK_SLACK_S:
        return CAMERA.ok("clock", f"{shown:%Y-%m-%d %H:%M}")
    if differs_s <= _DAY_S:
        return CAMERA.note(
            "clock", f"{seconds_text(differs_s)} off, or another time zone", "set it in the camera's menu"
        )
    return CAMERA.note("clock", f"{shown:%Y-%m-%d %H:%M}, the computer says {now:%Y-%m-%d %H:%M}", "set the camera's")


def pixel_pitch_finding(given_mm: float | None, facts: Mapping[str, str]) -> Finding:
    """Whether the photosite pitch that rig.yaml gives (mm) is that of the camera, as far as the camera is known."""
    known = known_camera("", _plain_name(facts))
    if known is None:
        if given_mm is None:
            mend = "set camera.pixel_pitch, in case its RAW files don't state it"
            return CAMERA.note("pixel pitch", "unknown for this camera", mend)
        return CAMERA.ok("pixel pitch", f"{1000 * given_mm:g} um, as rig.yaml says")
    seen = f"{1000 * known.pitch_mm:.2f} um by its data sheet"
    if given_mm is not None and abs(given_mm / known.pitch_mm - 1.0) > _SAME_PITCH:
        mend = "correct camera.pixel_pitch, or remove it"
        return CAMERA.warning("pixel pitch", f"rig.yaml says {1000 * given_mm:g} um, {seen}", mend)
    return CAMERA.ok("pixel pitch", seen)
