"""Regions of one depth each: what the blur splits, what it joins."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from calibration.bank import Bank
from calibration.image import LinearImage
from tests.unit.depth_evidence.synthetic import FOCUS_MM, as_image, leaves, photograph
from workbench.depth.depth_region_merging import merge_cells
from workbench.depth.depth_region_sides import telling_likelihoods
from workbench.depth.depth_regions import DepthRegionOptions, regions_of_one_depth, with_outlines

FloatArray = NDArray[np.float64]

SIDE = 300


def side_by_side(left_mm: float, right_mm: float, right: FloatArray | None = None) -> LinearImage:
    """Two planes of the same greys that meet in the middle."""
    textures = leaves(SIDE + 40, 3), leaves(SIDE + 40, 4) if right is None else right
    planes = [photograph(texture, depth).planes for texture, depth in zip(textures, (left_mm, right_mm), strict=True)]
    return as_image(np.concatenate(planes, axis=1))


def plaster(side: int, seed: int) -> FloatArray:
    """Grain without edges: what no restoration makes sparser, and so has no side of focus."""
    grain = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((side, side)), 1.0)
    return np.asarray(0.4 + 0.1 * grain / grain.std())


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


def lent_by_leaves(bank: Bank, options: DepthRegionOptions | None = None) -> float:
    """Share of plaster's pixels that go to leaves of its greys at its mirror depth, over six pairs."""
    lent = []
    for leaves_mm, seed in itertools.product((2300.0, 2600.0, 2900.0), (5, 6)):
        mirror_mm = 1.0 / (2.0 / FOCUS_MM - 1.0 / leaves_mm)
        image = side_by_side(leaves_mm, mirror_mm, plaster(SIDE + 40, seed))
        labels = regions_of_one_depth(image, bank, tiles(image), options)
        middle = labels.shape[1] // 2
        lent.append(float((labels[:, middle + 20 :] == halves(labels)[0]).mean()))
    return float(np.mean(lent))


def test_what_tells_no_side_of_focus_is_not_lent_one(bank: Bank) -> None:
    assert lent_by_leaves(bank) < 0.1
    assert lent_by_leaves(bank, DepthRegionOptions(telling_tolerance=1e6)) > 0.3


@pytest.mark.parametrize("depth_mm", [2000.0, 2600.0])
def test_surface_of_one_depth_becomes_one_region(bank: Bank, depth_mm: float) -> None:
    image = photograph(leaves(2 * SIDE, 5), depth_mm)
    labels = regions_of_one_depth(image, bank, tiles(image))
    assert np.bincount(labels.ravel()).max() > 0.9 * labels.size


def wall_kept_beside_a_page(bank: Bank, wall_mm: float, options: DepthRegionOptions | None = None) -> float:
    """Share of the wall's 60 pixels on either side of a page at 200 cm that stay with the wall."""
    planes, page = (photograph(leaves(2 * SIDE, seed), z).planes for seed, z in ((3, wall_mm), (4, 2000.0)))
    middle = planes.shape[1] // 2
    left, right = middle - 80, middle + 80
    planes = planes.copy()
    planes[:, left:right] = page[:, left:right]
    image = as_image(planes)
    labels = regions_of_one_depth(image, bank, tiles(image), options)
    own = [np.bincount(part.ravel()).argmax() for part in (labels[:, : left - 100], labels[:, right + 100 :])]
    beside = np.concatenate([labels[:, left - 60 : left], labels[:, right : right + 60]], axis=1)
    return float(np.isin(beside, own).mean())


@pytest.mark.parametrize("wall_mm", [2900.0, 1050.0])
def test_sharper_neighbour_takes_little_of_what_is_beside_it(bank: Bank, wall_mm: float) -> None:
    assert wall_kept_beside_a_page(bank, wall_mm) > 0.7
    assert wall_kept_beside_a_page(bank, wall_mm, DepthRegionOptions(window_px=128)) < 0.6


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("level", [0.0, -0.01])
def test_frame_as_dark_as_its_noise_has_regions(bank: Bank, level: float) -> None:
    """Less than the dark frame on average, in places or all over."""
    planes = level + 0.003 * np.random.default_rng(1).standard_normal((160, 200, 3))
    image = as_image(planes.astype(np.float32))
    assert regions_of_one_depth(image, bank, tiles(image)).min() == 1


FIRST, SECOND, EITHER = (0.0, -40.0), (-40.0, 0.0), (0.0, 0.0)
"""Log-likelihoods of two causes in a cell."""


