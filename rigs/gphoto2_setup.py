"""Setting a camera up and keeping it so: every setting is chosen from what is offered, set, and read back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from rigs.errors import SettingError
from rigs.gphoto2_config import ABSENT, CameraEvent, Gphoto2Settings, OnEvent
from rigs.gphoto2_link import CameraLink, Widget
from rigs.gphoto2_settings import (
    choose_aperture,
    choose_iso,
    choose_raw_format,
    choose_target,
    choose_time,
    dial_allows,
    has_no_contacts,
    is_battery_low,
    is_card,
    is_manual_focus,
    is_raw_format,
    is_raw_with_jpeg,
    listed,
    offered_isos,
    offered_times_s,
    parse_f_number,
    parse_time_s,
    same_aperture,
    same_iso,
    same_text,
    same_time,
)
from rigs.protocols import Exposure

NAMES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        # Nikon's shutterspeed is rounded to 0.1 ms, its shutterspeed2 is exact.
        "exposure_time": ("shutterspeed2", "shutterspeed", "exptime"),
        "iso": ("iso",),
        "image_format": ("imageformat", "imagequality"),
        "capture_target": ("capturetarget",),
        "aperture": ("aperture", "f-number"),
        "mode_dial": ("autoexposuremodedial", "autoexposuremode", "expprogram", "exposuremode"),
        "focus": ("focusmode", "focusmode2"),
        "autofocus": ("autofocus",),
        "drive": ("drivemode", "capturemode"),
        "bracketing": ("aeb",),
        "battery": ("batterylevel",),
        "release": ("eosremoterelease",),
        "live_view": ("viewfinder", "eosviewfinder"),
    }
)
"""Our name of a setting and the names that libgphoto2's drivers have for it, best first."""

_REREADS = 3
_READ_PER_FRAME = ("image_format", "capture_target", "aperture", "focus", "battery")

Same = Callable[[str, str], bool]


