"""Blur of edges by fitting the second derivative's whole profile, then freed of outliers: Bae and Durand 2007.

S. Bae and F. Durand, "Defocus magnification", Computer Graphics Forum 26, 571 (Eurographics 2007). Edges are those of
Elder and Zucker. Since the extrema of the second derivative are easily displaced by noise and by edges nearby, blur is
found by brute force: models of the profile of a step blurred by a Gaussian of standard deviation s, seen through a
second derivative of scale t, ``m(x) ~ -x exp(-x**2 / (2 (s**2 + t**2)))``, are fitted to the measured profile for many
s, and the best is taken. A cross bilateral filter along the picture then removes outliers: each edge's blur becomes the
mean of all edges', weighed with distance, difference of brightness, and a bias ``exp(-s / 2)`` towards sharp edges,
because shadows and neighbours make edges look softer, never sharper.

The paper then spreads the edges' blur over the picture; here a region's blur is its edges' median. What becomes of it:
:mod:`workbench.depth.references.blur_size`.
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
from workbench.depth.references.edges import Profiles
from workbench.depth.references.elder_zucker import (
    ElderZuckerOptions,
    edge_diagnostics,
    region_profiles,
    scatter,
    too_few_edges,
)
from workbench.depth.screening import screen

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BaeDurandOptions(ElderZuckerOptions):
    """Constants of the method, besides those of edge detection.

    Attributes
    ----------
    scales_px, second_scales_px, significance
        The paper's: octaves 0.5 to 64, 0.5 to 32, and 0.0001 %.
    models
        Open in the paper: number of blurs that are tried, in equal ratios from ``least_std_px`` to 1.3 times the
        largest blur of the bank.
    least_std_px
        Open in the paper: smallest blur that is tried.
    window
        Open in the paper: a model is compared with the profile within so many of its own standard deviations.
    bias_px
        The paper's bias ``exp(-s / bias_px)`` towards sharp edges: 2 pixels. None for no bias.
    space_share
        The paper's standard deviation of distance: 10 % of the picture's size (here the region's).
    range_share
        The paper's standard deviation of brightness: 10 % of its range.
    most_edges
        Ours: so many edge points of a region are enough.
    """

    scales_px: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
    second_scales_px: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
    significance: float = 1e-6
    models: int = 48
    least_std_px: float = 0.3
    window: float = 2.5
    bias_px: float | None = 2.0
    space_share: float = 0.1
    range_share: float = 0.1
    most_edges: int = 1000

    def __post_init__(self) -> None:
        ElderZuckerOptions.__post_init__(self)
        require(
            self,
            models=self.models >= 2,
            least_std_px=self.least_std_px > 0,
            window=self.window > 1,
            bias_px=self.bias_px is None or self.bias_px > 0,
            space_share=self.space_share > 0,
            range_share=self.range_share > 0,
        )


def estimate_bae_durand(
    image: LinearImage, bank: Bank, labels: NDArray[np.int32], options: BaeDurandOptions | None = None
) -> dict[int, DepthEstimate]:
    """Depth of each region from its edges' fitted and filtered blur.

    Parameters
    ----------
    image
        Developed by the bank's recipe; its luminance is used.
    bank
        Its central PSFs tell the width of blur at each depth.
    labels
        int32 (H, W), 0 = no region.
    options
        See :class:`BaeDurandOptions`.

    Returns
    -------
    dict
        Estimates by label, without intervals: the paper gives none. ``diagnostics``: ``edge_std_px`` (N,) after and
        ``edge_fitted_px`` (N,) before filtering, ``edge_y`` and ``edge_x`` (N,) in pixels of the frame,
        ``blur_std_px``, ``radius_px``.
    """
    options = options or BaeDurandOptions()
    screened, scale = screen(image, bank, labels, options), blur_scale(bank)
    luminance = image.luminance
    largest = float(scale.std_px(np.abs(bank.lens.radius_px)).max())
    tried = np.geomspace(options.least_std_px, 1.3 * max(largest, options.least_std_px), options.models)
    estimates = dict(screened.refused)
    for region in screened.regions:
        profiles, corner = region_profiles(image, bank, region, screened.noise, options)
        fitted = fit_profiles(profiles, tried, options.window)
        if fitted.size < options.least_edges:
            estimates[region.label] = too_few_edges(bank, region, fitted.size, options.least_edges)
            continue
        found = edge_diagnostics(fitted, profiles, corner)
        y, x = (found[name].astype(np.intp) for name in ("edge_y", "edge_x"))
        inner = luminance[region.box][region.inside]
        filtered = cross_bilateral(
            fitted, np.stack([y, x]).astype(np.float64), luminance[y, x].astype(np.float64),
            space=options.space_share * max(region.inside.shape), brightness=options.range_share * float(np.ptp(inner)),
            bias=options.bias_px,
        )  # fmt: skip
        estimates[region.label] = estimate_from_blur(
            bank, region, options, scale, float(np.median(filtered)), scatter(fitted),
            {**found, "edge_std_px": filtered, "edge_fitted_px": fitted},
        )  # fmt: skip
    return dict(sorted(estimates.items()))


def fit_profiles(profiles: Profiles, tried_px: FloatArray, window: float) -> FloatArray:
    """Standard deviation (px) of blur whose model is most like each edge's profile, float64 (N,).

    The model is centred between the extrema; its height is free. Unlikeness is the part of the profile's power within
    the window that the model leaves.
    """
    best = np.full(profiles.scale_px.size, np.inf)
    found = np.zeros(profiles.scale_px.size)
    x = profiles.offset_px[np.newaxis] - 0.5 * (profiles.dark_px + profiles.bright_px)[:, np.newaxis]
    for std in tried_px:
        width = np.hypot(std, profiles.scale_px)[:, np.newaxis]
        within = np.abs(x) <= window * width
        model = np.where(within, -x * np.exp(-0.5 * (x / width) ** 2), 0.0)
        seen = np.where(within, profiles.bend, 0.0)
        height = (model * seen).sum(axis=1) / (model**2).sum(axis=1)
        left = ((seen - np.maximum(height, 0.0)[:, np.newaxis] * model) ** 2).sum(axis=1)
        left /= np.maximum((seen**2).sum(axis=1), 1e-30)
        better = left < best
        best[better], found[better] = left[better], std
    return found


def cross_bilateral(
    values: FloatArray, yx: FloatArray, levels: FloatArray, *, space: float, brightness: float, bias: float | None
) -> FloatArray:
    """Mean of all values at each point, weighed with distance, difference of level, and bias; float64 (N,).

    Parameters
    ----------
    values
        (N,) blurs, px.
    yx, levels
        (2, N) places and (N,) brightness of the points.
    space, brightness
        Standard deviations of the weights.
    bias
        Values weigh ``exp(-value / bias)``; None for equal weights.
    """
    away = ((yx[:, :, np.newaxis] - yx[:, np.newaxis, :]) ** 2).sum(axis=0) / max(space, 1e-9) ** 2
    away += ((levels[:, np.newaxis] - levels[np.newaxis, :]) / max(brightness, 1e-9)) ** 2
    weight = np.exp(-0.5 * away)
    if bias is not None:
        weight *= np.exp(-(values - values.min()) / bias)
    return np.asarray((weight @ values) / weight.sum(axis=1), np.float64)
