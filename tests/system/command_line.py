"""The command line as tests use it: in this process for speed, or as a process of its own."""

from __future__ import annotations

import contextlib
import io
import json
import os
import struct
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigs.simulated.dng import FrameTags, encode_dng
from workbench.cli import workbench
from workbench.cli.common import run

SENSOR = (416, 624)
"""Photosites (height, width) of the simulated camera in these tests: a small part of the small preset's."""
PLAN = ("--from", "80cm", "--to", "280cm", "--step", "25cm", "--repeats", "1")
FEW = ("--from", "80cm", "--to", "230cm", "--step", "50cm", "--repeats", "1")
ENTRY = f"""
import sys
from rigs.simulated import world
world.PRESET_SHAPES["small"] = {SENSOR}
from workbench.cli import main
main()
"""


@dataclass(frozen=True)
class Outcome:
    """What a command did."""

    code: int
    out: str
    err: str

    @property
    def objects(self) -> list[dict[str, Any]]:
        """Machine output: every line of stdout is one JSON object."""
        return [json.loads(line) for line in self.out.splitlines()]

    @property
    def only(self) -> dict[str, Any]:
        """The one object on stdout."""
        (value,) = self.objects
        return value


def call(*argv: object, cwd: Path | None = None) -> Outcome:
    """Run a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.chdir(cwd or Path.cwd()):
        code = run(workbench, [str(part) for part in argv])
    return Outcome(code, out.getvalue(), err.getvalue())


def done(*argv: object, cwd: Path | None = None) -> Outcome:
    """Run a command that must succeed."""
    outcome = call(*argv, cwd=cwd)
    assert outcome.code == 0, f"{argv}: exit code {outcome.code}\n{outcome.err[-2000:]}"
    return outcome


def arguments(*argv: object) -> list[str]:
    """Command line of a process that is the console script, but for its smaller sensor."""
    return [sys.executable, "-c", ENTRY, *(str(part) for part in argv)]


def spawn(*argv: object, cwd: Path | None = None, env: dict[str, str] | None = None, input_text: str = "") -> Outcome:
    """Run a command as a process of its own."""
    finished = subprocess.run(
        arguments(*argv), cwd=cwd, env=os.environ | (env or {}), capture_output=True, text=True, timeout=200,
        check=False, input=input_text,
    )  # fmt: skip
    return Outcome(finished.returncode, finished.stdout, finished.stderr)


def refused(outcome: Outcome, *words: str) -> str:
    """Check that a command refused bad input as promised; the line it said."""
    lines = outcome.err.splitlines()
    assert outcome.code == 2, f"exit code {outcome.code}: {outcome.err[-2000:]}"
    assert len(lines) == 1, outcome.err[-2000:]
    assert lines[0].startswith("workbench: ")
    assert outcome.out == ""
    for word in words:
        assert word.lower() in lines[0].lower(), f"{word!r} is not in {lines[0]!r}"
    return lines[0]


def listing(*roots: Path) -> dict[str, bytes | None]:
    """Every file with its bytes and every directory: what a refused command must leave as it was."""
    found: dict[str, bytes | None] = {}
    for root in roots:
        found |= {str(p): p.read_bytes() if p.is_file() else None for p in sorted(root.rglob("*"))}
    return {name: content for name, content in found.items() if not name.endswith(".rig.lock")}


TAGS = FrameTags(
    exposure_s=0.01, iso=100, focal_length_mm=50.0, f_number=3.6, pitch_mm=0.0043, make="Depth Workbench",
    model="Simulated small", serial="SIM000001", black=2048, white=15000,
)  # fmt: skip


def dng(path: Path, mosaic: NDArray[Any], *, tags: FrameTags = TAGS, cfa: bytes = bytes([0, 1, 1, 2])) -> Path:
    """Write raw values (14 bits) as a DNG file, with another colour filter pattern if wanted."""
    data = bytearray(encode_dng(mosaic.astype(np.uint16), tags))
    count = struct.unpack_from("<H", data, 8)[0]
    for entry in range(10, 10 + 12 * count, 12):
        if struct.unpack_from("<H", data, entry)[0] == 33422:
            data[entry + 8 : entry + 12] = cfa
    path.write_bytes(data)
    return path


def spots(centres: Sequence[tuple[float, float]], level: float = 0.6, radius: float = 12.0) -> NDArray[np.float64]:
    """Raw values of a dark frame with round spots at these places (row, column; fractions of the frame)."""
    height, width = SENSOR
    yy, xx = np.mgrid[:height, :width]
    rng = np.random.default_rng(0)
    signal = np.zeros(SENSOR)
    for row, column in centres:
        signal += level * (np.hypot(yy - row * height, xx - column * width) < radius)
    span = TAGS.white - TAGS.black
    return np.clip(np.rint(TAGS.black + signal * span + rng.normal(0, 6, SENSOR)), 0, TAGS.white)
