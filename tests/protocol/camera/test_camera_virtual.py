"""The driver through the whole real stack: python-gphoto2, libgphoto2, PTP, and its virtual camera."""

from __future__ import annotations

import hashlib
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

from rigs.errors import CameraError, CaptureError, DeviceNotFoundError, RigError, SettingError
from rigs.gphoto2_camera import Gphoto2Camera, discover
from rigs.gphoto2_config import CameraEvent
from rigs.gphoto2_faults import Fault, Remedy
from rigs.protocols import Camera, Exposure
from tests.protocol.camera.conftest import EXPOSURE, FRAME_BYTES, Opened, Recorder, VirtualCamera


def test_is_found_and_says_who_it_is(virtual: VirtualCamera, open_camera: Opened) -> None:
    (found,) = discover(virtual.settings.environment)
    assert (found.model, found.port) == ("Nikon DSC D750", "usb:001,001")
    camera = open_camera(virtual.settings)
    assert isinstance(camera, Camera)
    identity = camera.identify()
    assert (identity.kind, identity.model, identity.serial) == ("gphoto2", "Nikon DSC D750", "0.1")
    assert camera.exposure_times_s() == (0.0001, 0.0012, 0.0025, 0.005, 0.01, 0.02, 0.05, 0.1, 1.0)


def test_frames_come_back_byte_for_byte_with_the_exposure_read_back(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path
) -> None:
    camera = open_camera(virtual.settings)
    for number, time_s in enumerate((0.02, 0.1, 0.1)):
        data = virtual.next_frame(number)
        result = camera.capture(Exposure(time_s, 100), tmp_path / f"{number}.nef")
        assert result.path.read_bytes() == data
        assert result.sha256 == hashlib.sha256(data).hexdigest()
        assert result.bytes == len(data)
        assert result.exposure.time_s == time_s
    assert result.settings["exposure_time"] == "0.1000s"
    assert result.settings["iso"] == result.settings["image_format"] == "absent"
    assert result.settings["capture_target"] == "Memory card"
    assert not list(tmp_path.glob(".part*"))


def test_facts_for_a_check_of_the_rig(virtual: VirtualCamera, open_camera: Opened) -> None:
    facts = open_camera(virtual.settings).facts()
    assert facts["battery"] == "50%"
    assert facts["mode_dial"] == "absent"
    assert int(facts["free_images"]) > 0
    assert facts["library"].startswith("libgphoto2 2.")


@pytest.mark.parametrize(
    ("choice", "named"),
    [
        ({"model": "650D"}, "Nikon DSC D750 at usb:001,001"),
        ({"port": "usb:009,009"}, "usb:009,009"),
        ({"serial": "53123456789"}, "53123456789"),
    ],
)
def test_the_wrong_camera_is_refused_by_name(virtual: VirtualCamera, choice: dict[str, str], named: str) -> None:
    with pytest.raises(DeviceNotFoundError, match=r"correct camera\.") as caught:
        Gphoto2Camera(replace(virtual.settings, **choice))
    assert named in str(caught.value)


@pytest.mark.parametrize("choice", [{"model": "d750"}, {"port": "usb:"}, {"serial": "0.1"}])
def test_the_right_camera_is_chosen(virtual: VirtualCamera, open_camera: Opened, choice: dict[str, str]) -> None:
    assert open_camera(replace(virtual.settings, **choice)).identify().model == "Nikon DSC D750"


def test_an_exposure_that_is_not_offered_is_refused_before_the_shutter_opens(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path
) -> None:
    camera = open_camera(virtual.settings)
    with pytest.raises(SettingError, match=r"no exposure of 0.008 s; nearest is 0.0100s"):
        camera.capture(Exposure(0.008, 100), tmp_path / "a.nef")
    assert not (tmp_path / "a.nef").exists()


def test_a_value_that_the_camera_snaps_is_noticed(virtual: VirtualCamera, open_camera: Opened) -> None:
    camera = open_camera(virtual.settings)
    camera.exposure_times_s()
    with pytest.raises(SettingError, match=r"was set to 0.0080s, but reads 0.0100s"):
        camera._setup._set("exposure_time", "0.0080s", lambda chosen, read: chosen == read)


def test_settings_that_may_not_be_absent_are_an_error(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path
) -> None:
    camera = open_camera(replace(virtual.settings, may_be_absent=("image_format",)))
    with pytest.raises(SettingError, match=r"no setting for iso"):
        camera.capture(EXPOSURE, tmp_path / "a.nef")


def test_live_view_is_refused_in_words(virtual: VirtualCamera, open_camera: Opened, tmp_path: Path) -> None:
    camera = open_camera(virtual.settings)
    with pytest.raises(CameraError, match="no live view"):
        camera.preview()
    assert camera.capture(EXPOSURE, tmp_path / "a.nef").bytes


def test_a_full_card_stops_at_once_and_a_fresh_process_goes_on(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path, reported: Recorder
) -> None:
    camera = open_camera(virtual.settings)
    for number in range(26):
        camera.capture(EXPOSURE, tmp_path / f"{number}.nef")
    with pytest.raises(CameraError, match="no space for another frame: put in an empty card") as caught:
        camera.capture(EXPOSURE, tmp_path / "full.nef")
    assert not isinstance(caught.value, CaptureError)  # taking the frame again can't help
    assert reported.events == []
    assert not (tmp_path / "full.nef").exists()
    camera.close()
    assert open_camera(virtual.settings).capture(EXPOSURE, tmp_path / "more.nef").bytes


