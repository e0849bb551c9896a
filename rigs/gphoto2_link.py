"""One chosen camera behind its process: found by model, serial number or port, opened, found again when it moves."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rigs.errors import DeviceNotFoundError
from rigs.gphoto2_config import Gphoto2Settings
from rigs.gphoto2_faults import Fault, FaultError, Remedy
from rigs.gphoto2_process import WORKER_COMMAND, WorkerProcess
from rigs.protocols import DeviceIdentity

_POLL_S = 0.5
_CLOSE_S = 3.0
_DRAIN_S = 3.0
_DRAIN_SLICE_S = 0.05
_SETTLE_S = 0.1
_FAULTS_OF_RETURNING = frozenset(
    {Fault.GONE, Fault.FROZEN, Fault.HUNG, Fault.HELD, Fault.BUSY, Fault.REFUSED, Fault.CRASHED}
)


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera on a port, not opened."""

    model: str
    port: str

    def __str__(self) -> str:
        return f"{self.model} at {self.port}"


@dataclass(frozen=True, slots=True)
class Widget:
    """One setting of the camera as text."""

    value: str
    choices: tuple[str, ...] = ()
    readonly: bool = False

    @classmethod
    def of(cls, answer: Mapping[str, Any]) -> Widget:
        """From the answer of the camera's process."""
        value = answer["value"]
        return cls("" if value is None else str(value), tuple(answer["choices"]), bool(answer["readonly"]))


