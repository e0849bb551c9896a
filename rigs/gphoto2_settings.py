"""Choosing among what a camera offers: names and numbers as libgphoto2 prints them. Pure functions, no camera.

Cameras print the same thing in many ways: an exposure of 8 ms is ``1/125``, ``0.0080s`` or ``0.008``. Choices are
made by what a text means, never by its place in the list, which differs from camera to camera.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from rigs.errors import SettingError

_DECIMAL = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*(?:s|sec|\"|″)?")
_FRACTION = re.compile(r"(\d+(?:\.\d+)?)\s*/\s*(\d+(?:\.\d+)?)\s*(?:s|sec)?")
_LONGEST_TIME_S = 3600.0
"""Longer ones are codes for bulb (429496.7295s) rather than times."""
_NIKON_CODES = 65535
"""Numerator of Nikon's codes for bulb, flash sync and time."""

_RAW = re.compile(r"\b(?:c?raw|nef|nrw|arw|raf|orf|rw2|dng|pef|cr[23w])\b", re.IGNORECASE)
_REDUCED = re.compile(r"\b(?:[sm]raw\d?|(?:raw|nef)[\s(]*(?:small|medium|[sm])\b)", re.IGNORECASE)
_LOSSY = re.compile(r"\bcraw\b|\blossy\b|(?<!lossless )\bcompressed\b", re.IGNORECASE)
_WITH_JPEG = re.compile(r"\+|jpe?g|fine|norm|basic", re.IGNORECASE)
_F_NUMBER = re.compile(r"(?:f\s*/?\s*)?(\d+(?:\.\d+)?)", re.IGNORECASE)
_ISO = re.compile(r"(?:iso\s*)?(\d+)", re.IGNORECASE)
_MANUAL_DIAL = re.compile(r"m|manual(?: exposure)?", re.IGNORECASE)
_SHUTTER_DIAL = re.compile(r"tv|s|shutter.*|custom.*|[cu]\d?|lock", re.IGNORECASE)

_LOW_BATTERY_PERCENT = 15
_MOST_LISTED = 12
_SAME_RELATIVE = 0.02


def parse_time_s(text: str) -> float | None:
    """Exposure time (s) of a text such as ``1/125``, ``0.3``, ``30``, ``0.0080s``; None for bulb and the like."""
    text = text.strip()
    if match := _FRACTION.fullmatch(text):
        numerator, denominator = float(match[1]), float(match[2])
        if numerator >= _NIKON_CODES or denominator == 0:
            return None
        value = numerator / denominator
    elif match := _DECIMAL.fullmatch(text):
        value = float(match[1])
    else:
        return None
    return value if 0 < value < _LONGEST_TIME_S else None


def rounding_s(text: str) -> float:
    """Half a unit of the last decimal that a text prints, in seconds: ``0.0012s`` may be 1/800."""
    match = _DECIMAL.fullmatch(text.strip())
    decimals = match[1].partition(".")[2] if match else ""
    return 0.5 * 10.0 ** -len(decimals) if decimals else 0.0


def offered_times_s(offered: Sequence[str]) -> tuple[float, ...]:
    """Exposure times among the offered texts, ascending, without duplicates."""
    return tuple(sorted({time for time in map(parse_time_s, offered) if time is not None}))


def choose_time(offered: Sequence[str], wanted_s: float, tolerance_stops: float) -> str:
    """Offered text whose exposure time is nearest (in stops) to the one wanted.

    Raises
    ------
    SettingError
        None is within the tolerance.
    """
    if not wanted_s > 0 or not math.isfinite(wanted_s):
        raise SettingError(f"camera: {wanted_s} s is no exposure time; ask for one above 0 s")
    timed = [(text, time) for text in offered if (time := parse_time_s(text)) is not None]
    if not timed:
        raise SettingError(f"camera: no exposure times ({listed(offered)}); turn its mode dial to M")
    text, nearest = min(timed, key=lambda pair: abs(math.log(pair[1] / wanted_s)))
    if abs(math.log2(nearest / wanted_s)) > tolerance_stops and abs(nearest - wanted_s) > rounding_s(text):
        raise SettingError(f"camera: no exposure of {wanted_s:.4g} s; nearest is {text}; it offers {listed(offered)}")
    return text


def same_time(chosen: str, read_back: str) -> bool:
    """Whether two texts mean the same exposure time, within what they can print."""
    a, b = parse_time_s(chosen), parse_time_s(read_back)
    if a is None or b is None:
        return False
    return chosen == read_back or abs(a - b) <= _SAME_RELATIVE * a + rounding_s(chosen) + rounding_s(read_back)


def parse_iso(text: str) -> int | None:
    """ISO value of a text; None for ``Auto``, ``Hi 1`` and the like."""
    match = _ISO.fullmatch(text.strip())
    return int(match[1]) if match and int(match[1]) > 0 else None


def offered_isos(offered: Sequence[str]) -> tuple[int, ...]:
    """ISO values among the offered texts, ascending."""
    return tuple(sorted({iso for iso in map(parse_iso, offered) if iso is not None}))


