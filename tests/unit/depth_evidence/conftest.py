"""A bank every 20 cm, its pupil fitted."""

from __future__ import annotations

import pytest

from calibration.bank import Bank
from tests.unit.depth_evidence.synthetic import make_bank, with_pupil


@pytest.fixture(scope="package")
def bank() -> Bank:
    return with_pupil(make_bank(step_mm=200.0))
