"""The project: its plan, its active bank, its sessions, and whether its devices belong together."""

from __future__ import annotations

from calibration.bank import Bank
from calibration.errors import BankError
from calibration.registry import read_registry
from workbench.banks import is_bad, open_bank, quality_reasons, quality_verdict
from workbench.config import RigConfig
from workbench.doctor.findings import Finding, Subject
from workbench.errors import InputError
from workbench.journal import fold, read_journal
from workbench.plan import Plan
from workbench.planning import PlanCost
from workbench.project import Project
from workbench.units import bytes_text, cm, seconds_text

PROJECT = Subject("project")


def project_findings(project: Project, config: RigConfig) -> tuple[list[Finding], Bank | None]:
    """Check what lies in the project directory; also the active bank, where there is a sound one."""
    on_bank, bank = _bank(project)
    return [*_devices(config), *_session(project), on_bank], bank


def plan_finding(plan: Plan, cost: PlanCost) -> Finding:
    """What calibrate would do."""
    first, last = cm(plan.depths_mm[0], 0), cm(plan.depths_mm[-1], 0)
    return PROJECT.ok(
        "plan",
        f"{len(plan.depths_mm)} depths, {first} to {last}, {cost.shots} shots and their metering: about "
        f"{seconds_text(cost.seconds)}, {bytes_text(cost.bytes)}",
    )


def _devices(config: RigConfig) -> list[Finding]:
    kinds = {"camera": config.camera.kind, "stage": config.stage.kind, "panel": config.panel.kind}
    simulated = [name for name, kind in kinds.items() if kind == "simulated"]
    named = ", ".join(f"{name} {kind}" for name, kind in kinds.items())
    if kinds["camera"] != "simulated" and simulated:
        return [
            PROJECT.warning(
                "devices",
                f"{named}: a real camera doesn't see what is simulated",
                f"name a real {' and '.join(simulated)} in rig.yaml (stage: manual needs no motor)",
            )
        ]
    return [PROJECT.ok("devices", named)]


def _session(project: Project) -> list[Finding]:
    try:
        newest = project.latest_session()
    except InputError:
        return []
    try:
        records, _ = read_journal(project.sessions / newest / "journal.jsonl")
    except (InputError, OSError) as error:
        return [PROJECT.warning("session", f"{newest}: {error}", "its frames can't be used; calibrate anew")]
    state = fold(records)
    if state.finished:
        return []
    return [
        PROJECT.note(
            "session",
            f"{newest} stopped after {len(state.shots)} shots",
            f"`workbench resume {newest}` goes on with it",
        )
    ]


def _bank(project: Project) -> tuple[Finding, Bank | None]:
    try:
        registry = read_registry(project.banks)
    except BankError as error:
        return PROJECT.failure("bank", error), None
    entry = registry.active
    if entry is None:
        mend = "`workbench calibrate` makes one"
        if registry.entries:
            mend = f"`workbench bank list`, then `workbench bank activate`, or {mend}"
        return PROJECT.note("bank", "none is active: nothing can be measured yet", mend), None
    name = f"v{entry.version} {entry.id}"
    try:
        bank, _ = open_bank(project, entry.id)
    except (BankError, OSError) as error:
        damaged = PROJECT.warning(
            "bank", f"{name}: {error}", "`workbench bank list`, then activate another, or calibrate anew"
        )
        return damaged, None
    reach = f"{len(bank.depths_mm)} depths, {cm(bank.depths_mm[0], 0)} to {cm(bank.depths_mm[-1], 0)}"
    if is_bad(bank):
        bad = PROJECT.warning("bank", f"{name}: its quality is bad: {quality_reasons(bank)}", "calibrate anew")
        return bad, bank
    said = f"{name}: every byte is as it was written; {reach}; quality {quality_verdict(bank)}"
    return PROJECT.ok("bank", said), bank
