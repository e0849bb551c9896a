"""Depth by sharpness assessment: deconvolve with the PSF of every depth, the sharpest result names the depth.

The method of the published paper, step by step (equation numbers are the paper's):

1. Richardson-Lucy deconvolution of the image with each PSF (Eq. 3).
2. Absolute first and second differences along x and y (Eq. 4), summed over a window along the same axis (Eq. 5). The
   absolute value is not printed there; without it the window sum telescopes and Eq. 6 divides by about zero.
3. Each of the four maps divided by its sum over the region (Eq. 6).
4. Denoising by the cumulative distribution (Eq. 7): its axis is cut into equal sections; the threshold is the largest
   magnitude of the first section whose successor spans at least twice as much.
5. Mean of what lies above, summed over the maps (Eq. 8), times a factor that makes up for the PSF's size (Eq. 9, 10).
6. The depth of the largest score (Eq. 11).

A score is no probability. The interval that is reported is the range of depths whose score comes within
``interval_drop`` of the best, and the confidence compares the best peak with the others on the same scale. Neither is
calibrated: read them as how peaked the curve is, not as how often the answer is right.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.errors import MismatchError
from calibration.image import LinearImage
from calibration.optics import mirror_depth
from workbench.depth.estimate import DepthEstimate, Status
from workbench.depth.options import require
from workbench.depth.regions import bounding_box, edge_distance
from workbench.depth.richardson_lucy import Deconvolver, FloatImage, KernelBank

LambdaReading = Literal["one-minus-abs-sigma-mm", "one-minus-sigma-mm", "minus-sigma", "none"]
FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAPS = ("x", "y", "xx", "yy")
"""The four edge maps: first and second difference along each axis."""


@dataclass(frozen=True, slots=True)
class SharpnessOptions:
    """Constants of the method; the defaults of the first five are the paper's.

    Attributes
    ----------
    iterations
        Richardson-Lucy iterations.
    window
        Half width w of the window sum, pixels: 2 w + 1 values are added.
    sections
        Sections of the cumulative distribution.
    increment_ratio
        How much more magnitude the next section must span to end the noise.
    lambda_reading
        The factor of Eq. 9, which is damaged in print: ``1 - |sigma|`` or ``1 - sigma`` with sigma in mm on the
        sensor, ``-sigma`` in mm as the characters stand, or none.
    fallback_cdf
        Where the threshold is put if no section qualifies ("in most cases 0.9").
    margin_px
        Strip along a region's edge that doesn't count; None for the bank's largest blur radius.
    keep_fraction
        The strip is made narrower where less than this part of the region would remain.
    min_pixels
        Fewer inner pixels than this carry no depth.
    interval_drop
        Depths whose score is within this fraction of the best make the interval.
    ambiguity
        A second peak within this fraction of the best makes a region ambiguous; also the scale on which peaks are
        compared for confidence and mirror probability.
    min_contrast
        Least standard deviation of a region's 4 x 4 block means, in units of what noise alone gives.
    max_saturated
        Larger fractions of saturated inner pixels are reported.
    diagnostics_side
        Maps for figures are reduced to at most this many pixels a side.
    workers
        Threads.
    """

    iterations: int = 20
    window: int = 2
    sections: int = 10
    increment_ratio: float = 2.0
    lambda_reading: LambdaReading = "one-minus-abs-sigma-mm"
    fallback_cdf: float = 0.9
    margin_px: float | None = None
    keep_fraction: float = 0.25
    min_pixels: int = 400
    interval_drop: float = 0.05
    ambiguity: float = 0.01
    min_contrast: float = 2.0
    max_saturated: float = 0.1
    diagnostics_side: int = 400
    workers: int = 1

    def __post_init__(self) -> None:
        if self.lambda_reading not in get_args(LambdaReading):
            raise ValueError(f"lambda_reading = {self.lambda_reading}: one of {', '.join(get_args(LambdaReading))}")
        require(
            self,
            iterations=self.iterations >= 1,
            window=self.window >= 0,
            sections=self.sections >= 2,
            increment_ratio=self.increment_ratio > 0,
            fallback_cdf=0 <= self.fallback_cdf < 1,
            margin_px=self.margin_px is None or self.margin_px >= 0,
            keep_fraction=0 < self.keep_fraction <= 1,
            min_pixels=self.min_pixels >= 1,
            interval_drop=0 <= self.interval_drop < 1,
            ambiguity=0 < self.ambiguity < 1,
            min_contrast=self.min_contrast >= 0,
            max_saturated=0 <= self.max_saturated <= 1,
            diagnostics_side=self.diagnostics_side >= 1,
            workers=self.workers >= 1,
        )


@dataclass(frozen=True, slots=True)
class Denoised:
    """One edge map of one region after Eq. 6 to 8.

    Attributes
    ----------
    total
        Sum of the map over the region, by which it was divided; what follows is in units of it.
    section_ends
        float64 (sections + 1,) magnitudes at equal steps of the cumulative distribution, from its least to its largest.
    threshold
        What is kept lies above.
    score
        Mean of the kept values (Eq. 8); 0 for a map without any edge.
    """

    total: float
    section_ends: FloatArray
    threshold: float
    score: float


@dataclass(slots=True)
class _Region:
    label: int
    box: tuple[slice, slice]
    inside: Mask
    scores: FloatArray
    """(4, D)."""
    best_total: float = -np.inf
    best_deconvolved: FloatImage | None = None


def estimate_sharpness(
    image: LinearImage, bank: Bank, regions: NDArray[np.int32], options: SharpnessOptions | None = None
) -> dict[int, DepthEstimate]:
    """Depth of each region by sharpness assessment.

    Parameters
    ----------
    image
        Developed by the bank's recipe; its luminance is used.
    bank
        Its central set of PSFs is used.
    regions
        int32 (H, W), 0 = no region.
    options
        See :class:`SharpnessOptions`.

    Returns
    -------
    dict
        Estimates by label. ``diagnostics``: ``scores`` (4, D) per edge map before lambda, ``lambda`` (D,), ``sigma_mm``
        (D,); and of the best depth, for each name M in :data:`MAPS`: ``window_M`` and ``denoised_M`` (2-D, reduced),
        ``histogram_M`` (64,) with ``magnitude_M`` (65,) its bin edges, ``sections_M``, ``threshold_M`` (1,).

    Raises
    ------
    ValueError
        Labels of another size than the image.
    MismatchError
        A lambda in mm for a bank that doesn't state its pixel pitch.
    """
    options = options or SharpnessOptions()
    if regions.shape != image.shape:
        raise ValueError(f"labels are {regions.shape}, the image is {image.shape}")
    sigma_mm = _sigma_mm(bank, options)
    weight = lambda_factor(sigma_mm, options.lambda_reading)
    luminance = image.luminance
    noise = _noise_level(luminance)
    margin = float(np.abs(bank.lens.radius_px).max()) if options.margin_px is None else options.margin_px
    estimates: dict[int, DepthEstimate] = {}
    usable: list[_Region] = []
    for label in (int(value) for value in np.unique(regions) if value > 0):
        region = _region(regions, label, margin, len(bank.depths_mm), options)
        refused = _refuse(region, luminance, noise, bank, options)
        if refused is not None:
            estimates[label] = refused
        else:
            usable.append(region)
    if usable:
        _score_all(luminance, ~image.saturated, bank, usable, weight, options)
    for region in usable:
        saturated = float(image.saturated[region.box][region.inside].mean())
        estimates[region.label] = _conclude(region, bank, weight, sigma_mm, saturated, options)
    return dict(sorted(estimates.items()))


def lambda_factor(sigma_mm: FloatArray, reading: LambdaReading) -> FloatArray:
    """Factor of Eq. 9 for signed radii (mm on the sensor), in one of its readings."""
    if reading == "one-minus-abs-sigma-mm":
        return 1.0 - np.abs(sigma_mm)
    if reading == "one-minus-sigma-mm":
        return 1.0 - sigma_mm
    if reading == "minus-sigma":
        return -sigma_mm
    return np.ones_like(sigma_mm)


def edge_maps(deconvolved: FloatImage, window: int) -> dict[str, FloatImage]:
    """Window sums of absolute first and second differences, float32 (H, W) by name (Eq. 4 and 5).

    Differences that would reach beyond the image are zero.
    """
    maps = {}
    for axis, name in ((1, "x"), (0, "y")):
        first = np.zeros_like(deconvolved)
        second = np.zeros_like(deconvolved)
        step = np.diff(deconvolved, axis=axis)
        later, middle = ([slice(None)] * 2 for _ in range(2))
        later[axis], middle[axis] = slice(1, None), slice(1, -1)
        first[tuple(later)] = np.abs(step)
        second[tuple(middle)] = np.abs(np.diff(step, axis=axis))
        size = (2 * window + 1, 1) if axis == 1 else (1, 2 * window + 1)
        for suffix, difference in ((name, first), (name * 2, second)):
            summed = cv2.boxFilter(difference, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
            maps[suffix] = np.asarray(summed, np.float32)
    return maps


def denoise(window_sums: NDArray[np.floating], options: SharpnessOptions) -> Denoised:
    """Total-sum scaling, threshold from the cumulative distribution, and score of one map (Eq. 6 to 8).

    Parameters
    ----------
    window_sums
        (n,) values of one edge map at a region's pixels.
    options
        ``sections``, ``increment_ratio`` and ``fallback_cdf`` are used.
    """
    ordered = np.sort(np.asarray(window_sums, np.float32))
    total = float(ordered.sum(dtype=np.float64))
    fractions = np.linspace(0.0, 1.0, options.sections + 1)
    if not total > 0:
        return Denoised(0.0, np.zeros_like(fractions), 0.0, 0.0)
    ranks = np.arange(len(ordered))

    def magnitude(fraction: FloatArray) -> FloatArray:
        return np.interp(fraction * (len(ordered) - 1), ranks, ordered)

    ends = magnitude(fractions)
    spans = np.diff(ends)
    qualified = np.flatnonzero(spans[1:] >= options.increment_ratio * spans[:-1])
    threshold = float(ends[qualified[0] + 1] if len(qualified) else magnitude(np.array(options.fallback_cdf)))
    kept = ordered[np.searchsorted(ordered, threshold, side="right") :]
    score = float(kept.mean(dtype=np.float64)) / total if len(kept) else 0.0
    return Denoised(total, ends / total, threshold / total, score)


def _sigma_mm(bank: Bank, options: SharpnessOptions) -> FloatArray:
    sigma_px = bank.lens.sigma_px(bank.depths_mm)
    if bank.pixel_pitch_mm is None:
        if options.lambda_reading != "none":
            raise MismatchError(
                f"lambda_reading = {options.lambda_reading} needs radii in mm, but the bank doesn't know its pixel "
                "pitch; state the pitch when the bank is made, or use lambda_reading = none"
            )
        return np.full_like(sigma_px, np.nan)
    return sigma_px * bank.pixel_pitch_mm


def _region(labels: NDArray[np.int32], label: int, margin: float, depths: int, options: SharpnessOptions) -> _Region:
    """A region's inner part, in the box that holds it."""
    mask = labels == label
    box = bounding_box(mask)
    distance = edge_distance(mask[box], frame_is_edge=True)
    limit = float(np.quantile(distance[mask[box]], 1.0 - options.keep_fraction))
    # Distances of edge pixels are 1: a region that can't afford any margin keeps all of its pixels.
    inside = mask[box] & (distance > min(margin, limit - 0.5))
    return _Region(label, box, inside, np.zeros((len(MAPS), depths)))


