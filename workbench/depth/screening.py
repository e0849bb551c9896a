"""What every region must pass before it is measured: an inner part, texture above the noise, light that isn't clipped.

The published methods refuse the same regions for the same reasons.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate, Status
from workbench.depth.options import require
from workbench.depth.regions import bounding_box, edge_distance

FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]
Box = tuple[slice, slice]


@dataclass(frozen=True, slots=True)
class ScreeningOptions:
    """When a region is refused. None of these comes from a paper; they are the same for every method.

    Attributes
    ----------
    margin_px
        Strip along a region's edge that doesn't count; None for the bank's largest blur radius.
    keep_fraction
        The strip is made narrower where less than this part of the region would remain.
    min_pixels
        Fewer inner pixels than this carry no depth.
    min_contrast
        Least standard deviation of a region's 4 x 4 block means, in units of what noise alone gives.
    max_saturated
        Larger fractions of saturated inner pixels are reported.
    """

    margin_px: float | None = None
    keep_fraction: float = 0.25
    min_pixels: int = 400
    min_contrast: float = 2.0
    max_saturated: float = 0.1

    def __post_init__(self) -> None:
        require(
            self,
            margin_px=self.margin_px is None or self.margin_px >= 0,
            keep_fraction=0 < self.keep_fraction <= 1,
            min_pixels=self.min_pixels >= 1,
            min_contrast=self.min_contrast >= 0,
            max_saturated=0 <= self.max_saturated <= 1,
        )


@dataclass(frozen=True, slots=True)
class Region:
    """A region that can be measured.

    Attributes
    ----------
    label
        Its number.
    box
        Rows and columns that hold it.
    inside
        bool, the box's shape: pixels of its inner part.
    saturated
        Fraction of them that are clipped.
    """

    label: int
    box: Box
    inside: Mask
    saturated: float

    @property
    def pixels(self) -> int:
        """Pixels of the inner part."""
        return int(self.inside.sum())


@dataclass(frozen=True, slots=True)
class Screened:
    """A frame's regions.

    Attributes
    ----------
    regions
        Those that can be measured.
    refused
        Estimates of the others, by label.
    noise
        Standard deviation of the luminance's noise.
    """

    regions: list[Region]
    refused: dict[int, DepthEstimate]
    noise: float


def screen(image: LinearImage, bank: Bank, labels: NDArray[np.int32], options: ScreeningOptions) -> Screened:
    """Cut regions to their inner parts, and refuse those that can't say anything.

    Raises
    ------
    ValueError
        Labels of another size than the image.
    """
    if labels.shape != image.shape:
        raise ValueError(f"labels are {labels.shape}, the image is {image.shape}")
    luminance = image.luminance
    noise = noise_level(luminance)
    margin = float(np.abs(bank.lens.radius_px).max()) if options.margin_px is None else options.margin_px
    found = Screened([], {}, noise)
    for label in (int(value) for value in np.unique(labels) if value > 0):
        mask = labels == label
        box = bounding_box(mask)
        distance = edge_distance(mask[box], frame_is_edge=True)
        limit = float(np.quantile(distance[mask[box]], 1.0 - options.keep_fraction))
        # Distances of edge pixels are 1: a region that can't afford any margin keeps all of its pixels.
        inside = mask[box] & (distance > min(margin, limit - 0.5))
        region = Region(label, box, inside, float(image.saturated[box][inside].mean()))
        if region.pixels < options.min_pixels:
            reason = f"only {region.pixels} inner pixels, {options.min_pixels} are needed"
        elif _contrast(luminance[box], inside) < options.min_contrast * noise / 4:
            reason = "no texture above the noise"
        else:
            found.regions.append(region)
            continue
        found.refused[label] = no_depth(bank, region.pixels, reason)
    return found


def no_depth(bank: Bank, pixels: int, reason: str, status: Status = "no-texture") -> DepthEstimate:
    """The estimate of a region that says nothing."""
    nan = float("nan")
    return DepthEstimate(
        depth_mm=nan, interval_mm=(nan, nan), confidence=0.0, mirror_mm=nan, mirror_probability=nan, status=status,
        depths_mm=bank.depths_mm, score=np.zeros(len(bank.depths_mm)), second_mm=nan, pixels=pixels, reason=reason,
    )  # fmt: skip


def noise_level(luminance: FloatImage) -> float:
    """Standard deviation of pixel noise, from the quietest tiles.

    Immerkaer's kernel (Computer Vision and Image Understanding 64, 300, 1996), which sees no plane and no edge along an
    axis; its median absolute value in tiles of 16 x 16, of which the tenth percentile: the other tiles hold texture.
    """
    kernel = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
    response = np.abs(cv2.filter2D(luminance, -1, kernel))
    height, width = (side // 16 for side in luminance.shape)
    if height == 0 or width == 0:
        return float(np.median(response)) / 0.6745 / 6
    tiles = response[: 16 * height, : 16 * width].reshape(height, 16, width, 16)
    return float(np.quantile(np.median(tiles, axis=(1, 3)), 0.1)) / 0.6745 / 6


def _contrast(luminance: FloatImage, inside: Mask) -> float:
    """Standard deviation of the 4 x 4 block means that lie inside, after a plane is taken away."""
    height, width = (side // 4 for side in luminance.shape)
    blocks = luminance[: 4 * height, : 4 * width].reshape(height, 4, width, 4).mean(axis=(1, 3), dtype=np.float64)
    full = inside[: 4 * height, : 4 * width].reshape(height, 4, width, 4).all(axis=(1, 3))
    y, x = np.nonzero(full)
    if len(y) < 4:
        return 0.0
    values = blocks[full]
    plane = np.stack([np.ones(len(y)), y, x], axis=1)
    return float(np.std(values - plane @ np.linalg.lstsq(plane, values, rcond=None)[0]))


def expanded(box: Box, reach: int, shape: tuple[int, int]) -> tuple[Box, Box]:
    """A box grown by ``reach`` within the frame, and where the old box lies in the new one."""
    grown = [
        slice(max(0, part.start - reach), min(side, part.stop + reach)) for part, side in zip(box, shape, strict=True)
    ]
    place = [slice(part.start - new.start, part.stop - new.start) for part, new in zip(box, grown, strict=True)]
    return (grown[0], grown[1]), (place[0], place[1])
