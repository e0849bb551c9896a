"""Blur of edges from the distance of their second derivative's extrema: Elder and Zucker 1998.

J. H. Elder and S. W. Zucker, "Local scale control for edge detection and blur estimation", IEEE Transactions on
Pattern Analysis and Machine Intelligence 20, 699 (1998). An edge blurred by a Gaussian of standard deviation s, seen
through a second derivative of scale t, has extrema ``d = 2 sqrt(s**2 + t**2)`` apart along the gradient; hence
``s = sqrt((d / 2)**2 - t**2)``. Scales are the smallest at which derivatives are significant against sensor noise.

The region's blur is the median of its edges'. What becomes of it: :mod:`workbench.depth.references.blur_size`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate
from workbench.depth.options import require
from workbench.depth.references.blur_size import blur_scale, estimate_from_blur
from workbench.depth.references.edges import Detection, Profiles, edge_profiles, find_edges
from workbench.depth.screening import Region, ScreeningOptions, expanded, no_depth, screen

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ElderZuckerOptions(ScreeningOptions):
    """Constants of the method.

    Attributes
    ----------
    scales_px
        Of the first derivative: the paper's octaves, 0.5 to 16.
    second_scales_px
        Of the second derivative: the paper's, as above.
    significance
        Chance of a false edge in the whole image: the paper's 5 %.
    least_edges
        Open in the paper: fewer edge points with a blur than this make no depth.
    most_edges
        Ours: so many edge points of a region are enough.
    """

    scales_px: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    second_scales_px: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    significance: float = 0.05
    least_edges: int = 20
    most_edges: int = 2000

    def __post_init__(self) -> None:
        ScreeningOptions.__post_init__(self)
        require(
            self,
            scales_px=len(self.scales_px) > 0 and min(self.scales_px) > 0,
            second_scales_px=len(self.second_scales_px) > 0 and min(self.second_scales_px) > 0,
            significance=0 < self.significance < 1,
            least_edges=self.least_edges >= 1,
            most_edges=self.most_edges >= self.least_edges,
        )

    @property
    def detection(self) -> Detection:
        """What edge detection needs of them."""
        return Detection(tuple(sorted(self.scales_px)), tuple(sorted(self.second_scales_px)), self.significance)


def estimate_elder_zucker(
    image: LinearImage, bank: Bank, labels: NDArray[np.int32], options: ElderZuckerOptions | None = None
) -> dict[int, DepthEstimate]:
    """Depth of each region from its edges' blur.

    Parameters
    ----------
    image
        Developed by the bank's recipe; its luminance is used.
    bank
        Its central PSFs tell the width of blur at each depth.
    labels
        int32 (H, W), 0 = no region.
    options
        See :class:`ElderZuckerOptions`.

    Returns
    -------
    dict
        Estimates by label, without intervals: the paper gives none. ``diagnostics``: ``edge_std_px`` (N,), ``edge_y``
        and ``edge_x`` (N,) in pixels of the frame, ``blur_std_px``, ``radius_px``.
    """
    options = options or ElderZuckerOptions()
    screened, scale = screen(image, bank, labels, options), blur_scale(bank)
    estimates = dict(screened.refused)
    for region in screened.regions:
        profiles, corner = region_profiles(image, bank, region, screened.noise, options)
        std = np.sqrt(np.maximum((profiles.distance_px / 2) ** 2 - profiles.scale_px**2, 0.0))
        if std.size < options.least_edges:
            estimates[region.label] = too_few_edges(bank, region, std.size, options.least_edges)
            continue
        estimates[region.label] = estimate_from_blur(
            bank, region, options, scale, float(np.median(std)), scatter(std), edge_diagnostics(std, profiles, corner)
        )
    return dict(sorted(estimates.items()))


def region_profiles(
    image: LinearImage, bank: Bank, region: Region, noise: float, options: ElderZuckerOptions
) -> tuple[Profiles, tuple[int, int]]:
    """Profiles of a region's edges, and the frame's row and column at which their coordinates begin."""
    reach = int(np.ceil(1.3 * np.abs(bank.lens.radius_px).max() + 8.0))
    outer, place = expanded(region.box, reach, image.shape)
    plane = np.ascontiguousarray(image.luminance[outer])
    usable = np.zeros(plane.shape, np.bool_)
    usable[place] = region.inside & ~image.saturated[region.box]
    edges = find_edges(plane, usable, max(noise, 1e-6), options.detection, options.most_edges)
    corner = (outer[0].start, outer[1].start)
    return edge_profiles(plane, edges, max(noise, 1e-6), options.detection, reach), corner


def too_few_edges(bank: Bank, region: Region, count: int, least: int) -> DepthEstimate:
    """The estimate of a region without enough edges."""
    return no_depth(bank, region.pixels, f"only {count} edge points whose blur can be measured, {least} are needed")


def scatter(values: FloatArray) -> float:
    """Standard deviation by the median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def edge_diagnostics(std_px: FloatArray, profiles: Profiles, corner: tuple[int, int]) -> dict[str, FloatArray]:
    """Blur and place of each edge point."""
    return {
        "edge_std_px": std_px,
        "edge_y": profiles.edges.y + corner[0],
        "edge_x": profiles.edges.x + corner[1],
    }