def _refuse(
    region: _Region, luminance: FloatImage, noise: float, bank: Bank, options: SharpnessOptions
) -> DepthEstimate | None:
    """The estimate of a region that can't say anything."""
    pixels = int(region.inside.sum())
    if pixels < options.min_pixels:
        reason = f"only {pixels} inner pixels, {options.min_pixels} are needed"
    elif _contrast(luminance[region.box], region.inside) < options.min_contrast * noise / 4:
        reason = "no texture above the noise"
    else:
        return None
    nan = float("nan")
    return DepthEstimate(
        depth_mm=nan, interval_mm=(nan, nan), confidence=0.0, mirror_mm=nan, mirror_probability=nan,
        status="no-texture", depths_mm=bank.depths_mm, score=np.zeros(len(bank.depths_mm)), second_mm=nan,
        pixels=pixels, reason=reason,
    )  # fmt: skip


def _score_all(
    luminance: FloatImage,
    observed: Mask,
    bank: Bank,
    regions: list[_Region],
    weight: FloatArray,
    options: SharpnessOptions,
) -> None:
    """Deconvolve what the regions span once per depth, and score every region in it."""
    reach = bank.psf.shape[-1] // 2
    spans = [
        slice(
            max(0, min(region.box[axis].start for region in regions) - reach),
            max(region.box[axis].stop for region in regions) + reach,
        )
        for axis in (0, 1)
    ]
    crop = (spans[0], spans[1])
    plane = luminance[crop]
    deconvolver = Deconvolver(
        (plane.shape[0], plane.shape[1]), bank.psf.shape[-1], mask=observed[crop], workers=options.workers
    )
    prepared = deconvolver.prepare(plane)
    kernels = KernelBank(deconvolver, bank.central, max_bytes=0)
    for depth in range(len(bank.depths_mm)):
        deconvolved = deconvolver.richardson_lucy(prepared, kernels[depth], options.iterations)
        maps = edge_maps(deconvolved, options.window)
        for region in regions:
            here = tuple(
                slice(part.start - span.start, part.stop - span.start)
                for part, span in zip(region.box, crop, strict=True)
            )
            for row, name in enumerate(MAPS):
                region.scores[row, depth] = denoise(maps[name][here][region.inside], options).score
            total = weight[depth] * region.scores[:, depth].sum()
            if total > region.best_total:
                region.best_total = total
                region.best_deconvolved = deconvolved[here].copy()


