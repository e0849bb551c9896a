"""What goes wrong with an EOS 650D, fault by fault: what the driver does about it, and what the operator reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from rigs.errors import CameraError, CaptureError, ConfigError, RigError, SettingError
from rigs.gphoto2_faults import RESPONSES, Fault, Remedy
from rigs.protocols import Exposure
from tests.protocol.camera.conftest import Recorder, Script
from tests.standins.scripted_camera import CARD, content

EXPOSURE = Exposure(1 / 60, 100)


def failing(op: str, code: int, *, log: str = "", last: int = 10**9, **more: Any) -> dict[str, Any]:
    return {"op": op, "do": "error", "code": code, "log": [log] if log else [], "last": last, **more}


def events(*said: dict[str, Any] | str, last: int = 10**9) -> dict[str, Any]:
    """A release after which the camera says this; a mere text is the name of a file on its card."""
    files = [{"event": "file", "folder": CARD, "name": name} if isinstance(name, str) else name for name in said]
    return {"op": "trigger", "do": "events", "events": files, "last": last}


def other(text: str) -> dict[str, Any]:
    return {"event": "other", "text": text}


@dataclass
class Case:
    """A fault, and how to bring it about."""

    fault: Fault
    rules: list[dict[str, Any]]
    settings: dict[str, Any] = field(default_factory=lambda: {"release": "trigger"})


ENDLESS = [
    Case(Fault.BUSY, [failing("trigger", -110)]),
    Case(Fault.BUSY, [failing("trigger", -1, log="PTP Device Busy (0x2019)")]),
    Case(Fault.GONE, [failing("trigger", -52), {"op": "list", "first": 2, "do": "answer", "ok": []}]),
    Case(Fault.FROZEN, [failing("download", -10)]),
    Case(Fault.HUNG, [{"op": "download", "do": "hang"}]),
    Case(Fault.CRASHED, [{"op": "download", "do": "crash"}]),
    Case(Fault.STORE_FULL, [failing("trigger", -3)]),
    Case(Fault.STORE_FULL, [events(other("PTP Event 400a"))]),
    Case(Fault.CARD_REMOVED, [events(other("PTP Event 4005"))]),
    Case(Fault.BATTERY, [failing("trigger", -1, log="canon: battery low")]),
    Case(Fault.NO_RELEASE, [failing("trigger", -1)]),
    Case(Fault.NO_IMAGE, [events(other("PTP Property d101 changed"))]),
    Case(Fault.NOT_RAW, [events("IMG_0001.JPG")]),
    Case(Fault.DOWNLOAD, [failing("download", -1)]),
    Case(Fault.EMPTY_FILE, [{"op": "download", "do": "content", "hex": ""}]),
    Case(Fault.SHORT_FILE, [{"op": "download", "do": "content", "hex": "00ff"}]),
    Case(Fault.FILE_LOST, [failing("download", -108)]),
    Case(Fault.REFUSED, [failing("get", -1)]),
]


@pytest.mark.parametrize("case", ENDLESS, ids=lambda case: f"{case.fault}-{case.rules[0]['op']}")
def test_a_fault_that_does_not_end_is_met_as_listed_and_told_in_one_line(
    script: Script, case: Case, tmp_path: Path, reported: Recorder
) -> None:
    response = RESPONSES[case.fault]
    scripted = script(*case.rules, **case.settings)
    with pytest.raises(RigError) as caught:
        scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    assert type(caught.value) is response.error
    text = str(caught.value)
    assert text.startswith(f"camera: {response.message}")
    assert len(text.splitlines()) == 1
    assert tuple(event.remedy for event in reported.events if event.fault) == response.remedies
    assert {event.fault for event in reported.events if event.fault} <= {case.fault}
    assert not list(tmp_path.glob("*.cr2"))
    assert not list(tmp_path.glob(".part*"))


PASSING = [
    Case(Fault.BUSY, [failing("trigger", -110, last=2)]),
    Case(Fault.FROZEN, [failing("download", -10, last=2)]),
    Case(Fault.HUNG, [{"op": "download", "do": "hang", "last": 1}]),
    Case(Fault.CRASHED, [{"op": "size", "do": "crash", "last": 1}]),
    Case(Fault.NO_RELEASE, [failing("trigger", -1, last=1)]),
    Case(Fault.NO_IMAGE, [events(last=1)]),
    Case(Fault.DOWNLOAD, [failing("download", -1, last=3)]),
    Case(Fault.EMPTY_FILE, [{"op": "download", "do": "content", "hex": "", "last": 1}]),
    Case(Fault.SHORT_FILE, [{"op": "download", "do": "content", "hex": "00ff", "last": 2}]),
    Case(Fault.FILE_LOST, [failing("download", -108, last=1)]),
    Case(Fault.REFUSED, [failing("get", -1, last=1)]),
]


@pytest.mark.parametrize("case", PASSING, ids=lambda case: str(case.fault))
def test_a_fault_that_passes_costs_no_frame(script: Script, case: Case, tmp_path: Path, reported: Recorder) -> None:
    scripted = script(*case.rules, **case.settings)
    result = scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    folder, _, name = result.settings["file"].rpartition("/")
    assert result.path.read_bytes() == content(folder, name)
    assert {event.fault for event in reported.events} == {case.fault}


def test_a_broken_download_is_repeated_without_another_exposure(script: Script, tmp_path: Path) -> None:
    scripted = script(failing("download", -1, last=2))
    scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    assert len(scripted.calls("trigger")) == 1
    assert len(scripted.calls("download")) == 3


def test_a_camera_that_the_desktop_holds_is_named_with_the_command_that_frees_it(
    script: Script, reported: Recorder
) -> None:
    with pytest.raises(RigError, match="gio mount -s gphoto2"):
        script(failing("open", -53))
    assert [event.remedy for event in reported.events] == [Remedy.AGAIN, Remedy.AGAIN]


def test_a_camera_that_comes_back_under_another_bus_number_goes_on(
    script: Script, tmp_path: Path, reported: Recorder
) -> None:
    elsewhere = {"op": "list", "first": 2, "do": "answer", "ok": [["Canon EOS 650D", "usb:001,009"]]}
    scripted = script(failing("trigger", -52, last=1), elsewhere, port="usb:001,005")
    scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    assert [event.remedy for event in reported.events] == [Remedy.REDISCOVER]
    assert [call["port"] for call in scripted.calls("open")] == ["usb:001,005", "usb:001,009"]


def test_autofocus_that_finds_nothing_in_the_dark_is_avoided_from_then_on(script: Script, tmp_path: Path) -> None:
    scripted = script(failing("trigger", -1))
    for number in range(2):
        scripted.camera.capture(EXPOSURE, tmp_path / f"{number}.dng")
    assert len(scripted.calls("trigger")) == 1
    pressed = [(call["name"], call["values"]) for call in scripted.calls("press")]
    assert pressed == [("eosremoterelease", ["Press Full MF", "Release Full"])] * 2


def test_a_release_without_autofocus_that_fails_is_told_as_one(script: Script, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="the shutter did not release"):
        script(failing("press", -1), release="without-autofocus").camera.capture(EXPOSURE, tmp_path / "a.dng")


def test_a_camera_that_leaves_in_the_middle_of_a_release_is_not_taken_for_one_that_cannot_focus(
    script: Script, tmp_path: Path
) -> None:
    scripted = script(failing("trigger", -52, last=1))
    scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    assert len(scripted.calls("trigger")) == 2
    assert scripted.calls("press") == []


def test_a_card_that_is_full_after_a_frame_has_cost_no_frame(script: Script, tmp_path: Path) -> None:
    scripted = script(events("IMG_0001.CR2", other("PTP Event 400a")), release="trigger")
    assert scripted.camera.capture(EXPOSURE, tmp_path / "a.dng").settings["file"].endswith("IMG_0001.CR2")


def test_a_frozen_camera_that_is_switched_off_and_on_before_its_first_word_goes_on(
    script: Script, reported: Recorder
) -> None:
    nobody = {"op": "list", "first": 3, "last": 3, "do": "answer", "ok": []}  # off, as it was asked for
    scripted = script(failing("open", -10, last=2), nobody, return_timeout_s=0.0, power_cycle_timeout_s=5.0)
    assert scripted.camera.identify().model == "Canon EOS 650D"
    assert [event.remedy for event in reported.events] == [Remedy.RESTART, Remedy.POWER_CYCLE]


@pytest.mark.parametrize("order", [("IMG_0001.JPG", "IMG_0001.CR2"), ("IMG_0001.CR2", "IMG_0001.JPG")])
def test_of_raw_and_jpeg_the_raw_file_is_taken_whichever_comes_first(
    script: Script, tmp_path: Path, order: tuple[str, str]
) -> None:
    late = {"event": "pause", "s": 0.05}
    scripted = script(events(order[0], late, order[1]), image_format="RAW + Large Fine JPEG", release="trigger")
    result = scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    assert result.settings["file"].endswith("IMG_0001.CR2")
    assert result.path.name == "a.cr2"
    assert [call["name"] for call in scripted.calls("download")] == ["IMG_0001.CR2"]


def test_a_file_announced_twice_is_one_frame_and_no_end_of_capture_is_needed(script: Script, tmp_path: Path) -> None:
    scripted = script(events("IMG_0001.CR2", "IMG_0001.CR2"), release="trigger")
    scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    assert len(scripted.calls("download")) == 1


def test_a_late_file_of_one_frame_is_not_taken_for_the_next_one(script: Script, tmp_path: Path) -> None:
    late = {"event": "pause", "s": 0.2}
    scripted = script(events("IMG_0001.CR2", late, "IMG_0001.NEF", last=1), release="trigger")
    scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    result = scripted.camera.capture(EXPOSURE, tmp_path / "b.dng")
    assert result.settings["file"].endswith("IMG_0002.CR2")


def test_a_frame_that_is_late_beyond_patience_is_not_taken_for_the_next_one(script: Script, tmp_path: Path) -> None:
    late = {"event": "pause", "s": 0.3}
    scripted = script(events(late, late, late, "IMG_0001.CR2", last=2), release="trigger")
    with pytest.raises(CaptureError, match="no image arrived"):
        scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    result = scripted.camera.capture(EXPOSURE, tmp_path / "b.dng")
    assert result.settings["file"].endswith("IMG_0003.CR2")


def test_frames_that_come_through_memory_for_want_of_a_card_are_fetched_and_announced(
    script: Script, tmp_path: Path, reported: Recorder
) -> None:
    scripted = script(events({"event": "file", "folder": "/", "name": "capt0000.cr2"}), release="trigger")
    scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    assert any("put a card in" in event.message for event in reported.events)
    assert len(scripted.calls("delete")) == 1


def test_an_older_frame_under_the_same_name_is_never_taken_for_a_new_one(
    script: Script, tmp_path: Path, reported: Recorder
) -> None:
    scripted = script(events("IMG_0001.CR2"), release="trigger")
    scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    with pytest.raises(CaptureError, match="delivers an older frame under the same name"):
        scripted.camera.capture(EXPOSURE, tmp_path / "b.dng")
    assert tuple(event.remedy for event in reported.events) == RESPONSES[Fault.STALE_FILE].remedies
    assert not (tmp_path / "b.cr2").exists()


def test_a_mode_dial_that_does_not_stand_on_m_is_named(script: Script, tmp_path: Path) -> None:
    scripted = script(
        {"op": "widget", "name": "autoexposuremode", "widget": {"value": "P", "choices": [], "readonly": True}}
    )
    with pytest.raises(SettingError, match="mode dial stands on P; turn it to M"):
        scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")


def test_a_setting_that_reads_otherwise_than_it_was_set_stops_the_shot(script: Script, tmp_path: Path) -> None:
    slow = {"value": "1/15", "choices": ["1/15", "1/60"], "readonly": False}
    scripted = script(
        {"op": "widget", "name": "shutterspeed", "widget": slow},
        {"op": "set", "name": "shutterspeed", "do": "answer", "ok": slow},
    )
    with pytest.raises(SettingError, match="exposure time was set to 1/60, but reads 1/15"):
        scripted.camera.capture(EXPOSURE, tmp_path / "a.dng")
    assert scripted.calls("trigger") == []


def test_a_setting_that_is_reported_late_is_waited_for(script: Script, tmp_path: Path) -> None:
    before = {"value": "1/15", "choices": ["1/15", "1/60"], "readonly": False}
    scripted = script(
        {"op": "set", "name": "shutterspeed", "do": "answer", "ok": before},
        {"op": "get", "name": "shutterspeed", "do": "answer", "ok": before, "last": 2},
    )
    assert scripted.camera.capture(EXPOSURE, tmp_path / "a.dng").settings["exposure_time"] == "1/60"
    assert len(scripted.calls("trigger")) == 1


def test_raw_is_chosen_by_name_and_the_lens_and_drive_are_taken_care_of(
    script: Script, tmp_path: Path, reported: Recorder
) -> None:
    low = {"value": "10%", "choices": [], "readonly": True}
    autofocus = {"value": "One Shot", "choices": ["One Shot", "Manual"], "readonly": True}
    scripted = script(
        {"op": "widget", "name": "batterylevel", "widget": low},
        {"op": "widget", "name": "focusmode", "widget": autofocus},
        aperture=8.0,
    )
    for number in range(2):
        result = scripted.camera.capture(EXPOSURE, tmp_path / f"{number}.dng")
    assert result.settings["image_format"] == "RAW"
    assert result.settings["capture_target"] == "Memory card"
    wished = {call["name"]: call["value"] for call in scripted.calls("set")}
    assert wished["drivemode"] == "Single"
    assert wished["iso"] == "100"
    messages = [event.message for event in reported.events]
    for words in ("battery at 10%", "put the lens switch to MF", "the lens reports no aperture; f/8"):
        assert sum(words in message for message in messages) == 1, messages


def test_live_view_that_is_not_there_is_told_apart_from_trouble(script: Script) -> None:
    with pytest.raises(CameraError, match="no live view over USB"):
        script(failing("preview", -6)).camera.preview()


def test_a_library_that_is_missing_is_said_so(script: Script) -> None:
    with pytest.raises(ConfigError, match="pip install gphoto2"):
        script(failing("list", 0))


def test_a_second_interrupt_while_the_camera_is_closed_leaves_no_process_behind(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = script().camera
    process = camera._link.process
    pid = process.pid
    assert pid is not None

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(process, "call", interrupted)
    with pytest.raises(KeyboardInterrupt):
        camera.close()
    assert not Path(f"/proc/{pid}").exists()
