"""One frame: release, wait for its RAW file among the camera's events, bring it to disk whole."""

from __future__ import annotations

import hashlib
import os
import re
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rigs.gphoto2_config import CameraEvent, Gphoto2Settings, OnEvent, Validate
from rigs.gphoto2_faults import Fault, FaultError
from rigs.gphoto2_link import CameraLink
from rigs.gphoto2_settings import release_without_autofocus
from rigs.gphoto2_setup import CameraSetup

RAW_SUFFIXES = frozenset(
    f".{kind}"
    for kind in "3fr arw cr2 cr3 crw dng iiq nef nrw orf pef raf raw rw2 rwl sr2 srf x3f".split(" ")  # noqa: SIM905
)

_EVENT_SLICE_S = 0.5
_QUIET_S = 0.1
_MOST_QUIET_SLICES = 5
_COMPANION_S = 5.0
_MAYBE_RAW_S = 1.0
_BLOCKING_CAPTURE_S = 100.0
_PTP_EVENT = re.compile(r"PTP Event ([0-9a-fA-F]{4})")
_PTP_FAULTS = {"400a": Fault.STORE_FULL, "4005": Fault.CARD_REMOVED}


@dataclass(frozen=True, slots=True)
class CameraFile:
    """A file in the camera."""

    folder: str
    name: str

    @property
    def is_raw(self) -> bool:
        """Whether its name says so."""
        return Path(self.name).suffix.lower() in RAW_SUFFIXES

    @property
    def on_card(self) -> bool:
        """Whether it lies on a card; EOS and Nikon cameras list their memory as the root folder."""
        return self.folder != "/"

    def at(self, destination: Path) -> Path:
        """Where this file goes on our disk: a RAW file keeps the suffix that tells its kind."""
        return destination.with_suffix(Path(self.name).suffix.lower()) if self.is_raw else destination

    def __str__(self) -> str:
        return f"{self.folder.rstrip('/')}/{self.name}"


@dataclass(frozen=True, slots=True)
class Download:
    """A frame on our disk."""

    bytes: int
    sha256: str


