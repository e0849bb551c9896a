"""Writes RAW frames as DNG files, lossless JPEG or uncompressed, the same bytes for the same frame.

A DNG file is a TIFF file (TIFF 6.0; DNG 1.4): a header, a directory of tagged values, an Exif directory, the pixels.
The container is written here because TIFF libraries refuse to write an Exif directory and 14-bit lossless JPEG into
the first image; the pixels are coded by imagecodecs.
"""

from __future__ import annotations

import hashlib
import os
import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Literal

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from rigs.errors import CaptureError

Compression = Literal["ljpeg", "none"]

_TILE = 432
_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _SRATIONAL = 1, 2, 3, 4, 5, 10
_UNDEFINED = 7
_SIZES = {_BYTE: 1, _ASCII: 1, _SHORT: 2, _LONG: 4, _RATIONAL: 8, _UNDEFINED: 1, _SRATIONAL: 8}
_CENTIMETRE = 3


@dataclass(frozen=True)
class FrameTags:
    """What the file says about the frame."""

    exposure_s: float
    iso: int
    focal_length_mm: float
    f_number: float
    pitch_mm: float
    make: str
    model: str
    serial: str
    black: int
    white: int
    software: str = "depth-workbench simulated rig"


def write_dng(
    path: Path, mosaic: NDArray[np.uint16], tags: FrameTags, *, compression: Compression = "ljpeg"
) -> tuple[str, int]:
    """Write a frame: temporary name, synced, renamed.

    Parameters
    ----------
    path
        Where the file shall be; replaced if it exists.
    mosaic
        uint16 (height, width), RGGB, 14 bits, at least 32 photosites a side.
    tags
        Camera, exposure, levels.
    compression
        ``ljpeg`` (lossless) or ``none``.

    Returns
    -------
    tuple[str, int]
        SHA-256 (hexadecimal) and number of bytes.

    Raises
    ------
    CaptureError
        The file can't be written (disk full, no such directory); nothing is left behind.
    """
    data = encode_dng(mosaic, tags, compression=compression)
    temporary = path.with_name(f".{path.name}.part")
    try:
        with temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise CaptureError(
            f"{path}: the frame can't be written ({error.strerror}); free or correct the place"
        ) from error
    return hashlib.sha256(data).hexdigest(), len(data)


def encode_dng(mosaic: NDArray[np.uint16], tags: FrameTags, *, compression: Compression = "ljpeg") -> bytes:
    """Bytes of the file that :func:`write_dng` writes."""
    height, width = mosaic.shape
    if height < 32 or width < 32:
        raise ValueError(f"a frame of {width} x {height} photosites is too small for RAW converters: at least 32 x 32")
    if int(mosaic.max()) >= 1 << 14:
        raise ValueError(f"raw value {int(mosaic.max())} has more than 14 bits")
    layout: list[_Entry]
    if compression == "none":
        chunks = [mosaic.astype("<u2").tobytes()]
        layout = [_long(278, height)]
        offsets_code, counts_code, bits, scheme = 273, 279, 16, 1
    elif min(height, width) < _TILE:
        # Decoders expect tiles to be no larger than the image.
        chunks = [_coded(mosaic)]
        layout = [_long(278, height)]
        offsets_code, counts_code, bits, scheme = 273, 279, 14, 7
    else:
        chunks = _tiles(mosaic)
        layout = [_long(322, _TILE), _long(323, _TILE)]
        offsets_code, counts_code, bits, scheme = 324, 325, 14, 7
    entries = [
        _long(254, 0), _long(256, width), _long(257, height), _short(258, bits), _short(259, scheme),
        _short(262, 32803), _ascii(271, tags.make), _ascii(272, tags.model), _short(274, 1), _short(277, 1),
        _short(284, 1), _ascii(305, tags.software), *layout,
        _short(33421, 2, 2), _Entry(33422, _BYTE, 4, bytes([0, 1, 1, 2])),
        _Entry(50706, _BYTE, 4, bytes([1, 4, 0, 0])), _Entry(50707, _BYTE, 4, bytes([1, 1, 0, 0])),
        _ascii(50708, tags.model), _Entry(50710, _BYTE, 3, bytes([0, 1, 2])), _short(50711, 1),
        _short(50713, 2, 2), _short(50714, *[tags.black] * 4), _long(50717, tags.white),
        _rational(50721, *([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]), kind=_SRATIONAL),
        _rational(50728, 1.0, 1.0, 1.0), _ascii(50735, tags.serial), _short(50778, 21),
    ]  # fmt: skip
    exif = [
        _rational(33434, tags.exposure_s), _rational(33437, tags.f_number), _short(34855, min(tags.iso, 65535)),
        _Entry(36864, _UNDEFINED, 4, b"0230"), _rational(37386, tags.focal_length_mm),
        _rational(41486, 10.0 / tags.pitch_mm), _rational(41487, 10.0 / tags.pitch_mm), _short(41488, _CENTIMETRE),
    ]  # fmt: skip
    counts = [len(chunk) for chunk in chunks]
    # Offsets depend on the directories' length and not on their own values: lay out once with zeros, then for good.
    placeholder = [*entries, _long(34665, 0), _long(offsets_code, *[0] * len(chunks)), _long(counts_code, *counts)]
    exif_at = 8 + len(_directory(placeholder, 8))
    pixels_at = exif_at + len(_directory(exif, exif_at))
    offsets = [pixels_at + sum(counts[:k]) for k in range(len(chunks))]
    final = [*entries, _long(34665, exif_at), _long(offsets_code, *offsets), _long(counts_code, *counts)]
    header = struct.pack("<2sHI", b"II", 42, 8)
    return b"".join([header, _directory(final, 8), _directory(exif, exif_at), *chunks])


