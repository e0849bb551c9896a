"""Frames on their way from the camera: each is developed once, and one that can't be used never gets its name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from calibration.errors import FrameError
from calibration.exif import known_camera
from calibration.image import FrameInfo, LinearImage
from calibration.raw import develop

_WHOLE = 0.98
"""Share of the data sheet's rows and columns that a whole frame has at least; RAW files have a few more of them."""


class FrameReader:
    """Develops the frames of one camera as superpixels; the size of the first one holds for all.

    Parameters
    ----------
    pixel_pitch_mm
        Photosite pitch; None takes it from the files.
    """

    def __init__(self, pixel_pitch_mm: float | None) -> None:
        self._pixel_pitch_mm = pixel_pitch_mm
        self._size: tuple[int, int] | None = None
        self._checked: tuple[_Identity, LinearImage] | None = None

    def check(self, path: Path) -> None:
        """Refuse a file that is no good frame; a driver calls this before the file gets its name.

        Raises
        ------
        FrameError
            It can't be decoded, its pixels can't be a photograph, or it isn't of the expected size.
        """
        self._checked = (_identity(path), self._develop(path))

    def read(self, path: Path) -> LinearImage:
        """The developed frame; one that was just checked under another name isn't decoded again.

        Raises
        ------
        FrameError
            As for :meth:`check`.
        """
        checked, self._checked = self._checked, None
        if checked is not None and checked[0] == _identity(path):
            image = checked[1]
            return replace(image, info=replace(image.info, path=str(path)))
        return self._develop(path)

    def _develop(self, path: Path) -> LinearImage:
        image = develop(path, pixel_pitch_mm=self._pixel_pitch_mm)
        self._check_size(path, image.info)
        _check_rows(path, image)
        return image

    def _check_size(self, path: Path, info: FrameInfo) -> None:
        size = info.raw_size
        if size is None:
            raise FrameError(f"{path}: is no RAW file; set the camera's image quality to RAW")
        facts = known_camera(info.make, info.model)
        if facts is not None and any(n < _WHOLE * full for n, full in zip(size, facts.full_frame, strict=True)):
            raise FrameError(
                f"{path}: {_text(size)} photosites, a whole frame of {info.model} has {_text(facts.full_frame)}; "
                "set image quality to full-size RAW and switch cropping off"
            )
        if self._size is not None and size != self._size:
            raise FrameError(
                f"{path}: {_text(size)} photosites, the frames before it {_text(self._size)}; "
                "set image quality to full-size RAW and leave the camera's menus alone"
            )
        self._size = size


def _check_rows(path: Path, image: LinearImage) -> None:
    """Every row of a photograph has noise in it, unless it is saturated; what a broken transfer left out has none."""
    constant = (image.planes == image.planes[:, :1]).all(axis=(1, 2)) & ~image.saturated.all(axis=1)
    if constant.any():
        raise FrameError(
            f"{path}: {int(constant.sum())} of {constant.size} rows of pixels are empty (lost on the way, or damaged); "
            "check cable and card, take it again"
        )


_Identity = tuple[int, int, int, int]


def _identity(path: Path) -> _Identity:
    """What stays the same when a file is renamed, and doesn't when it is written again."""
    status = path.stat()
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _text(size: tuple[int, int]) -> str:
    return f"{size[1]} x {size[0]}"
