"""Tags of TIFF-based files (DNG, CR2, NEF, ARW, TIFF) and the pixel pitch of known cameras."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import tifffile

_RESOLUTION_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """What is known of a camera body: photosite pitch (mm) and full frame (height, width) in photosites."""

    pitch_mm: float
    full_frame: tuple[int, int]


KNOWN_CAMERAS: Mapping[str, CameraFacts] = {
    "canon eos 650d": CameraFacts(0.00430, (3456, 5184)),
    "canon eos 700d": CameraFacts(0.00430, (3456, 5184)),
    "canon eos 600d": CameraFacts(0.00430, (3456, 5184)),
    "canon eos 60d": CameraFacts(0.00430, (3456, 5184)),
    "canon eos 7d": CameraFacts(0.00430, (3456, 5184)),
    "canon eos 80d": CameraFacts(0.00372, (4000, 6000)),
    "canon eos 5d mark ii": CameraFacts(0.00641, (3744, 5616)),
    "canon eos 5d mark iii": CameraFacts(0.00625, (3840, 5760)),
    "canon eos 6d": CameraFacts(0.00655, (3648, 5472)),
    "nikon d750": CameraFacts(0.00597, (4016, 6016)),
    "nikon d7000": CameraFacts(0.00478, (3264, 4928)),
    "sony ilce-7m3": CameraFacts(0.00593, (4000, 6000)),
}
"""By make and model in lower case, from the makers' data sheets. Preferred to FocalPlaneXResolution, which Canon
bodies state up to 3 % wrong (5728.18 per inch, i.e. 4.43 um, for the 4.30 um of an EOS 650D)."""


@dataclass(frozen=True, slots=True)
class Tags:
    """The few tags that calibration uses; unknown values are None or ''."""

    make: str = ""
    model: str = ""
    exposure_s: float | None = None
    iso: float | None = None
    focal_length_mm: float | None = None
    f_number: float | None = None
    pitch_mm: float | None = None


def read_tags(path: Path) -> Tags:
    """Read camera tags from a TIFF-based file; an empty :class:`Tags` where the file has none.

    ISO is looked for in the Exif IFD first, then in the first IFD.
    """
    logger = logging.getLogger("tifffile")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # maker notes of cameras are full of harmless oddities
    try:
        with tifffile.TiffFile(path) as tif:
            first = {tag.code: tag.value for tag in tif.pages.first.tags}
    except Exception:  # tags are a convenience: whatever is wrong with the file is judged when its pixels are read
        return Tags()
    finally:
        logger.setLevel(level)
    exif = first.get(34665)
    exif = exif if isinstance(exif, dict) else {}

    def pick(code: int, name: str) -> Any:
        return exif.get(name, first.get(code))

    iso = pick(34855, "ISOSpeedRatings")
    if iso is None:
        iso = exif.get("PhotographicSensitivity")
    return Tags(
        make=_text(first.get(271)),
        model=_text(first.get(272)),
        exposure_s=_number(pick(33434, "ExposureTime")),
        iso=_number(iso),
        focal_length_mm=_number(pick(37386, "FocalLength")),
        f_number=_number(pick(33437, "FNumber")),
        pitch_mm=_pitch_from_resolution(
            _number(pick(41486, "FocalPlaneXResolution")), pick(41488, "FocalPlaneResolutionUnit")
        ),
    )


def known_camera(make: str, model: str) -> CameraFacts | None:
    """Look a body up by what its files say, with or without the make repeated in the model."""
    make, model = make.strip().lower(), model.strip().lower()
    first_word = make.split()[0] if make else ""
    for name in (model, f"{first_word} {model}"):
        if name in KNOWN_CAMERAS:
            return KNOWN_CAMERAS[name]
    return None


def photosite_pitch_mm(tags: Tags) -> float | None:
    """Photosite pitch (mm): of the known body, else what the file states, else None."""
    facts = known_camera(tags.make, tags.model)
    return facts.pitch_mm if facts else tags.pitch_mm


def _text(value: Any) -> str:
    return str(value).strip("\x00 ") if value is not None else ""


def _number(value: Any) -> float | None:
    if isinstance(value, tuple):
        if len(value) >= 2 and value[1]:
            return float(Fraction(int(value[0]), int(value[1])))
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if number > 0 else None


def _pitch_from_resolution(per_unit: float | None, unit: Any) -> float | None:
    if not per_unit:
        return None
    pitch = _RESOLUTION_UNIT_MM.get(int(unit or 2), 25.4) / per_unit
    return pitch if 0.0003 < pitch < 0.1 else None
