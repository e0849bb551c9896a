"""Deconvolution with a sparse prior on derivatives, by iteratively reweighted least squares.

Levin, Fergus, Durand and Freeman, "Image and depth from a conventional camera with a coded aperture", ACM Transactions
on Graphics 26, 70 (SIGGRAPH 2007): least ``|y - f * x|**2 + we sum w_i |D_i x|**0.8`` over first and second
derivatives D_i. A power below 1 is reached by solving least squares again and again, each derivative weighed with
``max(|D_i x|, floor)**(0.8 - 2)`` of the solution before.

Light from outside the picture falls into it: the solution lives on a domain that is larger by the PSF's reach, and only
observed pixels count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from workbench.compiled import compiled

FloatImage = NDArray[np.float32]

_SECOND = 0.25
"""Weight of second derivatives relative to first ones, as in the authors' program."""


@dataclass(frozen=True, slots=True)
class SparsePrior:
    """Constants of the prior; see :class:`workbench.depth.references.levin.LevinOptions`."""

    exponent: float
    smoothness: float
    weight: float
    floor: float
    reweightings: int
    iterations: int


def sparse_deconvolve(picture: FloatImage, psf: FloatImage, prior: SparsePrior) -> tuple[FloatImage, FloatImage]:
    """Restore a picture and say what the restoration leaves unexplained.

    Parameters
    ----------
    picture
        float32 (H, W), about 0 to 1.
    psf
        float32 (K, K), K odd, unit sum.
    prior
        Constants.

    Returns
    -------
    (float32 (H, W), float32 (H, W))
        Restored picture, and ``y - f * x``.
    """
    half = psf.shape[0] // 2
    height, width = picture.shape
    size = fft.next_fast_len(height + 2 * half, real=True), fft.next_fast_len(width + 2 * half, real=True)
    padded = np.zeros(size, np.float32)
    padded[: psf.shape[0], : psf.shape[1]] = psf
    transfer = fft.rfft2(np.roll(padded, (-half, -half), axis=(0, 1)))
    observed = (slice(half, half + height), slice(half, half + width))
    spare = size[0] - height - half, size[1] - width - half
    extended = np.pad(picture, ((half, spare[0]), (half, spare[1])), mode="reflect")

    def blur(x: FloatImage) -> FloatImage:
        blurred = fft.irfft2(transfer * fft.rfft2(x), s=size)
        return np.asarray(blurred[observed], np.float32)

    def blur_adjoint(y: FloatImage) -> FloatImage:
        canvas = np.zeros(size, np.float32)
        canvas[observed] = y
        return np.asarray(fft.irfft2(np.conj(transfer) * fft.rfft2(canvas), s=size), np.float32)

    # The first solution weighs all derivatives alike, and all of them one.
    power = np.abs(transfer) ** 2 + prior.smoothness * _gradient_power(size)
    x = np.asarray(fft.irfft2(np.conj(transfer) * fft.rfft2(extended) / power, s=size), np.float32)
    target = blur_adjoint(picture)
    weights = np.ones((5, *size), np.float32)
    for _ in range(prior.reweightings + 1):

        def normal(v: FloatImage, weights: FloatImage = weights) -> FloatImage:
            return np.asarray(blur_adjoint(blur(v)) + np.float32(prior.smoothness) * _penalty(v, weights), np.float32)

        x = _conjugate_gradients(normal, target, x, prior.iterations)
        weights = _sparse_weights(x, prior)
    return x[observed], picture - blur(x)


@compiled
def _penalty(x: FloatImage, weights: FloatImage) -> FloatImage:
    """Half the gradient of the weighed squares of the derivatives x, y, xx, yy, xy; weights (5, H, W)."""
    height, width = x.shape
    total = np.zeros_like(x)
    for i in range(height):
        for j in range(width):
            if j + 1 < width:
                d = weights[0, i, j] * (x[i, j + 1] - x[i, j])
                total[i, j + 1] += d
                total[i, j] -= d
            if i + 1 < height:
                d = weights[1, i, j] * (x[i + 1, j] - x[i, j])
                total[i + 1, j] += d
                total[i, j] -= d
            if 0 < j < width - 1:
                d = weights[2, i, j] * (x[i, j + 1] - 2 * x[i, j] + x[i, j - 1])
                total[i, j + 1] += d
                total[i, j] -= 2 * d
                total[i, j - 1] += d
            if 0 < i < height - 1:
                d = weights[3, i, j] * (x[i + 1, j] - 2 * x[i, j] + x[i - 1, j])
                total[i + 1, j] += d
                total[i, j] -= 2 * d
                total[i - 1, j] += d
            if j + 1 < width and i + 1 < height:
                d = weights[4, i, j] * (x[i + 1, j + 1] - x[i + 1, j] - x[i, j + 1] + x[i, j])
                total[i + 1, j + 1] += d
                total[i + 1, j] -= d
                total[i, j + 1] -= d
                total[i, j] += d
    return total


def _sparse_weights(x: FloatImage, prior: SparsePrior) -> FloatImage:
    """Weights of the next least squares for the derivatives of this solution, float32 (5, H, W)."""
    size = np.zeros((5, *x.shape), np.float32)
    size[0, :, :-1] = np.diff(x, axis=1)
    size[1, :-1] = np.diff(x, axis=0)
    size[2, :, 1:-1] = np.diff(x, 2, axis=1)
    size[3, 1:-1] = np.diff(x, 2, axis=0)
    size[4, :-1, :-1] = np.diff(np.diff(x, axis=0), axis=1)
    np.abs(size, out=size)
    np.maximum(size, np.float32(prior.floor), out=size)
    np.power(size, np.float32(prior.exponent - 2.0), out=size)
    size *= np.float32(prior.weight)
    size[2:] *= np.float32(_SECOND)
    return size


def _gradient_power(size: tuple[int, int]) -> FloatImage:
    fy, fx = fft.fftfreq(size[0])[:, np.newaxis], fft.rfftfreq(size[1])[np.newaxis]
    x, y = 4.0 * np.sin(np.pi * fx) ** 2, 4.0 * np.sin(np.pi * fy) ** 2
    return np.asarray(x + y + x**2 + y**2 + x * y + 1e-6, np.float32)


def _conjugate_gradients(
    apply: Callable[[FloatImage], FloatImage], target: FloatImage, x: FloatImage, iterations: int
) -> FloatImage:
    """Solve ``apply(x) = target`` for a symmetric positive operator, from ``x``, by so many steps."""
    left = target - apply(x)
    direction = left.copy()
    size = float(np.vdot(left, left))
    for _ in range(iterations):
        if size < 1e-12:
            break
        pushed = apply(direction)
        step = np.float32(size / float(np.vdot(direction, pushed)))
        x = x + step * direction
        left -= step * pushed
        before, size = size, float(np.vdot(left, left))
        direction = left + np.float32(size / before) * direction
    return x
