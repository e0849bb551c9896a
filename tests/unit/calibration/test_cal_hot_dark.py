"""A photosite that long exposures drive to white in the dark too is neither light nor saturation."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.image import FrameInfo, LinearImage
from calibration.raw import subtract_dark


def frame(planes: np.ndarray) -> LinearImage:
    return LinearImage(planes, planes.max(axis=2) >= 0.99, "superpixel", 0.0086, FrameInfo("made.dng", ""))


def test_photosite_that_is_hot_in_the_dark_gets_its_neighbours_value_and_is_not_saturated() -> None:
    light, dark = np.full((9, 9, 3), 0.4, np.float32), np.full((9, 9, 3), 0.02, np.float32)
    light[4, 5, 1], dark[4, 5, 1] = 1.0, 0.7
    light[2, 2] = 1.0  # too much light, and nothing in the dark
    cleaned = subtract_dark(frame(light), frame(dark))
    assert not cleaned.saturated[4, 5]
    assert cleaned.planes[4, 5].tolist() == pytest.approx([0.38, 0.38, 0.38])
    assert cleaned.saturated[2, 2]
    assert cleaned.planes[2, 2, 0] == pytest.approx(0.98)
