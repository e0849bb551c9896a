"""Edges and their profiles: Gaussian derivatives, critical values of noise, second derivative along the gradient.

After Elder and Zucker, "Local scale control for edge detection and blur estimation" (IEEE PAMI 20, 699, 1998): at each
pixel a derivative is taken at the smallest scale at which it exceeds what sensor noise gives anywhere in the image.
Bae and Durand (2007) find edges in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcinv, ndtr

FloatArray = NDArray[np.float64]
FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]

_STEP_PX = 0.5
"""Between the samples of a profile."""


@lru_cache(maxsize=64)
def _kernels(scale_px: float) -> tuple[FloatImage, FloatImage, FloatImage]:
    """Gaussian and its first two derivatives along one axis, integrated over pixels, exact on polynomials."""
    half = int(np.ceil(4.5 * scale_px)) + 1
    x = np.arange(-half, half + 1, dtype=np.float64)
    edges = np.arange(-half - 0.5, half + 1) / scale_px
    bell = np.exp(-0.5 * edges**2)
    smooth = np.diff(ndtr(edges))
    smooth /= smooth.sum()
    slope = -np.diff(bell)
    slope /= (slope * x).sum()  # correlated with a ramp of slope one it gives one
    bend = np.diff(-edges * bell)
    bend -= bend.mean()
    bend /= (bend * x**2).sum() / 2
    return smooth.astype(np.float32), slope.astype(np.float32), bend.astype(np.float32)


def derivative(plane: FloatImage, scale_px: float, order_x: int, order_y: int) -> FloatImage:
    """Derivative of a plane (H, W) smoothed by a Gaussian, per pixel to the order's power; float32 (H, W)."""
    kernels = _kernels(scale_px)
    filtered = cv2.sepFilter2D(plane, cv2.CV_32F, kernels[order_x], kernels[order_y], borderType=cv2.BORDER_REFLECT)
    return np.asarray(filtered, np.float32)


def noise_gain(scale_px: float, order: int) -> float:
    """Standard deviation of a derivative along an axis per standard deviation of white pixel noise."""
    kernels = _kernels(scale_px)
    return float(np.linalg.norm(kernels[0]) * np.linalg.norm(kernels[order]))


@dataclass(frozen=True, slots=True)
class Detection:
    """How edges are found.

    Attributes
    ----------
    scales_px
        Of first derivatives, ascending.
    second_scales_px
        Of second derivatives, ascending.
    significance
        Chance that noise alone exceeds a critical value anywhere in the image.
    """

    scales_px: tuple[float, ...]
    second_scales_px: tuple[float, ...]
    significance: float

    def critical_slope(self, scale_px: float, noise: float, pixels: int) -> float:
        """Least gradient that noise doesn't explain: its modulus is Rayleigh distributed."""
        point = _pointwise(self.significance, pixels)
        return float(noise * noise_gain(scale_px, 1) * np.sqrt(-2.0 * np.log(point)))

    def critical_bend(self, scale_px: float, noise: float, pixels: int) -> float:
        """Least second derivative (absolute) that noise doesn't explain: normally distributed."""
        point = _pointwise(self.significance, pixels)
        return float(noise * noise_gain(scale_px, 2) * np.sqrt(2.0) * erfcinv(point))


def _pointwise(significance: float, pixels: int) -> float:
    return float(-np.expm1(np.log1p(-significance) / pixels))


@dataclass(frozen=True, slots=True)
class Edges:
    """Edge points.

    Attributes
    ----------
    y, x
        float64 (N,), pixels.
    direction_y, direction_x
        float64 (N,): unit vector towards the brighter side.
    """

    y: FloatArray
    x: FloatArray
    direction_y: FloatArray
    direction_x: FloatArray


def find_edges(plane: FloatImage, usable: Mask, noise: float, detection: Detection, most: int) -> Edges:
    """Zero crossings of the second derivative along the gradient, each derivative at its minimum reliable scale.

    Parameters
    ----------
    plane
        float32 (H, W).
    usable
        bool (H, W): where edges are wanted.
    noise
        Standard deviation of pixel noise.
    detection
        Scales and significance.
    most
        More edges than this are thinned out evenly.
    """
    slope_y, slope_x = _reliable_gradient(plane, noise, detection)
    size = np.hypot(slope_y, slope_x)
    known = size > 0
    unit_y, unit_x = (np.divide(part, size, out=np.zeros_like(part), where=known) for part in (slope_y, slope_x))
    bend = _reliable_bend(plane, unit_y, unit_x, noise, detection)
    y, x = np.nonzero(usable & known)
    ahead_y = np.clip(y + np.rint(unit_y[y, x]).astype(np.intp), 0, plane.shape[0] - 1)
    ahead_x = np.clip(x + np.rint(unit_x[y, x]).astype(np.intp), 0, plane.shape[1] - 1)
    here, ahead = bend[y, x], bend[ahead_y, ahead_x]
    crossing = np.flatnonzero(((here > 0) & (ahead <= 0)) | ((here >= 0) & (ahead < 0)))
    if crossing.size > most:
        crossing = crossing[np.linspace(0, crossing.size - 1, most).astype(np.intp)]
    y, x = y[crossing], x[crossing]
    return Edges(*(np.asarray(v, np.float64) for v in (y, x, unit_y[y, x], unit_x[y, x])))


