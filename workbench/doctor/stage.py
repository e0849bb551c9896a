"""The stage: reachable, in a state to be homed, protected, and long enough for the plan. Nothing moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rigs.errors import RigError
from rigs.grbl_inspect import inspect_grbl
from rigs.rig import DepthAxis
from rigs.simulated.devices import SimulatedStage
from rigs.stage_facts import StageFacts
from rigs.zaber_stage import ZaberStage
from workbench.config import RigConfig, StageConfig
from workbench.devices import MANUAL_LIMITS_MM, grbl_settings, simulated_world, zaber_settings
from workbench.doctor.findings import Finding, Subject
from workbench.doctor.processes import serial_programs

STAGE = Subject("stage")
_SAME_MM = 0.02
"""Limits of rig.yaml that differ by less from the controller's mean the same: one step, or a data sheet's rounding."""


def stage_findings(
    config: RigConfig, depths_mm: tuple[float, ...], *, programs: Sequence[str], operator_present: bool
) -> list[Finding]:
    """Check the stage that rig.yaml names.

    Parameters
    ----------
    config
        The rig.
    depths_mm
        Depths of the plan, ascending; empty where there is no plan.
    programs
        Names of running programs (see :func:`workbench.doctor.processes.running`).
    operator_present
        Whether somebody at a terminal can be asked to move a manual stage.
    """
    stage = config.stage
    match stage.kind:
        case "simulated":
            found = [STAGE.ok("connection", "simulated rail")]
            return found + _travel(stage, SimulatedStage(simulated_world(config)).limits_mm(), depths_mm)
        case "manual":
            return _manual(stage, depths_mm, operator_present=operator_present)
        case "grbl" | "zaber":
            try:
                facts = _facts(stage)
            except RigError as error:
                return [STAGE.failure("connection", error), *_programs(stage, programs)]
            return [*controller_findings(stage, facts, depths_mm), *_programs(stage, programs)]


def _facts(config: StageConfig) -> StageFacts:
    if config.kind == "grbl":
        return inspect_grbl(grbl_settings(config))
    device = ZaberStage(replace(zaber_settings(config), limits_mm=None))  # what it has, whatever rig.yaml wants
    try:
        return device.facts()
    finally:
        device.close()


def _programs(config: StageConfig, programs: Sequence[str]) -> list[Finding]:
    """Programs that are known to take serial ports away."""
    taking = [] if "://" in config.port else serial_programs(programs)
    return [STAGE.warning("other programs", f"{name} runs: {what}", mend) for name, what, mend in taking]


def _manual(config: StageConfig, depths_mm: tuple[float, ...], *, operator_present: bool) -> list[Finding]:
    found = [STAGE.ok("connection", f"moved by hand, {len(depths_mm)} times")]
    if not operator_present:
        found.append(
            STAGE.note("operator", "no terminal to ask at", "run the calibration from a terminal, not from a script")
        )
    return found + _travel(config, config.limits_mm or MANUAL_LIMITS_MM, depths_mm)


def controller_findings(config: StageConfig, facts: StageFacts, depths_mm: tuple[float, ...]) -> list[Finding]:
    """Judge what a controller said about itself."""
    who = facts.identity
    name = " ".join(filter(None, [who.make, who.model])) or who.kind
    firmware = f", firmware {who.firmware}" if who.firmware else ""
    serial = f", serial {who.serial}" if who.serial else ""
    found = [STAGE.ok("connection", f"{name}{firmware}{serial} at {config.port}"), _state(facts)]
    found += [STAGE.note(check, seen, mend) for check, seen, mend in facts.remarks]
    if facts.homing is not None:
        found.append(_homing(config, homing=facts.homing))
    if facts.soft_limits is not None:
        found.append(_soft_limits(config, soft_limits=facts.soft_limits))
    if facts.hard_limits is False:
        found.append(
            STAGE.note(
                "hard limits",
                "off: a carriage that lost steps runs into its end",
                "$21=1 stops it at the switch, where the wiring is free of noise",
            )
        )
    if facts.max_speed_mm_s is not None and (config.speed_mm_s or 0.0) > facts.max_speed_mm_s:
        found.append(
            STAGE.note(
                "speed",
                f"stage.speed is {config.speed_mm_s:g} mm/s, the controller allows {facts.max_speed_mm_s:g} mm/s",
                "moves take the slower one",
            )
        )
    limits = config.limits_mm if facts.homing is False else facts.travel_mm
    if limits is not None:
        found += _travel(config, limits, depths_mm)
    elif facts.homing is False:
        found.append(
            STAGE.error(
                "travel",
                "unknown: without homing the controller's travel says nothing",
                "write stage.limits: the positions that the carriage may take",
            )
        )
    return found


def _state(facts: StageFacts) -> Finding:
    if facts.problem is not None:
        return STAGE.error("state", *facts.problem)
    if facts.disturbance is not None:
        return STAGE.warning("state", *facts.disturbance)
    if facts.state == "Alarm":
        return STAGE.note(
            "state", "alarm: locked until it is homed, as after power-up", "calibrate homes it; keep its way free"
        )
    if not facts.referenced:
        return STAGE.ok("state", f"{facts.state}; position unknown until it is homed, as calibrate does")
    return STAGE.ok("state", f"{facts.state}; position known")


def _homing(config: StageConfig, *, homing: bool) -> Finding:
    if homing:
        return STAGE.ok("homing", "on")
    if config.allow_without_homing:
        return STAGE.warning(
            "homing",
            "off, and allowed by stage.allow_without_homing",
            "switch the controller on with the carriage at its zero; better: fit a switch and set $22=1",
        )
    return STAGE.error(
        "homing",
        "off in the controller: nobody knows where the carriage is",
        "fit a switch and set $22=1, or write stage.allow_without_homing: true",
    )


def _soft_limits(config: StageConfig, *, soft_limits: bool) -> Finding:
    if soft_limits:
        return STAGE.ok("soft limits", "on")
    if config.allow_without_soft_limits:
        return STAGE.warning(
            "soft limits",
            "off, and allowed by stage.allow_without_soft_limits",
            "set $130 to the travel and $20=1: the controller then refuses what lies outside",
        )
    return STAGE.error(
        "soft limits",
        "off in the controller: nothing keeps the carriage from its ends",
        "set $130 to the travel and $20=1, or write stage.allow_without_soft_limits: true",
    )


def _travel(config: StageConfig, own_mm: tuple[float, float], depths_mm: tuple[float, ...]) -> list[Finding]:
    """Whether every planned depth lies within both the controller's travel and stage.limits."""
    low, high = config.limits_mm or own_mm
    usable = max(low, own_mm[0]), min(high, own_mm[1])
    beyond = low < own_mm[0] - _SAME_MM or high > own_mm[1] + _SAME_MM
    if not usable[0] < usable[1]:
        return [
            STAGE.error(
                "travel",
                f"stage.limits, {low:g} to {high:g} mm, lie outside the travel of {own_mm[0]:g} to {own_mm[1]:g} mm",
                "correct stage.limits in rig.yaml (machine positions; GRBL counts below zero)",
            )
        ]
    found = []
    if beyond:
        found.append(
            STAGE.error(
                "limits",
                f"stage.limits, {low:g} to {high:g} mm, reach beyond the travel of {own_mm[0]:g} to {own_mm[1]:g} mm",
                "correct stage.limits in rig.yaml, or the controller's travel ($130; Zaber: limit.min, limit.max)",
            )
        )
    axis = DepthAxis(config.depth.offset_mm, config.depth.sign, config.depth.scale)
    nearest, farthest = axis.depth_limits_mm(usable)
    reach = _range(nearest, farthest)
    if not depths_mm:
        return [*found, STAGE.ok("travel", f"reaches {reach}")]
    plan = _range(depths_mm[0], depths_mm[-1])
    if all(nearest - 1e-6 <= depth <= farthest + 1e-6 for depth in depths_mm):
        return [*found, STAGE.ok("travel", f"reaches {reach}; the plan needs {plan}")]
    return [
        *found,
        STAGE.error(
            "travel",
            f"reaches {reach}; the plan needs {plan}",
            "change calibration.from and calibration.to, or correct stage.depth (offset, sign) in rig.yaml",
        ),
    ]


def _range(nearest_mm: float, farthest_mm: float) -> str:
    """Depths with all their digits: where a millimetre is missing, it has to be seen."""
    return f"{nearest_mm / 10:g} to {farthest_mm / 10:g} cm"