def _conclude(
    region: _Region,
    bank: Bank,
    weight: FloatArray,
    sigma_mm: FloatArray,
    saturated: float,
    options: SharpnessOptions,
) -> DepthEstimate:
    total = weight * region.scores.sum(axis=0)
    top = float(total.max())
    curve = total / abs(top) if top else total
    best = int(np.argmax(curve))
    depths = bank.depths_mm
    depth = float(depths[best])
    peaks = [int(index) for index in _local_maxima(curve) if index != best]
    second = max(peaks, key=lambda index: curve[index], default=None)
    likeness = np.exp((curve - curve[best]) / options.ambiguity)
    confidence = 1.0 / (1.0 + float(likeness[peaks].sum()))
    mirror = mirror_depth(depth, focus_mm=bank.lens.focus_mm)
    # Next to the focal plane both sides lie on one peak: the interval says so, and the mirror is no other answer.
    between = (depths >= min(depth, mirror)) & (depths <= max(depth, mirror))
    on_one_peak = float(curve[between].min()) >= curve[best] - options.interval_drop
    rivals = depths[0] <= mirror <= depths[-1] and not on_one_peak
    # The curve is as smooth in 1 / depth as the blur is.
    at_mirror = float(np.interp(-1.0 / mirror, -1.0 / depths, likeness)) if rivals else 0.0
    mirror_probability = at_mirror / (1.0 + at_mirror)
    status: Status = "ok"
    reason = ""
    if second is not None and curve[best] - curve[second] < options.ambiguity:
        status = "ambiguous"
        reason = f"{depths[second] / 10:.1f} cm scores within {100 * options.ambiguity:g} % of the best"
    if saturated > options.max_saturated:
        status = "saturated"
        reason = f"{100 * saturated:.0f} % of the inner pixels are saturated"
    return DepthEstimate(
        depth_mm=depth,
        interval_mm=_interval(depths, curve, options.interval_drop),
        confidence=min(confidence, 1.0 - mirror_probability),
        mirror_mm=mirror if rivals else float("nan"),
        mirror_probability=mirror_probability,
        status=status,
        depths_mm=depths,
        score=curve,
        second_mm=float("nan") if second is None else float(depths[second]),
        pixels=int(region.inside.sum()),
        reason=reason,
        diagnostics={
            "scores": region.scores,
            "lambda": weight,
            "sigma_mm": sigma_mm,
            **_diagnostics(region, options),
        },
    )


