"""Regions of a photograph: found by region merging or given by the operator, and their inner parts.

Region merging is the published algorithm (:mod:`workbench.depth.merging`). What is ours is the picture it is run on:

* Linear data are first given a tone curve. The predicate measures differences on one scale of 256 levels; on linear
  data the darker half of a scene would lie within a few levels and merge with whatever is beside it.
* Large photographs are reduced by whole-number averaging to ``working_side``. The predicate knows noise only as
  independent pixels, but blur makes neighbours alike: at full size a defocused texture is a patchwork of smooth
  regions, each statistically its own. Reducing also makes Q mean the same for every sensor.
* Regions below ``min_fraction`` of the frame are absorbed: they are too small to carry a depth.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.image import LinearImage
from workbench.depth.merging import absorb_small, merge_regions

Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class SrmOptions:
    """How regions are found.

    Attributes
    ----------
    q
        Q of Nock and Nielsen: larger gives more and finer regions (their own experiments: 32).
    min_fraction
        Regions smaller than this part of the frame are absorbed by the most similar neighbour.
    gamma, white_percentile
        Tone curve before merging: ``255 * (v / white) ** (1 / gamma)`` with white the given percentile of each pixel's
        largest channel.
    working_side
        The longer side is reduced to at most this many pixels; 0 to work at full size.
    smoothing_px
        Standard deviation of a Gaussian before merging, in pixels of the working image; 0 for none.
    """

    q: float = 32.0
    min_fraction: float = 0.005
    gamma: float = 2.2
    white_percentile: float = 99.5
    working_side: int = 1000
    smoothing_px: float = 1.0

    def __post_init__(self) -> None:
        for name, good in {
            "q": self.q > 0,
            "min_fraction": 0 <= self.min_fraction < 1,
            "gamma": self.gamma > 0,
            "white_percentile": 0 < self.white_percentile <= 100,
            "working_side": self.working_side >= 0,
            "smoothing_px": self.smoothing_px >= 0,
        }.items():
            if not good:
                raise ValueError(f"{name} = {getattr(self, name)}: out of range")


def srm(image: LinearImage, options: SrmOptions | None = None) -> Labels:
    """Segment a photograph by Statistical Region Merging.

    Parameters
    ----------
    image
        Linear, of any number of channels.
    options
        Defaults are described with :class:`SrmOptions`.

    Returns
    -------
    int32 (H, W)
        Labels 1 to n, in the order of decreasing size; every pixel belongs to a region.
    """
    options = options or SrmOptions()
    factor = -(-max(image.shape) // options.working_side) if options.working_side else 1
    levels = to_levels(_reduced(image.planes, factor), options)
    labels = merge_regions(levels, options.q)
    labels = absorb_small(labels, levels, int(np.ceil(options.min_fraction * labels.size)))
    return _by_size(_enlarged(labels, factor, image.shape))


def to_levels(planes: NDArray[np.float32], options: SrmOptions) -> NDArray[np.uint8]:
    """Apply the tone curve and smoothing of the options: linear (H, W, C) to uint8 of the same shape."""
    white = max(float(np.percentile(planes.max(axis=2), options.white_percentile)), 1e-6)
    toned = np.clip(planes / np.float32(white), 0, 1) ** np.float32(1 / options.gamma)
    if options.smoothing_px:
        toned = cv2.GaussianBlur(toned, (0, 0), options.smoothing_px).reshape(planes.shape)
    return np.asarray(np.rint(toned * 255).astype(np.uint8))


def whole(shape: tuple[int, int]) -> Labels:
    """One region, label 1, that fills the frame (H, W)."""
    return np.ones(shape, np.int32)


def from_roi(shape: tuple[int, int], roi: tuple[int, int, int, int]) -> Labels:
    """One region, label 1: the rectangle (x, y, width, height), pixels.

    Raises
    ------
    ValueError
        Empty, or not within the frame.
    """
    x, y, width, height = roi
    if min(width, height) < 1 or min(x, y) < 0 or x + width > shape[1] or y + height > shape[0]:
        raise ValueError(f"region {roi} (x, y, width, height) isn't within the frame of {shape[1]} x {shape[0]} pixels")
    labels = np.zeros(shape, np.int32)
    labels[y : y + height, x : x + width] = 1
    return labels


def inner(mask: NDArray[np.bool_], margin_px: float, *, frame_is_edge: bool = False) -> NDArray[np.bool_]:
    """Pixels of a region that are further than a margin from its edge.

    Parameters
    ----------
    mask
        bool (H, W).
    margin_px
        Width of the strip along the edge in which other depths mix in: the radius of the local blur.
    frame_is_edge
        Whether the frame's border counts as an edge.

    Returns
    -------
    bool (H, W).
    """
    return np.asarray(mask & (edge_distance(mask, frame_is_edge=frame_is_edge) > margin_px))


def bounding_box(mask: NDArray[np.generic], reach: int = 0) -> tuple[slice, slice]:
    """Rows and columns that hold all of a mask (H, W), which must hold something, and ``reach`` more on each side."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - reach), int(rows[-1]) + 1 + reach),
        slice(max(0, int(columns[0]) - reach), int(columns[-1]) + 1 + reach),
    )


def edge_distance(mask: NDArray[np.bool_], *, frame_is_edge: bool = False) -> NDArray[np.float32]:
    """float32 (H, W): distance (px) from each pixel of a region to the nearest one outside, or infinite."""
    padded = np.pad(mask.astype(np.uint8), 1, constant_values=0 if frame_is_edge else 1)
    if padded.all():
        return np.full(mask.shape, np.inf, np.float32)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    # its last digits depend on OpenCV's threads and on luck; squares of distances between pixels are whole numbers
    return np.asarray(np.sqrt(np.rint(distance * distance)), np.float32)


def _reduced(planes: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Mean over factor x factor blocks; the last row and column of blocks may be smaller."""
    if factor == 1:
        return planes
    height, width = planes.shape[:2]
    padding = ((0, -height % factor), (0, -width % factor), (0, 0))
    padded = np.pad(planes, padding, mode="edge")
    blocks = padded.reshape(padded.shape[0] // factor, factor, padded.shape[1] // factor, factor, -1)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _enlarged(labels: Labels, factor: int, shape: tuple[int, int]) -> Labels:
    if factor == 1:
        return labels
    return labels.repeat(factor, axis=0).repeat(factor, axis=1)[: shape[0], : shape[1]]


def _by_size(labels: Labels) -> Labels:
    """Labels 1 to n by decreasing size, ties by first pixel."""
    counts = np.bincount(labels.ravel())
    order = np.argsort(-counts, kind="stable")
    rank = np.empty(len(counts), np.int32)
    rank[order] = np.arange(1, len(counts) + 1, dtype=np.int32)
    return np.ascontiguousarray(rank[labels])


def without_parts(labels: Labels, parts: Iterable[Mask | None]) -> Labels:
    """The same regions, int32 (H, W), but for some parts of the picture, bool (H, W), which belong to none (0)."""
    kept = labels
    for part in parts:
        if part is not None:
            kept = labels.copy() if kept is labels else kept
            kept[part] = 0
    return kept
