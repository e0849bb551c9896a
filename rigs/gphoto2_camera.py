"""A tethered DSLR through libgphoto2, as a :class:`rigs.protocols.Camera`.

The library lives in a process of its own (:mod:`rigs.gphoto2_worker`), since its calls can block for minutes and
can't be interrupted. From here every call has a deadline; one that misses it is killed with its process, the camera
is opened again, and the frame is taken again. What goes wrong is met as :mod:`rigs.gphoto2_faults` says: a bounded
number of remedies, each reported, then one error that tells the operator what to do.
"""

from __future__ import annotations

import base64
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from rigs.errors import ConfigError, ConnectionLostError, RigError
from rigs.gphoto2_config import CameraEvent, Gphoto2Settings, OnEvent, Validate, accept_any, ignore_event
from rigs.gphoto2_faults import RESPONSES, Fault, FaultError, Remedy, failure
from rigs.gphoto2_inspect import facts_of, library_of
from rigs.gphoto2_link import CameraLink, FoundCamera
from rigs.gphoto2_process import WORKER_COMMAND
from rigs.gphoto2_setup import NAMES, CameraSetup
from rigs.gphoto2_shot import CameraFile, Download, Shooter
from rigs.protocols import CaptureResult, DeviceIdentity, Exposure

_MOST_REMEDIES = 6
"""In one operation, over all kinds of trouble."""
_CLOSE_WAITS_S = 1.0
_AS_OF_AUTOFOCUS = frozenset({Fault.NO_RELEASE, Fault.BUSY})
"""How a release fails whose autofocus finds nothing in the dark."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class _Frame:
    """A frame that was taken and isn't on disk yet."""

    file: CameraFile
    exposure: Exposure
    settings: Mapping[str, str]
    opens: int


