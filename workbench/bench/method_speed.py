"""How fast whole methods are on a full frame with six regions, and how much memory measuring one takes."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from workbench.depth.methods import estimate_depths
from workbench.depth.regions import edge_distance
from workbench.depth.sharpness import MAPS, SharpnessOptions, denoise, edge_maps, lambda_factor
from workbench.errors import InputError

SCIKIT_IMAGE = "paper's method on scikit-image"
_TURNS, _SHORT_S = 3, 30.0
"""Methods that take less are timed so often, before and after the slow ones, and their median counts."""


@dataclass(frozen=True, slots=True)
class MethodRow:
    """One method on the frame.

    Attributes
    ----------
    name
        Method.
    seconds
        For all regions of the frame, at all depths of the bank.
    speed_up
        Seconds of ``sharpness`` over these; NaN where it wasn't timed.
    scaled
        Depths that were really measured, where the time was scaled from fewer than all; else 0.
    """

    name: str
    seconds: float
    speed_up: float
    scaled: int = 0


def six_regions(shape: tuple[int, int]) -> NDArray[np.int32]:
    """Label image (H, W) of two rows of three regions that fill the frame."""
    rows = np.minimum(np.arange(shape[0]) * 2 // shape[0], 1)
    columns = np.minimum(np.arange(shape[1]) * 3 // shape[1], 2)
    return np.asarray(1 + 3 * rows[:, None] + columns[None, :], np.int32)


def method_rows(
    image: LinearImage, bank: Bank, methods: Sequence[str], *, labels: NDArray[np.int32] | None = None,
    scikit_image_depths: int = 1,
) -> list[MethodRow]:  # fmt: skip
    """Time whole methods on one developed frame.

    Parameters
    ----------
    image
        A frame that the bank fits.
    bank
        PSFs.
    methods
        Registered names. Each is run on a small corner first, so that nothing is compiled while the clock runs; fast
        ones take several turns, between those of the slow ones.
    labels
        int32 (H, W); default: six regions that fill the frame.
    scikit_image_depths
        Depths, evenly spread, at which the paper's method is run on scikit-image's ``richardson_lucy``; its time is
        scaled to the bank's number of depths. 0 leaves it out, and so does scikit-image not being installed.

    Returns
    -------
    list of MethodRow
        In the order given, scikit-image last.
    """
    regions = six_regions(image.shape) if labels is None else labels
    corner = LinearImage(
        image.planes[:256, :256], image.saturated[:256, :256], image.recipe, image.pixel_pitch_mm, image.info,
        None if image.mosaic is None else image.mosaic.part(slice(0, 256), slice(0, 256)),
    )  # fmt: skip
    times: dict[str, list[float]] = {method: [] for method in methods}
    for method in methods:
        estimate_depths(corner, bank, np.ones(corner.shape, np.int32), method, {})
    for _ in range(_TURNS):
        for method, spent in times.items():
            if not spent or spent[0] < _SHORT_S:
                started = time.perf_counter()
                estimate_depths(image, bank, regions, method, {})
                spent.append(time.perf_counter() - started)
    seconds = {method: float(np.median(spent)) for method, spent in times.items()}
    scaled = min(scikit_image_depths, len(bank.depths_mm))
    if scaled:
        per_depth = _scikit_image_seconds(image, bank, regions, scaled)
        if per_depth is not None:
            seconds[SCIKIT_IMAGE] = per_depth * len(bank.depths_mm)
    own = seconds.get("sharpness", float("nan"))
    return [
        MethodRow(name, spent, own / spent, scaled if name == SCIKIT_IMAGE and scaled < len(bank.depths_mm) else 0)
        for name, spent in seconds.items()
    ]


def _scikit_image_seconds(image: LinearImage, bank: Bank, regions: NDArray[np.int32], depths: int) -> float | None:
    """Mean seconds for one depth: deconvolution of the frame by scikit-image, and the scores of all regions."""
    try:
        from skimage import restoration
    except ImportError:
        return None
    richardson_lucy: Any = restoration.richardson_lucy
    options = SharpnessOptions()
    luminance = np.maximum(image.luminance, np.float32(0))
    margin = float(np.abs(bank.lens.radius_px).max())
    insides = []
    for label in np.unique(regions[regions > 0]):
        mask = regions == label
        insides.append(mask & (edge_distance(mask, frame_is_edge=True) > margin))
    weight = lambda_factor(bank.lens.sigma_px(bank.depths_mm) * (bank.pixel_pitch_mm or 1.0), options.lambda_reading)
    chosen = np.linspace(0, len(bank.depths_mm) - 1, depths + 2)[1:-1].round().astype(int)
    started = time.perf_counter()
    for depth in chosen:
        sharp = richardson_lucy(luminance, bank.central[depth], num_iter=options.iterations, clip=False)
        maps = edge_maps(np.asarray(sharp, np.float32), options.window)
        for inside in insides:
            float(weight[depth]) * sum(denoise(maps[name][inside], options).score for name in MAPS)
    return (time.perf_counter() - started) / depths


_MEASURE_ONE = """
import json, resource, sys, time
from pathlib import Path
from calibration.bank import load_bank
from workbench.measure import MeasureOptions, measure
bank = load_bank(sys.argv[1])
started = time.perf_counter()
measured = measure(Path(sys.argv[2]), bank, bank.id, MeasureOptions(method=sys.argv[3]))
seconds = time.perf_counter() - started
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps({"peak_bytes": peak * (1 if sys.platform == "darwin" else 1024), "seconds": seconds,
                  "regions": len(measured.estimates)}))
"""


@dataclass(frozen=True, slots=True)
class MemoryRow:
    """Measuring one photograph in a process of its own: RAW file to depth map and all-focus image."""

    method: str
    peak_bytes: int
    seconds: float
    regions: int


def peak_memory(bank_directory: Path, photograph: Path, method: str) -> MemoryRow:
    """Largest resident size of a fresh process that measures one photograph, regions found by merging.

    Raises
    ------
    InputError
        The measurement failed; with its last line.
    """
    command = [sys.executable, "-c", _MEASURE_ONE, str(bank_directory), str(photograph), method]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise InputError(f"{photograph}: measuring with {method} failed: {last[0]}")
    facts = json.loads(done.stdout)
    return MemoryRow(method, int(facts["peak_bytes"]), float(facts["seconds"]), int(facts["regions"]))