def _tiles(mosaic: NDArray[np.uint16]) -> list[bytes]:
    height, width = mosaic.shape
    padded = np.pad(mosaic, ((0, -height % _TILE), (0, -width % _TILE)), mode="edge")
    return [
        _coded(np.ascontiguousarray(padded[y : y + _TILE, x : x + _TILE]))
        for y in range(0, height, _TILE)
        for x in range(0, width, _TILE)
    ]


def _coded(pixels: NDArray[np.uint16]) -> bytes:
    coded = bytes(imagecodecs.ljpeg_encode(np.ascontiguousarray(pixels), bitspersample=14))
    return coded + b"\0" * (len(coded) % 2)


@dataclass(frozen=True)
class _Entry:
    code: int
    kind: int
    count: int
    value: bytes


def _short(code: int, *values: int) -> _Entry:
    return _Entry(code, _SHORT, len(values), struct.pack(f"<{len(values)}H", *values))


def _long(code: int, *values: int) -> _Entry:
    return _Entry(code, _LONG, len(values), struct.pack(f"<{len(values)}I", *values))


def _ascii(code: int, text: str) -> _Entry:
    value = text.encode("ascii", "replace") + b"\0"
    return _Entry(code, _ASCII, len(value), value)


def _rational(code: int, *values: float, kind: int = _RATIONAL) -> _Entry:
    parts = [Fraction(value).limit_denominator(1_000_000) for value in values]
    numbers = [number for part in parts for number in (part.numerator, part.denominator)]
    return _Entry(
        code, kind, len(values), struct.pack(f"<{len(numbers)}{'i' if kind == _SRATIONAL else 'I'}", *numbers)
    )


def _directory(entries: list[_Entry], at: int) -> bytes:
    """TIFF directory with the values that don't fit into it, for the file position ``at``."""
    entries = sorted(entries, key=lambda entry: entry.code)
    table = struct.pack("<H", len(entries))
    beyond = b""
    values_at = at + 2 + 12 * len(entries) + 4
    for entry in entries:
        assert len(entry.value) == entry.count * _SIZES[entry.kind]
        if len(entry.value) <= 4:
            field = entry.value.ljust(4, b"\0")
        else:
            field = struct.pack("<I", values_at + len(beyond))
            beyond += entry.value + b"\0" * (len(entry.value) % 2)
        table += struct.pack("<HHI", entry.code, entry.kind, entry.count) + field
    return table + struct.pack("<I", 0) + beyond
