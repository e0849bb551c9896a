"""A bank every 20 cm, its pupil fitted."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calibration.bank import Bank
from calibration.pupil import fit_pupil
from tests.unit.depth_evidence.synthetic import make_bank


@pytest.fixture(scope="package")
def bank() -> Bank:
    made = make_bank(step_mm=200.0)
    pupil = fit_pupil(made.depths_mm, made.psf[0], made.psf_se[0], made.lens)
    return replace(made, extras=pupil.as_arrays())
