"""What align says of a point: where, how wide, and what is wrong with the frame."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.image import FrameInfo, LinearImage
from rigs.protocols import Exposure
from workbench.alignment import look, only_show, preview_image

SHAPE = (240, 320)


def frame(light: NDArray[np.float64]) -> LinearImage:
    noisy = light[..., np.newaxis] + 0.001 * np.random.default_rng(0).standard_normal((*light.shape, 3))
    planes = np.clip(noisy, None, 1.0).astype(np.float32)
    return LinearImage(planes, planes.max(axis=2) >= 0.99, "superpixel", 0.0086, FrameInfo("made.dng", ""))


def disc(x: float, y: float, radius: float, level: float = 0.6) -> NDArray[np.float64]:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return level * np.clip(radius + 0.5 - np.hypot(rows - y, columns - x), 0.0, 1.0)


@pytest.mark.parametrize(("x", "y", "radius"), [(100.0, 80.0, 6.0), (159.5, 119.5, 12.0), (250.3, 40.6, 4.0)])
def test_disc_is_found_where_it_is_and_as_wide_as_it_is(x: float, y: float, radius: float) -> None:
    sample = look(frame(disc(x, y, radius)), Exposure(0.01, 100))
    assert sample.centroid_px == pytest.approx((x, y), abs=0.1)
    assert sample.offset_px() == pytest.approx((x - 159.5, y - 119.5), abs=0.1)
    assert sample.width_px == pytest.approx(np.sqrt(2.0) * radius, rel=0.06)  # twice the root mean square radius
    assert sample.peak == pytest.approx(0.6, abs=0.01)
    assert sample.saturated_px == 0
    assert sample.note == ""
    assert sample.exposure_s == 0.01
    assert sample.crop_px is not None
    picture = cv2.imdecode(np.frombuffer(sample.image, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    left, top = sample.crop_px[:2]
    rows, columns = np.nonzero(picture > 200)
    assert (columns.mean() + left, rows.mean() + top) == pytest.approx((x, y), abs=0.5)


def test_saturated_point_is_still_located_and_says_what_to_do() -> None:
    sample = look(frame(disc(120.0, 100.0, 8.0, level=3.0)), None)
    assert sample.centroid_px == pytest.approx((120.0, 100.0), abs=0.3)
    assert sample.saturated_px > 100
    assert "shorten the exposure" in sample.note


def test_hot_pixels_are_no_saturated_point() -> None:
    image = frame(disc(120.0, 100.0, 12.0))
    image.planes[[30, 101], [40, 118], 0] = 1.0
    image.saturated[[30, 101], [40, 118]] = True
    sample = look(image, None)
    assert (sample.saturated_px, sample.note) == (0, "")
    image.planes[80:120, 100:140] = 0.0
    image.saturated[101, 118] = False
    assert look(image, None).saturated_px == 0


def test_dark_frame_has_no_point_and_says_so() -> None:
    sample = look(frame(np.zeros(SHAPE)), None)
    assert sample.centroid_px is None
    assert sample.width_px is None
    assert "no point" in sample.note


def test_other_patterns_are_shown_and_not_measured() -> None:
    sample = only_show(frame(disc(100.0, 80.0, 6.0)), "cross-hair", None)
    assert sample.centroid_px is None
    assert sample.task.startswith("cross-hair: turn the camera")
    assert sample.image


def test_live_view_is_read_as_linear_light() -> None:
    jpeg = cv2.imencode(".jpg", np.full((40, 60, 3), 128, np.uint8))[1].tobytes()
    image = preview_image(jpeg)
    assert image is not None
    assert image.shape == (40, 60)
    assert float(image.planes.mean()) == pytest.approx((128 / 255) ** 2.2, abs=0.01)
    assert preview_image(b"no picture") is None
