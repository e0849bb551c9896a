"""The camera: free, and open to be asked. Nothing is set, no frame is taken."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from calibration.bank import Bank
from rigs.errors import DeviceBusyError, RigError
from rigs.gphoto2_camera import Gphoto2Camera, survey
from rigs.gphoto2_config import Gphoto2Settings
from rigs.gphoto2_process import WORKER_COMMAND
from workbench.config import CameraConfig
from workbench.devices import gphoto2_settings
from workbench.doctor.camera_facts import CAMERA, Demand, bank_finding, facts_findings, pixel_pitch_finding
from workbench.doctor.findings import Finding
from workbench.doctor.processes import camera_programs, desktop_mounts

_USB_PORT = re.compile(r"usb:(\d+),(\d+)$")
_CALL_S, _PATIENCE_S = 15.0, 5.0
"""A check waits for an answer, or for a camera to come back, less long than a session does."""


def cameras_in_sight(*, needed: bool) -> tuple[list[Finding], tuple[str, ...]]:
    """Cameras that libgphoto2 sees, and its version; a library that is missing matters only where it is needed."""
    try:
        seen = survey()
    except RigError as error:
        found = CAMERA.failure("library", error)
        return [found if needed else CAMERA.note("library", found.seen, found.mend)], ()
    return [CAMERA.ok("library", seen.library)], tuple(map(str, seen.cameras))


def camera_findings(
    config: CameraConfig,
    demand: Demand,
    in_sight: Sequence[str],
    *,
    programs: Sequence[str],
    bank: Bank | None = None,
) -> list[Finding]:
    """Check the camera that rig.yaml names.

    Parameters
    ----------
    config
        The camera.
    demand
        What the plan needs.
    in_sight
        Cameras that are plugged in (see :func:`cameras_in_sight`).
    programs
        Names of running programs (see :func:`workbench.doctor.processes.running`).
    bank
        The active one.
    """
    if config.kind == "simulated":
        if in_sight:
            seen = f"simulated camera; {in_sight[0]} isn't used"
            return [CAMERA.note("connection", seen, "camera.kind: gphoto2 in rig.yaml uses it")]
        return [CAMERA.ok("connection", "simulated camera")]
    settings = gphoto2_settings(config)
    facts, found = usb_camera_findings(settings, demand, now=datetime.now(), programs=programs)
    if facts is None:
        return [*found, *permission_findings(in_sight)]
    camera = {} if bank is None else bank.manifest.get("camera", {})
    fits = bank_finding((str(camera.get("make") or ""), str(camera.get("model") or "")), facts)
    return [*found, pixel_pitch_finding(config.pixel_pitch_mm, facts), *([] if fits is None else [fits])]


def permission_findings(in_sight: Sequence[str], bus: Path = Path("/dev/bus/usb")) -> list[Finding]:
    """Whether this user may open the cameras on USB: the library sees one that it may not open, and doesn't say why."""
    nodes = [bus / match[1] / match[2] for text in in_sight if (match := _USB_PORT.search(text))]
    return [
        CAMERA.error(
            "permission",
            f"no permission for {node}",
            "install the udev rules of libgphoto2 (Debian: libgphoto2-6), log in at the desk, plug the camera in again",
        )
        for node in nodes
        if node.exists() and not os.access(node, os.R_OK | os.W_OK)
    ]


def usb_camera_findings(
    settings: Gphoto2Settings,
    demand: Demand,
    *,
    now: datetime,
    programs: Sequence[str],
    worker: Sequence[str] = WORKER_COMMAND,
) -> tuple[Mapping[str, str] | None, list[Finding]]:
    """Open the camera, read what it says about itself, close it.

    Parameters
    ----------
    settings
        Which camera, and how a session will set it.
    demand
        What the plan needs.
    now
        The computer's clock, local time.
    programs
        Names of running programs (see :func:`workbench.doctor.processes.running`).
    worker
        Command of the camera's process.

    Returns
    -------
    tuple
        What the camera said, None where it can't be opened; and findings.
    """
    impatient = replace(
        settings,
        call_timeout_s=min(settings.call_timeout_s, _CALL_S),
        return_timeout_s=min(settings.return_timeout_s, _PATIENCE_S),
        power_cycle_timeout_s=min(settings.power_cycle_timeout_s, _PATIENCE_S),
    )
    try:
        camera = Gphoto2Camera(impatient, worker=worker)
        try:
            facts = camera.facts()
        finally:
            camera.close()
    except RigError as error:
        held = isinstance(error, DeviceBusyError)
        return None, [CAMERA.failure("connection", error), _programs(programs, held=held)]
    return facts, [*facts_findings(facts, settings, demand, now=now), _programs(programs, held=False)]


def _programs(programs: Sequence[str], *, held: bool) -> Finding:
    """Programs that hold the camera, or may."""
    mounts, others = desktop_mounts(programs), camera_programs(programs)
    if held and (mounts or others):
        mend = "run `gio mount -s gphoto2`" if mounts else f"close {others[0]}"
        return CAMERA.error("other programs", f"{', '.join([*mounts, *others])} runs, and may hold the camera", mend)
    if others:
        return CAMERA.warning("other programs", f"{', '.join(others)} runs, and may grab the camera", "close it")
    if mounts:
        return CAMERA.note(
            "other programs",
            f"{mounts[0]} runs: the desktop may grab the camera when it is plugged in again",
            "then run `gio mount -s gphoto2`; `systemctl --user mask gvfs-gphoto2-volume-monitor` ends it for good",
        )
    return CAMERA.ok("other programs", "none that is known to grab cameras")
