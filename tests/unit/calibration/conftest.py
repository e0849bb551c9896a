from __future__ import annotations

from pathlib import Path

import pytest
from drawn_points import DEPTHS_MM, point_image

from calibration.build import BuiltBank, PointFrame, build_bank


@pytest.fixture(scope="session")
def built() -> BuiltBank:
    return build_bank([PointFrame(z, (point_image(z),)) for z in DEPTHS_MM])


@pytest.fixture
def shared() -> Path:
    path = Path(__file__).parents[4] / "shared" / "pathtraced"
    if not path.is_dir():
        pytest.skip(f"{path} is not here")
    return path
