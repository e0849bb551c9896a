"""Next to focus, where superpixels mix up what tells the sides apart, the photosites tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.bank import Bank
from calibration.image import LinearImage
from calibration.mosaic import Mosaic
from calibration.pupil import fit_pupil
from tests.unit.depth_evidence.synthetic import HALF, leaves, make_bank, photograph_mosaic
from workbench.depth.estimate import DepthEstimate
from workbench.depth.evidence import EvidenceOptions, estimate_evidence
from workbench.depth.regions import whole

SIDE = 2 * 128 + 2 * HALF
NEAR_FOCUS_MM = (1430.0, 1480.0, 1720.0, 1780.0)


@pytest.fixture(scope="module")
def bank() -> Bank:
    made = make_bank()
    pupil = fit_pupil(made.depths_mm, made.psf[0], made.psf_se[0], made.lens)
    return replace(made, extras=pupil.as_arrays())


@pytest.fixture(scope="module")
def images() -> dict[float, LinearImage]:
    return {z: photograph_mosaic(leaves(SIDE, int(z)), z) for z in NEAR_FOCUS_MM}


def measured(image: LinearImage, bank: Bank, options: EvidenceOptions | None = None) -> DepthEstimate:
    return estimate_evidence(image, bank, whole(image.shape), options)[1]


def test_side_and_depth_are_known_where_superpixels_leave_them_open(
    bank: Bank, images: dict[float, LinearImage]
) -> None:
    fine = [measured(images[z], bank) for z in NEAR_FOCUS_MM]
    coarse = [measured(images[z], bank, EvidenceOptions(native_px=0.0)) for z in NEAR_FOCUS_MM]
    for z, found in zip(NEAR_FOCUS_MM, fine, strict=True):
        assert abs(found.depth_mm - z) < 30.0
        assert found.interval_mm[0] <= z <= found.interval_mm[1]
        assert found.status == "ok"
    widths = [[np.ptp(found.interval_mm) for found in some] for some in (fine, coarse)]
    assert np.mean(widths[0]) < 0.6 * np.mean(widths[1])


def test_photosites_without_details_of_their_own_are_not_looked_at(
    bank: Bank, images: dict[float, LinearImage]
) -> None:
    """Far from focus nothing changes either."""
    far = photograph_mosaic(leaves(SIDE, 5), 2600.0)
    assert measured(far, bank).depth_mm == measured(far, bank, EvidenceOptions(native_px=0.0)).depth_mm
    plain = replace(images[1430.0], mosaic=None)
    assert measured(plain, bank).depth_mm == measured(plain, bank, EvidenceOptions(native_px=0.0)).depth_mm


def test_coloured_light_is_made_grey_first(bank: Bank, images: dict[float, LinearImage]) -> None:
    image = images[1430.0]
    assert image.mosaic is not None
    sites = image.mosaic.photosites.astype(np.float64) - 512
    sites[0::2, 0::2] *= 0.5
    sites[1::2, 1::2] *= 0.7
    mosaic = replace(image.mosaic, photosites=np.rint(sites + 512).astype(np.uint16))
    tinted = replace(image, planes=image.planes * np.array([0.5, 1.0, 0.7], np.float32), mosaic=mosaic)
    assert abs(measured(tinted, bank).depth_mm - measured(image, bank).depth_mm) < 10.0


def test_dark_channel_leaves_the_photosites_alone(bank: Bank, images: dict[float, LinearImage]) -> None:
    """Red light only: the other photosites hold nothing that could be made grey."""
    image = images[1780.0]
    assert image.mosaic is not None
    sites = np.full_like(image.mosaic.photosites, 512)
    sites[0::2, 0::2] = image.mosaic.photosites[0::2, 0::2]
    red = replace(image, planes=image.planes * np.array([1, 0, 0], np.float32), mosaic=Mosaic(
        sites, image.mosaic.pattern, image.mosaic.blacks, image.mosaic.white))  # fmt: skip
    assert measured(red, bank).depth_mm == measured(replace(red, mosaic=None), bank).depth_mm
