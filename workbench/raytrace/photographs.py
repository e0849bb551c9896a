"""A directory of traced RAW files with their truth: points for a bank, planes, still lifes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigs.simulated.dng import FrameTags, write_dng
from workbench.files import write_json
from workbench.progress import Observer, Step
from workbench.raytrace.stills import PLANES, plane, still_life
from workbench.raytrace.tracing import Traced, trace, trace_point
from workbench.raytrace.world import Camera
from workbench.truth_files import write_scene_truth

POINT_DEPTHS_MM = tuple(100.0 * k for k in range(6, 36))
CAMERA = Camera(height=1536, width=2304)
_POINT_FRAME = 512
_PLANE_FRAME = 768
_POINT_RAYS = 1 << 19
_BRIGHT = 0.85
"""Share of the white level that a photograph's brightest thousandth reaches, and a point's peak."""


def write_photographs(
    directory: Path, *, scenes: int, planes: int, seed: int, rays: int, observer: Observer, camera: Camera = CAMERA,
    point_depths_mm: Sequence[float] = POINT_DEPTHS_MM,
) -> None:  # fmt: skip
    """Trace and write everything; :func:`workbench.bench.truth.read_truth` reads it.

    Parameters
    ----------
    directory
        Exists; gets ``psf/``, ``dark/``, ``planes/``, ``scenes/`` and ``truth.json``.
    scenes, planes
        How many still lifes, and single planes, these with depths drawn evenly in 1/z from 60 to 350 cm.
    seed
        Photograph k is drawn from ``seed + k``.
    rays
        Per photosite, a power of two.
    observer
        Progress.
    camera
        Of the scenes; points and planes are photographed on the middle of its sensor.
    point_depths_mm
        The bank's planes.
    """
    files: dict[str, dict[str, Any]] = {}
    done, total = 0, 1 + len(point_depths_mm) + planes + scenes

    def finish(name: str, facts: dict[str, Any]) -> None:
        nonlocal done
        files[name] = facts
        done += 1
        observer(Step(name, done, total))

    for folder in ("psf", "dark", "planes", "scenes"):
        (directory / folder).mkdir(exist_ok=True)
    small = replace(camera, height=_POINT_FRAME, width=_POINT_FRAME)
    dark = np.zeros((small.height, small.width), np.float32)
    _write(directory / "dark/dark_1.dng", dark, small, seed, 1.0)
    finish("dark/dark_1.dng", {"kind": "dark"})
    for depth_mm in point_depths_mm:
        name = f"psf/psf_{depth_mm / 10:03.0f}cm.dng"
        light = trace_point(small, depth_mm, rays=_POINT_RAYS, seed=seed + int(depth_mm))
        _write(directory / name, light, small, seed + int(depth_mm), _BRIGHT / float(light.max()))
        finish(name, {"kind": "psf", "z_mm": depth_mm})
    generator = np.random.default_rng([seed, 0x92])
    side = min(camera.height, _PLANE_FRAME)
    square = replace(camera, height=side, width=side)
    for number in range(planes):
        depth_mm = float(np.round(1 / generator.uniform(1 / point_depths_mm[-1], 1 / point_depths_mm[0])))
        kind = PLANES[number % len(PLANES)]
        name = f"planes/{kind}_{seed + number}.dng"
        traced = trace(square, plane(square, kind, depth_mm, seed + number), rays=rays, seed=seed + number)
        _write(directory / name, traced.light, square, seed + number, _exposure(traced))
        finish(name, {"kind": kind, "z_mm": depth_mm})
    for number in range(seed, seed + scenes):
        surfaces = still_life(camera, number)
        traced = trace(camera, surfaces, rays=rays, seed=number)
        name = f"scenes/still_{number}"
        _write(directory / f"{name}.dng", traced.light, camera, number, _exposure(traced))
        names = [surface.name for surface in surfaces]
        truth = write_scene_truth(directory, name, traced.depth_mm, traced.surface + 1, names)
        finish(f"{name}.dng", truth)
    write_json(directory / "truth.json", {"files": files})


def _exposure(traced: Traced) -> float:
    return _BRIGHT / float(np.quantile(traced.light, 0.999))


def _write(path: Path, light: NDArray[np.floating], camera: Camera, seed: int, gain: float) -> None:
    """Expose: shot noise of the electrons, noise of reading."""
    generator = np.random.default_rng([seed, 0x93])
    electrons = generator.poisson(light * (gain * camera.full_well_e)) + generator.normal(
        0.0, camera.read_noise_e, light.shape
    )
    raw = camera.black + electrons * ((camera.white - camera.black) / camera.full_well_e)
    mosaic = np.clip(np.rint(raw), 0, camera.white).astype(np.uint16)
    tags = FrameTags(
        exposure_s=0.01, iso=100, focal_length_mm=camera.focal_mm, f_number=3.6, pitch_mm=camera.pitch_mm,
        make="traced", model="Traced thin lens", serial="0", black=camera.black, white=camera.white,
        software="depth-workbench ray tracer",
    )  # fmt: skip
    write_dng(path, mosaic, tags)
