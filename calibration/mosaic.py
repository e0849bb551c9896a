"""Photosites behind a colour filter array, and the two ways in which they become pixels.

superpixel
    Each 2x2 CFA cell becomes one pixel with R, the mean of both G, and B. No interpolation; twice the photosite pitch.
native
    Photosite pitch. Each channel is filled in from its own photosites by the kernel [1 2 1]' [1 2 1], normalised by
    the photosites that it hits (bilinear interpolation for R and B). With the same kernel for all channels the
    luminance (R + 2 G + B) / 4 is the mosaic filtered by [1 2 1]' [1 2 1] / 16: shift-invariant, and with zeros
    exactly where the CFA puts its carriers, so that a coloured point leaves no checkerboard.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

SATURATION_FRACTION = 0.99
"""A photosite at or above this fraction of white counts as saturated (sensors clip a little below the stated white)."""

_CHANNELS = {"R": 0, "G": 1, "B": 2}
_KERNEL = np.array([1.0, 2.0, 1.0], np.float32) / 4.0
_DARK = 0.1
"""A channel with less than this part of the brightest one's light isn't made grey: its noise would drown the others."""
_RESOLVED = 0.9
"""Least ratio of squared differences within cells to those across them where photosites see details of their own."""


@dataclass(frozen=True, slots=True)
class Mosaic:
    """Visible photosites of a RAW file, whole 2x2 cells.

    Attributes
    ----------
    photosites
        uint16 (2 H, 2 W): raw values.
    pattern
        Colour index (0 R, 1 G, 2 B, 3 the other G) of a cell's four photosites, row by row.
    blacks
        Raw value of no light, by colour index.
    white
        Raw value of saturation.
    """

    photosites: NDArray[np.uint16]
    pattern: tuple[int, int, int, int]
    blacks: tuple[float, ...]
    white: float

    def part(self, rows: slice, columns: slice) -> Mosaic:
        """The cells of a rectangle, its slices with start and stop counted in cells; it may reach beyond the mosaic."""
        sites = self.photosites[2 * rows.start : 2 * rows.stop, 2 * columns.start : 2 * columns.stop]
        return replace(self, photosites=sites)


def superpixels(mosaic: Mosaic) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Planes float32 (H, W, 3), fraction of white, and saturated pixels bool (H, W), one pixel a cell."""
    height, width = mosaic.photosites.shape[0] // 2, mosaic.photosites.shape[1] // 2
    planes = np.zeros((height, width, 3), np.float32)
    saturated = np.zeros((height, width), np.bool_)
    for position, index in enumerate(mosaic.pattern):
        values, span = _channel(mosaic, position), mosaic.white - mosaic.blacks[index]
        channel = _CHANNELS["RGBG"[index]]
        planes[:, :, channel] += values * np.float32((0.5 if channel == 1 else 1.0) / span)
        saturated |= values >= SATURATION_FRACTION * span
    return planes, saturated


def native_pixels(mosaic: Mosaic) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Planes float32 (2 H, 2 W, 3), fraction of white, and saturated pixels bool (2 H, 2 W), one pixel a photosite."""
    shape = mosaic.photosites.shape
    planes = np.empty((*shape, 3), np.float32)
    clipped = np.zeros(shape, np.uint8)
    for channel in range(3):
        sparse = np.zeros(shape, np.float32)
        for position, index in enumerate(mosaic.pattern):
            if _CHANNELS["RGBG"[index]] != channel:
                continue
            cell = (slice(position // 2, None, 2), slice(position % 2, None, 2))
            values, span = _channel(mosaic, position), mosaic.white - mosaic.blacks[index]
            sparse[cell] = values * np.float32(1.0 / span)
            clipped[cell] = values >= SATURATION_FRACTION * span
        # the kernel hits a quarter of its weight in R and B photosites, half in G, wherever it stands
        planes[:, :, channel] = _filtered(sparse) * np.float32(2.0 if channel == 1 else 4.0)
    saturated = cv2.dilate(clipped, np.ones((3, 3), np.uint8)) > 0
    return planes, np.asarray(saturated, np.bool_)


def grey_photosites(mosaic: Mosaic, inside: NDArray[np.bool_]) -> NDArray[np.float32] | None:
    """Luminance at photosite pitch of light that is made grey, float32 (2 H, 2 W); as of :func:`native_pixels`.

    Parameters
    ----------
    mosaic
        Of the photograph, or a part of it.
    inside
        bool (H, W): cells whose mean is to be grey, in the first green photosite's unit.

    Returns
    -------
    ndarray or None
        None where a channel is too dark for that.
    """
    channels = [_channel(mosaic, position) for position in range(4)]
    levels = [float(channel[inside].mean(dtype=np.float64)) for channel in channels]
    if min(levels) <= _DARK * max(levels):
        return None
    green = mosaic.pattern.index(1)
    sites = np.empty(mosaic.photosites.shape, np.float32)
    for position, (channel, level) in enumerate(zip(channels, levels, strict=True)):
        gain = levels[green] / level / (mosaic.white - mosaic.blacks[1])
        sites[position // 2 :: 2, position % 2 :: 2] = channel * np.float32(gain)
    return _filtered(sites)


def native_luminance_power(fy: NDArray[np.float64], fx: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared response of a luminance at photosite pitch to grey light, at frequencies in cycles per photosite."""
    return np.asarray((np.cos(np.pi * fy) * np.cos(np.pi * fx)) ** 4, np.float64)


def resolves_photosites(mosaic: Mosaic) -> bool:
    """Whether photosites see details of their own, or whole cells were filled from one coarser pixel each.

    Of the two green photosites of a cell and the two nearest of neighbouring cells, each a diagonal step apart, both
    pairs differ by as much in a photograph; in a mosaic made from a coarser picture those of one cell differ by noise.
    One that shows hardly anything but noise passes.
    """
    first, second = (position for position, index in enumerate(mosaic.pattern) if index in (1, 3))
    one, other = _channel(mosaic, first), _channel(mosaic, second)
    # the second green lies below the first; across a cell's border its nearest one is above, on the other side
    above = other[:-1, 2:] if first % 2 > second % 2 else other[:-1, :-2]
    within, across = one[1:, 1:-1] - other[1:, 1:-1], one[1:, 1:-1] - above
    return bool((within**2).sum(dtype=np.float64) >= _RESOLVED * (across**2).sum(dtype=np.float64))


def _filtered(sites: NDArray[np.float32]) -> NDArray[np.float32]:
    # reflect_101 keeps the parity of the mosaic, so that the border needs no case of its own
    filtered = cv2.sepFilter2D(sites, cv2.CV_32F, _KERNEL, _KERNEL, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(filtered, np.float32)


def _channel(mosaic: Mosaic, position: int) -> NDArray[np.float32]:
    """One photosite of each cell above its black, float32 (H, W)."""
    sites = mosaic.photosites[position // 2 :: 2, position % 2 :: 2]
    return np.asarray(sites - np.float32(mosaic.blacks[mosaic.pattern[position]]), np.float32)
