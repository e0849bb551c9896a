"""Accuracy on RAW files whose truth is known: a directory with ``truth.json``.

``truth.json`` holds ``files``: by path relative to it, what each file shows. ``kind`` is ``psf`` or ``dark`` (the
bank's), ``scene`` (with ``ids`` and ``depth``, PNG images at the size of the developed image, and ``objects``: by name
an ``id``), or anything else for a single plane at ``z_mm``, such as ``chart`` or ``photo``.

Planes are measured whole. Scenes are measured twice: each object's inner part as a region of its own, and as an
operator would, by region merging, where an object's depth is the median of the depth map over its inner part.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from calibration.photograph import develop_photograph
from rigs.simulated.scene import SceneTruth
from workbench.bench.accuracy import outcome_of, timed_estimates
from workbench.bench.scoring import GRID_MM, Outcome
from workbench.demo import compare, object_core
from workbench.depth.regions import whole
from workbench.errors import InputError
from workbench.measure import MeasureOptions, measure
from workbench.progress import Observer, Step

ONE_DEPTH_MM = 100.0
"""An object whose inner part spans more depth than this has no single depth to be compared with."""


@dataclass(frozen=True, slots=True)
class TruePlane:
    """A photograph of one plane."""

    path: Path
    kind: str
    true_mm: float


@dataclass(frozen=True, slots=True)
class TrueScene:
    """A photograph of several objects, with the truth of each developed pixel (id 0: none)."""

    path: Path
    truth: SceneTruth


@dataclass(frozen=True, slots=True)
class TrueFiles:
    """What a directory holds to be measured."""

    planes: tuple[TruePlane, ...]
    scenes: tuple[TrueScene, ...]


@dataclass(frozen=True, slots=True)
class Single:
    """One measured plane or object, named."""

    name: str
    outcome: Outcome


def read_truth(directory: Path) -> TrueFiles:
    """Read ``truth.json`` and the images that it names.

    Raises
    ------
    InputError
        It is missing or damaged, names a file that isn't there, or holds nothing to measure.
    """
    table = directory / "truth.json"
    try:
        files = json.loads(table.read_text(encoding="utf-8"))["files"]
        planes = [
            TruePlane(directory / name, facts["kind"], float(facts["z_mm"]))
            for name, facts in files.items()
            if facts["kind"] not in ("psf", "dark", "scene")
        ]
        scenes = [_read_scene(directory, name, facts) for name, facts in files.items() if facts["kind"] == "scene"]
    except FileNotFoundError:
        raise InputError(f"{table}: no such file; it must say the true depth of each RAW file") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{table}: can't be used ({type(error).__name__}: {error}); expected files: {{name: {{kind, z_mm}}}}"
        ) from None
    everything: list[TruePlane | TrueScene] = [*planes, *scenes]
    missing = [item.path for item in everything if not item.path.is_file()]
    if missing:
        raise InputError(f"{table}: names {missing[0]}, which isn't there")
    if not everything:
        raise InputError(f"{table}: lists no photograph to measure (only psf and dark frames)")
    return TrueFiles(tuple(planes), tuple(scenes))


def _read_scene(directory: Path, name: str, facts: Mapping[str, Any]) -> TrueScene:
    ids, depth = (_read_png(directory / facts[key]) for key in ("ids", "depth"))
    if ids.shape != depth.shape:
        raise InputError(f"{directory / facts['ids']}: {ids.shape}, but the depth image is {depth.shape}")
    names = tuple(facts["objects"])
    numbered = np.zeros(ids.shape, np.uint8)
    for number, item in enumerate(names, start=1):
        numbered[ids == int(facts["objects"][item]["id"])] = number
    return TrueScene(directory / name, SceneTruth(depth.astype(np.float32), numbered, names))


def _read_png(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None or image.ndim != 2:
        raise InputError(f"{path}: no such image of one channel")
    return np.asarray(image)


def run_truth(
    files: TrueFiles,
    bank: Bank,
    methods: Sequence[str],
    settings: Mapping[str, Mapping[str, str]],
    observer: Observer,
) -> list[Single]:
    """Measure all files with all methods.

    Parameters
    ----------
    files
        See :func:`read_truth`.
    bank
        Of the camera that took them.
    methods, settings
        Names, and their options as texts.
    observer
        Progress.

    Returns
    -------
    list of Single
        Outcomes whose ``size`` is ``whole``, ``object`` (inner part given) or ``merged`` (regions found by merging).

    Raises
    ------
    CalibrationError, InputError
        A file can't be used or doesn't fit the bank.
    """
    everything: list[TruePlane | TrueScene] = [*files.planes, *files.scenes]
    total, done = len(everything) * len(methods), 0
    singles: list[Single] = []
    for item in everything:
        image = develop_photograph(item.path, bank)
        for method in methods:
            chosen = settings.get(method, {})
            if isinstance(item, TruePlane):
                singles.append(_whole(item, image, bank, method, chosen))
            else:
                singles += _objects(item, image, bank, method, chosen)
                singles += _merged(item, bank, method, chosen)
            done += 1
            observer(Step(f"{item.path.name}, {method}", done, total))
    return singles


def _whole(plane: TruePlane, image: LinearImage, bank: Bank, method: str, settings: Mapping[str, str]) -> Single:
    labels = whole(image.shape)
    estimates, seconds = timed_estimates(image, bank, labels, method, settings)
    outcome = outcome_of(
        estimates[1], method=method, texture=plane.kind, size="whole", light="", true_mm=plane.true_mm,
        seconds=seconds, on_grid=plane.true_mm % GRID_MM == 0, pixels=labels.size,
    )  # fmt: skip
    return Single(plane.path.stem, outcome)


def _objects(
    scene: TrueScene, image: LinearImage, bank: Bank, method: str, settings: Mapping[str, str]
) -> list[Single]:
    labels = np.zeros(image.shape, np.int32)
    depths = _single_depths(scene, image)
    for number in depths:
        labels[object_core(scene.truth.object_id == number)] = number
    estimates, seconds = timed_estimates(image, bank, labels, method, settings)
    return [
        Single(
            f"{scene.path.stem}: {scene.truth.names[number - 1]}",
            outcome_of(
                estimates[number], method=method, texture=_kind_of(scene.truth.names[number - 1]), size="object",
                light="", true_mm=true_mm, seconds=seconds, on_grid=true_mm % GRID_MM == 0,
                pixels=int((labels == number).sum()),
            ),
        )
        for number, true_mm in depths.items()
    ]  # fmt: skip


def _kind_of(name: str) -> str:
    """Objects of one kind may be numbered: ``brick 2`` is a brick."""
    return name.rstrip("0123456789").rstrip() or name


def _single_depths(scene: TrueScene, image: LinearImage) -> dict[int, float]:
    """True depth (median over the inner part) by number of the objects that have one depth."""
    if scene.truth.object_id.shape != image.shape:
        raise InputError(
            f"{scene.path}: develops to {image.shape[1]} x {image.shape[0]} pixels, its truth has "
            f"{scene.truth.object_id.shape[1]} x {scene.truth.object_id.shape[0]}"
        )
    depths = {}
    for number in range(1, len(scene.truth.names) + 1):
        within = scene.truth.depth_mm[object_core(scene.truth.object_id == number)]
        if within.size and float(np.ptp(within)) <= ONE_DEPTH_MM:
            depths[number] = float(np.median(within))
    return depths


def _merged(scene: TrueScene, bank: Bank, method: str, settings: Mapping[str, str]) -> list[Single]:
    measured = measure(scene.path, bank, bank.id, MeasureOptions(method, tuple(settings.items())))
    singles = []
    depths = _single_depths(scene, measured.image)
    numbers = {name: number for number, name in enumerate(scene.truth.names, start=1)}
    for result in compare(measured, scene.truth):
        if numbers[result.name] not in depths:
            continue
        estimate = measured.estimates.get(result.region)
        nan = float("nan")
        outcome = Outcome(
            method=method, texture=_kind_of(result.name), size="merged", light="", true_mm=result.true_mm,
            depth_mm=result.measured_mm, interval_mm=estimate.interval_mm if estimate else (nan, nan),
            confidence=estimate.confidence if estimate else 0.0, status=result.status,
            seconds=measured.seconds / max(len(measured.estimates), 1), on_grid=result.true_mm % GRID_MM == 0,
            pixels=int(object_core(scene.truth.object_id == numbers[result.name]).sum()),
        )  # fmt: skip
        singles.append(Single(f"{scene.path.stem}: {result.name}", outcome))
    return singles
