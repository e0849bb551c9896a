"""Regions of one depth each: what merging by colour found, split and joined by what the blur says.

Two grey objects that touch are one region to any segmentation by colour, and a page of text is many. Their blur tells:
the likelihood of every blur radius is computed in windows on a coarse grid over the whole frame; neighbouring cells are
merged, the most compatible first, as long as one common radius explains both nearly as well as one radius each. Small
windows see little of their neighbours, and often little else; what goes with anything goes with its own colour. The
outlines come from the colour regions: one that lies within one piece goes to it as a whole, one that spans several is
cut along the grid. Radii are compared without their side of focus first, which single windows can't tell; then what
has one radius is merged anew by what its texture tells: the far side, the near one, or none, so that nothing is lent
its neighbour's side. Last come the sides themselves, so that two objects at mirror depths don't stay one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.bank import Bank
from calibration.image import LinearImage
from workbench.depth.depth_region_merging import merge_cells
from workbench.depth.depth_region_sides import side_likelihoods, side_odds_by_cell, telling_likelihoods
from workbench.depth.evidence_expected import smeared_power
from workbench.depth.evidence_model import DepthModel, EvidenceOptions, learned_of, prepare
from workbench.depth.evidence_periodogram import pooled_periodogram
from workbench.depth.evidence_spectrum import fit_spectra
from workbench.depth.evidence_windows import Window, hann
from workbench.processors import each

FloatArray = NDArray[np.float64]
Labels = NDArray[np.int32]


_DARKEST = 1e-3
"""Least value of a colour, relative to the picture's mean."""
_FAR_LARGER = 2.0
"""Of two colours that both span pieces the smaller one is a guest where the other has more than so many times its
pixels; else both are at home."""
_WINDOW_SHARE = 0.37
"""Area of a window of which its taper makes use: the squared mean of a Hann taper's energy, both ways."""


@dataclass(frozen=True, slots=True)
class DepthRegionOptions:
    """How regions are split and joined.

    Attributes
    ----------
    window_px
        Side of the windows; only the lower half of their frequencies is used, which is a quarter of the work.
        Large ones see across outlines, into a sharper neighbour say, small ones may hold no edge.
    least_cell_px, most_cells
        Spacing of the grid: at least so many pixels, and at most so many cells along the longer side.
    radius_step_px
        Step between the radii that are compared.
    tolerance
        Log-likelihood (nats) that two pieces may lose by a common radius and still be merged.
    telling_tolerance
        The same by a common kind of texture, one that tells the far side, the near one, or none.
    side_tolerance
        The same by a common side of focus.
    least_cells
        A piece of fewer cells is given to the neighbour that suits it best.
    whole_share
        A colour region with this share of its pixels in one piece belongs to it as a whole.
    least_fraction
        Connected parts smaller than this part of the frame go to their neighbour.
    """

    window_px: int = 64
    least_cell_px: int = 48
    most_cells: int = 20
    radius_step_px: float = 1.0
    tolerance: float = 8.0
    telling_tolerance: float = 8.0
    side_tolerance: float = 4.0
    least_cells: int = 3
    whole_share: float = 0.5
    least_fraction: float = 0.005