def test_the_blocking_capture_meets_a_full_card_too(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path
) -> None:
    camera = open_camera(replace(virtual.settings, release="capture"))
    assert camera.capture(EXPOSURE, tmp_path / "first.nef").path.read_bytes() == virtual.frame.read_bytes()
    for _ in range(25):
        camera._link.call("capture")
    with pytest.raises(CameraError, match=r"no space for another frame.*-3"):
        camera.capture(EXPOSURE, tmp_path / "full.nef")


def test_a_process_that_is_renewed_in_time_takes_any_number_of_frames(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path, reported: Recorder
) -> None:
    camera = open_camera(replace(virtual.settings, restart_every=9))
    pids = set()
    for number in range(30):
        camera.capture(EXPOSURE, tmp_path / f"{number}.nef")
        pids.add(camera.worker_pid)
    assert len(pids) == 4
    assert reported.events == []


@pytest.mark.parametrize("damage", ["missing", "short"])
def test_a_frame_that_is_missing_or_short_is_reported_and_the_next_one_works(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path, reported: Recorder, damage: str
) -> None:
    def whole(path: Path) -> None:
        if path.stat().st_size != FRAME_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes")

    camera = open_camera(virtual.settings, validate=whole)
    camera.capture(EXPOSURE, tmp_path / "before.nef")
    if damage == "missing":
        virtual.frame.rename(tmp_path / "away")
    else:
        virtual.frame.write_bytes(b"short")
    with pytest.raises(CaptureError, match="camera: "):
        camera.capture(EXPOSURE, tmp_path / "bad.nef")
    assert reported.events
    assert not (tmp_path / "bad.nef").exists()
    assert not list(tmp_path.glob(".part*"))
    data = virtual.next_frame(7)
    assert camera.capture(EXPOSURE, tmp_path / "after.nef").path.read_bytes() == data


def test_a_frame_restored_while_the_driver_tries_is_delivered(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path, reported: Recorder
) -> None:
    camera = open_camera(virtual.settings)
    data = virtual.frame.read_bytes()
    virtual.frame.unlink()
    reported.then = lambda: virtual.frame.write_bytes(data)
    assert camera.capture(EXPOSURE, tmp_path / "a.nef").path.read_bytes() == data
    assert len(reported.events) == 1


def test_a_crash_inside_the_library_is_survived(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path, reported: Recorder
) -> None:
    camera = open_camera(virtual.settings)
    camera.capture(EXPOSURE, tmp_path / "before.nef")
    with pytest.raises(RigError, match="libgphoto2 crashed"):
        # An aperture that this camera accepts and can't read back: the library dies of it.
        camera._attempt(lambda: camera._link.set("f-number", "f/1.2"))
    assert [event.remedy for event in reported.events] == [Remedy.RESTART, Remedy.RESTART]
    assert "SIG" in reported.events[0].message
    assert camera.capture(EXPOSURE, tmp_path / "after.nef").bytes


def test_a_call_that_hangs_is_killed_in_time_and_the_frame_is_taken_after_all(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path, reported: Recorder
) -> None:
    camera = open_camera(replace(virtual.settings, call_timeout_s=2.0))
    camera.capture(EXPOSURE, tmp_path / "before.nef")
    stopped = camera.worker_pid
    assert stopped is not None
    os.kill(stopped, signal.SIGSTOP)
    started = time.monotonic()
    result = camera.capture(EXPOSURE, tmp_path / "after.nef")
    assert time.monotonic() - started < 15
    assert result.path.read_bytes() == virtual.frame.read_bytes()
    assert reported.faults == [Fault.HUNG]
    assert camera.worker_pid != stopped
    with pytest.raises(ProcessLookupError):
        os.kill(stopped, 0)


def test_a_frame_that_cannot_be_decoded_never_gets_its_name(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path, reported: Recorder
) -> None:
    seen: list[Path] = []

    def decode(path: Path) -> None:
        seen.append(path)
        assert path.read_bytes() == virtual.frame.read_bytes()
        raise ValueError("all pixels are zero")

    camera = open_camera(virtual.settings, validate=decode)
    with pytest.raises(CaptureError, match=r"can't be used.*all pixels are zero"):
        camera.capture(EXPOSURE, tmp_path / "a.nef")
    assert seen[0].suffix == ".nef"
    assert seen[0].parent == tmp_path
    assert list(tmp_path.glob("*.nef")) == []
    assert [event.remedy for event in reported.events] == [Remedy.AGAIN, Remedy.SHOOT_AGAIN]


def test_settings_kept_by_the_library_are_set_again_in_every_process(
    virtual: VirtualCamera, open_camera: Opened, tmp_path: Path
) -> None:
    memory = open_camera(replace(virtual.settings, capture_target="memory"))
    assert memory.capture(EXPOSURE, tmp_path / "a.nef").settings["capture_target"] == "Internal RAM"
    memory.close()
    card = open_camera(virtual.settings)
    assert card.capture(EXPOSURE, tmp_path / "b.nef").settings["capture_target"] == "Memory card"


def test_events_read_as_one_line_each() -> None:
    assert str(CameraEvent("camera: busy")) == "camera: busy"
