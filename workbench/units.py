"""Lengths, times and speeds as people write them: "60cm", "0.6 m", "4.3um", "1/125 s", "50 mm/s"."""

from __future__ import annotations

import math
import re
from fractions import Fraction

from workbench.errors import InputError

_LENGTH_MM = {"nm": 1e-6, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
_TIME_S = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0}
_QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zA-Zµμ]*)\s*$")


def _parse(value: object, units: dict[str, float], what: str, example: str, default_unit: str | None) -> float:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise InputError(f"{value!r} is not a {what}: write for example {example}")
    match = _QUANTITY.match(str(value))
    if not match:
        raise InputError(f"{str(value)!r} is not a {what}: write for example {example}")
    number, unit = float(match.group(1)), match.group(2)
    if not unit:
        if default_unit is None:
            raise InputError(f"{str(value)!r} has no unit: write for example {example}")
        unit = default_unit
    if unit not in units:
        known = ", ".join(u for u in units if u.isascii())
        raise InputError(f"{str(value)!r}: {unit!r} is not a unit of {what}; known are {known}")
    result = number * units[unit]
    if not math.isfinite(result):
        raise InputError(f"{str(value)!r} is not a finite {what}")
    return result


def length_mm(value: object, *, default_unit: str | None = None) -> float:
    """Millimetres of a text with a unit; ``default_unit`` is taken for a bare number, None refuses it.

    Raises
    ------
    InputError
        Not a length, an unknown unit, or no unit where one is needed.
    """
    return _parse(value, _LENGTH_MM, "length", "60cm", default_unit)


PITCHES_MM = (0.0005, 0.1)
"""Smallest and largest pitch that a sensor's pixels, single or binned, may have."""


def pixel_pitch_mm(value: object) -> float:
    """Millimetres of a pixel pitch with its unit (``8.6um``); see :func:`length_mm`.

    Raises
    ------
    InputError
        Not a length with a unit, or none that the pixels of a sensor have.
    """
    try:
        pitch = length_mm(value)
    except InputError:
        pitch = 0.0
    if not PITCHES_MM[0] <= pitch <= PITCHES_MM[1]:
        raise InputError(f"{value!s} is no pitch of a sensor's pixels: give it with its unit, for example 4.3um")
    return pitch


def duration_s(value: object, *, default_unit: str | None = None) -> float:
    """Seconds of a text such as "2 s", "20ms" or "1/125 s"; see :func:`length_mm`."""
    if isinstance(value, str) and "/" in value:
        text, unit = re.sub(r"[a-zA-Z\s]", "", value), re.sub(r"[^a-zA-Z]", "", value)
        try:
            value = f"{float(Fraction(text))}{unit}"
        except (ValueError, ZeroDivisionError):
            raise InputError(f"{value!r} is not a time: write for example 1/125 s") from None
    return _parse(value, _TIME_S, "time", "1/125 s", default_unit)


def speed_mm_s(value: object) -> float:
    """Millimetres per second of a text such as "50 mm/s" or "0.1 m/s"; see :func:`length_mm`."""
    match = re.fullmatch(r"(.*\S)\s*/\s*(s|min)\s*", value) if isinstance(value, str) else None
    if match is None:
        raise InputError(f"{value!r} is not a speed: write for example 50 mm/s")
    return length_mm(match[1]) / _TIME_S[match[2]]


def cm(depth_mm: float, digits: int = 1) -> str:
    """``1234.5`` -> ``123.5 cm``; a dash for an unknown depth."""
    return f"{depth_mm / 10:.{digits}f} cm" if math.isfinite(depth_mm) else "-"


def exposure_text(time_s: float) -> str:
    """``0.008`` -> ``1/125 s``, ``2.5`` -> ``2.5 s``."""
    return f"1/{round(1 / time_s)} s" if time_s < 0.3 else f"{time_s:g} s"


def bytes_text(count: float) -> str:
    """``17000000`` -> ``17.0 MB``."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000 or unit == "GB":
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    raise AssertionError


def seconds_text(seconds: float) -> str:
    """``75`` -> ``1 min 15 s``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
