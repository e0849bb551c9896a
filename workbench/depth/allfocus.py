"""The all-focus image and the depth map of a measured photograph.

Every depth that occurs is deconvolved once, from the pixels of its own regions alone: what lies outside, or is
saturated, is unobserved (the weights of :mod:`workbench.depth.richardson_lucy`), so that a bright neighbour at another
depth neither rings into a region nor darkens its edge. Where those pixels say next to nothing about the scene, the
photograph itself stands in, as it does outside of all regions. The results are blended over a few pixels with weights
that sum to one.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.field import bank_at, region_place
from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate
from workbench.depth.regions import bounding_box
from workbench.depth.richardson_lucy import Deconvolver

_REACH_SIGMAS = 3
_NO_REGION = -1
_TRUSTED = 0.25
"""A pixel of the scene counts as fully known when this part of its light was observed: a corner of the frame has it."""


def depth_map(labels: NDArray[np.int32], estimates: Mapping[int, DepthEstimate]) -> NDArray[np.float32]:
    """float32 (H, W): depth (mm) of each pixel's region; NaN outside regions and where a region says nothing."""
    table = np.full(int(labels.max(initial=0)) + 1, np.nan, np.float32)
    for label, estimate in estimates.items():
        if 0 < label < len(table):
            table[label] = estimate.depth_mm
    return np.asarray(table[labels])


def all_focus(
    image: LinearImage,
    bank: Bank,
    labels: NDArray[np.int32],
    estimates: Mapping[int, DepthEstimate],
    *,
    iterations: int = 20,
    feather_px: float = 1.0,
    workers: int = 1,
) -> NDArray[np.float32]:
    """Deconvolve each region with the PSF of its depth; what is in no region stays as photographed.

    Parameters
    ----------
    image
        Linear, any number of channels.
    bank
        For each region its PSF that is nearest in inverse depth is used; of a bank over the field, that of the
        region's place.
    labels
        int32 (H, W), 0 = no region.
    estimates
        By label. Regions without a depth are taken to be as far as the bank reaches.
    iterations
        Richardson-Lucy iterations.
    feather_px
        Standard deviation of the blend between depths, pixels.
    workers
        Threads.

    Returns
    -------
    float32 (H, W, C), linear, unit of the image.

    Raises
    ------
    ValueError
        Labels of another size than the image.
    """
    if labels.shape != image.shape:
        raise ValueError(f"labels are {labels.shape}, the image is {image.shape}")
    planes_used = _nearest_plane(depth_map(labels, estimates), bank.depths_mm)
    blended = np.zeros_like(image.planes)
    weights = np.zeros(image.shape, np.float32)
    depths = len(bank.depths_mm)
    by_place = len(bank.field_yx) > 1
    groups = labels * depths + planes_used if by_place else planes_used
    groups = np.where(labels > 0, groups, _NO_REGION)
    for group in np.unique(groups):
        mask = (groups == group).astype(np.float32)
        weight = cv2.GaussianBlur(mask, (0, 0), feather_px) if feather_px > 0 else mask
        reach = int(np.ceil(_REACH_SIGMAS * feather_px))
        box = bounding_box(mask, reach)
        local = weight[box]
        weights[box] += local
        if group == _NO_REGION:
            blended[box] += local[:, :, None] * image.planes[box]
            continue
        index = group % depths
        psfs = bank_at(bank, region_place(mask > 0)).central if by_place else bank.central
        observed = (mask[box] > 0) & ~image.saturated[box]
        deconvolver = Deconvolver((local.shape[0], local.shape[1]), bank.psf.shape[-1], mask=observed, workers=workers)
        kernel = deconvolver.kernel(psfs[index])
        trust = np.minimum(deconvolver.observed_fraction(kernel) / np.float32(_TRUSTED), np.float32(1))
        for channel in range(image.planes.shape[2]):
            plane = image.planes[*box, channel]
            sharp = deconvolver.richardson_lucy(plane, kernel, iterations)
            blended[*box, channel] += local * (plane + trust * (sharp - plane))
    return np.asarray(blended / weights[:, :, None])


def _nearest_plane(depth_mm: NDArray[np.float32], depths_mm: NDArray[np.float64]) -> NDArray[np.intp]:
    """Index of the bank's depth that is nearest in inverse depth, the farthest for NaN; (H, W)."""
    inverse = -1.0 / depths_mm
    middles = (inverse[1:] + inverse[:-1]) / 2
    known = np.isfinite(depth_mm)
    found = np.searchsorted(middles, -1.0 / np.where(known, depth_mm, 1.0))
    return np.where(known, found, len(depths_mm) - 1)