class CameraSetup:
    """The settings of one camera; learnt and made anew whenever it is opened."""

    def __init__(self, link: CameraLink, settings: Gphoto2Settings, tell: OnEvent) -> None:
        self._link, self._settings, self._tell = link, settings, tell
        self._widgets: dict[str, Widget] = {}
        self._names: dict[str, str] = {}

    def prepare(self) -> None:
        """Set everything but the exposure.

        Raises
        ------
        SettingError
            The mode dial is wrong, a setting isn't offered, or isn't what was set when read back.
        FaultError
            The camera fails.
        """
        self._learn()
        dial = self.value("mode_dial")
        if not dial_allows(dial):
            raise SettingError(f"camera: its mode dial stands on {dial}; turn it to M, so that exposures can be set")
        self._offered_times()
        self._set_format()
        self._set_target()
        self._set_focus()
        self._set_aperture()
        self._set_if_offered("autofocus", lambda text: same_text(text, "off"))
        self._set_if_offered("bracketing", lambda text: same_text(text, "off"))
        self._set_if_offered("drive", lambda text: text.casefold().startswith("single"))

    def _learn(self) -> None:
        everything = self._link.widgets()
        self._names, self._widgets = {}, {}
        for ours, candidates in NAMES.items():
            present = [name for name in candidates if name in everything]
            if present:
                name = next((name for name in present if _useful(ours, everything[name])), present[0])
                self._names[ours], self._widgets[ours] = name, everything[name]

    def value(self, ours: str) -> str:
        """Value as last read, or ``absent``."""
        widget = self._widgets.get(ours)
        return widget.value if widget is not None else ABSENT

    def choices(self, ours: str) -> tuple[str, ...]:
        """What is offered for a setting; empty where the camera doesn't have it."""
        widget = self._widgets.get(ours)
        return widget.choices if widget is not None else ()

    def driver_name(self, ours: str) -> str:
        """What the library calls a setting that the camera has."""
        return self._names[ours]

    def times_s(self) -> tuple[float, ...]:
        """Exposure times offered, ascending."""
        return offered_times_s(self.choices("exposure_time"))

    def isos(self) -> tuple[int, ...]:
        """ISO values offered, ascending; empty where the camera doesn't let them be set."""
        return offered_isos(self.choices("iso"))

    @property
    def memory_target(self) -> bool:
        """Whether frames go to the camera's memory, where they have to be fetched and deleted."""
        target = self.value("capture_target")
        return target != ABSENT and not is_card(target)

    @property
    def card_target(self) -> bool:
        """Whether the camera says that frames go to its card."""
        return is_card(self.value("capture_target"))

    @property
    def raw_expected(self) -> bool:
        """Whether the camera was set to RAW, so that a file of another kind is not the frame."""
        return is_raw_format(self.value("image_format"))

    @property
    def companion_expected(self) -> bool:
        """Whether a second file comes with each frame."""
        return is_raw_with_jpeg(self.value("image_format"))

    def set_exposure(self, exposure: Exposure) -> tuple[Exposure, dict[str, str]]:
        """Set time and ISO; return them, and every other setting, as read back just before the frame.

        Raises
        ------
        SettingError
            Not offered, or not what was set when read back.
        FaultError
            The camera fails.
        """
        chosen = choose_time(self._offered_times(), exposure.time_s, self._settings.shutter_tolerance_stops)
        texts = {"exposure_time": self._keep("exposure_time", chosen, same_time)}
        if "iso" in self._names:
            texts["iso"] = self._keep("iso", choose_iso(self.choices("iso"), exposure.iso), same_iso)
        else:
            texts["iso"] = self._missing("iso")
        for ours in _READ_PER_FRAME:
            if ours in self._names:
                self._reread(ours)
        if "image_format" in self._names:
            self._set_format()  # somebody may have been in the menus
        self._warn_of_battery()
        texts |= {ours: self.value(ours) for ours in _READ_PER_FRAME}
        time_s = parse_time_s(texts["exposure_time"])
        assert time_s is not None  # same_time compared it
        return Exposure(time_s, exposure.iso), texts

    def end_live_view(self) -> None:
        """Switch the live view off; a frame taken with it on may differ."""
        if "live_view" in self._names:
            self._link.set(self._names["live_view"], 0)

    def _offered_times(self) -> tuple[str, ...]:
        if not self.times_s():
            raise SettingError(
                f"camera: it offers no exposure times ({listed(self.choices('exposure_time'))}); "
                "turn its mode dial to M"
            )
        return self.choices("exposure_time")

    def _warn_of_battery(self) -> None:
        if is_battery_low(self.value("battery")):
            self._tell(CameraEvent(f"camera: battery at {self.value('battery')}; charge it or use a mains adapter"))

    def _reread(self, ours: str) -> str:
        widget = self._link.get(self._names[ours])
        self._widgets[ours] = widget
        return widget.value

    def _keep(self, ours: str, chosen: str, same: Same) -> str:
        value = self._reread(ours)
        return value if same(chosen, value) else self._set(ours, chosen, same)

    def _set(self, ours: str, chosen: str, same: Same) -> str:
        widget = self._widgets[ours] = self._link.set(self._names[ours], chosen)
        for _ in range(_REREADS):
            if same(chosen, widget.value):
                break
            self._link.settle(memory_target=self.memory_target)  # some cameras report a change only after a while
            widget = self._widgets[ours] = self._link.get(self._names[ours])
        if not same(chosen, widget.value):
            raise SettingError(
                f"camera: {ours.replace('_', ' ')} was set to {chosen}, but reads {widget.value or 'nothing'}; "
                "check its mode dial and menus"
            )
        return widget.value

    def _missing(self, ours: str) -> str:
        if ours not in self._settings.may_be_absent:
            raise SettingError(
                f"camera: it has no setting for {ours.replace('_', ' ')}; turn its mode dial to M, "
                f"or add {ours} to camera.may_be_absent in rig.yaml"
            )
        return ABSENT

    def _set_format(self) -> None:
        if not self.choices("image_format"):
            self._missing("image_format")
            return
        chosen = choose_raw_format(self.choices("image_format"), self._settings.image_format)
        if not same_text(chosen, self.value("image_format")):
            self._set("image_format", chosen, same_text)

    def _set_target(self) -> None:
        wanted = self._settings.capture_target
        if "capture_target" not in self._names:
            self._missing("capture_target")
            return
        chosen = choose_target(self.choices("capture_target"), card=wanted != "memory")
        if chosen is None and wanted == "auto":
            return
        if chosen is None:
            raise SettingError(
                f"camera: no capture target {wanted!r}; it offers {listed(self.choices('capture_target'))}; "
                "correct camera.capture_target"
            )
        if same_text(self.value("capture_target"), chosen):
            return
        try:
            self._set("capture_target", chosen, same_text)
        except SettingError:
            if wanted != "auto":
                raise
            self._tell(CameraEvent("camera: no card; a download that breaks costs the frame; put one in"))

    def _set_focus(self) -> None:
        widget = self._widgets.get("focus")
        if widget is None or is_manual_focus(widget.value):
            return
        manual = next((text for text in widget.choices if is_manual_focus(text)), None)
        if manual is not None and not widget.readonly:
            self._widgets["focus"] = self._link.set(self._names["focus"], manual)
        if not is_manual_focus(self.value("focus")):
            self._tell(CameraEvent(f"camera: focus stands on {self.value('focus')}; put the lens switch to MF"))

    def _set_aperture(self) -> None:
        wanted, widget = self._settings.aperture, self._widgets.get("aperture")
        if wanted is None:
            return
        if widget is None or _without_contacts(widget):
            self._tell(CameraEvent(f"camera: the lens reports no aperture; f/{wanted:g} is yours to set on it"))
            return
        self._keep("aperture", choose_aperture(widget.choices, wanted), same_aperture)

    def _set_if_offered(self, ours: str, fits: Callable[[str], bool]) -> None:
        widget = self._widgets.get(ours)
        if widget is None or widget.readonly or fits(widget.value):
            return
        chosen = next((text for text in widget.choices if fits(text)), None)
        if chosen is not None:
            self._set(ours, chosen, same_text)


def _useful(ours: str, widget: Widget) -> bool:
    if ours == "exposure_time":
        return bool(offered_times_s(widget.choices))
    if ours == "image_format":
        return any(map(is_raw_format, widget.choices))
    return bool(widget.value)


def _without_contacts(widget: Widget) -> bool:
    return has_no_contacts(widget.value) or not any(map(parse_f_number, widget.choices))
