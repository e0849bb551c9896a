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
from workbench.depth.estimate import DepthEstimate, Status, local_maxima
from workbench.depth.options import require
from workbench.depth.richardson_lucy import Deconvolver, FloatImage, KernelBank
from workbench.depth.screening import Region, ScreeningOptions, screen

LambdaReading = Literal["one-minus-abs-sigma-mm", "one-minus-sigma-mm", "minus-sigma", "none"]
FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAPS = ("x", "y", "xx", "yy")
"""The four edge maps: first and second difference along each axis."""


@dataclass(frozen=True, slots=True)
class SharpnessOptions(ScreeningOptions):
    """Constants of the method; the defaults of the first five named here are the paper's.

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
    interval_drop
        Depths whose score is within this fraction of the best make the interval.
    ambiguity
        A second peak within this fraction of the best makes a region ambiguous; also the scale on which peaks are
        compared for confidence and mirror probability.
    diagnostics_side
        Maps for figures are reduced to at most this many pixels a side.
    """

    iterations: int = 20
    window: int = 2
    sections: int = 10
    increment_ratio: float = 2.0
    lambda_reading: LambdaReading = "one-minus-abs-sigma-mm"
    fallback_cdf: float = 0.9
    interval_drop: float = 0.05
    ambiguity: float = 0.01
    diagnostics_side: int = 400

    def __post_init__(self) -> None:
        ScreeningOptions.__post_init__(self)
        if self.lambda_reading not in get_args(LambdaReading):
            raise ValueError(f"lambda_reading = {self.lambda_reading}: one of {', '.join(get_args(LambdaReading))}")
        require(
            self,
            iterations=self.iterations >= 1,
            window=self.window >= 0,
            sections=self.sections >= 2,
            increment_ratio=self.increment_ratio > 0,
            fallback_cdf=0 <= self.fallback_cdf < 1,
            interval_drop=0 <= self.interval_drop < 1,
            ambiguity=0 < self.ambiguity < 1,
            diagnostics_side=self.diagnostics_side >= 1,
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
class _Scored:
    region: Region
    scores: FloatArray
    """(4, D)."""
    best_total: float = -np.inf
    best_deconvolved: FloatImage | None = None


def estimate_sharpness(
    image: LinearImage,
    bank: Bank,
    regions: NDArray[np.int32],
    options: SharpnessOptions | None = None,
    *,
    workers: int = 1,
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
    workers
        Threads; no answer depends on their number.

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
    sigma_mm = _sigma_mm(bank, options)
    weight = lambda_factor(sigma_mm, options.lambda_reading)
    screened = screen(image, bank, regions, options)
    estimates = dict(screened.refused)
    usable = [_Scored(region, np.zeros((len(MAPS), len(bank.depths_mm)))) for region in screened.regions]
    if usable:
        _score_all(image.luminance, ~image.saturated, bank, usable, weight, options, workers)
    for scored in usable:
        estimates[scored.region.label] = _conclude(scored, bank, weight, sigma_mm, options)
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


def _score_all(
    luminance: FloatImage,
    observed: Mask,
    bank: Bank,
    scored: list[_Scored],
    weight: FloatArray,
    options: SharpnessOptions,
    workers: int,
) -> None:
    """Deconvolve what the regions span once per depth, and score every region in it."""
    reach = bank.psf.shape[-1] // 2
    boxes = [one.region.box for one in scored]
    spans = [
        slice(
            max(0, min(box[axis].start for box in boxes) - reach),
            max(box[axis].stop for box in boxes) + reach,
        )
        for axis in (0, 1)
    ]
    crop = (spans[0], spans[1])
    plane = luminance[crop]
    deconvolver = Deconvolver(
        (plane.shape[0], plane.shape[1]), bank.psf.shape[-1], mask=observed[crop], workers=workers
    )
    prepared = deconvolver.prepare(plane)
    kernels = KernelBank(deconvolver, bank.central, max_bytes=0)
    for depth in range(len(bank.depths_mm)):
        deconvolved = deconvolver.richardson_lucy(prepared, kernels[depth], options.iterations)
        maps = edge_maps(deconvolved, options.window)
        for one in scored:
            here = tuple(
                slice(part.start - span.start, part.stop - span.start)
                for part, span in zip(one.region.box, crop, strict=True)
            )
            for row, name in enumerate(MAPS):
                one.scores[row, depth] = denoise(maps[name][here][one.region.inside], options).score
            total = weight[depth] * one.scores[:, depth].sum()
            if total > one.best_total:
                one.best_total = total
                one.best_deconvolved = deconvolved[here].copy()


def _conclude(
    scored: _Scored,
    bank: Bank,
    weight: FloatArray,
    sigma_mm: FloatArray,
    options: SharpnessOptions,
) -> DepthEstimate:
    total = weight * scored.scores.sum(axis=0)
    top = float(total.max())
    curve = total / abs(top) if top else total
    best = int(np.argmax(curve))
    depths = bank.depths_mm
    depth = float(depths[best])
    peaks = [int(index) for index in local_maxima(curve) if index != best]
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
    if scored.region.saturated > options.max_saturated:
        status = "saturated"
        reason = f"{100 * scored.region.saturated:.0f} % of the inner pixels are saturated"
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
        pixels=scored.region.pixels,
        reason=reason,
        diagnostics={
            "scores": scored.scores,
            "lambda": weight,
            "sigma_mm": sigma_mm,
            **_diagnostics(scored, options),
        },
    )


def _interval(depths: FloatArray, curve: FloatArray, drop: float) -> tuple[float, float]:
    """From the first to the last depth that scores well enough, each widened by half a step of the bank."""
    good = np.flatnonzero(curve >= curve.max() - drop)
    edges = np.concatenate([depths[:1], (depths[1:] + depths[:-1]) / 2, depths[-1:]])
    return float(edges[good[0]]), float(edges[good[-1] + 1])


def _diagnostics(scored: _Scored, options: SharpnessOptions) -> dict[str, FloatArray]:
    if scored.best_deconvolved is None:
        return {}
    inside, found = scored.region.inside, dict[str, FloatArray]()
    for name, window_sums in edge_maps(scored.best_deconvolved, options.window).items():
        result = denoise(window_sums[inside], options)
        picture = np.where(inside, window_sums / (result.total or 1.0), 0.0)
        counts, edges = np.histogram(picture[inside], bins=64)
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
