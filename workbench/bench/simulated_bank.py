"""The bank of an accuracy run: a whole calibration of the simulated rig, kept for the next run."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import calibration
from calibration.bank import Bank
from calibration.raw import develop
from rigs.simulated.world import SimulatedRigSettings
from workbench import calibrate
from workbench.banks import open_bank
from workbench.config import RigConfig
from workbench.devices import open_rig, simulated_world
from workbench.errors import InputError
from workbench.files import sha256_file, sha256_json
from workbench.planning import make_plan
from workbench.progress import Observer
from workbench.project import Project, create_project
from workbench.session import SessionRunner, create_session


def default_work() -> Path:
    """The user's cache directory for benchmarks."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "depth-workbench" / "bench"


def rig_settings(config: RigConfig) -> SimulatedRigSettings:
    """Truth of the simulated rig that a configuration describes.

    Raises
    ------
    InputError
        Its camera is a real one.
    """
    if config.camera.kind != "simulated":
        raise InputError("bench accuracy: the project's camera is a real one; give --raws DIR, or leave out --bank")
    return simulated_world(config).settings


def simulated_bank(work: Path, *, seed: int, step_mm: float, observer: Observer) -> tuple[Bank, RigConfig]:
    """Calibrate the simulated rig as an operator would, or open the bank that an earlier run made so.

    Plan, session, metering, RAW files and bank are those of ``workbench calibrate``. The frames are thrown away, the
    project with its bank and report stays in ``work``, under a name that follows from the settings and from the code
    that makes banks.

    Parameters
    ----------
    work
        Directory for such projects.
    seed
        Of the simulated rig.
    step_mm
        Between the bank's planes.
    observer
        Progress.
    """
    code = [sha256_file(path) for path in sorted(Path(calibration.__path__[0]).glob("*.py"))]
    code.append(sha256_file(Path(calibrate.__file__)))
    root = work / f"bank-{sha256_json([seed, step_mm, code])[:12]}"
    project = Project(root) if (root / "rig.yaml").exists() else create_project(root, preset="small", seed=seed)
    config = project.config()
    if not (project.banks / "registry.jsonl").exists():
        with project.lock_rig():
            _calibrate(project, config, step_mm, observer)
    return open_bank(project, "active")[0], config


def _calibrate(project: Project, config: RigConfig, step_mm: float, observer: Observer) -> None:
    shutil.rmtree(project.sessions, ignore_errors=True)  # of a run that was interrupted
    directory = project.sessions / project.new_session_id()
    plan = make_plan(config, step_mm=step_mm)
    create_session(directory, plan)

    def check(path: Path) -> None:
        develop(path, recipe=config.camera.recipe)

    with open_rig(config, tell=lambda _: None) as rig:
        state = SessionRunner(directory, plan, rig, observer=observer, check=check).run()
    calibrate.calibrate_session(project, directory, plan, state, config)
    shutil.rmtree(project.sessions)