class CameraLink:
    """Keeps one camera open; after trouble it may be another process, another port, but never another camera."""

    def __init__(self, settings: Gphoto2Settings, command: Sequence[str] = WORKER_COMMAND) -> None:
        self._settings = settings
        self.process = WorkerProcess(settings.environment, command)
        self.found: FoundCamera | None = None
        self.identity: DeviceIdentity | None = None
        self.is_open = False
        self.opens = 0
        """How often it was opened so far: what lay in its memory before the last time is lost."""

    def call(self, op: str, deadline_s: float | None = None, /, **arguments: Any) -> Any:
        """One operation of the camera's process, with the usual patience unless told otherwise."""
        try:
            return self.process.call(op, deadline_s or self._settings.call_timeout_s, **arguments)
        except FaultError as trouble:
            if trouble.fault in (Fault.HUNG, Fault.CRASHED):
                self.is_open = False
            raise

    def list(self) -> tuple[FoundCamera, ...]:
        """Every camera that can be seen."""
        return tuple(FoundCamera(str(model), str(port)) for model, port in self.call("list"))

    def connect(self, wait_s: float = 0.0) -> None:
        """Find the configured camera and open it, waiting for it to (re)appear where told to.

        Raises
        ------
        DeviceNotFoundError
            No camera, another one, or several that fit.
        FaultError
            It can't be opened, or didn't come back.
        """
        deadline = time.monotonic() + wait_s
        while True:
            try:
                self._connect()
                return
            except DeviceNotFoundError:  # switched off just now, as it was asked for
                if time.monotonic() >= deadline:
                    raise
            except FaultError as trouble:
                if trouble.fault not in _FAULTS_OF_RETURNING or time.monotonic() >= deadline:
                    raise
            time.sleep(_POLL_S)

    def _connect(self) -> None:
        self.disconnect()
        cameras = self.list()
        fitting = [camera for camera in cameras if self._fits(camera)]
        if self.identity is None:
            self._refuse_unless_clear(cameras, fitting)
        for camera in fitting:
            self.call("open", model=camera.model, port=camera.port)
            identity, serials = self._identify(camera)
            wanted = self.identity.serial if self.identity is not None else self._settings.serial
            if not wanted or wanted in serials:
                self.found, self.identity, self.is_open = camera, self.identity or identity, True
                self.opens += 1
                return
            self.call("close")
        if self.identity is None:
            raise DeviceNotFoundError(
                f"camera: none with serial number {self._settings.serial!r}; found {_listed(cameras)}; "
                "correct camera.serial (`workbench doctor` shows the numbers)"
            )
        raise FaultError(Fault.GONE, "list", f"{self.identity.model} {self.identity.serial}".strip())

    def _fits(self, camera: FoundCamera) -> bool:
        wanted = self._settings
        if self.found is not None:  # it may come back on another port
            return camera.model == self.found.model
        return wanted.model.casefold() in camera.model.casefold() and camera.port.startswith(wanted.port)

    def _refuse_unless_clear(self, cameras: Sequence[FoundCamera], fitting: Sequence[FoundCamera]) -> None:
        if not cameras:
            raise DeviceNotFoundError(
                "camera: none found; switch it on, wake it with a half press of the release, check the USB cable, "
                "set its USB mode to PTP"
            )
        if not fitting:
            asked = " at ".join(filter(None, [self._settings.model, self._settings.port]))
            raise DeviceNotFoundError(
                f"camera: no {asked!r}; found {_listed(cameras)}; correct camera.model or camera.port in rig.yaml"
            )
        if len(fitting) > 1 and not self._settings.serial:
            raise DeviceNotFoundError(
                f"camera: several found ({_listed(fitting)}); name one by camera.serial, camera.model or camera.port"
            )

    def _identify(self, camera: FoundCamera) -> tuple[DeviceIdentity, tuple[str, ...]]:
        widgets = self.widgets()
        texts = {name: widget.value for name, widget in widgets.items() if widget.value}
        serials = tuple(texts[name] for name in ("eosserialnumber", "serialnumber") if name in texts)
        lens = texts.get("lensname") or texts.get("lens")
        # What may change while a session lasts (port, battery) is no part of an identity.
        identity = DeviceIdentity(
            kind="gphoto2",
            make=texts.get("manufacturer", ""),
            model=camera.model,
            serial=self._settings.serial or next(iter(serials), ""),
            firmware=texts.get("deviceversion", ""),
            extra={"lens": lens} if lens else {},
        )
        return identity, serials

    def disconnect(self) -> None:
        """Close the camera; the process stays."""
        if self.is_open:
            self.is_open = False
            self.call("close")

    def widgets(self) -> dict[str, Widget]:
        """Every setting and status value that the camera has, by name."""
        return {name: Widget.of(answer) for name, answer in self.call("config").items()}

    def get(self, name: str) -> Widget:
        """Read one setting from the camera."""
        return Widget.of(self._named(name, "get", name=name))

    def set(self, name: str, value: str | int) -> Widget:
        """Set one setting and read it back."""
        return Widget.of(self._named(f"{name}={value}", "set", name=name, value=value))

    def _named(self, what: str, op: str, **arguments: Any) -> Any:
        try:
            return self.call(op, None, **arguments)
        except FaultError as trouble:
            raise FaultError(trouble.fault, f"{op} {what}", trouble.detail) from trouble

    def drain(self, *, memory_target: bool) -> None:
        """Take what the camera still has to say; frames left in its memory are fetched and forgotten."""
        deadline = time.monotonic() + _DRAIN_S
        while time.monotonic() < deadline:
            event = self.call("wait", timeout_s=_DRAIN_SLICE_S)
            if event["event"] == "timeout":
                return
            if event["event"] == "file" and (memory_target or event["folder"] == "/"):
                self.call("discard", self._settings.download_timeout_s, folder=event["folder"], name=event["name"])

    def settle(self, *, memory_target: bool) -> None:
        """Give the camera time to report what was changed."""
        time.sleep(_SETTLE_S)
        self.drain(memory_target=memory_target)

    def apply(self, remedy: Remedy, attempt: int, *, memory_target: bool) -> None:
        """Do what is to be done about trouble, up to having the camera open again.

        Parameters
        ----------
        remedy
            What to do.
        attempt
            How many remedies this operation has needed so far, this one included; waits grow with it.
        memory_target
            Frames go to the camera's memory.

        Raises
        ------
        FaultError
            That failed, too.
        """
        settings = self._settings
        if remedy in (Remedy.AGAIN, Remedy.DRAIN):
            time.sleep(settings.backoff_s * 2 ** (attempt - 1))
        if remedy in (Remedy.DRAIN, Remedy.SHOOT_AGAIN) and self.is_open:
            self.drain(memory_target=memory_target)
        elif remedy is Remedy.REOPEN:
            self.disconnect()
            self.connect(settings.return_timeout_s)
        elif remedy in (Remedy.RESTART, Remedy.REDISCOVER):
            self.restart()
            self.connect(settings.return_timeout_s)
        elif remedy is Remedy.POWER_CYCLE:
            self.restart()
            self.connect(settings.power_cycle_timeout_s)

    def restart(self) -> None:
        """End the process; the next call starts a fresh one."""
        self.is_open = False
        self.process.close(_CLOSE_S)


def _listed(cameras: Sequence[FoundCamera]) -> str:
    return ", ".join(map(str, cameras)) or "none"