def _local_maxima(curve: FloatArray) -> NDArray[np.intp]:
    """Indices of maxima, ends included; of equal neighbours the first."""
    padded = np.concatenate([[-np.inf], curve, [-np.inf]])
    return np.flatnonzero((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]))


def _interval(depths: FloatArray, curve: FloatArray, drop: float) -> tuple[float, float]:
    """From the first to the last depth that scores well enough, each widened by half a step of the bank."""
    good = np.flatnonzero(curve >= curve.max() - drop)
    edges = np.concatenate([depths[:1], (depths[1:] + depths[:-1]) / 2, depths[-1:]])
    return float(edges[good[0]]), float(edges[good[-1] + 1])


def _diagnostics(region: _Region, options: SharpnessOptions) -> dict[str, FloatArray]:
    if region.best_deconvolved is None:
        return {}
    found: dict[str, FloatArray] = {}
    for name, window_sums in edge_maps(region.best_deconvolved, options.window).items():
        result = denoise(window_sums[region.inside], options)
        picture = np.where(region.inside, window_sums / (result.total or 1.0), 0.0)
        counts, edges = np.histogram(picture[region.inside], bins=64)
        found |= {
            f"window_{name}": _reduced(picture, options.diagnostics_side),
            f"denoised_{name}": _reduced(np.where(picture > result.threshold, picture, 0.0), options.diagnostics_side),
            f"histogram_{name}": counts.astype(np.float64),
            f"magnitude_{name}": edges,
            f"sections_{name}": result.section_ends,
            f"threshold_{name}": np.array([result.threshold]),
        }
    return found


def _reduced(picture: FloatArray, side: int) -> FloatArray:
    factor = max(picture.shape) / side
    if factor <= 1:
        return picture
    size = (max(1, round(picture.shape[1] / factor)), max(1, round(picture.shape[0] / factor)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float64)


def _noise_level(luminance: FloatImage) -> float:
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
