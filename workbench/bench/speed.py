"""How fast the deconvolution is: against scikit-image on the same input, and against the bare cost of its transforms.

All contenders run in one process, on one input, taking turns, so that whatever else the machine does meets them alike.
Medians of their times are compared.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
import scipy.signal
from numpy.typing import NDArray

from workbench.depth.richardson_lucy import Deconvolver

FloatImage = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class SpeedRow:
    """One contender.

    Attributes
    ----------
    name
        Who.
    median_s, fastest_s
        Seconds for one run.
    times_floor
        Median over the median of the bare transforms.
    speed_up
        Median of scikit-image over this median; NaN where it isn't installed.
    largest_difference
        Largest absolute difference from scikit-image's result, in units of that result's maximum; NaN where the two
        treat borders differently or there is nothing to compare.
    """

    name: str
    median_s: float
    fastest_s: float
    times_floor: float
    speed_up: float
    largest_difference: float


def speed_table(
    size: tuple[int, int] = (864, 1296),
    *,
    psf_size: int = 91,
    iterations: int = 20,
    repeats: int = 5,
    workers: int = 1,
    seed: int = 0,
) -> list[SpeedRow]:
    """Time Richardson-Lucy deconvolution.

    Ours with dark borders treats them as scikit-image does, so their results are compared; ours with weighted borders
    is what measuring uses. The floor is the same number of forward and inverse real transforms (two each an iteration)
    of the padded shape, in single precision, and nothing else. Our times hold everything from pixels to pixels: OTF,
    weights, and the image's own transform. scikit-image always runs on one thread but for its transforms.

    Parameters
    ----------
    size
        (height, width) of the image, pixels.
    psf_size
        Side of the PSF, odd.
    iterations
        Richardson-Lucy iterations.
    repeats
        Turns; an untimed one goes before (it compiles).
    workers
        Threads for ours and for the floor's transforms.
    seed
        Of the random scene.

    Returns
    -------
    list of SpeedRow
        Ours (weighted borders), ours (dark borders), bare transforms, and scikit-image where it is installed.
    """
    image, psf = _blurred_scene(size, psf_size, seed)
    weighted = Deconvolver(size, psf_size, workers=workers)
    dark = Deconvolver(size, psf_size, borders="dark", workers=workers)
    contenders: dict[str, Callable[[], FloatImage]] = {
        "ours": lambda: weighted.richardson_lucy(image, psf, iterations),
        "ours, dark borders": lambda: dark.richardson_lucy(image, psf, iterations),
        "bare transforms": lambda: bare_transforms(weighted.domain, iterations, workers),
    }
    reference = _scikit_image(image, psf, iterations, workers)
    if reference is not None:
        contenders["scikit-image"] = reference
    results = {name: run() for name, run in contenders.items()}
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, run in contenders.items():
            started = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - started)
    medians = {name: float(np.median(times)) for name, times in seconds.items()}
    judge = results.get("scikit-image")

    def row(name: str) -> SpeedRow:
        comparable = name == "ours, dark borders"
        return SpeedRow(
            name=name,
            median_s=medians[name],
            fastest_s=min(seconds[name]),
            times_floor=medians[name] / medians["bare transforms"],
            speed_up=medians.get("scikit-image", float("nan")) / medians[name],
            largest_difference=_difference(results[name], judge) if comparable and judge is not None else float("nan"),
        )

    return [row(name) for name in contenders]


def bare_transforms(domain: tuple[int, int], iterations: int, workers: int) -> FloatImage:
    """Only the transforms of so many iterations: there and back twice each, float32, at this shape."""
    plane = np.zeros(domain, np.float32)
    for _ in range(2 * iterations):
        plane = scipy.fft.irfft2(scipy.fft.rfft2(plane, workers=workers), s=domain, workers=workers)
    return plane


def _scikit_image(image: FloatImage, psf: FloatImage, iterations: int, workers: int) -> Callable[[], FloatImage] | None:
    try:
        from skimage import restoration
    except ImportError:
        return None

    richardson_lucy: Any = restoration.richardson_lucy

    def run() -> FloatImage:
        with scipy.fft.set_workers(workers):
            return np.asarray(richardson_lucy(image, psf, num_iter=iterations, clip=False), np.float32)

    return run


def _blurred_scene(size: tuple[int, int], psf_size: int, seed: int) -> tuple[FloatImage, FloatImage]:
    """Random blocks behind a PSF without symmetry, values in 0 to 1."""
    rng = np.random.default_rng(seed)
    blocks = rng.random((-(-size[0] // 6), -(-size[1] // 6)), dtype=np.float32)
    scene = np.kron(blocks, np.ones((6, 6), np.float32))[: size[0], : size[1]]
    y, x = np.mgrid[-1 : 1 : psf_size * 1j, -1 : 1 : psf_size * 1j]
    psf = ((np.abs(y + 0.6) < 0.15) & (np.abs(x) < 0.7)) | (
        (np.abs(x - 0.4 + 0.4 * (y + 0.6)) < 0.15) & (np.abs(y) < 0.8)
    )
    psf = psf.astype(np.float32) / np.float32(psf.sum())
    blurred = scipy.signal.fftconvolve(scene, psf, mode="same")
    return np.clip(blurred, 0, None).astype(np.float32), psf


def _difference(one: FloatImage, other: FloatImage) -> float:
    return float(np.abs(one - other).max() / np.abs(other).max())
