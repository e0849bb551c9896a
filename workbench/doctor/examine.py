"""All checks in turn; whatever one of them meets, the others are still made, and everything is closed again."""

from __future__ import annotations

import time
from contextlib import ExitStack

from rigs.serial_link import discover_ports
from workbench.config import RigConfig
from workbench.devices import Tell
from workbench.doctor.camera import CAMERA, cameras_in_sight
from workbench.doctor.findings import Checkup, Finding, PluggedIn, in_order
from workbench.doctor.host import computer_findings, newest_file_s, versions
from workbench.doctor.panel import panel_findings
from workbench.doctor.project import PROJECT, plan_finding, project_findings
from workbench.doctor.stage import stage_findings
from workbench.errors import InputError
from workbench.planning import cost, dot_size_px, make_plan
from workbench.progress import Observer, Step
from workbench.project import Project

_STEPS = ("project and computer", "camera", "stage", "panel")


def examine(
    project: Project,
    config: RigConfig,
    *,
    panel_wait_s: float,
    operator_present: bool,
    tell: Tell,
    observer: Observer,
) -> Checkup:
    """Check a project and the rig that its rig.yaml names. Nothing moves, no frame is taken, nothing is left behind.

    Parameters
    ----------
    project, config
        The project and its rig.
    panel_wait_s
        How long the panel's page may take to connect and to be ready.
    operator_present
        Whether somebody at a terminal can answer.
    tell
        Shows the operator a line (the panel's address).
    observer
        Hears what is being checked.
    """

    def step(number: int) -> None:
        observer(Step(_STEPS[number], number, len(_STEPS)))

    step(0)
    found: list[Finding] = []
    depths_mm: tuple[float, ...] = ()
    need_bytes, dot_px = 0.0, 1.0
    try:
        plan = make_plan(config)
    except InputError as error:
        found.append(PROJECT.error("plan", str(error), "correct the section calibration in rig.yaml"))
    else:
        estimate = cost(plan, config)
        found.append(plan_finding(plan, estimate))
        depths_mm, need_bytes = plan.depths_mm, estimate.bytes
        dot_px = dot_size_px(config, depths_mm[0])
    found += project_findings(project, config)
    found += computer_findings(
        project.root,
        need_bytes,
        found_versions=versions(),
        now_s=time.time(),
        built_s=newest_file_s(project.root),
    )
    browsers: tuple[str, ...] = ()
    with ExitStack() as held:
        step(1)
        in_sight, cameras = cameras_in_sight({}, needed=config.camera.kind != "simulated")
        found += in_sight
        try:
            held.enter_context(project.lock_rig())
        except InputError:
            found.append(
                PROJECT.error(
                    "rig", "in use by another workbench process: its devices were not opened", "wait for it"
                )
            )
        else:
            found.append(CAMERA.ok("connection", "simulated camera"))
            step(2)
            found += stage_findings(config, depths_mm, operator_present=operator_present)
            step(3)
            on_panel, browsers = panel_findings(config.panel, dot_px, wait_s=panel_wait_s, tell=tell)
            found += on_panel
    devices = {"camera": config.camera.kind, "stage": config.stage.kind, "panel": config.panel.kind}
    ports = tuple(map(str, discover_ports()))
    return Checkup(devices, in_order(found), PluggedIn(cameras, ports, browsers))
