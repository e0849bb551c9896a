"""RAW (or a linear file) to the developed image: one recipe for bank and scene.

``superpixel`` and ``native`` pixels are made of a RAW file's photosites (:mod:`calibration.mosaic`); ``linear``: the
file was linear already (TIFF, NPY).
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

from calibration.errors import FrameError
from calibration.exif import Tags, photosite_pitch_mm, read_tags
from calibration.image import FrameInfo, LinearImage, Recipe
from calibration.linear_files import is_linear_file, read_linear
from calibration.mosaic import SATURATION_FRACTION, Mosaic, native_pixels, resolves_photosites, superpixels

_HOT_IN_DARK = 0.1
"""A photosite that collects this fraction of white in the dark is hot."""


def develop(
    path: str | Path,
    *,
    recipe: Recipe = "superpixel",
    dark: LinearImage | None = None,
    pixel_pitch_mm: float | None = None,
    white: float | None = None,
    keep_mosaic: bool = False,
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
    keep_mosaic
        Keep the photosites beside superpixels, where they see details of their own; not with a dark frame.

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
        image = _develop_raw(path, sha256, tags, recipe, pixel_pitch_mm, keep_mosaic)
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


def _develop_raw(
    path: Path, sha256: str, tags: Tags, recipe: Recipe, pitch_mm: float | None, keep_mosaic: bool
) -> LinearImage:
    if recipe not in ("superpixel", "native"):
        raise FrameError(f"{path}: a RAW file is developed as superpixel or native, not {recipe!r}")
    try:
        with _decoder_heard(path), rawpy.imread(str(path)) as raw:
            mosaic = _mosaic(path, raw)
            other = raw.other
            info = _info(
                path,
                sha256,
                tags,
                raw_size=(int(mosaic.photosites.shape[0]), int(mosaic.photosites.shape[1])),
                cfa="".join("RGBG"[index] for index in mosaic.pattern),
                exposure_s=float(other.shutter_speed) or None,
                iso=float(other.iso_speed) or None,
                focal_length_mm=float(other.focal_length) or None,
                f_number=float(other.aperture) or None,
            )
            planes, saturated = superpixels(mosaic) if recipe == "superpixel" else native_pixels(mosaic)
            kept = None
            if keep_mosaic and recipe == "superpixel" and resolves_photosites(mosaic):
                kept = replace(mosaic, photosites=mosaic.photosites.copy())  # the decoder's memory ends with the file
    except rawpy.LibRawFileUnsupportedError as error:
        raise FrameError(f"{path}: is not a RAW file that LibRaw knows; give RAW, or linear .tif or .npy") from error
    except rawpy.LibRawError as error:
        raise FrameError(f"{path}: {_what_it_is(path, tags)} ({_first_line(error)})") from error
    pitch = pitch_mm or info.pixel_pitch_mm
    if pitch is not None and recipe == "superpixel":
        pitch *= 2.0
    return LinearImage(planes, saturated, recipe, pitch, info, kept)


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


def _mosaic(path: Path, raw: Any) -> Mosaic:
    """Visible photosites cut to whole 2x2 cells; they lie in the decoder's memory."""
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
    return Mosaic(visible[:height, :width], (a, b, c, d), *_levels(path, raw))


def _levels(path: Path, raw: Any) -> tuple[tuple[float, ...], float]:
    blacks = tuple(float(level) for level in raw.black_level_per_channel)
    white = float(raw.white_level)
    if raw.camera_white_level_per_channel:
        stated = [float(level) for level in raw.camera_white_level_per_channel if level > 0]
        white = min([white, *stated])
    if white <= max(blacks):
        raise FrameError(
            f"{path}: white level {white:g} is not above black level {max(blacks):g}; the file's tags are broken"
        )
    return blacks, white


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
