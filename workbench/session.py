"""The only code that moves hardware: runs a plan through the journal, and resumes it.

::

    empty --started--> running --shot recorded--> running --all shots--> finished
                          |  ^
       Ctrl-C / error     v  | resume (verified shots are skipped)
                   interrupted / failed

At each depth: move and confirm, meter (once per depth, unless the journal has it), then every shot: pattern painted
and acknowledged, exposure, pattern still shown, frame checked, record appended. A shot counts when its record is on
disk. Whatever ends a session early, the stage is stopped first.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import Any

from calibration.image import LinearImage
from rigs.errors import CaptureError, NotAcknowledgedError, RigError
from rigs.protocols import CaptureResult, Exposure
from rigs.rig import Rig
from workbench.device_news import DeviceNews
from workbench.errors import InputError
from workbench.files import made_directory, sha256_file, write_json
from workbench.journal import Journal, SessionState, verified_shots
from workbench.metering import meter
from workbench.plan import PatternSpec, Plan, Shot
from workbench.progress import Observer, Step
from workbench.units import cm, exposure_text

TRIES_PER_SHOT = 3
"""A frame that doesn't arrive or a pattern that isn't acknowledged is tried again so often, each try journaled."""


FrameCheck = Callable[[Path], LinearImage]
"""Develops a frame just arrived as superpixels; raises if it can't be a good RAW file."""


def create_session(directory: Path, plan: Plan) -> None:
    """Write the plan of a new session; the journal starts when it runs."""
    with made_directory(directory / "frames"):
        write_json(directory / "plan.json", plan.model_dump(mode="json"))


def load_plan(directory: Path) -> Plan:
    """Read the plan of a session.

    Raises
    ------
    InputError
        The session isn't there or its plan is damaged.
    """
    path = directory / "plan.json"
    try:
        return Plan.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{directory}: no such session (no plan.json); `ls {directory.parent}` shows them") from None
    except ValueError:
        raise InputError(f"{path}: damaged plan; start a new session with `workbench calibrate`") from None


_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, `kill`, and a terminal that is closed: the carriage has to stop for each."""


class StopRequest:
    """Ctrl-C that can't get lost: one that a library swallows in a callback still counts at the next shot.

    What else asks a program to end (SIGTERM, SIGHUP) counts as Ctrl-C, too: the stage has to stop first.
    """

    def __init__(self) -> None:
        self._asked = False

    @contextmanager
    def heard(self) -> Iterator[None]:
        """Listen to Ctrl-C and its like; does nothing outside the main thread, which alone may."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def ask(_signal: int, _frame: FrameType | None) -> None:
            self._asked = True
            raise KeyboardInterrupt

        heard = [kind for kind in _ENDING if kind is signal.SIGINT or signal.getsignal(kind) is not signal.SIG_IGN]
        before = {kind: signal.signal(kind, ask) for kind in heard}  # what nohup ignores stays ignored
        try:
            yield
            self.check()
        finally:
            for kind, handler in before.items():
                signal.signal(kind, handler)

    def withdraw(self) -> None:
        """It was heard, and what it should end has ended."""
        self._asked = False

    def check(self) -> None:
        """Raise KeyboardInterrupt if one was asked for."""
        if self._asked:
            raise KeyboardInterrupt


