"""All checks in turn; whatever one of them meets, the others are still made, and everything is closed again."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack

from rigs.protocols import Pattern
from rigs.serial_link import discover_ports
from workbench.config import RigConfig
from workbench.devices import Tell
from workbench.doctor.camera import camera_findings, cameras_in_sight
from workbench.doctor.camera_facts import Demand
from workbench.doctor.findings import Checkup, Finding, PluggedIn, in_order
from workbench.doctor.host import computer_findings, newest_file_s, versions
from workbench.doctor.panel import panel_findings
from workbench.doctor.processes import running
from workbench.doctor.project import PROJECT, plan_finding, project_findings
from workbench.doctor.stage import stage_findings
from workbench.errors import InputError
from workbench.planning import METER_SHOTS_PER_DEPTH, cost, make_plan
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
    demand, pattern = Demand(1, 0.0, config.camera.iso), Pattern("dot")
    try:
        plan = make_plan(config)
    except InputError as error:
        found.append(PROJECT.error("plan", str(error), "correct the section calibration in rig.yaml"))
    else:
        estimate = cost(plan, config)
        found.append(plan_finding(plan, estimate))
        depths_mm, pattern = plan.depths_mm, plan.widest.pattern()
        frames = estimate.shots + math.ceil(METER_SHOTS_PER_DEPTH * len(depths_mm))
        demand = Demand(frames, estimate.bytes, plan.iso)
    in_project, bank = project_findings(project, config)
    found += in_project
    installed, programs = versions(), running()
    found += computer_findings(
        project.root,
        demand.bytes,
        installed=installed,
        now_s=time.time(),
        newest_file_s=newest_file_s(project.root),
    )
    step(1)
    in_sight, cameras = cameras_in_sight(needed=config.camera.kind != "simulated")
    found += in_sight
    browsers: tuple[str, ...] = ()
    with ExitStack() as held:
        try:
            held.enter_context(project.lock_rig())
        except InputError:
            seen = "in use by another workbench process: its devices were not opened"
            found.append(PROJECT.error("rig", seen, "wait for it, or end it"))
        except OSError as error:  # a directory that can't be written to: said by the check of the disk
            found.append(PROJECT.warning("rig", f"can't be locked ({error.strerror})", "see computer: disk"))
        else:
            found += camera_findings(config.camera, demand, cameras, programs=programs, bank=bank)
            step(2)
            found += stage_findings(config, depths_mm, programs=programs, operator_present=operator_present)
            step(3)
            on_panel, browsers = panel_findings(config.panel, pattern, wait_s=panel_wait_s, tell=tell)
            found += on_panel
    devices = {"camera": config.camera.kind, "stage": config.stage.kind, "panel": config.panel.kind}
    ports = tuple(map(str, discover_ports()))
    return Checkup(devices, in_order(found), PluggedIn(cameras, ports, browsers), installed)
