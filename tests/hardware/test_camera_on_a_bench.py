"""A real camera on USB, named by WORKBENCH_TEST_CAMERA: part of its model's name, or ``any``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.raw import develop
from rigs.errors import CameraError
from rigs.gphoto2_camera import Gphoto2Camera
from rigs.gphoto2_config import Gphoto2Settings
from rigs.protocols import Exposure
from workbench.frame_reader import FrameReader

NAME = os.environ.get("WORKBENCH_TEST_CAMERA", "")
pytestmark = [
    pytest.mark.hardware,
    pytest.mark.skipif(not NAME, reason="WORKBENCH_TEST_CAMERA names no camera (a part of its model's name, or any)"),
]


@pytest.fixture(scope="module")
def camera() -> Iterator[Gphoto2Camera]:
    settings = Gphoto2Settings(model="" if NAME == "any" else NAME)
    opened = Gphoto2Camera(settings, validate=FrameReader(None).check)
    yield opened
    opened.close()


def test_it_says_who_it_is(camera: Gphoto2Camera) -> None:
    identity = camera.identify()
    assert identity.kind == "gphoto2"
    assert identity.model


def test_times_are_offered_in_order(camera: Gphoto2Camera) -> None:
    times = camera.exposure_times_s()
    assert len(times) > 10
    assert all(a < b for a, b in pairwise(times))


def test_longer_exposures_are_brighter_and_every_frame_is_whole(camera: Gphoto2Camera, tmp_path: Path) -> None:
    isos = camera.isos()
    levels = []
    for number, wanted in enumerate((1 / 250, 1 / 60, 1 / 15)):
        time_s = min(camera.exposure_times_s(), key=lambda offered: abs(np.log(offered / wanted)))
        result = camera.capture(Exposure(time_s, isos[0] if isos else 100), tmp_path / f"frame-{number}.cr2")
        assert result.exposure.time_s == pytest.approx(time_s, rel=0.2)
        assert result.path.stat().st_size == result.bytes
        levels.append(float(np.median(develop(result.path).luminance)))
    assert levels[0] < levels[1] < levels[2] or levels[-1] > 0.95, "point the camera at something lit, not saturated"


def test_ten_frames_in_a_row_are_ten_different_ones(camera: Gphoto2Camera, tmp_path: Path) -> None:
    time_s = min(camera.exposure_times_s(), key=lambda offered: abs(offered - 1 / 60))
    hashes = {camera.capture(Exposure(time_s, 100), tmp_path / f"shot-{n}.cr2").sha256 for n in range(10)}
    assert len(hashes) == 10


def test_live_view_is_a_picture(camera: Gphoto2Camera) -> None:
    try:
        jpeg = camera.preview()
    except CameraError as error:
        if "no live view" not in str(error):
            raise
        pytest.skip(str(error))
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert min(picture.shape[:2]) > 100