def merged(row: list[tuple[float, ...]], hues: list[float], least_cells: int = 1) -> list[int]:
    """Pieces of a row of cells."""
    colours, within = np.array(hues)[:, np.newaxis], np.zeros(len(row), np.int32)
    return [int(piece) for piece in merge_cells(np.array(row), colours, (1, len(row)), within, 8.0, least_cells)]


def test_cell_that_goes_with_anything_goes_with_its_colour() -> None:
    row = [FIRST, EITHER, EITHER, SECOND]
    assert merged(row, [0.0, 0.1, 0.1, 1.0]) == [1, 1, 1, 2]
    assert merged(row, [0.0, 0.9, 0.9, 1.0]) == [1, 2, 2, 2]
    assert merged(row, [0.0, 0.1, 0.9, 1.0]) == [1, 1, 2, 2]


def test_what_was_seen_overrules_colour() -> None:
    slightly = (0.0, -3.0)
    assert merged([FIRST, slightly, SECOND], [0.0, 1.0, 1.0]) == [1, 1, 2]
    assert merged([FIRST, SECOND, SECOND], [0.0, 0.0, 1.0]) == [1, 2, 2]
    assert merged([FIRST, FIRST, FIRST], [0.0, 5.0, -5.0]) == [1, 1, 1]


def test_piece_of_too_few_cells_goes_where_it_loses_least() -> None:
    odd, third = (-20.0, -90.0, 0.0), (0.0, -90.0, -90.0)
    row = [third, third, odd, (-90.0, 0.0, -90.0), (-90.0, 0.0, -90.0)]
    assert merged(row, [0.0] * 5, least_cells=2) == [1, 1, 1, 2, 2]
    assert merged(row, [0.0] * 5) == [1, 1, 2, 3, 3]


def test_cells_tell_a_side_or_none() -> None:
    far, near, none = 0, 1, 2
    likelihood = telling_likelihoods(np.array([0.0, 1.0, 5.0, 50.0, -5.0]))
    assert likelihood.argmax(axis=1).tolist() == [none, none, far, far, near]
    assert likelihood[2, far] == likelihood[3, far] == likelihood[4, near] == 0.0
    np.testing.assert_allclose(likelihood[[2, 4]], likelihood[[4, 2]][:, [near, far, none]])  # sides are alike


def test_what_of_a_colour_lies_in_cells_of_another_surface_goes_home(bank: Bank) -> None:
    """One colour at two depths, and a thing between them whose cells hold a strip of it on both sides."""
    planes = [
        photograph(leaves(SIDE + 40, seed), depth).planes for seed, depth in ((3, 2900.0), (4, 1300.0), (5, 2000.0))
    ]
    image = as_image(np.concatenate(planes, axis=1))
    ends = np.cumsum([part.shape[1] for part in planes])[:2]
    assert all(end % 48 > 5 for end in ends)  # outlines lie within cells
    colours = tiles(image)
    colours[:, : ends[0]] = colours[:, ends[1] :] = 1
    labels = regions_of_one_depth(image, bank, colours)
    thing = np.bincount(labels[:, ends[0] : ends[1]].ravel()).argmax()
    inside = np.zeros(labels.shape, bool)
    inside[:, ends[0] : ends[1]] = True
    assert (labels[~inside] == thing).mean() < 0.005
    assert (labels[inside] == thing).mean() > 0.97


def test_of_two_colours_that_span_pieces_the_far_smaller_one_is_the_guest() -> None:
    """A card's blank part lies in the wall's cells: it goes to the piece where the card shows its letters."""
    wall, more, letters, frame, cell = 1, 2, 3, 4, 50
    pieces = np.full((6, 9), wall, np.int32)
    pieces[:, :3], pieces[:, 7:], pieces[2:4, 5:7] = more, frame, letters  # no colour lies half within one
    colours = np.ones((300, 450), np.int32)
    colours[100:200, 170:370] = 2  # the card: 80 columns of it among the wall, 20 in the frame
    result = with_outlines(pieces, cell, colours, 0.51)
    assert (result[colours == 2] == letters).all()
    assert set(np.unique(result[colours == 1])) == {wall, more, frame}


def test_of_two_colours_of_like_size_none_is_a_guest() -> None:
    pieces = np.repeat(np.array([1, 2, 3], np.int32), 2)[:, np.newaxis] * np.ones(8, np.int32)
    colours = np.ones((300, 400), np.int32)
    colours[:, 220:] = 2
    result = with_outlines(pieces, 50, colours, 0.5)
    assert all((result[100 * k : 100 * (k + 1)] == k + 1).all() for k in range(3))