def _reliable_gradient(plane: FloatImage, noise: float, detection: Detection) -> tuple[FloatImage, FloatImage]:
    """Gradient at each pixel's minimum reliable scale; zero where there is none."""
    slope_y, slope_x = np.zeros_like(plane), np.zeros_like(plane)
    open_ = np.ones(plane.shape, np.bool_)
    for scale in detection.scales_px:
        gx, gy = derivative(plane, scale, 1, 0), derivative(plane, scale, 0, 1)
        taken = open_ & (np.hypot(gx, gy) > detection.critical_slope(scale, noise, plane.size))
        slope_y[taken], slope_x[taken] = gy[taken], gx[taken]
        open_ &= ~taken
    return slope_y, slope_x


def _reliable_bend(
    plane: FloatImage, unit_y: FloatImage, unit_x: FloatImage, noise: float, detection: Detection
) -> FloatImage:
    """Second derivative along given directions at each pixel's minimum reliable scale; zero where there is none."""
    bend = np.zeros_like(plane)
    open_ = np.ones(plane.shape, np.bool_)
    for scale in detection.second_scales_px:
        steered = _steered(_second(plane, scale), unit_y, unit_x)
        taken = open_ & (np.abs(steered) > detection.critical_bend(scale, noise, plane.size))
        bend[taken] = steered[taken]
        open_ &= ~taken
    return bend


def _second(plane: FloatImage, scale_px: float) -> tuple[FloatImage, FloatImage, FloatImage]:
    return derivative(plane, scale_px, 2, 0), derivative(plane, scale_px, 1, 1), derivative(plane, scale_px, 0, 2)


def _steered(
    second: tuple[FloatImage, FloatImage, FloatImage], unit_y: NDArray[np.floating], unit_x: NDArray[np.floating]
) -> FloatImage:
    xx, xy, yy = second
    return np.asarray(unit_x**2 * xx + 2.0 * unit_x * unit_y * xy + unit_y**2 * yy, np.float32)


@dataclass(frozen=True, slots=True)
class Profiles:
    """Second derivative along the gradient at N edge points, each at the scale at which both its extrema are reliable.

    Attributes
    ----------
    offset_px
        float64 (L,): distance along the gradient from the edge point.
    bend
        float32 (N, L).
    scale_px
        float64 (N,).
    dark_px, bright_px
        float64 (N,): offsets of the extrema on the dark (positive) and bright (negative) side.
    edges
        The points, of those given, that have such a profile.
    """

    offset_px: FloatArray
    bend: FloatImage
    scale_px: FloatArray
    dark_px: FloatArray
    bright_px: FloatArray
    edges: Edges

    @property
    def distance_px(self) -> FloatArray:
        """Distance between the extrema, float64 (N,)."""
        return self.bright_px - self.dark_px


def edge_profiles(plane: FloatImage, edges: Edges, noise: float, detection: Detection, reach_px: int) -> Profiles:
    """Profiles of all edges on which both extrema are found within ``reach_px``; see :class:`Profiles`."""
    offset = np.arange(-reach_px, reach_px + _STEP_PX / 2, _STEP_PX)
    wanted = np.arange(edges.y.size)
    found: list[tuple[NDArray[np.intp], FloatImage, FloatArray, FloatArray, float]] = []
    for scale in detection.second_scales_px:
        if wanted.size == 0:
            break
        uy, ux = edges.direction_y[wanted, np.newaxis], edges.direction_x[wanted, np.newaxis]
        map_y = (edges.y[wanted, np.newaxis] + uy * offset).astype(np.float32)
        map_x = (edges.x[wanted, np.newaxis] + ux * offset).astype(np.float32)
        xx, xy, yy = (
            np.asarray(cv2.remap(part, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), np.float32)
            for part in _second(plane, scale)
        )
        bend = _steered((xx, xy, yy), uy, ux)
        critical = detection.critical_bend(scale, noise, plane.size)
        middle = offset.size // 2
        bright = _first_lobe(-bend[:, middle:], critical)
        dark = _first_lobe(bend[:, middle::-1], critical)
        good = np.isfinite(bright) & np.isfinite(dark)
        found.append((wanted[good], bend[good], -_STEP_PX * dark[good], _STEP_PX * bright[good], scale))
        wanted = wanted[~good]
    if not found:
        empty = np.zeros(0)
        return Profiles(offset, np.zeros((0, offset.size), np.float32), empty, empty, empty, edges)
    index = np.concatenate([part[0] for part in found])
    return Profiles(
        offset_px=offset,
        bend=np.concatenate([part[1] for part in found]),
        scale_px=np.concatenate([np.full(part[0].size, part[4]) for part in found]),
        dark_px=np.concatenate([part[2] for part in found]),
        bright_px=np.concatenate([part[3] for part in found]),
        edges=Edges(edges.y[index], edges.x[index], edges.direction_y[index], edges.direction_x[index]),
    )


def _first_lobe(values: FloatImage, least: float) -> FloatArray:
    """Place of the highest point of the first lobe above ``least`` in each row, between samples by a parabola.

    A lobe ends where the sign changes; its first local maximum would often be a ripple of noise. NaN where no lobe
    rises above ``least``, or it has no maximum within the row.
    """
    above = np.maximum.accumulate(values > least, axis=1)
    over = np.maximum.accumulate(above & (values <= 0), axis=1)
    lobe = np.where(over, -np.inf, values)
    rows = np.arange(len(values))
    at = np.argmax(lobe, axis=1)
    good = above.any(axis=1) & (at > 0) & (at < values.shape[1] - 1)
    at = np.clip(at, 1, values.shape[1] - 2)
    before, top, after = (values[rows, at + k].astype(np.float64) for k in (-1, 0, 1))
    bend = before - 2.0 * top + after
    shift = np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend < 0)
    return np.where(good, at + np.clip(shift, -0.5, 0.5), np.nan)
