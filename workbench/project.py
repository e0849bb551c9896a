"""A project directory: where rig.yaml, sessions, banks and measurements live."""

from __future__ import annotations

import fcntl
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files as package_files
from pathlib import Path

from workbench.config import RigConfig, load_rig_config
from workbench.errors import InputError
from workbench.files import write_text


@dataclass(frozen=True, slots=True)
class Project:
    """Paths of one project."""

    root: Path

    @property
    def rig_file(self) -> Path:
        """The rig's description."""
        return self.root / "rig.yaml"

    @property
    def sessions(self) -> Path:
        """One directory per capture session."""
        return self.root / "sessions"

    @property
    def banks(self) -> Path:
        """One directory per bank, and the registry beside them."""
        return self.root / "banks"

    @property
    def measurements(self) -> Path:
        """One directory per measured photograph."""
        return self.root / "measurements"

    @property
    def photographs(self) -> Path:
        """RAW files of scenes that the rig's camera took."""
        return self.root / "photographs"

    def config(self) -> RigConfig:
        """Validated rig.yaml."""
        return load_rig_config(self.rig_file)

    def relative(self, path: Path) -> str:
        """``path`` relative to the project where it lies inside, absolute elsewhere."""
        resolved, root = path.resolve(), self.root.resolve()
        return str(resolved.relative_to(root)) if resolved.is_relative_to(root) else str(resolved)

    def new_session_id(self) -> str:
        """Next free session number, as ``s0001``."""
        taken = [
            int(m.group(1)) for p in (self.sessions.iterdir() if self.sessions.exists() else ())
            if (m := re.fullmatch(r"s(\d+)", p.name))
        ]  # fmt: skip
        return f"s{max(taken, default=0) + 1:04d}"

    def latest_session(self) -> str:
        """Newest session's id.

        Raises
        ------
        InputError
            There is none.
        """
        ids = sorted(p.name for p in self.sessions.iterdir() if p.is_dir()) if self.sessions.exists() else []
        ids = [name for name in ids if re.fullmatch(r"s\d+", name)]
        if not ids:
            raise InputError(f"{self.root}: no session to resume; start one with `workbench calibrate`")
        return ids[-1]

    @contextmanager
    def lock_rig(self) -> Iterator[None]:
        """Hold the rig for this process: two sessions must not move one stage.

        Raises
        ------
        InputError
            Another process holds it.
        """
        with (self.root / ".rig.lock").open("w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise InputError(f"{self.root}: another workbench process is using this rig; wait for it") from None
            yield


def open_project(root: Path) -> Project:
    """Open a project directory.

    Raises
    ------
    InputError
        It is none.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such directory; make a project there with `workbench init {root}`")
    if not (root / "rig.yaml").is_file():
        raise InputError(f"{root}: not a project (no rig.yaml); make one with `workbench init {root}`")
    return Project(root)


def create_project(root: Path, *, preset: str = "small", seed: int = 1) -> Project:
    """Make a project with a commented rig.yaml for the simulated rig.

    Raises
    ------
    InputError
        There is one already, or ``root`` is a file.
    """
    if root.exists() and not root.is_dir():
        raise InputError(f"{root}: is a file; name a directory")
    if (root / "rig.yaml").exists():
        raise InputError(f"{root}: is a project already (rig.yaml exists); edit it, or name another directory")
    template = (package_files("workbench") / "templates" / "rig.yaml").read_text(encoding="utf-8")
    write_text(root / "rig.yaml", template.replace("@PRESET@", preset).replace("@SEED@", str(seed)))
    return Project(root)