class Shooter:
    """Takes frames with a camera that is open and set up."""

    def __init__(self, link: CameraLink, setup: CameraSetup, settings: Gphoto2Settings, tell: OnEvent) -> None:
        self._link, self._setup, self._settings, self._tell = link, setup, settings, tell
        self._delivered: dict[tuple[int, CameraFile], str] = {}
        self.avoid_autofocus = settings.release == "without-autofocus"
        """Release without focusing, where the camera offers that."""

    def expose(self, exposure_s: float) -> CameraFile:
        """Release and wait for the frame; what comes beside it is left on the card or removed from memory.

        Raises
        ------
        FaultError
            It didn't release, or no (RAW) file came in time.
        """
        self._link.drain(memory_target=self._setup.memory_target)
        first = self._release(exposure_s)
        files = self._collect([first] if first else [], exposure_s)
        raws = [file for file in files if file.is_raw]
        if not files:
            raise FaultError(Fault.NO_IMAGE, "wait")
        if not raws and self._setup.raw_expected:
            raise FaultError(Fault.NOT_RAW, "wait", f"only {', '.join(file.name for file in files)}")
        frame = (raws or files)[0]
        for other in files:
            if other != frame and self._in_memory(other):
                with suppress(FaultError):
                    self._call_file("discard", other)
        return frame

    def _release(self, exposure_s: float) -> CameraFile | None:
        patience = self._settings.call_timeout_s + 2 * exposure_s
        without_autofocus = release_without_autofocus(self._setup.choices("release"))
        if self.avoid_autofocus and without_autofocus is not None:
            self._link.call("press", patience, name=self._setup.driver_name("release"), values=without_autofocus)
            return None
        if self._settings.release != "capture":
            try:
                self._link.call("trigger", patience)
                return None
            except FaultError as trouble:
                if trouble.fault is not Fault.UNSUPPORTED or self._settings.release == "trigger":
                    raise
        folder, name = self._link.call("capture", patience + _BLOCKING_CAPTURE_S)
        return CameraFile(folder, name)

    def _collect(self, files: list[CameraFile], exposure_s: float) -> list[CameraFile]:
        # Noise reduction takes a second, dark exposure before the file is written.
        deadline = time.monotonic() + 2 * exposure_s + self._settings.arrive_timeout_s
        complete = False
        companion_deadline: float | None = None
        while (now := time.monotonic()) < deadline:
            raw_here = any(file.is_raw for file in files)
            if raw_here or (files and not self._setup.raw_expected):
                if companion_deadline is None:
                    companion_deadline = now + self._companion_patience_s(raw_here=raw_here)
                if complete or len(files) > 1 or now >= companion_deadline:
                    break
            event = self._link.call("wait", timeout_s=min(_EVENT_SLICE_S, deadline - now))
            complete = self._note(event, files) or complete
        # What comes right after must not be taken for the next frame's.
        for _ in range(_MOST_QUIET_SLICES):
            event = self._link.call("wait", timeout_s=_QUIET_S)
            if event["event"] == "timeout":
                break
            self._note(event, files)
        return files

    def _companion_patience_s(self, *, raw_here: bool) -> float:
        if self._setup.companion_expected:
            return _COMPANION_S
        return 0.0 if raw_here else _MAYBE_RAW_S

    def _note(self, event: dict[str, Any], files: list[CameraFile]) -> bool:
        """Take an event in; True when it ends the capture."""
        if event["event"] == "file":
            file = CameraFile(event["folder"], event["name"])
            if file not in files:  # announced twice by some cameras
                files.append(file)
        elif event["event"] == "other" and (match := _PTP_EVENT.match(event["text"])):
            fault = _PTP_FAULTS.get(match[1].lower())
            if fault is not None and not files:  # a frame that just fitted is a frame
                raise FaultError(fault, "wait", event["text"])
        return bool(event["event"] == "complete")

    def _in_memory(self, file: CameraFile) -> bool:
        if not file.on_card and self._setup.card_target:
            self._tell(
                CameraEvent("camera: frames come through its memory although the card was chosen: put a card in")
            )
        return self._setup.memory_target or not file.on_card

    def _call_file(self, op: str, file: CameraFile, **arguments: Any) -> Any:
        return self._link.call(op, self._settings.download_timeout_s, folder=file.folder, name=file.name, **arguments)

    def fetch(self, file: CameraFile, destination: Path, validate: Validate) -> Download:
        """Bring a frame to ``destination``: under a temporary name first, checked, synced, then renamed.

        Parameters
        ----------
        file
            The frame in the camera.
        destination
            Where it shall be.
        validate
            Raises where the file on disk is no good frame.

        Raises
        ------
        FaultError
            It can't be downloaded, or what arrived is empty, short, old or damaged.
        OSError
            The disk is full or can't be written.
        """
        part = destination.with_name(f".part-{destination.name}")  # keeps the suffix that tells readers its kind
        try:
            download = self._download(file, part)
            try:
                validate(part)
            except Exception as error:
                raise FaultError(Fault.BAD_FILE, f"check of {file.name}", str(error)) from error
            part.replace(destination)
        finally:
            part.unlink(missing_ok=True)
        _sync_directory(destination.parent)
        self._delivered[self._link.process.starts, file] = download.sha256
        if self._in_memory(file) or not self._settings.keep_on_card:
            with suppress(FaultError):  # some cameras forget a fetched frame by themselves
                self._call_file("delete", file)
        return download

    def _download(self, file: CameraFile, part: Path) -> Download:
        try:
            stated = int(self._call_file("size", file))
        except FaultError as trouble:
            if trouble.fault not in (Fault.UNSUPPORTED, Fault.DOWNLOAD):
                raise
            stated = 0
        answer = self._call_file("download", file, path=str(part.absolute()))
        sent = Download(int(answer["bytes"]), str(answer["sha256"]))
        if sent.bytes == 0:
            raise FaultError(Fault.EMPTY_FILE, "download", file.name)
        if stated and sent.bytes < stated:
            raise FaultError(Fault.SHORT_FILE, "download", f"{file.name}: {sent.bytes} of {stated} bytes")
        on_disk = _measured(part)
        if on_disk != sent:
            detail = f"{file.name}: {on_disk.bytes} bytes on disk, {sent.bytes} sent, or changed on the way"
            raise FaultError(Fault.SHORT_FILE, "download", detail)
        if self._delivered.get((self._link.process.starts, file)) == sent.sha256:
            raise FaultError(Fault.STALE_FILE, "download", file.name)  # two exposures never agree in every bit
        return sent


def _measured(path: Path) -> Download:
    with path.open("rb") as stream:
        return Download(path.stat().st_size, hashlib.file_digest(stream, "sha256").hexdigest())


def _sync_directory(directory: Path) -> None:
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
