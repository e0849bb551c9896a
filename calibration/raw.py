"""RAW (or a linear file) to the developed image: one recipe for bank and scene.

Recipes
-------
superpixel
    Each 2x2 CFA cell becomes one pixel with R, the mean of both G, and B. No interpolation; twice the photosite pitch.
native
    Photosite pitch. Each channel is filled in from its own photosites by the kernel [1 2 1]' [1 2 1], normalised by
    the photosites that it hits (bilinear interpolation for R and B). With the same kernel for all channels the
    luminance (R + 2 G + B) / 4 is the mosaic filtered by [1 2 1]' [1 2 1] / 16: shift-invariant, and with zeros
    exactly where the CFA puts its carriers, so that a coloured point leaves no checkerboard.
linear
    The file was linear already (TIFF, NPY).
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rawpy
from numpy.typing import NDArray

from calibration.errors import FrameError
from calibration.exif import Tags, photosite_pitch_mm, read_tags
from calibration.image import FrameInfo, LinearImage, Recipe
from calibration.linear_files import is_linear_file, read_linear

SATURATION_FRACTION = 0.99
"""A photosite at or above this fraction of white counts as saturated (sensors clip a little below the stated white)."""

_HOT_IN_DARK = 0.1
"""A photosite that collects this fraction of white in the dark is hot."""
_CHANNELS = {"R": 0, "G": 1, "B": 2}


def develop(
    path: str | Path,
    *,
    recipe: Recipe = "superpixel",
    dark: LinearImage | None = None,
    pixel_pitch_mm: float | None = None,
    white: float | None = None,
) -> LinearImage:
    """Develop one file to a linear image.

    Parameters
    ----------
    path
        RAW file, or linear ``.tif``, ``.tiff``, ``.npy`` (then ``recipe`` is ignored: the result is ``linear``).
    recipe
        ``superpixel`` or ``native``, see the module.
    dark
        Developed dark frame to subtract. Of the same size: pixel by pixel; of another size: its median level per
        channel (``info.dark`` says which).
    pixel_pitch_mm
        Photosite pitch (mm) for RAW, pixel pitch for a linear file. Default: the known camera's, else the file's.
    white
        For linear files: the value that counts as 1 (default 1 for floats, the type's largest for integers).

    Returns
    -------
    LinearImage
        float32 planes, fraction of white above black.

    Raises
    ------
    FrameError
        Missing, empty, truncated, not RAW, unsupported CFA, or pixels that can't be a photograph (constant, all zero).
    """
    path = Path(path)
    sha256 = _hash(path)
    tags = read_tags(path) if path.suffix.lower() != ".npy" else Tags()
    if is_linear_file(path):
        planes = read_linear(path, white=white)
        saturated = np.asarray(planes.max(axis=2) >= SATURATION_FRACTION)
        info = _info(path, sha256, tags)
        pitch = pixel_pitch_mm or info.pixel_pitch_mm
        image = LinearImage(planes, saturated, "linear", pitch, info)
    else:
        image = _develop_raw(path, sha256, tags, recipe, pixel_pitch_mm)
    _check_pixels(image)
    return image if dark is None else subtract_dark(image, dark)


def subtract_dark(image: LinearImage, dark: LinearImage) -> LinearImage:
    """Subtract a developed dark (panel-off) frame; see :func:`develop`.

    Raises
    ------
    FrameError
        The dark frame is another camera's, was developed by another recipe or has another number of channels.
    """
    if dark.recipe != image.recipe or dark.planes.shape[2] != image.planes.shape[2]:
        raise FrameError(
            f"{dark.info.path}: developed as {dark.recipe} with {dark.planes.shape[2]} channels, "
            f"but {image.info.path} as {image.recipe} with {image.planes.shape[2]}; take both by the same recipe"
        )
    if dark.info.cfa and image.info.cfa and (dark.info.model, dark.info.cfa) != (image.info.model, image.info.cfa):
        raise FrameError(
            f"{dark.info.path}: taken with {dark.info.model or 'an unnamed camera'} {dark.info.cfa}, but "
            f"{image.info.path} with {image.info.model or 'an unnamed camera'} {image.info.cfa}; "
            "take both with one camera"
        )
    if dark.planes.shape == image.planes.shape:
        planes, how = image.planes - dark.planes, "pixelwise"
        hot = image.saturated & (dark.planes.max(axis=2) > _HOT_IN_DARK)
        if hot.any():  # at white by its own charge: neither its value nor its saturation is the light's
            channels = [cv2.medianBlur(np.ascontiguousarray(planes[:, :, c]), 3) for c in range(planes.shape[2])]
            planes = np.where(hot[:, :, np.newaxis], np.stack(channels, axis=2), planes)
            image = replace(image, saturated=image.saturated & ~hot)
    else:
        level = np.median(dark.planes.reshape(-1, dark.planes.shape[2]), axis=0).astype(np.float32)
        planes, how = image.planes - level, "median level"
    return LinearImage(planes, image.saturated, image.recipe, image.pixel_pitch_mm, image.info.with_dark(how))


def average_darks(darks: list[LinearImage]) -> LinearImage:
    """Mean of several developed dark frames of one size (their first frame's facts are kept).

    Raises
    ------
    FrameError
        The frames differ in size.
    """
    shapes = {d.planes.shape for d in darks}
    if len(shapes) != 1:
        raise FrameError(
            f"{darks[0].info.path}: dark frames of different sizes {sorted(shapes)}; keep those of one size"
        )
    if len(darks) == 1:
        return darks[0]
    total = np.zeros(darks[0].planes.shape, np.float32)
    for dark in darks:
        total += dark.planes
    first = darks[0]
    return LinearImage(total / np.float32(len(darks)), first.saturated, first.recipe, first.pixel_pitch_mm, first.info)


def _hash(path: Path) -> str:
    if path.is_dir():
        raise FrameError(f"{path}: is a directory; name an image file")
    try:
        if path.stat().st_size == 0:
            raise FrameError(f"{path}: is empty (0 bytes); copy it again from the camera")
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except FileNotFoundError:
        raise FrameError(f"{path}: no such file") from None
    except OSError as error:
        raise FrameError(f"{path}: can't be read: {error.strerror or error}") from error


def _info(path: Path, sha256: str, tags: Tags, **more: Any) -> FrameInfo:
    return FrameInfo(
        path=str(path),
        sha256=sha256,
        make=tags.make,
        model=tags.model,
        exposure_s=more.pop("exposure_s", None) or tags.exposure_s,
        iso=more.pop("iso", None) or tags.iso,
        focal_length_mm=more.pop("focal_length_mm", None) or tags.focal_length_mm,
        f_number=more.pop("f_number", None) or tags.f_number,
        pixel_pitch_mm=photosite_pitch_mm(tags),
        **more,
    )


def _develop_raw(path: Path, sha256: str, tags: Tags, recipe: Recipe, pitch_mm: float | None) -> LinearImage:
    if recipe not in ("superpixel", "native"):
        raise FrameError(f"{path}: a RAW file is developed as superpixel or native, not {recipe!r}")
    try:
        with _decoder_heard(path), rawpy.imread(str(path)) as raw:
            mosaic, pattern = _mosaic(path, raw)
            blacks, white = _levels(path, raw)
            other = raw.other
            info = _info(
                path,
                sha256,
                tags,
                raw_size=(int(mosaic.shape[0]), int(mosaic.shape[1])),
                cfa="".join("RGBG"[index] for index in pattern),
                exposure_s=float(other.shutter_speed) or None,
                iso=float(other.iso_speed) or None,
                focal_length_mm=float(other.focal_length) or None,
                f_number=float(other.aperture) or None,
            )
            develop_mosaic = _superpixel if recipe == "superpixel" else _native
            planes, saturated = develop_mosaic(mosaic, pattern, blacks, white)
    except rawpy.LibRawFileUnsupportedError as error:
        raise FrameError(f"{path}: is not a RAW file that LibRaw knows; give RAW, or linear .tif or .npy") from error
    except rawpy.LibRawError as error:
        raise FrameError(f"{path}: {_what_it_is(path, tags)} ({_first_line(error)})") from error
    pitch = pitch_mm or info.pixel_pitch_mm
    if pitch is not None and recipe == "superpixel":
        pitch *= 2.0
    return LinearImage(planes, saturated, recipe, pitch, info)


def _what_it_is(path: Path, tags: Tags) -> str:
    """What to say of a file that LibRaw gives up on: it doesn't tell a broken RAW file from a shopping list."""
    with path.open("rb") as stream:
        start = stream.read(1 << 16)
        if not any(start) and not any(any(block) for block in iter(lambda: stream.read(1 << 20), b"")):
            return "all its bytes are zero; copy it again from the camera"
    if tags.make or tags.model:
        return "can't be decoded, truncated or damaged; copy it again"
    try:
        start.decode("utf-8")
        is_text = b"\0" not in start
    except UnicodeDecodeError:
        is_text = False
    if is_text:
        return "is a text file, not a RAW file; give RAW, or linear .tif or .npy"
    return "is not a RAW file, or one cut off near its beginning; give RAW, or linear .tif or .npy, or copy it again"


@contextmanager
def _decoder_heard(path: Path) -> Iterator[None]:
    """LibRaw tells of damaged data on the process's stderr, past Python, and may go on: listen, and refuse the file.

    Raises
    ------
    FrameError
        Part of the pixels couldn't be read.
    """
    with tempfile.TemporaryFile() as said:
        try:
            stderr = os.dup(2)
        except OSError:  # a process without stderr
            yield
            return
        try:
            os.dup2(said.fileno(), 2)
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        said.seek(0)
        text = said.read()
    for complaint in (b"Unexpected end of file", b"data corrupted"):
        if complaint in text:
            raise FrameError(f"{path}: truncated or damaged ({complaint.decode().lower()}); copy it again")


def _mosaic(path: Path, raw: Any) -> tuple[NDArray[np.uint16], tuple[int, int, int, int]]:
    """Visible photosites cut to whole 2x2 cells, and the colour index of the cell's four (row by row)."""
    if raw.raw_type != rawpy.RawType.Flat or raw.raw_pattern is None:
        raise FrameError(
            f"{path}: has no colour mosaic (already demosaiced or layered sensor); give RAW of a Bayer camera"
        )
    if raw.raw_pattern.shape != (2, 2):
        rows, columns = raw.raw_pattern.shape
        raise FrameError(
            f"{path}: {rows}x{columns} colour pattern (X-Trans?) is not supported; give RAW of a Bayer camera"
        )
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    pattern = tuple(int(raw.raw_color(top + y, left + x)) for y in (0, 1) for x in (0, 1))
    letters = "".join(chr(raw.color_desc[i]) for i in pattern)
    if sorted(letters) != ["B", "G", "G", "R"]:
        raise FrameError(f"{path}: colour pattern {letters} is not supported; give RAW of an RGB Bayer camera")
    visible = raw.raw_image_visible
    height, width = visible.shape[0] & ~1, visible.shape[1] & ~1
    if height < 16 or width < 16:
        raise FrameError(f"{path}: only {visible.shape[1]} x {visible.shape[0]} photosites; not a photograph")
    a, b, c, d = pattern
    return visible[:height, :width], (a, b, c, d)


def _levels(path: Path, raw: Any) -> tuple[list[float], float]:
    blacks = [float(level) for level in raw.black_level_per_channel]
    white = float(raw.white_level)
    if raw.camera_white_level_per_channel:
        stated = [float(level) for level in raw.camera_white_level_per_channel if level > 0]
        white = min([white, *stated])
    if white <= max(blacks):
        raise FrameError(
            f"{path}: white level {white:g} is not above black level {max(blacks):g}; the file's tags are broken"
        )
    return blacks, white


def _superpixel(
    mosaic: NDArray[np.uint16], pattern: tuple[int, int, int, int], blacks: list[float], white: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    height, width = mosaic.shape[0] // 2, mosaic.shape[1] // 2
    planes = np.zeros((height, width, 3), np.float32)
    saturated = np.zeros((height, width), np.bool_)
    for position, index in enumerate(pattern):
        sites = mosaic[position // 2 :: 2, position % 2 :: 2]
        channel = _CHANNELS["RGBG"[index]]
        share = np.float32((0.5 if channel == 1 else 1.0) / (white - blacks[index]))
        planes[:, :, channel] += (sites - np.float32(blacks[index])) * share
        saturated |= sites >= blacks[index] + SATURATION_FRACTION * (white - blacks[index])
    return planes, saturated


def _native(
    mosaic: NDArray[np.uint16], pattern: tuple[int, int, int, int], blacks: list[float], white: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    planes = np.empty((*mosaic.shape, 3), np.float32)
    clipped = np.zeros(mosaic.shape, np.uint8)
    kernel = np.array([1.0, 2.0, 1.0], np.float32) / 4.0
    for channel in range(3):
        sparse = np.zeros(mosaic.shape, np.float32)
        for position, index in enumerate(pattern):
            if _CHANNELS["RGBG"[index]] != channel:
                continue
            cell = (slice(position // 2, None, 2), slice(position % 2, None, 2))
            black, span = blacks[index], white - blacks[index]
            sparse[cell] = (mosaic[cell] - np.float32(black)) * np.float32(1.0 / span)
            clipped[cell] = mosaic[cell] >= black + SATURATION_FRACTION * span
        # reflect_101 keeps the parity of the mosaic, so that the border needs no case of its own; the kernel hits
        # a quarter of its weight in R and B photosites, half in G, wherever it stands
        filled = cv2.sepFilter2D(sparse, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
        planes[:, :, channel] = filled * np.float32(2.0 if channel == 1 else 4.0)
    saturated = cv2.dilate(clipped, np.ones((3, 3), np.uint8)) > 0
    return planes, np.asarray(saturated, np.bool_)


def _check_pixels(image: LinearImage) -> None:
    """Files of the wrong kind decode without complaint to nothing: look at the pixels.

    A frame that is saturated everywhere is a photograph, though of no use: it tells that its exposure was too long.
    """
    planes, path = image.planes, image.info.path
    low, high = float(planes.min()), float(planes.max())
    if high == low and not image.saturated.all():
        what = "all zero" if abs(high) < 1e-12 or high < 0 else f"all equal ({high:.4g} of white)"
        raise FrameError(f"{path}: decodes, but its pixels are {what}; this is no usable RAW file, take it again")
    if high <= 0:
        raise FrameError(f"{path}: no pixel is above black level; its black level or bit depth is wrong")


def _first_line(error: BaseException) -> str:
    text = error.args[0] if error.args else type(error).__name__
    if isinstance(text, bytes):
        text = text.decode(errors="replace")
    return str(text).splitlines()[0][:100]
