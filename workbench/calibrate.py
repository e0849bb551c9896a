"""Frames -> PSFs -> bank, with its report: from a session of the rig, or from RAW files taken elsewhere."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from calibration.bank import Bank
from calibration.build import BuildOptions, BuiltBank, PointFrame, build_bank
from calibration.errors import DepthListError, FitError
from calibration.exif import photosite_pitch_mm, read_tags
from calibration.frames import find_frames
from calibration.lens_fit import MIN_DEPTHS_FOR_ZERO
from calibration.linear_files import is_linear_file
from calibration.registry import Entry
from workbench.banks import store_bank
from workbench.config import RigConfig
from workbench.journal import SessionState
from workbench.plan import Plan
from workbench.project import Project


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A bank that was made, stored and registered."""

    bank: Bank
    built: BuiltBank
    entry: Entry
    report: Path


def calibrate_frames(project: Project, directory: Path, config: RigConfig, *, apply_zero: bool) -> CalibrationResult:
    """Make a bank from RAW files taken elsewhere.

    Depths are the operator's word; the fitted stage zero is reported, and applied only on demand.

    Raises
    ------
    CalibrationError
        The files, the depths or the points in them can't be used.
    """
    listed = find_frames(directory)
    if apply_zero and len(listed.points) < MIN_DEPTHS_FOR_ZERO:
        raise DepthListError(
            f"{directory}: --apply-zero needs {MIN_DEPTHS_FOR_ZERO} depths to find the zero, there are "
            f"{len(listed.points)}; leave it out or add depths"
        )
    frames = [PointFrame(depth_mm, tuple(paths)) for depth_mm, paths in listed.points]
    options = BuildOptions(
        recipe=config.camera.recipe,
        pixel_pitch_mm=_unstated_pitch_mm(frames[0], config),
        apply_zero=apply_zero,
    )
    try:
        built = build_bank(frames, listed.darks, options)
    except (DepthListError, FitError) as error:
        raise type(error)(f"{directory}: {error}") from None
    return _finish(project, built)


def _unstated_pitch_mm(frame: PointFrame, config: RigConfig) -> float | None:
    """Photosite pitch of rig.yaml where the file doesn't state its own: bank and scenes must take it from one source.

    A linear file's pixels needn't be photosites, so rig.yaml says nothing about them.
    """
    path = frame.sources[0]
    assert isinstance(path, Path)
    if is_linear_file(path) or photosite_pitch_mm(read_tags(path)):
        return None
    return config.camera.pixel_pitch_mm


def calibrate_session(
    project: Project, session_dir: Path, plan: Plan, state: SessionState, config: RigConfig
) -> CalibrationResult:
    """Make a bank from a finished session of the rig; the fitted stage zero is applied to the depths."""
    points: dict[float, list[Path]] = defaultdict(list)
    offs: dict[float, list[Path]] = defaultdict(list)
    stood_mm: dict[float, list[float]] = defaultdict(list)
    for shot in plan.shots():
        record = state.shots[shot.id]
        (points if shot.kind == "point" else offs)[shot.depth_mm].append(session_dir / record["file"])
        if shot.kind == "point":
            stood_mm[shot.depth_mm].append(record["position_mm"])
    axis = config.stage.depth.axis
    frames = [
        PointFrame(  # where the stage confirmed that it stood: a panel moved by hand is rarely where it was asked to be
            round(axis.depth_mm(fmean(stood_mm[depth_mm])), 3), tuple(points[depth_mm]),
            dot_mm=dot.size_px * config.panel.pixel_pitch_mm, offs=tuple(offs[depth_mm]),
        )
        for depth_mm, dot in zip(plan.depths_mm, plan.dots, strict=True)
    ]  # fmt: skip
    camera = state.identities["camera"]
    options = BuildOptions(
        recipe=config.camera.recipe,
        pixel_pitch_mm=_unstated_pitch_mm(frames[0], config),
        focal_length_mm=config.optics.focal_length_mm,
        apply_zero=True,
        sensor_size=_frame_size(camera),
        camera={key: camera[key] for key in ("serial", "firmware") if camera[key]},
        settings={
            name: f"{identity['kind']} {identity['model']}".strip() for name, identity in state.identities.items()
        },
        plan_sha256=plan.hash,
        expected_points=max(len(plan.dots[0].points_px), 1),
    )
    return _finish(project, build_bank(frames, (), options))


def _frame_size(camera: dict[str, Any]) -> tuple[int, int] | None:
    """Photosites (height, width) of the whole sensor, where the camera says so (``5184x3456``)."""
    text = camera["extra"].get("sensor", "")
    if "x" not in text:
        return None
    width, height = (int(part) for part in text.split("x"))
    return height, width


def _finish(project: Project, built: BuiltBank) -> CalibrationResult:
    stored = store_bank(project, built.bank)
    return CalibrationResult(built.bank, built, stored.entry, stored.report)
