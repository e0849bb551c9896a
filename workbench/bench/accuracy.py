"""Accuracy of the methods on frames of the simulated rig: cases in, outcomes out, over a pool of processes."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from calibration.photograph import develop_photograph
from calibration.pupil import PsfModel, psf_model
from rigs.simulated.rig import SceneFrame
from rigs.simulated.scenes import plane_scene
from rigs.simulated.world import SimulatedRigSettings
from workbench.bench.bound import depth_bound_mm, signal_and_noise, texture_spectrum
from workbench.bench.cases import BLANK, Case, lay_out, photograph
from workbench.bench.one_thread import one_thread_each, sendable, start_in_one_thread
from workbench.bench.scoring import Outcome
from workbench.depth.estimate import DepthEstimate
from workbench.depth.methods import estimate_depths
from workbench.progress import Observer, Step


@dataclass(frozen=True, slots=True)
class View:
    """A rig, and the bank of its aperture."""

    bank: Bank
    rig: SimulatedRigSettings


@dataclass(frozen=True, slots=True)
class Run:
    """What an accuracy run does with its cases.

    Attributes
    ----------
    methods
        Names, see :mod:`workbench.depth.methods`.
    first
        A method named here measures only so many of the cases, the first ones.
    settings
        Options per method, as texts.
    sizes, lights
        See :mod:`workbench.bench.cases`.
    """

    methods: tuple[str, ...]
    sizes: tuple[str, ...]
    lights: tuple[str, ...]
    first: Mapping[str, int] = field(default_factory=dict)
    settings: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    def methods_of(self, index: int) -> tuple[str, ...]:
        """Methods that measure the case of this index."""
        return tuple(name for name in self.methods if index < self.first.get(name, index + 1))


def run_cases(
    cases: Sequence[Case], run: Run, view: View, *, second: Mapping[str, View] | None = None, jobs: int,
    observer: Observer,
) -> list[Outcome]:  # fmt: skip
    """Photograph and measure every case.

    Frames are written as RAW files, developed, measured and thrown away. Each process works on one thread, so that
    times are those of one core. Outcomes come in the order of the cases, whatever the number of processes.

    Parameters
    ----------
    cases
        See :func:`workbench.bench.cases.make_cases`.
    run
        What to do with each.
    view
        What photographs the cases.
    second
        Second views, of the methods that need two.
    jobs
        Processes.
    observer
        Progress.
    """
    views = _sendable(view), {name: _sendable(other) for name, other in (second or {}).items()}
    results: dict[int, list[Outcome]] = {}
    started = time.monotonic()
    with one_thread_each(), tempfile.TemporaryDirectory(prefix="workbench-bench-") as scratch:
        context = multiprocessing.get_context("spawn")  # forking a process that has threads may deadlock
        with ProcessPoolExecutor(jobs, context, _start_worker, (*views, run, Path(scratch))) as pool:
            futures = {pool.submit(_measure_case, index, case): index for index, case in enumerate(cases)}
            try:
                for done, future in enumerate(as_completed(futures), start=1):
                    index = futures[future]
                    results[index] = future.result()
                    left = (time.monotonic() - started) / done * (len(cases) - done)
                    case = cases[index]
                    observer(Step(f"{case.texture} at {case.true_mm / 10:.0f} cm", done, len(cases), left))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    return [outcome for index in sorted(results) for outcome in results[index]]


def _sendable(view: View) -> View:
    return View(sendable(view.bank), view.rig)


@dataclass(frozen=True, slots=True)
class _Worker:
    view: View
    psfs: PsfModel
    second: Mapping[str, View]
    run: Run
    scratch: Path


_worker: _Worker | None = None


def _start_worker(view: View, second: Mapping[str, View], run: Run, scratch: Path) -> None:
    global _worker
    start_in_one_thread()
    _worker = _Worker(view, psf_model(view.bank), second, run, scratch)


def _measure_case(index: int, case: Case) -> list[Outcome]:
    assert _worker is not None
    run, bank = _worker.run, _worker.view.bank
    layout = lay_out(run.sizes, case.seed)
    pixels = np.bincount(layout.labels.ravel())[1:]
    methods = run.methods_of(index)
    others = {
        name: {light: image for light, image, _ in _developed(case, view, layout.frame_shape)}
        for name, view in _worker.second.items()
        if name in methods
    }
    outcomes: list[Outcome] = []
    for light, image, frame in _developed(case, _worker.view, layout.frame_shape):
        bounds = _bounds_mm(case, frame, pixels)
        for method in methods:
            settings: dict[str, Any] = dict(run.settings.get(method, {}))
            if method in others:
                settings |= {"second_image": others[method][light], "second_bank": _worker.second[method].bank}
            estimates, seconds = timed_estimates(image, bank, layout.labels, method, settings)
            outcomes += [
                outcome_of(
                    estimates[label], method=method, texture=case.texture, size=size, light=light,
                    true_mm=case.true_mm, seconds=seconds, on_grid=case.on_grid, pixels=int(pixels[label - 1]),
                    bound_mm=bounds[label - 1],
                )
                for label, size in enumerate(layout.sizes, start=1)
            ]  # fmt: skip
    return outcomes


def _developed(case: Case, view: View, shape: tuple[int, int]) -> Iterator[tuple[str, LinearImage, SceneFrame]]:
    """Photograph a case and develop it, light by light."""
    assert _worker is not None
    for light, path, frame in photograph(case, view.rig, shape, _worker.run.lights, _worker.scratch):
        image = develop_photograph(path, view.bank)
        path.unlink()
        yield light, image, frame


def timed_estimates(
    image: LinearImage, bank: Bank, labels: NDArray[np.int32], method: str, settings: Mapping[str, Any]
) -> tuple[dict[int, DepthEstimate], float]:
    """Depths of all regions of a frame, and the seconds that it took, divided by the number of regions."""
    started = time.perf_counter()
    estimates = estimate_depths(image, bank, labels, method, settings)
    return estimates, (time.perf_counter() - started) / max(len(estimates), 1)


def outcome_of(
    estimate: DepthEstimate, *, method: str, texture: str, size: str, light: str, true_mm: float, seconds: float,
    on_grid: bool, pixels: int, bound_mm: float = float("nan"),
) -> Outcome:  # fmt: skip
    """One row of the raw results."""
    return Outcome(
        method=method, texture=texture, size=size, light=light, true_mm=true_mm, depth_mm=estimate.depth_mm,
        interval_mm=estimate.interval_mm, confidence=estimate.confidence, status=estimate.status, seconds=seconds,
        on_grid=on_grid, pixels=pixels, bound_mm=bound_mm,
    )  # fmt: skip


def _bounds_mm(case: Case, frame: SceneFrame, pixels: NDArray[np.intp]) -> list[float]:
    """Cramer-Rao bound per region; the spectrum is the texture's in general, not of this drawing of it."""
    assert _worker is not None
    if case.texture == BLANK:
        return [float("inf")] * len(pixels)
    item = plane_scene(case.texture, case.true_mm).objects[0]
    spectrum, mean = texture_spectrum(case.texture, frame.world.sensor.shape)
    gain, noise = signal_and_noise(item, mean, frame.world.sensor, _worker.view.rig.scene_illumination, frame.exposure)
    spectrum = gain**2 * spectrum
    one = depth_bound_mm(_worker.psfs, case.true_mm, spectrum, noise, 1)
    return [one / float(np.sqrt(count)) for count in pixels]
