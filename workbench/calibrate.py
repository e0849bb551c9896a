"""Frames -> PSFs -> bank, with its report: from a session of the rig, or from RAW files taken elsewhere."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.bank import Bank
from calibration.build import BuildOptions, BuiltBank, PointFrame, build_bank
from calibration.frames import find_frames
from calibration.registry import Entry
from workbench.banks import store_bank
from workbench.config import RigConfig
from workbench.journal import SessionState
from workbench.plan import Plan
from workbench.project import Project
from workbench.report import write_bank_report


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A bank that was made, stored and registered."""

    bank: Bank
    built: BuiltBank
    entry: Entry
    directory: Path
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
    frames = [PointFrame(depth_mm, tuple(paths)) for depth_mm, paths in listed.points]
    options = BuildOptions(
        recipe=config.camera.recipe,
        pixel_pitch_mm=config.camera.pixel_pitch_mm,
        apply_zero=apply_zero,
    )
    return _finish(project, build_bank(frames, listed.darks, options))


def calibrate_session(
    project: Project, session_dir: Path, plan: Plan, state: SessionState, config: RigConfig
) -> CalibrationResult:
    """Make a bank from a finished session of the rig; the fitted stage zero is applied to the depths."""
    points: dict[float, list[Path]] = defaultdict(list)
    offs: dict[float, list[Path]] = defaultdict(list)
    for shot in plan.shots():
        record = state.shots[shot.id]
        (points if shot.kind == "point" else offs)[shot.depth_mm].append(session_dir / record["file"])
    frames = [
        PointFrame(
            depth_mm, tuple(points[depth_mm]), dot_mm=dot.size_px * config.panel.pixel_pitch_mm,
            offs=tuple(offs[depth_mm]),
        )
        for depth_mm, dot in zip(plan.depths_mm, plan.dots, strict=True)
    ]  # fmt: skip
    camera = state.identities["camera"]
    options = BuildOptions(
        recipe=config.camera.recipe,
        pixel_pitch_mm=config.camera.pixel_pitch_mm,
        focal_length_mm=config.optics.focal_length_mm,
        apply_zero=True,
        sensor_size=_frame_size(camera),
        camera={key: camera[key] for key in ("serial", "firmware") if camera[key]},
        settings={
            name: f"{identity['kind']} {identity['model']}".strip() for name, identity in state.identities.items()
        },
        plan_sha256=plan.hash,
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
    entry, directory = store_bank(project, built.bank)
    report = directory / "report.html"
    write_bank_report(built.bank, report, version=f"v{entry.version}")
    return CalibrationResult(built.bank, built, entry, directory, report)
