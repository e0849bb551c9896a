"""What single frames can get wrong together: another camera, the same file twice, a dark frame that isn't dark."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from calibration.errors import FrameError, PointError
from calibration.exif import read_tags
from calibration.exposure import meter
from calibration.image import FrameInfo, LinearImage
from calibration.points import PointOptions, find_points

LONGEST_DARK = 4.0
"""A dark frame may collect so many times the light of the longest point frame: charge and stray light grow with it."""
MOST_SATURATED = 0.01
"""Hot photosites saturate fewer pixels of a dark frame than this part."""
LEAST_PEAK = 0.05
"""A point that is worth measuring reaches this fraction of white; stray light on a dark panel doesn't."""


class Distinct:
    """Refuses a file of the same bytes as an earlier one: two exposures never agree in their noise."""

    def __init__(self) -> None:
        self._seen: dict[str, str] = {}

    def check(self, info: FrameInfo) -> None:
        """Remember a frame.

        Raises
        ------
        FrameError
            It is a copy of another.
        """
        first = self._seen.setdefault(info.sha256, info.path)
        if first != info.path:
            raise FrameError(f"{info.path}: is a copy of {Path(first).name}, byte for byte; remove one of them")


def check_same_camera(first: FrameInfo, this: FrameInfo) -> None:
    """Refuse a frame of another camera or lens than the first frame's.

    Raises
    ------
    FrameError
        Naming both files and what differs.
    """
    if (first.model, first.cfa) != (this.model, this.cfa):
        raise FrameError(
            f"{this.path}: taken with {this.model or 'an unnamed camera'} {this.cfa}, but {first.path} with "
            f"{first.model or 'an unnamed camera'} {first.cfa}; keep frames of one camera"
        )
    for what, unit, theirs, ours, tolerance in (
        ("pixel pitch", " mm", this.pixel_pitch_mm, first.pixel_pitch_mm, 0.01),
        ("focal length", " mm", this.focal_length_mm, first.focal_length_mm, 0.01),
        ("f-number", "", this.f_number, first.f_number, 0.05),
    ):
        if theirs and ours and abs(theirs / ours - 1.0) > tolerance:
            raise FrameError(
                f"{this.path}: {what} is {theirs:g}{unit}, but {ours:g}{unit} in {first.path}; "
                "keep frames of one camera and one setting of the lens"
            )


def longest_exposure(sources: Iterable[Path | LinearImage]) -> FrameInfo | None:
    """Facts of the frame that collects most light (time times ISO), as far as the files tell their exposure."""
    infos = [source.info if isinstance(source, LinearImage) else _stated(source) for source in sources]
    known = [info for info in infos if info.exposure_s]
    return max(known, key=_light, default=None)


def check_dark(dark: LinearImage, longest: FrameInfo | None, options: PointOptions) -> None:
    """Refuse a dark (panel-off) frame that would spoil what it is subtracted from.

    Parameters
    ----------
    dark
        Developed.
    longest
        The point frame that collects most light, see :func:`longest_exposure`.
    options
        What counts as a point.

    Raises
    ------
    FrameError
        Saturated, exposed for much longer than any point frame, or with the point in it.
    """
    info = dark.info
    saturated = float(dark.saturated.mean())
    if saturated > MOST_SATURATED:
        raise FrameError(
            f"{info.path}: given as a dark frame, but {100 * saturated:.0f} % of its pixels are saturated; take it "
            "with the panel off, at the point frames' exposure"
        )
    if longest is not None and info.exposure_s and _light(info) > LONGEST_DARK * _light(longest):
        raise FrameError(
            f"{info.path}: given as a dark frame, exposed {_exposure(info)}, but the longest point frame "
            f"{_exposure(longest)} ({Path(longest.path).name}); take it at the point frames' exposure"
        )
    if meter(dark).peak < LEAST_PEAK:
        return
    try:
        find_points(dark, options=options)
    except PointError as error:
        if error.reason != "saturated":
            return  # stray light, or too little of it to be a point
    raise FrameError(f"{info.path}: given as a dark frame, but shows a point; take it with the panel off")


def _stated(path: Path) -> FrameInfo:
    if path.suffix.lower() == ".npy" or not path.is_file():
        return FrameInfo(str(path), "")
    tags = read_tags(path)
    return FrameInfo(str(path), "", exposure_s=tags.exposure_s, iso=tags.iso)


def _light(info: FrameInfo) -> float:
    return (info.exposure_s or 0.0) * (info.iso or 100.0)


def _exposure(info: FrameInfo) -> str:
    return f"{info.exposure_s:g} s" + (f" at ISO {info.iso:g}" if info.iso else "")
