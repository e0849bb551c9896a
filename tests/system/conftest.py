from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import FEW, PLAN, SENSOR, done

from rigs.simulated import world
from workbench.figures import style


@pytest.fixture(scope="session", autouse=True)
def small_sensor() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(world.PRESET_SHAPES, "small", SENSOR)
        yield


@pytest.fixture(autouse=True)
def undrawn_figures(small_sensor: None, lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lab's reports have their figures; drawing those of every test's reports again would take minutes."""
    monkeypatch.setattr(style, "to_bytes", lambda figure, *_, **__: b"")


@pytest.fixture(scope="session")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with one calibrated bank and one photograph; not to be changed."""
    root = tmp_path_factory.mktemp("lab") / "project"
    done("init", root)
    done("-C", root, "calibrate", *PLAN)
    done("-C", root, "capture", "--roi", "20,20,96,96", "--method", "sharpness")
    return root


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with a session that nothing disturbed."""
    root = tmp_path_factory.mktemp("finished")
    done("init", root)
    done("-C", root, "calibrate", *FEW)
    return root


@pytest.fixture(scope="session")
def wanted(finished: Path) -> str:
    """Its bank's id."""
    return str(done("-C", finished, "bank", "show", "--json").only["id"])


@pytest.fixture(scope="session")
def photograph(lab: Path) -> Path:
    return lab / "photographs" / "photograph-0001.dng"


@pytest.fixture
def project(lab: Path, tmp_path: Path) -> Path:
    """A copy of the lab's bank, without its frames, that a test may change."""
    root = tmp_path / "project"
    root.mkdir()
    shutil.copy(lab / "rig.yaml", root)
    shutil.copytree(lab / "banks", root / "banks")
    return root


@pytest.fixture(scope="session")
def some_frames(lab: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session's frames as files taken elsewhere: five depths and a dark frame."""
    directory = tmp_path_factory.mktemp("elsewhere") / "psf"
    directory.mkdir()
    taken = lab / "sessions" / "s0001" / "frames"
    for depth_cm in (80, 105, 130, 205, 255):
        shutil.copy(taken / f"point-{depth_cm * 100:05d}-1.dng", directory / f"psf_{depth_cm:03d}cm.dng")
    shutil.copy(taken / "off-08000-1.dng", directory / "dark.dng")
    return directory


@pytest.fixture
def frames(some_frames: Path, tmp_path: Path) -> Path:
    """A copy of these files that a test may spoil."""
    return Path(shutil.copytree(some_frames, tmp_path / "frames"))


@pytest.fixture
def shared() -> Path:
    path = Path(__file__).parents[3] / "shared" / "pathtraced"
    if not path.is_dir():
        pytest.skip(f"{path} is not here")
    return path
