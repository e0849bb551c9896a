"""The pupil model gives the PSF between the planes, and says what it leaves over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.bank import Bank
from calibration.errors import BankError
from calibration.pupil import (
    BetweenPlanes,
    PsfInterpolator,
    PupilModel,
    between_planes,
    fit_pupil,
    interpolator_of_bank,
    psf_model,
    pupil_of_bank,
)
from calibration.render import Core
from tests.unit.depth_evidence.synthetic import draw_psf, make_bank, with_pupil


@pytest.fixture(scope="module")
def bank() -> Bank:
    return make_bank(step_mm=400.0)


@pytest.fixture(scope="module")
def pupil(bank: Bank) -> PupilModel:
    return fit_pupil(bank.depths_mm, bank.psf[0], bank.psf_se[0], bank.lens)


def misfit(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(((a - b) ** 2).sum() / (b**2).sum()))


@pytest.mark.parametrize("depth_mm", [800.0, 1000.0, 2500.0, 3300.0])
def test_psf_between_planes_40_cm_apart_matches_a_drawn_one(pupil: PupilModel, depth_mm: float) -> None:
    assert misfit(pupil.psf_at(depth_mm, 41), draw_psf(depth_mm)) < 0.15


def test_pupil_beats_blending_neighbours_between_distant_planes(bank: Bank, pupil: PupilModel) -> None:
    blend = interpolator_of_bank(bank, 0)
    assert misfit(pupil.psf_at(900.0, 41), draw_psf(900.0)) < misfit(blend.psf_at(900.0, 41), draw_psf(900.0))


@pytest.mark.parametrize("depth_mm", [1400.0, 1500.0, 1700.0, 1900.0])
def test_psf_drawn_for_photosites_matches_a_drawn_one(pupil: PupilModel, depth_mm: float) -> None:
    """Its aperture's shape is known from large blurs: planes 40 cm apart hold nothing of it next to focus."""
    fine = pupil.finer(2).psf_at(depth_mm, 41)
    assert misfit(fine, draw_psf(depth_mm, per_superpixel=2)) < 0.2


def test_near_psf_is_the_far_one_turned_over(pupil: PupilModel) -> None:
    depth_mm = 2400.0
    mirror_mm = 1 / (2 / 1600.0 - 1 / depth_mm)
    assert misfit(pupil.psf_at(mirror_mm)[::-1, ::-1], pupil.psf_at(depth_mm)) < 0.15


def test_outline_that_changes_with_depth_falls_back_to_interpolation(bank: Bank) -> None:
    psf = np.array(bank.psf)
    for i in range(0, psf.shape[1], 2):  # every second plane is another aperture
        psf[0, i] = np.rot90(psf[0, i])
    broken = Bank(bank.depths_mm, psf, bank.psf_se, bank.field_yx, bank.lens, bank.recipe, bank.pixel_pitch_mm)
    pupil = fit_pupil(broken.depths_mm, broken.psf[0], broken.psf_se[0], broken.lens)
    assert np.median(pupil.residual) > 0.15
    blend = PsfInterpolator(broken.depths_mm, broken.psf[0], (13.0, -20800.0), np.zeros((broken.depths_mm.size, 2)))
    np.testing.assert_allclose(blend.psf_at(float(broken.depths_mm[1])), psf[0, 1].clip(0), atol=5e-3)


def test_a_stage_that_sways_is_no_error_of_the_psf(bank: Bank) -> None:
    """Windows are cut about whole pixels: places jump from plane to plane, shapes stay."""
    plain = with_pupil(bank)
    steps = np.array([(i % 3 - 1, i % 2) for i in range(bank.depths_mm.size)])
    psf = np.array([[np.roll(p, step, axis=(0, 1)) for p, step in zip(bank.psf[0], steps, strict=True)]])
    swaying = replace(plain, psf=psf, extras={**plain.extras, "chief_yx": plain.extras["chief_yx"] + steps})
    fitted_anew = replace(swaying, extras={})
    still = pupil_of_bank(plain)
    for moved in (swaying, fitted_anew):
        np.testing.assert_allclose(pupil_of_bank(moved).residual, still.residual, rtol=0.1, atol=2e-3)
    blends = [interpolator_of_bank(each, 0) for each in (swaying, plain)]
    np.testing.assert_allclose(blends[0].residual, blends[1].residual, rtol=0.1, atol=2e-3)
    lost = [misfit(blend.psf_about((0.0, 0.0), 900.0), draw_psf(900.0)) for blend in blends]
    assert lost[0] == pytest.approx(lost[1], rel=0.02)


@pytest.mark.parametrize(
    ("aperture", "core"),
    [({"core_px": [0.3], "core_wings": [0.1]}, Core(0.3, 0.1)), ({"core_px": [0.3]}, Core(0.3))],
)
def test_the_core_that_a_bank_names_is_taken(bank: Bank, aperture: dict[str, list[float]], core: Core) -> None:
    named = with_pupil(bank)
    assert pupil_of_bank(replace(named, manifest={**named.manifest, "aperture": aperture})).core == core


@pytest.mark.parametrize("wings", [-0.1, 1.7])
def test_wings_of_more_or_less_than_the_light_are_refused(bank: Bank, wings: float) -> None:
    aperture = {"core_px": [0.3], "core_wings": [wings]}
    with pytest.raises(BankError, match=f"gives {wings:g} of the light .* calibrate again"):
        pupil_of_bank(replace(with_pupil(bank), manifest={"aperture": aperture}))


def test_where_psfs_between_the_planes_come_from_is_told(bank: Bank) -> None:
    told = between_planes(bank)
    assert told is not None
    assert told.source == "pupil"
    assert 0 < told.residual < 0.15
    psf, generator = np.array(bank.psf), np.random.default_rng(1)
    for i in range(psf.shape[1]):  # alike from plane to plane, and nothing that scales
        psf[0, i] = np.roll(draw_psf(900.0), i, axis=0)
        psf[0, i] += 1e-6 * generator.random(psf[0, i].shape).astype(np.float32)
    odd = Bank(bank.depths_mm, psf, bank.psf_se, bank.field_yx, bank.lens, bank.recipe, bank.pixel_pitch_mm)
    assert between_planes(odd) == BetweenPlanes("interpolation", float(np.median(psf_model(odd).residual)))
    few = Bank(bank.depths_mm[:2], psf[:, :2], bank.psf_se[:, :2], bank.field_yx, bank.lens, bank.recipe,
               bank.pixel_pitch_mm)  # fmt: skip
    assert between_planes(few) is None


def test_bank_without_aperture_picture_is_fitted_anew(bank: Bank) -> None:
    assert isinstance(psf_model(bank), PupilModel)