def choose_iso(offered: Sequence[str], wanted: int) -> str:
    """Offered text of exactly this ISO value.

    Raises
    ------
    SettingError
        It isn't offered.
    """
    for text in offered:
        if parse_iso(text) == wanted:
            return text
    raise SettingError(f"camera: no ISO {wanted}; set camera.iso to one that it offers: {listed(offered)}")


def same_iso(chosen: str, read_back: str) -> bool:
    """Whether two texts mean the same ISO value."""
    return parse_iso(chosen) == parse_iso(read_back)


def is_raw_format(text: str) -> bool:
    """Whether an image format contains a full-size RAW file."""
    return bool(_RAW.search(text)) and not _REDUCED.search(text)


def is_raw_with_jpeg(text: str) -> bool:
    """Whether an image format makes a RAW file and another one beside it."""
    return is_raw_format(text) and bool(_WITH_JPEG.search(text))


def choose_raw_format(offered: Sequence[str], wanted: str = "") -> str:
    """RAW format by name: the one wanted, or the plain, lossless, full-size one.

    Raises
    ------
    SettingError
        The one wanted, or any RAW format, isn't offered; or it holds no full-size RAW file.
    """
    raws = [text for text in offered if is_raw_format(text)]
    if not raws:
        raise SettingError(f"camera: no RAW format among {listed(offered)}; turn its mode dial to M, check its menu")
    if not wanted:
        return min(raws, key=lambda text: (bool(_LOSSY.search(text)), is_raw_with_jpeg(text), raws.index(text)))
    for text in raws:
        if text.casefold() == wanted.casefold():
            return text
    reason = "holds no full-size RAW file" if wanted.casefold() in map(str.casefold, offered) else "isn't offered"
    raise SettingError(f"camera: image format {wanted!r} {reason}; set camera.image_format to one of {listed(raws)}")


def is_card(target: str) -> bool:
    """Whether a capture target is the card."""
    return "card" in target.casefold()


def choose_target(offered: Sequence[str], *, card: bool) -> str | None:
    """Capture target by name: card, or the camera's memory; None where it isn't offered."""
    return next((text for text in offered if is_card(text) is card and "+" not in text), None)


def parse_f_number(text: str) -> float | None:
    """f-number of ``5.6``, ``f/5.6`` or ``f5.6``; None where the lens has no contacts to report one."""
    match = _F_NUMBER.fullmatch(text.strip())
    value = float(match[1]) if match else 0.0
    return value if value > 0 else None


def choose_aperture(offered: Sequence[str], wanted: float) -> str:
    """Offered text of this f-number.

    Raises
    ------
    SettingError
        It isn't offered.
    """
    for text in offered:
        if same_aperture(f"{wanted}", text):
            return text
    raise SettingError(
        f"camera: no aperture f/{wanted:g}; set camera.aperture to one that it offers: {listed(offered)}"
    )


def same_aperture(chosen: str, read_back: str) -> bool:
    """Whether two texts mean the same f-number."""
    a, b = parse_f_number(chosen), parse_f_number(read_back)
    return a is not None and b is not None and abs(a - b) <= _SAME_RELATIVE * a


def same_text(chosen: str, read_back: str) -> bool:
    """Whether two texts are equal but for the case of their letters."""
    return chosen.casefold() == read_back.casefold()


def dial_allows(dial: str) -> bool:
    """Whether exposure time is ours to set in this mode: M, shutter priority or a custom mode; unknown ones pass."""
    if _MANUAL_DIAL.fullmatch(dial) or _SHUTTER_DIAL.fullmatch(dial):
        return True
    return dial.isdigit() or dial.casefold().startswith("unknown") or dial in ("", "absent")


def is_manual_focus(focus: str) -> bool:
    """Whether a focus mode leaves focusing to the hand."""
    return focus.casefold().startswith(("manual", "mf", "m "))


def has_no_contacts(aperture: str) -> bool:
    """Whether an aperture's text is what cameras say of a lens that doesn't talk to them."""
    return aperture.casefold().startswith(("implicit auto", "unknown value"))


def is_battery_low(level: str) -> bool:
    """Whether a battery level (``12%``, ``Low``) won't last."""
    number = level.rstrip("%").strip()
    return same_text(number, "low") or (number.isdigit() and int(number) <= _LOW_BATTERY_PERCENT)


def release_without_autofocus(offered: Sequence[str]) -> tuple[str, str] | None:
    """Texts that press and let go of an EOS shutter release without focusing; None where not offered."""
    press = next((text for text in offered if re.fullmatch(r"press full mf", text, re.IGNORECASE)), None)
    release = next((text for text in offered if re.fullmatch(r"release full(?: mf)?", text, re.IGNORECASE)), None)
    return (press, release) if press and release else None


def listed(offered: Sequence[str]) -> str:
    """Offered texts for a message; the middle of a long list is left out."""
    if len(offered) <= _MOST_LISTED:
        return ", ".join(offered) or "nothing"
    return f"{', '.join(offered[:4])}, ... {', '.join(offered[-4:])}"