class Gphoto2Camera:
    """A camera on USB (see :class:`rigs.protocols.Camera`). Opens at once; is set up before its first frame.

    Parameters
    ----------
    settings
        Which camera, and how it is set.
    validate
        Raises where a downloaded file is no good frame; called before the file gets its name.
    on_event
        Hears of every remedy and notice, for the journal.
    worker
        Command of the camera's process.

    Raises
    ------
    DeviceNotFoundError
        No camera, the wrong one, or several that fit.
    DeviceBusyError
        Another program holds it.
    RigError
        It can't be opened.
    """

    def __init__(
        self,
        settings: Gphoto2Settings,
        *,
        validate: Validate = accept_any,
        on_event: OnEvent = ignore_event,
        worker: Sequence[str] = WORKER_COMMAND,
    ) -> None:
        unknown = set(settings.may_be_absent) - set(NAMES)
        if unknown:
            raise ConfigError(f"camera.may_be_absent: no setting {min(unknown)!r}; known are {', '.join(NAMES)}")
        self._settings, self._validate, self._on_event = settings, validate, on_event
        self._told: set[str] = set()
        self._link = CameraLink(settings, worker)
        self._setup = CameraSetup(self._link, settings, self._tell)
        self._shooter = Shooter(self._link, self._setup, settings, self._tell)
        self._prepared_for = 0
        self._frames: Counter[int] = Counter()
        self._suspicious = False
        self._live_view = False
        self._closed = False
        self._lock = threading.RLock()
        try:
            self._attempt(lambda: None)
        except BaseException:
            self.close()
            raise

    @property
    def worker_pid(self) -> int | None:
        """Process id of the camera's process; None where none runs."""
        return self._link.process.pid

    def identify(self) -> DeviceIdentity:
        """Make, model, serial number; lens in ``extra['lens']`` where the camera knows it."""
        assert self._link.identity is not None  # known since __init__
        return self._link.identity

    def exposure_times_s(self) -> tuple[float, ...]:
        """Offered exposure times (s), ascending, without bulb."""
        return self._attempt(lambda: self._prepared().times_s())

    def isos(self) -> tuple[int, ...]:
        """Offered ISO values, ascending; empty where the camera doesn't let them be set."""
        return self._attempt(lambda: self._prepared().isos())

    def facts(self) -> dict[str, str]:
        """What a check of the rig wants to know, whatever the mode dial says (see :func:`facts_of`)."""
        return self._attempt(lambda: facts_of(self._link))

    def capture(self, exposure: Exposure, destination: Path) -> CaptureResult:
        """Expose once; the RAW file is at ``destination``, but with its own suffix, when this returns.

        Raises
        ------
        SettingError
            Exposure time or ISO isn't offered, or isn't what was set when read back.
        CaptureError
            No good frame arrived.
        RigError
            The camera is in trouble that remedies didn't end.
        """
        if not destination.parent.is_dir():
            raise ConfigError(f"{destination.parent}: no such directory for frames; create it")
        with self._lock:
            if 0 < self._settings.restart_every <= self._frames[self._link.process.starts]:
                self._link.restart()
            pending: list[_Frame] = []
            try:
                frame, download = self._attempt(lambda: self._take(exposure, destination, pending), pending)
            except RigError:
                self._suspicious = True
                raise
            self._frames[self._link.process.starts] += 1
        settings = {**frame.settings, "file": str(frame.file)}
        path = frame.file.at(destination)
        return CaptureResult(path, download.sha256, download.bytes, frame.exposure, settings)

    def _take(self, exposure: Exposure, destination: Path, pending: list[_Frame]) -> tuple[_Frame, Download]:
        if self._suspicious:  # a late file of a failed frame must not be taken for this one's
            self._suspicious = False
            self._link.connect()
        setup = self._prepared()
        if pending and pending[0].opens != self._link.opens and not pending[0].file.on_card:
            pending.clear()  # what lay in the camera's memory is gone
        if not pending:
            if self._live_view:
                setup.end_live_view()
                self._live_view = False
            read_back, texts = setup.set_exposure(exposure)
            file = self._shooter.expose(read_back.time_s)
            pending.append(_Frame(file, read_back, texts, self._link.opens))
        file = pending[0].file
        return pending[0], self._shooter.fetch(file, file.at(destination), self._validate)

    def preview(self) -> bytes:
        """One JPEG of the live view.

        Raises
        ------
        CameraError
            The camera has no live view.
        """
        text: str = self._attempt(lambda: self._link.call("preview"))
        self._live_view = True
        return base64.b64decode(text)

    def close(self) -> None:
        """Let go of the camera; a call that hangs in another thread is broken off. Safe to call twice."""
        self._closed = True
        if not self._lock.acquire(timeout=_CLOSE_WAITS_S):
            self._link.process.kill()
            return
        try:
            self._link.restart()
        finally:
            self._lock.release()

    def _prepared(self) -> CameraSetup:
        if self._prepared_for != self._link.opens:
            self._setup.prepare()
            self._prepared_for = self._link.opens
        return self._setup

    def _attempt(self, action: Callable[[], T], pending: list[_Frame] | None = None) -> T:
        """Do something with the camera open; meet trouble with its remedies, in turn, as often as they are listed."""
        used: Counter[Fault] = Counter()
        remedy: Remedy | None = None
        with self._lock:
            while True:
                self._check_not_closed()
                try:
                    if remedy is not None:
                        self._link.apply(remedy, used.total(), memory_target=self._setup.memory_target)
                        remedy = None
                    if not self._link.is_open:
                        self._link.connect()
                    return action()
                except FaultError as trouble:
                    self._check_not_closed()
                    remedy = self._remedy(trouble, used)
                    if remedy is None:
                        raise failure(trouble) from trouble
                    if remedy is Remedy.SHOOT_AGAIN and pending:
                        pending.clear()

    def _check_not_closed(self) -> None:
        if self._closed:
            raise ConnectionLostError("camera: it was closed meanwhile; open it again")

    def _remedy(self, trouble: FaultError, used: Counter[Fault]) -> Remedy | None:
        remedies = RESPONSES[trouble.fault].remedies
        if used[trouble.fault] >= len(remedies) or used.total() >= _MOST_REMEDIES:
            return None
        remedy = remedies[used[trouble.fault]]
        used[trouble.fault] += 1
        if trouble.op == "trigger" and trouble.fault in _AS_OF_AUTOFOCUS and self._settings.release == "auto":
            self._shooter.avoid_autofocus = True
        self._on_event(CameraEvent(f"camera: {trouble}; {remedy}", trouble.fault, remedy, used[trouble.fault]))
        return remedy

    def _tell(self, event: CameraEvent) -> None:
        if event.message not in self._told:
            self._told.add(event.message)
            self._on_event(event)


@dataclass(frozen=True, slots=True)
class Survey:
    """What is there before a camera is opened.

    Attributes
    ----------
    cameras
        Every camera that can be seen.
    library
        Versions of libgphoto2 and of its Python binding.
    """

    cameras: tuple[FoundCamera, ...]
    library: str


def survey(environment: Mapping[str, str] | None = None, *, worker: Sequence[str] = WORKER_COMMAND) -> Survey:
    """Every camera that can be seen, without opening one, and what looks for them.

    Parameters
    ----------
    environment
        Added to the environment of the camera's process.
    worker
        Its command.

    Raises
    ------
    RigError
        python-gphoto2 can't be loaded or doesn't answer.
    """
    link = CameraLink(Gphoto2Settings(environment=environment or {}), worker)
    try:
        return Survey(link.list(), library_of(link))
    except FaultError as trouble:
        raise failure(trouble) from trouble
    finally:
        link.restart()


def discover(
    environment: Mapping[str, str] | None = None, *, worker: Sequence[str] = WORKER_COMMAND
) -> tuple[FoundCamera, ...]:
    """Every camera that can be seen (see :func:`survey`)."""
    return survey(environment, worker=worker).cameras
