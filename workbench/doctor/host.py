"""The computer: versions, clock, space on disk, and the serial ports that it lists."""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import workbench
from workbench.doctor.findings import Finding, Subject
from workbench.units import bytes_text, seconds_text

COMPUTER = Subject("computer")

LIBRARIES = (
    "numpy",
    "scipy",
    "opencv-python-headless",
    "rawpy",
    "numba",
    "pyserial",
    "gphoto2",
    "starlette",
    "uvicorn",
)
"""Whose versions matter when something goes wrong."""
_SHOWN = ("workbench", "python", "numpy", "rawpy", "gphoto2")
_OPTIONAL = frozenset({"gphoto2"})
"""Reported as missing by the check of the camera that needs it."""
_SPARE = 1.5
_CLOCK_SLACK_S = 120.0


def versions() -> dict[str, str]:
    """Versions of the workbench, of Python and of :data:`LIBRARIES`; empty text where one isn't installed."""
    found = {"workbench": workbench.__version__, "python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = ""
    return found


def computer_findings(
    root: Path, need_bytes: float, *, installed: Mapping[str, str], now_s: float, newest_file_s: float
) -> list[Finding]:
    """Check versions, clock and disk.

    Parameters
    ----------
    root
        Directory of the project.
    need_bytes
        What the planned frames take.
    installed
        See :func:`versions`.
    now_s
        The computer's clock (seconds since 1970).
    newest_file_s
        A moment that must lie in the past (see the function of this name).
    """
    return [_versions(installed), _clock(now_s, newest_file_s), _disk(root, need_bytes)]


def newest_file_s(root: Path) -> float:
    """When the newest of the program's own files and of the project's banks and sessions was written."""
    program = Path(workbench.__file__).parent.rglob("*.py")
    own = (root / name for name in ("rig.yaml", "banks/registry.jsonl"))
    sessions = root.glob("sessions/*/journal.jsonl")
    return max((path.stat().st_mtime for path in (*program, *own, *sessions) if path.is_file()), default=0.0)


def _versions(found: Mapping[str, str]) -> Finding:
    missing = [name for name, number in found.items() if not number and name not in _OPTIONAL]
    if missing:
        return COMPUTER.error(
            "versions", f"missing: {', '.join(missing)}", f"install the workbench anew, or `pip install {missing[0]}`"
        )
    return COMPUTER.ok("versions", ", ".join(f"{name} {found[name]}" for name in _SHOWN if found.get(name)))


def _clock(now_s: float, newest_s: float) -> Finding:
    now = datetime.fromtimestamp(now_s, UTC)
    shown = now.astimezone().strftime("%Y-%m-%d %H:%M %Z")
    if now_s < newest_s - _CLOCK_SLACK_S:
        return COMPUTER.warning(
            "clock",
            f"{shown}: {seconds_text(newest_s - now_s)} before the newest file of program or project",
            "set the clock (`timedatectl set-ntp true`): dates in journals and banks would be wrong",
        )
    return COMPUTER.ok("clock", shown)


def _disk(root: Path, need_bytes: float) -> Finding:
    if not os.access(root, os.W_OK | os.X_OK):
        return COMPUTER.error("disk", f"{root} can't be written to", "change its permissions, or use another directory")
    free = shutil.disk_usage(root).free
    seen = f"{bytes_text(free)} free, the plan's frames take about {bytes_text(need_bytes)}"
    if free < need_bytes:
        return COMPUTER.error("disk", seen, "free some space, or keep the project on another disk")
    if free < _SPARE * need_bytes:
        return COMPUTER.warning("disk", seen, "free some space: banks, reports and photographs come on top")
    return COMPUTER.ok("disk", seen)
