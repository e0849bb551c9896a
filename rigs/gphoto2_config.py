"""What an operator may say about a gphoto2 camera, and what its driver reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from rigs.gphoto2_faults import Fault, Remedy

ABSENT = "absent"
"""Stands for a setting that the camera doesn't have."""


@dataclass(frozen=True, slots=True)
class Gphoto2Settings:
    """Which camera, and how it is set. The defaults suit a tethered DSLR in mode M.

    Attributes
    ----------
    model, serial, port
        Choose the camera: part of the model's name (``650D``), the serial number, the port (``usb:001,005``, or
        ``usb:`` with any bus number). Empty ones fit every camera; the only camera found needs none.
    image_format
        RAW format by the name that the camera offers (``RAW``, ``RAW + Large Fine JPEG``, ``NEF (Raw)``); empty: the
        plain full-size RAW that it offers.
    capture_target
        ``card``: frames are kept on the card as well, so that a broken download can be repeated; ``memory``: never;
        ``auto``: card, or memory where there is no card.
    keep_on_card
        False deletes a frame from the card once it is safely here.
    aperture
        f-number for lenses with contacts, e.g. 5.6; None leaves it. Lenses without contacts have none to set.
    shutter_tolerance_stops
        How far the nearest offered exposure time may be from the one asked for.
    release
        ``trigger``: as the library thinks best; ``without-autofocus``: Canon EOS full press that never focuses;
        ``capture``: the library's blocking capture. ``auto``: trigger; where that fails, without autofocus if offered.
    may_be_absent
        Settings that this camera may lack (``iso``, ``image_format``, ``capture_target``); they are reported as
        ``absent``. Exposure time must always be there.
    restart_every
        Start a fresh camera process after so many frames; 0: never. For cameras that tire.
    call_timeout_s
        Patience with one call into the library (it gives up itself after about 20 s of a silent port).
    arrive_timeout_s
        How long after the exposure the RAW file may take to appear.
    download_timeout_s
        How long one file may take to copy.
    return_timeout_s
        How long a camera that left USB may take to come back.
    power_cycle_timeout_s
        How long the operator has to switch a frozen camera off and on.
    backoff_s
        Wait before the first repetition on a busy camera; doubles with each.
    environment
        Added to the environment of the camera's process (``CAMLIBS``, ``VCAMERADIR``, ``XDG_CONFIG_HOME``).
    """

    model: str = ""
    serial: str = ""
    port: str = ""
    image_format: str = ""
    capture_target: Literal["auto", "card", "memory"] = "auto"
    keep_on_card: bool = True
    aperture: float | None = None
    shutter_tolerance_stops: float = 0.26
    release: Literal["auto", "trigger", "without-autofocus", "capture"] = "auto"
    may_be_absent: tuple[str, ...] = ("iso", "image_format", "capture_target")
    restart_every: int = 0
    call_timeout_s: float = 30.0
    arrive_timeout_s: float = 30.0
    download_timeout_s: float = 90.0
    return_timeout_s: float = 30.0
    power_cycle_timeout_s: float = 120.0
    backoff_s: float = 0.5
    environment: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True)
class CameraEvent:
    """Something that the journal should know and the operator may want to.

    Attributes
    ----------
    message
        One line.
    fault, remedy
        What went wrong and what is done about it; None for a mere notice.
    attempt
        Number of this remedy for this fault within the operation, from 1; 0 for a notice.
    """

    message: str
    fault: Fault | None = None
    remedy: Remedy | None = None
    attempt: int = 0

    def __str__(self) -> str:
        return self.message


OnEvent = Callable[[CameraEvent], None]
Validate = Callable[[Path], None]
"""Raises where a file is no good frame."""


def ignore_event(_: CameraEvent) -> None:
    """Report to nobody."""


def accept_any(_: Path) -> None:
    """Take every file for a frame."""
