"""A directory of files taken elsewhere -> which file shows the point at which depth.

Either file names say it (``psf_060cm.dng``, ``psf_0600mm_2.npy``, ``dark_1.dng``), or a ``frames.csv`` with the columns
``file,depth_cm,kind``, kind being ``psf`` or ``dark``. Repeats of a depth differ in what follows its unit
(``psf_060cm.dng``, ``psf_060cm_2.dng``).
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

from calibration.errors import DepthListError, FrameError
from calibration.lens_fit import check_depths

_NAME = re.compile(
    r"^(?P<kind>psf|point|dot)[_-]?(?P<number>\d+(?:[.,]\d+)?)(?P<unit>cm|mm|m)(?:[_-](?P<repeat>\w+))?$", re.IGNORECASE
)
_DARK = re.compile(r"^(dark|black|bias)([_-]?\w+)?$", re.IGNORECASE)
_TO_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_IGNORED = {".csv", ".json", ".txt", ".md", ".yaml", ".yml", ".html", ".jpg", ".jpeg", ".xmp", ".tmp"}
_LONGEST_LINE = 10_000
_COLUMNS = ("file", "depth_cm", "kind")


@dataclass(frozen=True, slots=True)
class FrameList:
    """Point frames by depth, and dark frames, of one directory."""

    points: tuple[tuple[float, tuple[Path, ...]], ...]
    """(nominal depth in mm, its repeats), by ascending depth."""
    darks: tuple[Path, ...]


def find_frames(directory: str | Path) -> FrameList:
    """List the frames of a directory, from ``frames.csv`` where there is one, else from the file names.

    Dark frames are also looked for in a sibling directory ``dark``, where the directory itself has none.

    Raises
    ------
    FrameError
        No such directory, nothing in it that is named like a frame, a file named in the list is missing, a bad line,
        two files named for the same repeat of a depth.
    DepthListError
        Fewer than 3 depths, or numbers that can't be right.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise FrameError(f"{directory}: no such directory of frames")
    table = directory / "frames.csv"
    points, darks = _from_table(table) if table.is_file() else _from_names(directory)
    if not darks and not table.is_file():
        sibling = directory.parent / "dark"
        darks = [p for p in _files(sibling) if _DARK.match(p.stem)] if sibling.is_dir() else []
    if not points:
        raise FrameError(f"{directory}: has no frames named like psf_060cm.dng, and no frames.csv")
    try:
        check_depths(sorted(points))
    except DepthListError as error:
        raise DepthListError(f"{table if table.is_file() else directory}: {error}") from None
    return FrameList(
        points=tuple((depth, tuple(sorted(points[depth]))) for depth in sorted(points)), darks=tuple(sorted(darks))
    )


def _files(directory: Path) -> list[Path]:
    return sorted(p for p in directory.iterdir() if p.is_file() and p.suffix.lower() not in _IGNORED)


def _from_names(directory: Path) -> tuple[dict[float, list[Path]], list[Path]]:
    points: dict[float, list[Path]] = {}
    darks: list[Path] = []
    named: dict[tuple[float, str], Path] = {}
    for path in _files(directory):
        match = _NAME.match(path.stem)
        if match:
            depth_mm = round(float(match["number"].replace(",", ".")) * _TO_MM[match["unit"].lower()], 3)
            first = named.setdefault((depth_mm, (match["repeat"] or "").lower()), path)
            if first is not path:
                raise FrameError(
                    f"{path}: stands for {depth_mm / 10:g} cm like {first.name}; name a repeat "
                    f"{first.stem}_2{path.suffix}, or remove one of them"
                )
            points.setdefault(depth_mm, []).append(path)
        elif _DARK.match(path.stem):
            darks.append(path)
        elif path.stem.lower().startswith("psf"):
            raise FrameError(
                f"{path}: its name doesn't tell the depth; name it like psf_060cm{path.suffix}, or use frames.csv"
            )
    return points, darks


def _from_table(table: Path) -> tuple[dict[float, list[Path]], list[Path]]:
    points: dict[float, list[Path]] = {}
    darks: list[Path] = []
    order: list[float] = []
    seen: set[Path] = set()
    try:
        text = table.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FrameError(f"{table}: can't be read as text ({error})") from error
    if any(len(line) > _LONGEST_LINE for line in text.splitlines()):
        raise FrameError(f"{table}: has a line of over {_LONGEST_LINE} characters; is it a list of frames?")
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    missing = [column for column in _COLUMNS if column not in (reader.fieldnames or [])]
    if missing:
        raise FrameError(f"{table}: has no column {missing[0]!r}; the first line must be {','.join(_COLUMNS)}")
    for row in reader:
        where = f"{table}, line {reader.line_num}"
        path = table.parent / (row["file"] or "").strip()
        kind = (row["kind"] or "").strip().lower()
        if not path.is_file():
            raise FrameError(f"{where}: no such file {path}")
        if path in seen:
            raise FrameError(f"{where}: {path.name} is listed twice")
        seen.add(path)
        if kind == "dark":
            darks.append(path)
        elif kind == "psf":
            try:
                depth_mm = float(row["depth_cm"] or "") * 10.0
            except ValueError:
                raise FrameError(f"{where}: depth_cm is {row['depth_cm']!r}; give a number of centimetres") from None
            if not order or order[-1] != depth_mm:
                order.append(depth_mm)
            points.setdefault(depth_mm, []).append(path)
        else:
            raise FrameError(f"{where}: kind is {kind!r}; it must be psf or dark")
    if points:
        # repeats stand together; a depth that comes back later, or a list that goes to and fro, is a slip
        try:
            check_depths(order, ordered=True)
        except DepthListError as error:
            raise DepthListError(f"{table}: {error}") from None
    return points, darks
