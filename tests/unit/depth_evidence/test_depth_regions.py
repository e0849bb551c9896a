"""Regions of one depth each: what the blur splits, what it joins."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.bank import Bank
from calibration.image import LinearImage
from tests.unit.depth_evidence.synthetic import FOCUS_MM, as_image, leaves, photograph
from workbench.depth.depth_regions import regions_of_one_depth

SIDE = 300


def side_by_side(left_mm: float, right_mm: float) -> LinearImage:
    """Two planes of the same greys that meet in the middle."""
    left, right = (photograph(leaves(SIDE + 40, seed), depth).planes for seed, depth in ((3, left_mm), (4, right_mm)))
    return as_image(np.concatenate([left, right], axis=1))


def tiles(image: LinearImage, side: int = 20) -> np.ndarray:
    """Small square regions instead of those found by colour."""
    rows, columns = (np.arange(n) // side for n in image.shape)
    return np.asarray(1 + rows[:, np.newaxis] * (columns[-1] + 1) + columns, np.int32)


def halves(labels: np.ndarray) -> tuple[int, int, float]:
    """Commonest label left and right, and how much of the halves they cover."""
    middle = labels.shape[1] // 2
    parts = labels[:, :middle], labels[:, middle:]
    counts = [np.bincount(part.ravel()) for part in parts]
    covered = sum(count.max() for count in counts) / labels.size
    return int(counts[0].argmax()), int(counts[1].argmax()), float(covered)


def test_surfaces_of_one_colour_and_two_depths_become_two_regions(bank: Bank) -> None:
    image = side_by_side(2900.0, 1300.0)
    left, right, covered = halves(regions_of_one_depth(image, bank, tiles(image)))
    assert left != right
    assert covered > 0.85


def test_mirror_depths_with_the_same_blur_become_two_regions(bank: Bank) -> None:
    mirror_mm = 1.0 / (2.0 / FOCUS_MM - 1.0 / 2600.0)
    image = side_by_side(2600.0, mirror_mm)
    left, right, covered = halves(regions_of_one_depth(image, bank, tiles(image)))
    assert left != right
    assert covered > 0.8


@pytest.mark.parametrize("depth_mm", [2000.0, 2600.0])
def test_surface_of_one_depth_becomes_one_region(bank: Bank, depth_mm: float) -> None:
    image = photograph(leaves(2 * SIDE, 5), depth_mm)
    labels = regions_of_one_depth(image, bank, tiles(image))
    assert np.bincount(labels.ravel()).max() > 0.9 * labels.size