class SessionRunner:
    """Runs one plan on one rig, from wherever the journal stands."""

    def __init__(
        self,
        directory: Path,
        plan: Plan,
        rig: Rig,
        *,
        observer: Observer,
        check: FrameCheck,
        news: DeviceNews | None = None,
    ) -> None:
        self._directory, self._plan, self._rig = directory, plan, rig
        self._observer, self._check, self._news = observer, check, news
        self._shots = list(plan.shots())
        self._done: dict[str, dict[str, Any]] = {}
        self._stop = StopRequest()
        self._started = time.monotonic()
        self._done_at_start = 0

    def run(self) -> SessionState:
        """Take every shot that isn't recorded and verified yet.

        Raises
        ------
        RigError
            A device is in trouble; the session can be resumed.
        InputError
            The journal belongs to another plan or is damaged.
        KeyboardInterrupt
            Interrupted; journaled, resumable.
        """
        journal = Journal(self._directory / "journal.jsonl")
        try:
            self._open(journal)
            try:
                with self._stop.heard(), self._news.journaled(journal) if self._news else nullcontext():
                    self._take_all(journal)
            except BaseException as error:
                with suppress(RigError):
                    self._rig.stage.stop()
                interrupted = isinstance(error, KeyboardInterrupt)
                with suppress(OSError):
                    journal.append("interrupted" if interrupted else "failed", message=str(error) or repr(error))
                raise
            journal.append("finished", shots=len(self._shots))
            return journal.state()
        finally:
            journal.close()

    def _open(self, journal: Journal) -> None:
        state = journal.state()
        devices = {
            name: asdict(device.identify())
            for name, device in (("camera", self._rig.camera), ("stage", self._rig.stage), ("panel", self._rig.panel))
        }
        if state.records == 0:
            journal.append("started", plan_hash=self._plan.hash, devices=devices)
            return
        if state.plan_hash != self._plan.hash:
            raise InputError(f"{self._directory}: plan.json was changed since the session started; start a new one")
        if devices["camera"] != state.identities["camera"]:
            before, now = (f"{d['model']} {d['serial']}" for d in (state.identities["camera"], devices["camera"]))
            raise InputError(f"{self._directory}: taken with camera {before}, not {now}; connect the first one")
        self._done, bad = verified_shots(state, self._directory)
        self._done_at_start = len(self._done)
        journal.append("resumed", devices=devices, verified=len(self._done), retake=bad)
        for shot_id in bad:
            self._tell(f"{shot_id}: frame on disk is missing or differs from its record; it is taken again")

    def _take_all(self, journal: Journal) -> None:
        self._rig.check_reach(self._plan.depths_mm)
        for depth_mm, group in groupby(self._shots, key=lambda shot: shot.depth_mm):
            shots = [shot for shot in group if shot.id not in self._done]
            if not shots:
                continue
            if not self._rig.stage.homed():
                self._tell("stage: finding its reference")
                self._rig.stage.home()
                journal.append("homed", position_mm=self._rig.stage.position_mm())
            position = self._rig.stage.move_to_mm(self._rig.axis.position_mm(depth_mm))
            journal.append("moved", depth_mm=depth_mm, position_mm=round(position, 4))
            for shot in shots:
                self._stop.check()
                exposure = self._exposure(journal, shot)
                self._take(journal, shot, exposure, position)

    def _exposure(self, journal: Journal, shot: Shot) -> Exposure:
        known = journal.state().exposures
        if shot.exposure_of not in known:
            dot = next(s.pattern for s in self._shots if s.exposure_of == shot.exposure_of and s.kind == "point")
            last = list(known.values())[-1] if known else None
            start = Exposure(last["time_s"], int(last["iso"])) if last else None

            def expose(exposure: Exposure, path: Path) -> LinearImage:
                return self._capture(journal, dot, exposure, path)[1]

            stem = self._directory / "frames" / f"meter-{shot.exposure_of}"
            chosen = meter(
                expose,
                self._rig.camera,
                stem,
                start=start,
                base_iso=self._plan.iso,
                max_shots=self._plan.max_meter_shots,
            )
            journal.append(
                "metered",
                key=shot.exposure_of,
                time_s=chosen.exposure.time_s,
                iso=chosen.exposure.iso,
                peak=round(chosen.peak, 5),
                frames=chosen.frames,
            )
            self._tell(
                f"{cm(shot.depth_mm, 0)}: exposure {exposure_text(chosen.exposure.time_s)}, "
                f"brightest pixel at {chosen.peak:.0%} of white"
            )
        record = journal.state().exposures[shot.exposure_of]
        return Exposure(time_s=record["time_s"], iso=int(record["iso"]))

    def _take(self, journal: Journal, shot: Shot, exposure: Exposure, position_mm: float) -> None:
        result, _ = self._capture(journal, shot.pattern, exposure, self._directory / "frames" / f"{shot.id}.dng")
        record = {
            "shot": shot.id, "kind": shot.kind, "depth_mm": shot.depth_mm, "position_mm": round(position_mm, 4),
            "file": str(result.path.relative_to(self._directory)), "sha256": result.sha256, "bytes": result.bytes,
            "time_s": result.exposure.time_s, "iso": result.exposure.iso, "settings": dict(result.settings),
        }  # fmt: skip
        journal.append("shot", **record)
        self._done[shot.id] = record
        self._tell(f"{shot.id} ({cm(shot.depth_mm, 0)})")

    def _capture(
        self, journal: Journal, pattern: PatternSpec, exposure: Exposure, path: Path
    ) -> tuple[CaptureResult, LinearImage]:
        for attempt in range(1, TRIES_PER_SHOT + 1):
            try:
                self._rig.panel.show(pattern.pattern())
                result = self._rig.camera.capture(exposure, path)
                path = result.path
                self._rig.panel.check_shown()
                if sha256_file(result.path) != result.sha256:
                    raise CaptureError(f"{result.path}: differs from what the camera delivered; check the disk")
                return result, self._check(result.path)
            except (CaptureError, NotAcknowledgedError) as error:
                path.unlink(missing_ok=True)
                journal.append("event", message=str(error), attempt=attempt)
                if attempt == TRIES_PER_SHOT:
                    raise
                self._tell(f"{error}; trying again ({attempt} of {TRIES_PER_SHOT - 1})")
        raise AssertionError

    def _tell(self, message: str) -> None:
        done, total = len(self._done), len(self._shots)
        new = done - self._done_at_start
        left = (time.monotonic() - self._started) / new * (total - done) if new > 0 else None
        self._observer(Step(message, done, total, left))
