"""A scene's frame -> regions -> depths -> files."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from calibration.photograph import develop_photograph
from workbench.banks import open_bank, quality_verdict
from workbench.depth.allfocus import all_focus, depth_map
from workbench.depth.depth_regions import regions_of_one_depth
from workbench.depth.methods import DEFAULT_METHOD, estimate_depths, needs_second_view, option_values
from workbench.depth.regions import SrmOptions, from_roi, srm, whole, without_parts
from workbench.display import png_bytes, to_srgb8
from workbench.errors import InputError
from workbench.files import sha256_json, staged_files, write_json
from workbench.measurement import Measurement
from workbench.processors import usable_processors
from workbench.project import Project
from workbench.report import write_measurement_report


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """What the operator chose for a measurement."""

    method: str = DEFAULT_METHOD
    method_options: tuple[tuple[str, Any], ...] = ()
    """``--set name=value`` pairs of the method; see :func:`open_second_view` for those that aren't texts."""
    roi: tuple[int, int, int, int] | None = None
    """x, y, width, height in pixels of the developed image."""
    labels: Path | None = None
    whole: bool = False
    segment: Literal["depth", "colour"] = "depth"
    """How regions are found: by colour and blur, or by colour alone (as published)."""
    srm_q: float = 32.0

    @property
    def regions_given(self) -> list[str]:
        """Options by which the operator says where regions are; without them they are found in the photograph."""
        given = ("--roi", self.roi), ("--labels", self.labels), ("--whole", self.whole)
        return [name for name, value in given if value]


MOST_REGIONS = 65535
"""What the 16-bit label image that a measurement writes can tell apart."""


_MOST_AT_ONCE = 8
"""Regions that are measured at once: each takes memory like a frame or two."""


def read_labels(path: Path, shape: tuple[int, int]) -> NDArray[np.int32]:
    """Read a label image (PNG or TIFF, one integer per pixel, 0 = none).

    Raises
    ------
    InputError
        Unreadable, not single-channel integers, of another size than the developed image, or without regions.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such label image")
    try:  # not by OpenCV: it takes half a file for a whole one, and talks on stderr
        is_tiff = path.suffix.lower() in (".tif", ".tiff")
        labels = np.asarray(tifffile.imread(path) if is_tiff else imagecodecs.png_decode(path.read_bytes()))
    except Exception as error:  # decoders raise whatever broken bytes lead them to
        raise InputError(f"{path}: can't be read as a PNG or TIFF; save the label image again") from error
    if labels.ndim != 2 or labels.dtype.kind not in "ui":
        raise InputError(f"{path}: not a label image; expected a PNG or TIFF with one integer per pixel")
    if labels.shape != shape:
        raise InputError(
            f"{path}: {labels.shape[1]} x {labels.shape[0]} pixels, the developed image has {shape[1]} x {shape[0]}; "
            "draw labels on the developed image (half the RAW's size for the superpixel recipe)"
        )
    if not labels.any():
        raise InputError(f"{path}: holds no region (every pixel is 0)")
    low, high = int(labels.min()), int(labels.max())
    if low < 0 or high > MOST_REGIONS:
        raise InputError(
            f"{path}: holds the label {low if low < 0 else high}; number the regions 1 to {MOST_REGIONS}, 0 for none"
        )
    return labels.astype(np.int32)


SUPERPIXEL_Q = 32.0
"""For regions of one depth, colour regions are made finer by this factor of Q: they only give the outlines."""
SUPERPIXEL_FRACTION = 3e-4


def open_second_view(
    project: Project, method: str, settings: tuple[tuple[str, str], ...]
) -> tuple[tuple[str, Any], ...]:
    """Open the second photograph and bank of methods that need them, where ``--set`` names a file and a bank.

    Returns
    -------
    tuple
        The settings, with ``second_image`` and ``second_bank`` opened; those of other methods as they are.

    Raises
    ------
    CalibrationError
        The file can't be used, the bank is unknown, or they don't belong together.
    InputError
        One of them is missing.
    """
    if not needs_second_view(method):
        return settings
    chosen: dict[str, Any] = dict(settings)
    missing = [name for name in ("second_image", "second_bank") if name not in chosen]
    if missing:
        raise InputError(
            f"--method {method}: needs a second photograph through another aperture and its bank; "
            f"give --set {missing[0]}={'FILE' if missing[0] == 'second_image' else 'REF'}"
        )
    bank, _ = open_bank(project, chosen["second_bank"])
    image = develop_photograph(Path(chosen["second_image"]), bank)
    return tuple((chosen | {"second_bank": bank, "second_image": image}).items())


def find_regions(image: LinearImage, bank: Bank, options: MeasureOptions) -> NDArray[np.int32]:
    """Label image (H, W) by whatever the operator chose; merging by colour and blur by default.

    Raises
    ------
    InputError
        More than one way chosen, an ROI outside the image, a label image that doesn't fit.
    """
    if len(options.regions_given) > 1:
        raise InputError(f"{' and '.join(options.regions_given)}: choose one of them")
    height, width = image.shape
    if options.roi is not None:
        x, y, w, h = options.roi
        if w <= 0 or h <= 0 or x < 0 or y < 0 or x + w > width or y + h > height:
            raise InputError(
                f"--roi {x},{y},{w},{h}: outside the developed image ({width} x {height} pixels); give x,y,width,height"
            )
        return from_roi(image.shape, options.roi)
    if options.labels is not None:
        return read_labels(options.labels, image.shape)
    if options.whole:
        return whole(image.shape)
    if options.segment == "colour":
        return srm(image, SrmOptions(q=options.srm_q))
    fine = srm(image, SrmOptions(q=options.srm_q * SUPERPIXEL_Q, min_fraction=SUPERPIXEL_FRACTION))
    return regions_of_one_depth(image, bank, fine, workers=usable_processors())


def measure(path: Path, bank: Bank, bank_ref: str, options: MeasureOptions) -> Measurement:
    """Measure one photograph; writes nothing.

    Raises
    ------
    CalibrationError
        The file can't be used, or doesn't belong to this bank.
    InputError
        The region or method options can't be used.
    """
    started = time.perf_counter()
    image = develop_photograph(path, bank)
    labels = find_regions(image, bank, options)
    workers = min(usable_processors(), _MOST_AT_ONCE)
    estimates = estimate_depths(
        image,
        bank,
        labels,
        options.method,
        dict(options.method_options),
        workers=workers,
        outlines_found=not options.regions_given,
    )
    labels = without_parts(labels, (estimate.left_out for estimate in estimates.values()))
    return Measurement(
        image=image,
        image_name=str(path),
        bank_ref=bank_ref,
        bank_id=bank.id,
        method=options.method,
        options=_options_json(options),
        labels=labels,
        estimates=estimates,
        depth_map_mm=depth_map(labels, estimates),
        all_focus=all_focus(image, bank, labels, estimates, workers=usable_processors()),
        bank_quality=quality_verdict(bank),
        seconds=time.perf_counter() - started,
    )


def _options_json(options: MeasureOptions) -> dict[str, Any]:
    values = asdict(replace(options, method_options=()))
    values["labels"] = str(options.labels) if options.labels else None
    values["method_options"] = option_values(options.method, dict(options.method_options))
    return values


def measurement_id(measurement: Measurement) -> str:
    """Name of a measurement: the photograph's name and a hash of photograph, bank and options."""
    content = [measurement.image.info.sha256, measurement.bank_id, measurement.method, measurement.options]
    return f"{Path(measurement.image_name).stem}-{sha256_json(content)[:8]}"


