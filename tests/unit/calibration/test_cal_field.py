"""Banks over the field: what is blended where, and what stays as it was."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.field import bank_at, central_bank, places_of, region_place
from calibration.lens_fit import LensFit

DEPTHS_MM = np.array([600.0, 1000.0, 3000.0])
LENS = LensFit(
    focus_mm=1600.0, focus_se_mm=1.0, scale_px=20.0, scale_se_px=0.02, zero_mm=0.0, zero_se_mm=1.0,
    radius_px=20.0 * (1 - 1600.0 / DEPTHS_MM), radius_se_px=np.full(3, 0.01), residual_px=np.zeros(3),
    zero_applied=True, suspect=(False,) * 3,
)  # fmt: skip


def field_bank(places_yx: list[tuple[float, float]], **extras: NDArray[Any]) -> Bank:
    """A bank whose sets are single bright pixels, each with its own share in the centre and the rest beside it."""
    psf = np.zeros((len(places_yx), 3, 7, 7), np.float32)
    for f in range(len(places_yx)):
        psf[f, :, 3, 3] = 0.1 * (f + 1)
        psf[f, :, 3, 5] = 1 - 0.1 * (f + 1)
    return Bank(DEPTHS_MM, psf, 0.01 * psf, np.array(places_yx), LENS, "superpixel", 0.0086, extras=extras)


SQUARE = [(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)]


def test_a_central_bank_is_used_as_it_is() -> None:
    bank = field_bank([(0.0, 0.0)])
    assert bank_at(bank, (0.7, -0.3)) is bank
    assert central_bank(bank) is bank


@pytest.mark.parametrize(
    ("place", "share"),
    [((-0.5, -0.5), 0.1), ((0.5, -0.5), 0.3), ((0.0, 0.0), 0.25), ((-0.5, 0.25), 0.175), ((0.9, 0.9), 0.4)],
)
def test_sets_are_blended_bilinearly_and_not_beyond_the_grid(place: tuple[float, float], share: float) -> None:
    found = bank_at(field_bank(SQUARE), place)
    assert found.psf.shape == (1, 3, 7, 7)
    np.testing.assert_allclose(found.psf[0, :, 3, 3], share, rtol=1e-5)
    np.testing.assert_allclose(found.psf.sum(axis=(2, 3)), 1.0, rtol=1e-5)


def test_a_grid_that_shrinks_with_depth_is_read_at_each_depths_own_places() -> None:
    places = np.stack([np.array(SQUARE), np.array(SQUARE), 0.5 * np.array(SQUARE)], axis=1)
    bank = field_bank(SQUARE, place_yx=places)
    np.testing.assert_array_equal(places_of(bank), places)
    shares = bank_at(bank, (0.0, 0.25)).psf[0, :, 3, 3]
    np.testing.assert_allclose(shares, [0.275, 0.275, 0.3], rtol=1e-5)


def test_chief_rays_coincide_before_sets_are_blended() -> None:
    chief = np.zeros((4, 3, 2))
    chief[1:, :, 1] = 1.0  # their point is a pixel further right
    shifted = field_bank(SQUARE, chief_yx=chief)
    found = bank_at(shifted, (-0.5, -0.1))
    np.testing.assert_allclose(found.extras["chief_yx"][0, :, 1], 0.0)
    np.testing.assert_allclose(found.psf[0, :, 3, 2], 0.4 * 0.2, rtol=1e-5)


def test_points_that_form_no_grid_give_the_nearest_set() -> None:
    found = bank_at(field_bank([(-0.5, -0.5), (-0.5, 0.5), (0.5, 0.0)]), (0.4, 0.1))
    np.testing.assert_allclose(found.psf[0, :, 3, 3], 0.3, rtol=1e-5)


def test_what_was_learned_of_the_axis_pupil_is_not_used_off_axis() -> None:
    extras = {"aperture": np.ones((3, 3)), "evidence_learned": np.ones(2)}
    assert set(bank_at(field_bank(SQUARE, **extras), (0.5, 0.5)).extras) == {"evidence_learned", "chief_yx"}


def test_the_central_set_alone_is_a_bank() -> None:
    bank = field_bank([(0.0, 0.6), (0.0, 0.0), (0.0, -0.6)], chief_yx=np.zeros((3, 3, 2)), place_yx=np.zeros((3, 3, 2)))
    aperture = {"core_px": [0.3, 0.4, 0.5], "core_wings": [0.0, 0.1, 0.2], "radius_mm": 7.0}
    alone = central_bank(replace(bank, manifest={"aperture": aperture}))
    assert alone.manifest["aperture"] == {"core_px": [0.4], "core_wings": [0.1], "radius_mm": 7.0}
    np.testing.assert_array_equal(alone.psf, bank.psf[1:2])
    assert set(alone.extras) == {"chief_yx"}
    assert alone.extras["chief_yx"].shape == (1, 3, 2)


def test_a_regions_place_is_its_centroid() -> None:
    mask = np.zeros((100, 200), np.bool_)
    mask[75:, :50] = True
    assert region_place(mask) == pytest.approx((0.75, -0.75))
