"""From cut-out points to the planes of a bank: average repeats, place the chief ray, normalise, undo the dot's size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.special import j1

from calibration.points import PointImage

FloatArray = NDArray[np.float64]

REGISTER_ABOVE_PX = 0.05
"""Repeats that lie closer than this are averaged as they are: interpolation would blur more than it mends."""


@dataclass(frozen=True, slots=True)
class Stacked:
    """The average of all repeats at one depth (see :class:`calibration.points.PointImage` for the arrays).

    Attributes
    ----------
    point
        Averaged cut-out; ``variance`` is that of the average.
    repeats
        Number of frames.
    scatter
        Root mean square difference of single frames from the average over what their noise predicts; 1 is perfect,
        NaN for a single frame.
    shifts_px
        float64 (repeats, 2): measured shift of each frame against the first.
    flux_spread
        Relative standard deviation of the frames' flux (lamp, shutter); NaN for a single frame.
    """

    point: PointImage
    repeats: int
    scatter: float
    shifts_px: FloatArray
    flux_spread: float


def stack_repeats(points: Sequence[PointImage]) -> Stacked:
    """Average repeated images of one point, registered to a fraction of a pixel, each scaled to the mean flux.

    The shifts are found by least squares on the first image's gradients (Lucas and Kanade 1981), iterated. Frames
    that lie within 0.05 px of each other are not interpolated; others are moved by cubic splines to the mean position.
    """
    if len(points) == 1:
        return Stacked(points[0], 1, float("nan"), np.zeros((1, 2)), float("nan"))
    corner = np.min([p.corner_yx for p in points], axis=0)
    end = np.max([np.add(p.corner_yx, p.values.shape) for p in points], axis=0)
    shape = (int(end[0] - corner[0]), int(end[1] - corner[1]))
    values = np.zeros((len(points), *shape))
    variance = np.zeros((len(points), *shape))
    support = np.zeros(shape, np.bool_)
    for k, p in enumerate(points):
        y, x = int(p.corner_yx[0] - corner[0]), int(p.corner_yx[1] - corner[1])
        area = (slice(y, y + p.values.shape[0]), slice(x, x + p.values.shape[1]))
        values[k][area] = p.values
        variance[k] = p.noise**2
        variance[k][area] = p.variance
        support[area] |= p.support
    flux = np.array([p.flux for p in points])
    gain = flux.mean() / flux
    values *= gain[:, np.newaxis, np.newaxis]
    variance *= gain[:, np.newaxis, np.newaxis] ** 2
    shifts = np.array([_shift_between(values[0], v) for v in values])
    moves = shifts.mean(axis=0) - shifts
    for k, move in enumerate(moves):
        if np.abs(move).max() > REGISTER_ABOVE_PX:
            values[k] = ndimage.shift(values[k], move, order=3, mode="constant")
            variance[k] = np.maximum(ndimage.shift(variance[k], move, order=1, mode="nearest"), variance[k].min())
    mean = values.mean(axis=0)
    predicted = variance.mean(axis=0)
    count = len(points)
    seen = ((values - mean) ** 2).sum(axis=0) / (count - 1)
    scatter = float(np.sqrt((seen[support] / predicted[support]).mean()))
    stacked_variance = predicted / count * max(1.0, scatter**2)
    first = points[0]
    total = float(mean[support].sum())
    point = replace(
        first,
        values=mean,
        variance=stacked_variance,
        support=support,
        corner_yx=(int(corner[0]), int(corner[1])),
        flux=total,
        flux_snr=total / float(np.sqrt(stacked_variance[support].sum())),
        background=float(np.mean([p.background for p in points])),
        background_tilt=float(np.mean([p.background_tilt for p in points])),
        noise=first.noise / float(np.sqrt(count)),
        peak=max(p.peak for p in points),
        hot_pixels=max(p.hot_pixels for p in points),
    )
    return Stacked(point, count, scatter, shifts, float(flux.std(ddof=1) / flux.mean()))


def _shift_between(reference: FloatArray, image: FloatArray, iterations: int = 8) -> FloatArray:
    """Shift (rows, columns) of ``image`` against ``reference`` by iterated least squares on the gradients."""
    correlation = fft.irfft2(np.conj(fft.rfft2(reference)) * fft.rfft2(image), s=reference.shape)
    peak = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
    shift = np.array([p - n if p > n // 2 else p for p, n in zip(peak, reference.shape, strict=True)], np.float64)
    for _ in range(iterations):
        moved = ndimage.shift(image, -shift, order=3, mode="constant")
        gy, gx = np.gradient(moved)
        design = np.stack([gy.ravel(), gx.ravel()], axis=1)
        step = np.linalg.lstsq(design, (moved - reference).ravel(), rcond=None)[0]
        shift = shift - step
        if np.abs(step).max() < 1e-3:
            break
    return shift


def dot_radius_px(dot_mm: float, depth_mm: float, *, image_distance_mm: float, pitch_mm: float) -> float:
    """Radius (px) of the in-focus image of a dot of diameter ``dot_mm`` at ``depth_mm`` (thin lens magnification)."""
    return 0.5 * dot_mm * image_distance_mm / depth_mm / pitch_mm


def disc_variance(radius_px: float) -> float:
    """Variance per axis (px^2) of a uniform disc: r^2 / 4."""
    return radius_px**2 / 4.0


def common_fraction(centres: FloatArray) -> FloatArray:
    """Fraction of a pixel (2,) that the chief rays of all depths share: their circular mean, in [-1/2, 1/2)."""
    phase = np.exp(2j * np.pi * centres)
    return np.asarray(np.angle(phase.mean(axis=0)) / (2 * np.pi), np.float64)


@dataclass(frozen=True, slots=True)
class Plane:
    """One depth's PSF on the bank's grid.

    Attributes
    ----------
    psf, se
        float64 (K, K): unit sum, zero outside the support; standard error per pixel (0 outside the support).
    offset_yx
        Chief ray's position relative to the centre pixel (px); up to half a pixel, since measured samples are never
        interpolated.
    """

    psf: FloatArray
    se: FloatArray
    offset_yx: tuple[float, float]


def half_size(point: PointImage, centre_yx: tuple[int, int]) -> int:
    """Half side (px) of the square about ``centre_yx`` (row, column in the frame) that holds the point's support."""
    rows, columns = np.nonzero(point.support)
    dy = np.abs(rows + point.corner_yx[0] - centre_yx[0]).max()
    dx = np.abs(columns + point.corner_yx[1] - centre_yx[1]).max()
    return int(max(dy, dx))