def regions_of_one_depth(
    image: LinearImage, bank: Bank, labels: Labels, options: DepthRegionOptions | None = None, *, workers: int = 1
) -> Labels:
    """Split and join colour regions so that each holds one depth.

    Parameters
    ----------
    image
        Developed like the bank.
    bank
        PSFs and lens fit.
    labels
        int32 (H, W): many small colour regions (superpixels), numbered from 1, every pixel in one.
    options
        See :class:`DepthRegionOptions`.
    workers
        Threads.

    Returns
    -------
    int32 (H, W)
        Labels 1 to n by decreasing size; ``labels`` themselves where the frame is narrower than two windows.
    """
    options = options or DepthRegionOptions()
    height, width = image.shape
    if min(height, width) < 2 * options.window_px:
        return labels
    cell = max(options.least_cell_px, int(np.ceil(max(height, width) / options.most_cells)))
    shape = -(-height // cell), -(-width // cell)
    model: DepthModel = prepare(bank, EvidenceOptions(radius_step_px=options.radius_step_px))
    windows = _cell_windows(image.shape, cell, shape, options)
    likelihood = _cell_likelihoods(image.luminance, windows, model, workers)
    whole = np.zeros(len(windows), np.int32)
    colours = _cell_colours(image.planes, cell)
    pieces = merge_cells(likelihood, colours, shape, whole, options.tolerance, options.least_cells)
    overlap = min(1.0, (cell / options.window_px) ** 2 / _WINDOW_SHARE)
    odds = side_odds_by_cell(
        image.luminance, windows, pieces, likelihood, model, learned_of(bank),
        least_cells=options.least_cells, overlap=overlap,
    )  # fmt: skip
    telling, sides = telling_likelihoods(odds), side_likelihoods(odds)
    pieces = merge_cells(telling, colours, shape, pieces, options.telling_tolerance, options.least_cells)
    pieces = merge_cells(sides, colours, shape, pieces, options.side_tolerance, options.least_cells)
    return _by_size(with_outlines(pieces.reshape(shape), cell, labels, options.whole_share), options.least_fraction)


def _cell_windows(
    image_shape: tuple[int, int], cell: int, shape: tuple[int, int], options: DepthRegionOptions
) -> list[Window]:
    """A window about each cell's centre, row by row."""
    size = options.window_px
    taper = np.outer(hann(size), hann(size)).astype(np.float32)
    rows = _corners(shape[0], cell, size, image_shape[0])
    columns = _corners(shape[1], cell, size, image_shape[1])
    return [Window(y, x, taper, 1.0) for y in rows for x in columns]


def _cell_likelihoods(plane: NDArray[np.float32], windows: list[Window], model: DepthModel, workers: int) -> FloatArray:
    """Log-likelihood of each radius in each window, float64 (cells, R)."""
    lags, size = model.kernel_lags.shape[1] // 2, windows[0].taper.shape[0]
    taper_lags = pooled_periodogram(plane, windows[:1], lags).taper_lags  # the same for all of them
    expected = _low_half(smeared_power(model.kernel_lags, taper_lags, size))

    def of_window(window: Window) -> FloatArray:
        pooled = pooled_periodogram(plane, [window], lags)
        low = _low_half(pooled.power[np.newaxis])[0]
        return fit_spectra(low, pooled.trusted, expected, independent_share=pooled.independent_share).log_likelihood

    return np.stack(each(of_window, windows, workers))


def _cell_colours(planes: NDArray[np.float32], cell: int) -> FloatArray:
    """Log of each cell's mean colour, float64 (cells, C)."""
    rows, columns = (np.arange(0, length, cell) for length in planes.shape[:2])
    sums = np.add.reduceat(np.add.reduceat(planes, rows, axis=0, dtype=np.float64), columns, axis=1)
    sizes = np.outer(*(np.diff(np.append(starts, n)) for starts, n in zip((rows, columns), planes.shape, strict=False)))
    means = (sums / sizes[..., np.newaxis]).reshape(-1, planes.shape[2])
    return np.asarray(np.log(np.maximum(means, max(_DARKEST * float(means.mean()), 1e-12))))


def _corners(cells: int, cell: int, size: int, length: int) -> list[int]:
    centres = (np.minimum(np.arange(1, cells + 1) * cell, length) + np.arange(cells) * cell) / 2
    return [int(np.clip(round(c - size / 2), 0, length - size)) for c in centres]


def _low_half(power: NDArray[np.floating]) -> NDArray[np.floating]:
    """Frequencies up to a quarter cycle per pixel of (D, N, N // 2 + 1): what the image at half its size would show."""
    n = power.shape[1]
    rows = np.r_[0 : n // 4, n - n // 4 : n]
    return np.ascontiguousarray(power[:, rows, : n // 4 + 1])


def with_outlines(pieces: Labels, cell: int, labels: Labels, whole_share: float) -> Labels:
    """Give pieces the outlines of the colour regions.

    A colour region that lies mostly within one piece belongs to it as a whole. One that spans several is cut along the
    cells; but in a piece of which whole ones are more than it is, or another one that spans several far more, or where
    it doesn't fill a cell, it is a guest: what lies there goes to the nearest piece where it is at home, if there is
    one.

    Parameters
    ----------
    pieces
        int32 (rows, columns) of cells: piece of each, numbered from 1.
    cell
        Side of a cell, px.
    labels
        int32 (H, W): colour region of each pixel, numbered from 1.
    whole_share
        Share of its pixels in one piece with which a colour region belongs to it as a whole.

    Returns
    -------
    int32 (H, W)
        Piece of each pixel.
    """
    rows, columns = (np.arange(length) // cell for length in labels.shape)
    by_pixel = pieces[np.ix_(rows, columns)]
    count = int(pieces.max()) + 1
    joint = labels.astype(np.int64) * count + by_pixel
    shares = np.bincount(joint.ravel(), minlength=(int(labels.max()) + 1) * count).reshape(-1, count)
    owner, sizes = shares.argmax(axis=1), shares.sum(axis=1)
    is_whole = shares.max(axis=1) >= whole_share * np.maximum(sizes, 1)
    result = np.where(is_whole[labels], owner[labels], by_pixel).astype(np.int32)
    owned = np.bincount(owner[is_whole], sizes[is_whole], minlength=count)
    boxes = ndimage.find_objects(labels)
    spanning = np.flatnonzero(~is_whole)
    largest = shares[spanning].max(axis=0, initial=0)
    for region in spanning:
        at_home = shares[region] >= np.maximum(np.maximum(owned, largest / _FAR_LARGER), cell * cell)
        if at_home.any() and (shares[region][~at_home] > 0).any():
            nearest = ndimage.distance_transform_edt(~at_home[pieces], return_distances=False, return_indices=True)
            box = boxes[region - 1]
            homes = pieces[tuple(nearest)][np.ix_(rows[box[0]], columns[box[1]])]
            result[box] = np.where(labels[box] == region, homes, result[box])
    return result


def _by_size(pieces: Labels, least_fraction: float) -> Labels:
    """Connected parts, numbered from 1 by decreasing size; crumbs go to the nearest part that is none."""
    result = np.zeros_like(pieces)
    count = 0
    for piece in np.unique(pieces):
        parts, found = ndimage.label(pieces == piece)
        result[parts > 0] = parts[parts > 0] + count
        count += found
    sizes = np.bincount(result.ravel())
    crumb = sizes[result] < least_fraction * pieces.size
    if not crumb.all():
        nearest = ndimage.distance_transform_edt(crumb, return_distances=False, return_indices=True)
        result = result[tuple(nearest)]
    sizes = np.bincount(result.ravel())
    order = np.argsort(-sizes, kind="stable")
    order = order[sizes[order] > 0]
    rank = np.zeros(len(sizes), np.int32)
    rank[order] = np.arange(1, len(order) + 1, dtype=np.int32)
    return np.ascontiguousarray(rank[result])
