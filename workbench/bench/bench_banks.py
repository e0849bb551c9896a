"""Banks of accuracy runs: whole calibrations, of the simulated rig or from RAW files, kept for the next run."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import calibration
import rigs
import rigs.simulated
import workbench
from calibration.bank import Bank
from calibration.frames import find_frames
from calibration.raw import develop
from rigs.simulated.lens import SEVEN, PolygonPupil
from rigs.simulated.rig import make_rig
from rigs.simulated.world import SimulatedRigSettings
from workbench import calibrate
from workbench.banks import open_bank
from workbench.config import RigConfig
from workbench.devices import simulated_world
from workbench.errors import InputError
from workbench.files import sha256_file, sha256_json
from workbench.planning import make_plan
from workbench.progress import Observer
from workbench.project import Project, create_project
from workbench.session import SessionRunner, create_session

_PATIENCE_S = 300.0
_TEMPLATE = Path(workbench.__path__[0]) / "templates" / "rig.yaml"
SECOND_PUPILS = {
    "pair": PolygonPupil((((-5.0, 5.0), (-2.0, 5.0), (-2.0, -2.0), (5.0, -2.0), (5.0, -5.0), (-5.0, -5.0)),)),
    "pentland": PolygonPupil(tuple(tuple((0.6 * x, 0.6 * y) for x, y in loop) for loop in SEVEN.loops_mm)),
}
"""Second apertures of the methods that need one: a letter L, whose zeros differ from the seven's; the seven itself
stopped down to 60 %."""


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


def simulated_bank(
    work: Path, *, seed: int, step_mm: float, observer: Observer, pupil: PolygonPupil = SEVEN
) -> tuple[Bank, RigConfig]:
    """Calibrate the simulated rig as an operator would, or open the bank that an earlier run made so.

    Plan, session, metering, RAW files and bank are those of ``workbench calibrate``. The frames are thrown away, the
    project with its bank and report stays in ``work``, under a name that follows from the settings and from the code
    of rig, session and bank: where any of it has changed, the bank is made anew.

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
    pupil
        Aperture of the rig's lens.
    """
    made_by = [*_modules(calibration), *_modules(rigs), *_modules(rigs.simulated), *_modules(workbench), _TEMPLATE]
    project = _scratch(work / f"bank-{_key([seed, step_mm, pupil.loops_mm], made_by)}", seed)
    config = project.config()
    with _alone(project):
        if not _has_bank(project):
            _calibrate(project, config, step_mm, observer, pupil)
    return for_crops(open_bank(project, "active")[0]), config


def for_crops(bank: Bank) -> Bank:
    """The bank without its sensor's size: the cases' frames are parts of that sensor, and would be refused."""
    camera = {**bank.manifest["camera"], "sensor_size": None}
    return replace(bank, manifest={**bank.manifest, "camera": camera})


def raws_bank(work: Path, directory: Path) -> Bank:
    """Make a bank from RAW files of points as ``workbench calibrate --frames`` does, or open the one made before.

    Parameters
    ----------
    work
        Directory for projects with such banks.
    directory
        Holds the frames, see :func:`calibration.frames.find_frames`.

    Raises
    ------
    CalibrationError
        The files can't be used.
    """
    listed = find_frames(directory)
    paths = [*listed.darks, *(path for _, repeats in listed.points for path in repeats)]
    made_by = [*_modules(calibration), Path(calibrate.__file__)]
    project = _scratch(work / f"raws-{_key([sha256_file(path) for path in paths], made_by)}", 1)
    with _alone(project):
        if not _has_bank(project):
            calibrate.calibrate_frames(project, directory, project.config(), apply_zero=False)
    return open_bank(project, "active")[0]


def _key(settings: Sequence[object], code: Sequence[Path]) -> str:
    """Twelve digits for settings and the code that makes banks of them."""
    return sha256_json([list(settings), [sha256_file(path) for path in code]])[:12]


def _modules(package: ModuleType) -> list[Path]:
    """A package's modules, without those of packages in it."""
    return sorted(Path(package.__path__[0]).glob("*.py"))


def _scratch(root: Path, seed: int) -> Project:
    return Project(root) if (root / "rig.yaml").exists() else create_project(root, preset="small", seed=seed)


@contextmanager
def _alone(project: Project) -> Iterator[None]:
    """Hold a project; where another run is making its bank, wait for that one."""
    deadline = time.monotonic() + _PATIENCE_S
    with ExitStack() as held:
        while True:
            try:
                held.enter_context(project.lock_rig())
                break
            except InputError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(1.0)
        yield


def _has_bank(project: Project) -> bool:
    return (project.banks / "registry.jsonl").exists()


def _calibrate(project: Project, config: RigConfig, step_mm: float, observer: Observer, pupil: PolygonPupil) -> None:
    shutil.rmtree(project.sessions, ignore_errors=True)  # of a run that was interrupted
    directory = project.sessions / project.new_session_id()
    plan = make_plan(config, step_mm=step_mm)
    create_session(directory, plan)

    with make_rig(replace(rig_settings(config), pupil=pupil)).rig() as rig:
        state = SessionRunner(directory, plan, rig, observer=observer, check=develop).run()
    calibrate.calibrate_session(project, directory, plan, state, config)
    shutil.rmtree(project.sessions)
