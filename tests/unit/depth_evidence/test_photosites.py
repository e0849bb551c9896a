"""Next to focus, where superpixels mix up what tells the sides apart, the photosites tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.bank import Bank
from calibration.image import LinearImage
from calibration.mosaic import Mosaic, superpixels
from tests.unit.depth_evidence.synthetic import HALF, as_image, leaves, make_bank, photograph_mosaic, with_pupil
from workbench.depth.estimate import DepthEstimate
from workbench.depth.evidence import EvidenceOptions, estimate_evidence
from workbench.depth.evidence_periodogram import Pooled
from workbench.depth.evidence_spectrum import SpectralFit
from workbench.depth.evidence_view import View, joined_likelihood
from workbench.depth.evidence_windows import Window, thinned
from workbench.depth.regions import whole

SIDE = 2 * 128 + 2 * HALF
NEAR_FOCUS_MM = (1430.0, 1480.0, 1720.0, 1780.0)


@pytest.fixture(scope="module")
def bank() -> Bank:
    return with_pupil(make_bank())


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


def test_far_from_focus_photosites_change_nothing(bank: Bank) -> None:
    far = photograph_mosaic(leaves(SIDE, 5), 2600.0)
    assert measured(far, bank).depth_mm == measured(far, bank, EvidenceOptions(native_px=0.0)).depth_mm


@pytest.mark.parametrize("corner", [(0, 0), (37, 51), (132, 92)])
def test_region_is_found_among_the_photosites_wherever_it_lies(
    bank: Bank, images: dict[float, LinearImage], corner: tuple[int, int]
) -> None:
    """Its surroundings are of another depth, sharp: photosites of another place would be in focus."""
    image, (top, left) = images[1430.0], corner
    around = photograph_mosaic(leaves(2 * 260 + 2 * HALF, 9), 1600.0)
    assert image.mosaic is not None
    assert around.mosaic is not None
    sites, planes, labels = around.mosaic.photosites.copy(), around.planes.copy(), np.zeros(around.shape, np.int32)
    height, width = image.shape
    sites[2 * top : 2 * (top + height), 2 * left : 2 * (left + width)] = image.mosaic.photosites
    planes[top : top + height, left : left + width] = image.planes
    labels[top : top + height, left : left + width] = 1
    pasted = replace(as_image(planes), mosaic=replace(around.mosaic, photosites=sites))
    found = estimate_evidence(pasted, bank, labels)[1]
    assert abs(found.depth_mm - 1430.0) < 30.0
    assert found.interval_mm[0] <= 1430.0 <= found.interval_mm[1]


@pytest.mark.parametrize("seed", [3, 4])
def test_colours_that_would_pass_for_detail_leave_the_photosites_alone(bank: Bank, seed: int) -> None:
    """Every channel a texture of its own: what lies on the filters' carriers looks sharp, and so in focus."""
    channels = [photograph_mosaic(leaves(SIDE, 1000 * k + seed), 1440.0).mosaic for k in (1, 2, 3)]
    red, green, blue = (mosaic.photosites for mosaic in channels if mosaic is not None)
    sites = green.copy()
    sites[0::2, 0::2], sites[1::2, 1::2] = red[0::2, 0::2], blue[1::2, 1::2]
    assert channels[0] is not None
    mosaic = replace(channels[0], photosites=sites)
    image = replace(as_image(superpixels(mosaic)[0]), mosaic=mosaic)
    found = measured(image, bank)
    assert found.interval_mm[0] <= 1440.0 <= found.interval_mm[1]
    assert found.depth_mm == measured(replace(image, mosaic=None), bank).depth_mm


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


def test_few_windows_are_spread_over_a_region() -> None:
    taper = np.ones((8, 8), np.float32)
    grid = [Window(4 * row, 4 * column, taper, 1.0) for row in range(5) for column in range(5)]
    assert thinned(grid, 30) == grid
    assert {(w.row, w.column) for w in thinned(grid, 5)} == {(8, 8), (0, 0), (0, 16), (16, 0), (16, 16)}
    assert [(w.row, w.column) for w in thinned(grid, 1)] == [(8, 8)]


def seen(log_likelihood: list[float]) -> View:
    """A view of which nothing but the fits' likelihood counts."""
    values, empty = np.array(log_likelihood), np.zeros(0, np.float32)
    fit = SpectralFit(values, 0.0, np.zeros((values.size, 0)), np.zeros(values.size), ())
    return View(empty, empty, empty, [], Pooled(np.zeros((0, 0)), 1.0, np.zeros((0, 0)), 0.3), fit)


def test_photosites_give_the_shape_next_to_focus_and_superpixels_its_level() -> None:
    superpixels = seen([-10.0, -12.0, -30.0, -31.0, -32.0, -60.0])
    joined = joined_likelihood(superpixels, seen([100.0, 90.0, 80.0, 79.0, 78.0]))
    np.testing.assert_allclose(joined, [-10.0, -20.0, -30.0, -31.0, -32.0, -60.0])


def test_photosites_lift_no_blur_next_to_focus_far_over_a_larger_one() -> None:
    """Their last rows fit badly where the blur is larger than all of them."""
    superpixels = seen([-37.0, -32.0, -80.0, -70.0, -60.0, 0.0])
    joined = joined_likelihood(superpixels, seen([90.0, 100.0, 10.0, 5.0, 0.0]))
    np.testing.assert_allclose(joined, [-32.0, -22.0, -112.0, -117.0, -122.0, 0.0])
