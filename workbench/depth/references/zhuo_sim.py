"""Blur of edges from the ratio of gradients before and after blurring again: Zhuo and Sim 2011.

S. Zhuo and T. Sim, "Defocus map estimation from a single image", Pattern Recognition 44, 1852 (2011). At a step edge
blurred by a Gaussian of standard deviation s, gradients taken through Gaussians a < b are in the ratio
``R = sqrt((s**2 + b**2) / (s**2 + a**2))``; hence ``s**2 = (b**2 - R**2 a**2) / (R**2 - 1)``. The paper writes it with
a = 0; its authors' program takes both gradients through Gaussians. Edges are Canny's.

The paper then spreads the edges' blur over the picture; here a region's blur is that of its edges' median ratio. Edges
whose ratio shows no blur or an endless one count in the median. What becomes of the blur:
:mod:`workbench.depth.references.blur_size`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate
from workbench.depth.options import require
from workbench.depth.references.blur_size import blur_scale, estimate_from_blur
from workbench.depth.references.edges import FloatImage, Mask, derivative, noise_gain
from workbench.depth.references.elder_zucker import scatter, too_few_edges
from workbench.depth.screening import ScreeningOptions, expanded, screen

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ZhuoSimOptions(ScreeningOptions):
    """Constants of the method.

    Attributes
    ----------
    first_px, second_px
        Standard deviations a and b of the two gradients: 1 and 1.5 as in the authors' program.
    edge_scale_px
        Open in the paper: scale of Canny's gradient.
    edge_share
        Open in the paper ("tuned"): Canny's upper threshold as a fraction of the region's 99th percentile of gradients.
    edge_low_ratio
        Lower threshold of Canny as a fraction of the upper; 0.4 as in the program's environment.
    edge_noise
        Ours: the upper threshold is at least so many standard deviations of the gradient's noise.
    least_edges
        Ours: fewer edge points make no depth.
    """

    first_px: float = 1.0
    second_px: float = 1.5
    edge_scale_px: float = 2.0
    edge_share: float = 0.4
    edge_low_ratio: float = 0.4
    edge_noise: float = 6.0
    least_edges: int = 20

    def __post_init__(self) -> None:
        ScreeningOptions.__post_init__(self)
        require(
            self,
            first_px=self.first_px > 0,
            second_px=self.second_px > self.first_px,
            edge_scale_px=self.edge_scale_px > 0,
            edge_share=0 < self.edge_share <= 1,
            edge_low_ratio=0 < self.edge_low_ratio <= 1,
            edge_noise=self.edge_noise >= 0,
            least_edges=self.least_edges >= 1,
        )


def estimate_zhuo_sim(
    image: LinearImage, bank: Bank, labels: NDArray[np.int32], options: ZhuoSimOptions | None = None
) -> dict[int, DepthEstimate]:
    """Depth of each region from the ratio of its edges' gradients.

    Parameters
    ----------
    image
        Developed by the bank's recipe; its luminance is used.
    bank
        Its central PSFs tell the width of blur at each depth.
    labels
        int32 (H, W), 0 = no region.
    options
        See :class:`ZhuoSimOptions`.

    Returns
    -------
    dict
        Estimates by label, without intervals: the paper gives none. ``diagnostics``: ``edge_ratio`` (N,), ``edge_y``
        and ``edge_x`` (N,) in pixels of the frame, ``blur_std_px``, ``radius_px``.
    """
    options = options or ZhuoSimOptions()
    screened, scale = screen(image, bank, labels, options), blur_scale(bank)
    luminance = image.luminance
    largest = float(scale.std_px(np.abs(bank.lens.radius_px)).max())
    estimates = dict(screened.refused)
    for region in screened.regions:
        outer, place = expanded(region.box, int(6 * options.edge_scale_px) + 2, image.shape)
        plane = np.ascontiguousarray(luminance[outer])
        usable = np.zeros(plane.shape, np.bool_)
        usable[place] = region.inside & ~image.saturated[region.box]
        y, x = np.nonzero(_canny(plane, usable, screened.noise, options))
        if y.size < options.least_edges:
            estimates[region.label] = too_few_edges(bank, region, y.size, options.least_edges)
            continue
        gentle, strong = (_gradient(plane, scale_px)[y, x] for scale_px in (options.second_px, options.first_px))
        ratio = np.divide(strong, gentle, out=np.ones_like(strong), where=gentle > 0).astype(np.float64)
        median = _std(np.median(ratio, keepdims=True), options, 2.0 * largest)
        spread = scatter(_std(ratio, options, 2.0 * largest)) / np.sqrt(y.size)
        found = {
            "edge_ratio": ratio,
            "edge_y": (y + outer[0].start).astype(np.float64),
            "edge_x": (x + outer[1].start).astype(np.float64),
        }
        estimates[region.label] = estimate_from_blur(
            bank, region, options, scale, float(median[0]), float(spread), found
        )
    return dict(sorted(estimates.items()))


def _std(ratio: FloatArray, options: ZhuoSimOptions, most: float) -> FloatArray:
    """Standard deviation of blur from the ratio; 0 for sharp edges, ``most`` for those that show no end of blur."""
    a, b = options.first_px, options.second_px
    excess = np.maximum(ratio**2 - 1.0, 1e-12)
    return np.asarray(np.minimum(np.sqrt(np.maximum(b**2 - ratio**2 * a**2, 0.0) / excess), most), np.float64)


def _gradient(plane: FloatImage, scale_px: float) -> FloatImage:
    return np.hypot(derivative(plane, scale_px, 1, 0), derivative(plane, scale_px, 0, 1))


def _canny(plane: FloatImage, usable: Mask, noise: float, options: ZhuoSimOptions) -> Mask:
    """Canny's edges among the usable pixels."""
    gx, gy = derivative(plane, options.edge_scale_px, 1, 0), derivative(plane, options.edge_scale_px, 0, 1)
    size = np.hypot(gx, gy)
    floor = options.edge_noise * noise * noise_gain(options.edge_scale_px, 1)
    upper = max(options.edge_share * float(np.percentile(size[usable], 99)), floor, 1e-9)
    steps = 16_000.0 / max(float(size.max()), upper)  # OpenCV's Canny takes whole numbers of 16 bits
    whole_x, whole_y = (np.rint(steps * part).astype(np.int16) for part in (gx, gy))
    found = cv2.Canny(whole_x, whole_y, steps * upper * options.edge_low_ratio, steps * upper, L2gradient=True)
    return np.asarray((found > 0) & usable)
