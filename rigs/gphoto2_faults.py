"""What goes wrong with a tethered camera: from codes to named faults, what the driver does, what the operator reads.

``docs/reference/camera-errors.md`` is the same table for people.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from rigs.errors import (
    CameraError,
    CaptureError,
    ConfigError,
    ConnectionLostError,
    DeviceBusyError,
    DeviceTimeoutError,
    RigError,
)


class Fault(StrEnum):
    """Each kind of trouble by name, as it stands in the journal."""

    HELD = "held by another program"
    BUSY = "busy"
    GONE = "gone"
    FROZEN = "frozen"
    HUNG = "call hung"
    CRASHED = "camera process crashed"
    STORE_FULL = "card full"
    CARD_REMOVED = "card removed"
    BATTERY = "battery empty"
    NO_RELEASE = "did not release"
    NO_IMAGE = "no image arrived"
    NOT_RAW = "no RAW file arrived"
    DOWNLOAD = "download failed"
    EMPTY_FILE = "empty download"
    SHORT_FILE = "short download"
    STALE_FILE = "old frame delivered again"
    BAD_FILE = "frame is damaged"
    FILE_LOST = "file not found in the camera"
    UNSUPPORTED = "not supported"
    NO_LIVE_VIEW = "no live view"
    REFUSED = "refused"
    NO_LIBRARY = "gphoto2 missing"


class Remedy(StrEnum):
    """What the driver does about a fault before it gives up."""

    AGAIN = "trying again"
    DRAIN = "emptying its event queue, waiting, trying again"
    REOPEN = "closing and opening it again"
    RESTART = "restarting the camera process"
    REDISCOVER = "waiting for it to come back: wake it with a half press of the release, check the cable"
    POWER_CYCLE = "SWITCH THE CAMERA OFF AND ON NOW; waiting for it to come back"
    SHOOT_AGAIN = "taking the frame again"


class FaultError(Exception):
    """Something failed in or below the camera's process; becomes a RigError when remedies are used up."""

    def __init__(self, fault: Fault, op: str, detail: str = "") -> None:
        super().__init__(f"{fault} ({op}: {detail})" if detail else f"{fault} ({op})")
        self.fault, self.op, self.detail = fault, op, detail


@dataclass(frozen=True, slots=True)
class Response:
    """How one fault is met.

    Attributes
    ----------
    remedies
        Tried in this order, one per occurrence within one operation; then the error is raised.
    error, message
        What is raised then: the line that the operator reads, after ``camera: ``.
    """

    remedies: tuple[Remedy, ...]
    error: type[RigError]
    message: str


_SWITCHES = "lens switch to MF, mirror lock-up and self-timer off"
_FETCH_AGAIN = (Remedy.AGAIN, Remedy.REOPEN, Remedy.SHOOT_AGAIN)

RESPONSES: Mapping[Fault, Response] = MappingProxyType(
    {
        Fault.HELD: Response(
            (Remedy.AGAIN, Remedy.AGAIN),
            DeviceBusyError,
            "another program holds it, mostly the desktop's file manager: run `gio mount -s gphoto2`, "
            "close photo programs, then try again",
        ),
        Fault.BUSY: Response(
            (Remedy.DRAIN, Remedy.DRAIN, Remedy.REOPEN),
            DeviceBusyError,
            f"stays busy: {_SWITCHES}; leave its menus and playback; if that doesn't help, switch it off and on",
        ),
        Fault.GONE: Response(
            (Remedy.REDISCOVER, Remedy.REDISCOVER),
            ConnectionLostError,
            "gone from USB: wake it with a half press of the release, switch its auto power off to `disable`, "
            "check cable and battery",
        ),
        Fault.FROZEN: Response(
            (Remedy.RESTART, Remedy.POWER_CYCLE),
            DeviceTimeoutError,
            "doesn't answer any more: switch it off and on (or take the battery out for a moment)",
        ),
        Fault.HUNG: Response(
            (Remedy.RESTART, Remedy.POWER_CYCLE),
            DeviceTimeoutError,
            "a call to it hung and was broken off: switch it off and on, check the cable",
        ),
        Fault.CRASHED: Response(
            (Remedy.RESTART, Remedy.RESTART),
            CameraError,
            "libgphoto2 crashed more than once: switch the camera off and on",
        ),
        Fault.STORE_FULL: Response(
            (),
            CameraError,
            "no space for another frame: put in an empty card or format this one in the camera",
        ),
        Fault.CARD_REMOVED: Response(
            (),
            CameraError,
            "its card was taken out: put it back, close the card door",
        ),
        Fault.BATTERY: Response(
            (),
            CameraError,
            "battery empty: charge or exchange it (a mains adapter is best)",
        ),
        Fault.NO_RELEASE: Response(
            (Remedy.DRAIN, Remedy.REOPEN),
            CaptureError,
            f"the shutter did not release: {_SWITCHES} (autofocus can't lock on a point in the dark); "
            "check that the card has space",
        ),
        Fault.NO_IMAGE: Response(
            (Remedy.REOPEN,),
            CaptureError,
            f"released, but no image arrived: check card and card door; {_SWITCHES}; drive mode to single",
        ),
        Fault.NOT_RAW: Response(
            (),
            CaptureError,
            "delivered no RAW file: set its image quality to RAW (or camera.image_format to a RAW format it offers)",
        ),
        Fault.DOWNLOAD: Response(
            _FETCH_AGAIN,
            CaptureError,
            "the frame can't be downloaded: check cable and card; switch the camera off and on",
        ),
        Fault.EMPTY_FILE: Response(
            _FETCH_AGAIN,
            CaptureError,
            "the frame arrives empty: check cable and card; switch the camera off and on",
        ),
        Fault.SHORT_FILE: Response(
            _FETCH_AGAIN,
            CaptureError,
            "the frame arrives shorter than the camera says it is: check cable and card",
        ),
        Fault.STALE_FILE: Response(
            (Remedy.REOPEN, Remedy.SHOOT_AGAIN),
            CaptureError,
            "delivers an older frame under the same name: format the card, or set file numbering to continuous",
        ),
        Fault.BAD_FILE: Response(
            (Remedy.AGAIN, Remedy.SHOOT_AGAIN),
            CaptureError,
            "the frame that arrived can't be used: check cable, card and image format",
        ),
        Fault.FILE_LOST: Response(
            (Remedy.SHOOT_AGAIN,),
            CaptureError,
            "the frame is not where the camera said: check the card; switch the camera off and on",
        ),
        Fault.UNSUPPORTED: Response(
            (),
            CameraError,
            "it can't do that by remote control; do it on the camera itself",
        ),
        Fault.NO_LIVE_VIEW: Response(
            (),
            CameraError,
            "no live view over USB; use repeated frames instead",
        ),
        Fault.REFUSED: Response(
            (Remedy.DRAIN, Remedy.REOPEN),
            CameraError,
            "refuses without saying why: leave its menus, check the mode dial, switch it off and on",
        ),
        Fault.NO_LIBRARY: Response(
            (),
            ConfigError,
            "python-gphoto2 is missing or broken: `pip install gphoto2`",
        ),
    }
)