def save(measurement: Measurement, bank: Bank, project: Project, out: Path | None = None) -> Measurement:
    """Write depth map, all-focus image, labels, JSON and report into one directory, whole or not at all.

    ``out`` replaces the default directory ``measurements/ID``. An existing ``out`` keeps its other files.

    Returns
    -------
    Measurement
        With ``files`` filled in.
    """
    directory = out or project.measurements / measurement_id(measurement)
    names = {
        "depth_png": "depth.png",
        "depth_tiff": "depth.tiff",
        "all_focus": "all_focus.png",
        "labels": "labels.png",
        "report": "report.html",
    }
    done = replace(measurement, files={role: directory / name for role, name in names.items()})
    with staged_files(directory) as temporary:
        (temporary / names["depth_png"]).write_bytes(png_bytes(depth_to_png(measurement.depth_map_mm)))
        tifffile.imwrite(
            temporary / names["depth_tiff"], measurement.depth_map_mm, compression="zlib", metadata=None,
            description="depth in mm, NaN = unknown",
        )  # fmt: skip
        (temporary / names["all_focus"]).write_bytes(png_bytes(to_srgb8(measurement.all_focus)))
        (temporary / names["labels"]).write_bytes(png_bytes(measurement.labels.astype(np.uint16)))
        write_measurement_report(done, bank, temporary / names["report"])
        write_json(temporary / "measurement.json", done.as_json(project.relative))
    return done


def depth_to_png(depth_map_mm: NDArray[np.float32]) -> NDArray[np.uint16]:
    """uint16 (H, W) millimetres, 0 = unknown; depths beyond 65.5 m saturate."""
    filled = np.nan_to_num(depth_map_mm, nan=0.0, posinf=0.0, neginf=0.0)
    return np.clip(np.rint(filled), 0, 65535).astype(np.uint16)
