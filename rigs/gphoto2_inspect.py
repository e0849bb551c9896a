"""What a check of the rig wants to know about a camera that is open: read only, nothing is set."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from types import MappingProxyType

from rigs.gphoto2_config import ABSENT
from rigs.gphoto2_faults import FaultError
from rigs.gphoto2_link import CameraLink, Widget
from rigs.gphoto2_settings import offered_isos, offered_times_s
from rigs.gphoto2_setup import NAMES

FACTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "model": ("cameramodel", "model"),
        "serial": ("eosserialnumber", "serialnumber"),
        "firmware": ("deviceversion",),
        "mode_dial": NAMES["mode_dial"],
        "image_format": NAMES["image_format"],
        "exposure_time": NAMES["exposure_time"],
        "iso": NAMES["iso"],
        "aperture": NAMES["aperture"],
        "lens": ("lensname", "lens"),
        "focus": NAMES["focus"],
        "drive": NAMES["drive"],
        "capture_target": NAMES["capture_target"],
        "battery": NAMES["battery"],
        "available_shots": ("availableshots",),
        "auto_power_off": ("autopoweroff",),
        "mirror_lockup": ("mirrorlock", "mirrorlockup"),
        "datetime": ("datetimeutc", "datetime"),
    }
)


def facts_of(link: CameraLink) -> dict[str, str]:
    """Status and settings of an open camera as text.

    Returns
    -------
    dict
        One entry for each of :data:`FACTS` (``absent`` where the camera doesn't say), and ``port``, ``identified_as``
        (the model as the library knows it), ``image_formats``, ``apertures`` and ``isos`` (those offered, separated by
        ``, ``), ``exposure_times_s`` (the shortest and the longest offered), ``free_mb`` and ``free_images`` (of the
        card, where there is one), ``library``. ``datetime`` is the camera's clock, ISO 8601.

    Raises
    ------
    FaultError
        The camera fails.
    """
    widgets = link.widgets()
    facts = {fact: _first(widgets, names) for fact, names in FACTS.items()}
    if facts["datetime"].isdigit():
        facts["datetime"] = datetime.fromtimestamp(int(facts["datetime"])).isoformat(sep=" ")
    facts["image_formats"] = ", ".join(_offered(widgets, "image_format")) or ABSENT
    facts["apertures"] = ", ".join(_offered(widgets, "aperture")) or ABSENT
    facts["isos"] = ", ".join(map(str, offered_isos(_offered(widgets, "iso")))) or ABSENT
    times = offered_times_s(_offered(widgets, "exposure_time"))
    facts["exposure_times_s"] = f"{times[0]:g} to {times[-1]:g}" if times else ABSENT
    assert link.found is not None  # it is open
    facts["port"], facts["identified_as"] = link.found.port, link.found.model
    facts["library"] = library_of(link)
    return facts | _free_space(link)


def library_of(link: CameraLink) -> str:
    """Versions of libgphoto2 and of its Python binding."""
    hello = link.call("hello")
    return f"libgphoto2 {hello['library']}, python-gphoto2 {hello['binding']}"


def _offered(widgets: Mapping[str, Widget], ours: str) -> tuple[str, ...]:
    """Choices of a setting under the first of its names that has some."""
    return next((widgets[name].choices for name in NAMES[ours] if name in widgets and widgets[name].choices), ())


def _first(widgets: Mapping[str, Widget], names: tuple[str, ...]) -> str:
    return next((widgets[name].value for name in names if name in widgets and widgets[name].value), ABSENT)


def _free_space(link: CameraLink) -> dict[str, str]:
    try:
        stores = link.call("storage")
    except FaultError:  # no card, or a camera that doesn't count
        stores = []
    kilobytes = max((store["free_kb"] for store in stores if store["free_kb"] is not None), default=None)
    images = max((store["free_images"] for store in stores if store["free_images"] is not None), default=None)
    return {
        "free_mb": ABSENT if kilobytes is None else str(kilobytes // 1024),
        "free_images": ABSENT if images is None else str(images),
    }