def place(point: PointImage, chief_yx: tuple[float, float], centre_yx: tuple[int, int], half: int) -> Plane:
    """Put a point on a (2 half + 1)^2 grid about ``centre_yx`` and normalise it to unit sum.

    The standard error contains the pixel's own noise and its share of the sum's.
    """
    k = 2 * half + 1
    psf, variance = np.zeros((k, k)), np.zeros((k, k))
    y, x = point.corner_yx[0] - centre_yx[0] + half, point.corner_yx[1] - centre_yx[1] + half
    h, w = point.values.shape
    y0, y1, x0, x1 = max(0, y), min(k, y + h), max(0, x), min(k, x + w)
    inner = (slice(y0 - y, y1 - y), slice(x0 - x, x1 - x))
    psf[y0:y1, x0:x1] = np.where(point.support, point.values, 0.0)[inner]
    variance[y0:y1, x0:x1] = np.where(point.support, point.variance, 0.0)[inner]
    total = float(psf.sum())
    psf /= total
    # p = v / S: var(p) = (var(v) (1 - 2 p) + p^2 var(S)) / S^2
    variance = np.maximum(variance * (1.0 - 2.0 * psf) + psf**2 * variance.sum(), 0.0) / total**2
    return Plane(psf, np.sqrt(variance), (chief_yx[0] - centre_yx[0], chief_yx[1] - centre_yx[1]))


def undo_dot(plane: Plane, radius_px: float) -> Plane:
    """Undo the blur by the dot's own image, a disc of ``radius_px``, as far as the noise allows.

    Richardson-Lucy with the disc's transform, restricted to the measured support and to a handful of iterations
    (about as many as pixels that the disc covers): it sharpens edges blurred by up to a disc's radius, keeps the sum
    and stays non-negative. What it can't do is to restore detail finer than the disc; the standard errors are scaled
    by how much the noise grew (measured on a perturbed copy). Below 0.25 px nothing is done: the effect on the
    variance is then under 0.016 px^2.
    """
    if radius_px < 0.25:
        return plane
    k = plane.psf.shape[0]
    support = plane.psf != 0
    size = fft.next_fast_len(2 * k)
    transfer = _disc_transfer(size, radius_px)

    def blur(image: FloatArray) -> FloatArray:
        padded = fft.irfft2(fft.rfft2(image, s=(size, size)) * transfer, s=(size, size))
        return np.asarray(padded[:k, :k], np.float64)

    iterations = int(np.clip(np.ceil(np.pi * radius_px**2 * 3), 3, 15))

    def sharpen(data: FloatArray) -> FloatArray:
        data = np.maximum(data, 0.0)
        floor = 1e-4 * data.max()
        estimate = np.where(support, data, 0.0)
        weight = np.maximum(blur(support.astype(np.float64)), 0.1)
        for _ in range(iterations):
            ratio = (data + floor) / (np.maximum(blur(estimate), 0.0) + floor)
            estimate = estimate * np.where(support, blur(np.where(support, ratio, 0.0)) / weight, 0.0)
        return np.asarray(estimate / estimate.sum(), np.float64)

    sharp = sharpen(plane.psf)
    perturbed = sharpen(plane.psf + plane.se * np.random.default_rng(0).standard_normal(plane.psf.shape))
    grown = float(np.sqrt(((perturbed - sharp)[support] ** 2).sum() / max((plane.se[support] ** 2).sum(), 1e-300)))
    return replace(plane, psf=sharp, se=plane.se * max(1.0, grown))


def _disc_transfer(size: int, radius_px: float) -> FloatArray:
    """Transform of a uniform disc, 2 J1(t) / t with t = 2 pi radius |f| (Airy 1835); real, (size, size//2 + 1)."""
    fy, fx = np.fft.fftfreq(size)[:, np.newaxis], np.fft.rfftfreq(size)[np.newaxis, :]
    t = np.maximum(2 * np.pi * radius_px * np.hypot(fy, fx), 1e-9)
    return np.asarray(2.0 * j1(t) / t, np.float64)