_BY_CODE: Mapping[int, Fault] = MappingProxyType(
    {
        0: Fault.NO_LIBRARY,
        -3: Fault.STORE_FULL,
        -5: Fault.GONE,
        -6: Fault.UNSUPPORTED,
        -7: Fault.GONE,
        -10: Fault.FROZEN,
        -31: Fault.GONE,
        -34: Fault.GONE,
        -35: Fault.GONE,
        -51: Fault.GONE,
        -52: Fault.GONE,
        -53: Fault.HELD,
        -60: Fault.HELD,
        -105: Fault.GONE,
        -110: Fault.BUSY,
        -115: Fault.STORE_FULL,
    }
)
_BY_WORD: tuple[tuple[str, Fault], ...] = (
    ("0x2019", Fault.BUSY),
    ("device busy", Fault.BUSY),
    ("0x200c", Fault.STORE_FULL),
    ("store full", Fault.STORE_FULL),
    ("battery low", Fault.BATTERY),
    ("low battery", Fault.BATTERY),
    ("battery exhausted", Fault.BATTERY),
    ("no such device", Fault.GONE),
)
"""A bare -1 may still carry its reason in the library's log."""
_RELEASING = frozenset({"trigger", "press", "capture"})
_DOWNLOADING = frozenset({"download", "size", "discard"})


def classify(op: str, code: int, text: str = "", log: Sequence[str] = ()) -> FaultError:
    """Name the trouble behind an error code of libgphoto2.

    Parameters
    ----------
    op
        Operation of the camera's process that failed (``open``, ``trigger``, ``download``, ...).
    code
        Negative code of libgphoto2; 0 where its Python binding can't be loaded.
    text
        The library's text for it.
    log
        The last lines that the library logged as errors.
    """
    spoken = " ".join(log).lower()
    fault = _BY_CODE.get(code) or next((fault for word, fault in _BY_WORD if word in spoken), None)
    if fault is Fault.STORE_FULL and op not in _RELEASING:
        fault = None  # -3 is `out of memory` elsewhere
    if fault is Fault.UNSUPPORTED and op == "preview":
        fault = Fault.NO_LIVE_VIEW
    if fault is None:
        if op in _RELEASING:
            fault = Fault.NO_RELEASE
        elif op == "wait":
            fault = Fault.NO_IMAGE
        elif op in _DOWNLOADING:
            fault = Fault.FILE_LOST if code in (-107, -108) else Fault.DOWNLOAD
        else:
            fault = Fault.REFUSED
    return FaultError(fault, op, f"{code} {text}".strip() if code else text)


def failure(trouble: FaultError) -> RigError:
    """The error that the operator reads once remedies are used up."""
    response = RESPONSES[trouble.fault]
    detail = f" ({trouble.op}: {trouble.detail})" if trouble.detail else ""
    return response.error(f"camera: {response.message}{detail}")
