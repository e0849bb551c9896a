"""What periodogram a blur makes one expect, of white texture: one blur, or several side by side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]

_AT_ONCE = 8
"""Blurs, as many as the processor's cache holds."""


def smeared_power(kernel_lags: Float32, taper_lags: FloatArray, size: int) -> Float32:
    """Expected periodogram of white texture behind each blur.

    Parameters
    ----------
    kernel_lags
        float32 (D, 2 L + 1, 2 L + 1): autocorrelation that each blur leaves
        (:func:`~workbench.depth.evidence_kernels.kernel_lags`).
    taper_lags
        float64 (2 L + 1, 2 L + 1).
    size
        Window side N; lags beyond it fold over, as sampling the spectrum at N frequencies makes them.

    Returns
    -------
    float32 (D, N, N // 2 + 1).
    """
    longest = kernel_lags.shape[1] // 2
    reach = min(longest, size - 1)  # the taper has no longer lags
    part = slice(longest - reach, longest + reach + 1)
    taper = taper_lags[part, part].astype(np.float32)
    power = np.empty((kernel_lags.shape[0], size, size // 2 + 1), np.float32)
    unfolded = np.zeros((_AT_ONCE, 2 * size, 2 * size), np.float32)
    middle = unfolded[:, size - reach : size + reach + 1, size - reach : size + reach + 1]
    for first in range(0, len(power), _AT_ONCE):
        count = min(_AT_ONCE, len(power) - first)
        np.multiply(kernel_lags[first : first + count, part, part], taper, out=middle[:count])
        rows = unfolded[:count, :size] + unfolded[:count, size:]
        power[first : first + count] = fft.rfft2(rows[:, :, :size] + rows[:, :, size:], axes=(1, 2)).real
    return power


def mixed_power(expected: Float32, radius_px: FloatArray, spread_px: float) -> Float32:
    """Expected periodogram where all blurs up to ``spread_px`` smaller or larger than one another occur side by side.

    Parameters
    ----------
    expected
        float32 (D, N, N // 2 + 1): :func:`smeared_power` of each blur.
    radius_px
        float64 (D,): their radii, evenly spaced; |radius| counts, so that blurs of both sides of focus may mix.
    spread_px
        Half the range of radii in a mixture, as far as the rows reach.

    Returns
    -------
    float32 (M, N, N // 2 + 1)
        Mixtures about every third radius.
    """
    radius = np.abs(radius_px)
    step = float(np.median(np.abs(np.diff(radius))))
    order = np.argsort(radius)
    ascending = radius[order]
    middles = ascending[::3][ascending[::3] <= ascending[-1] - 0.5 * spread_px]
    offsets = np.arange(-spread_px, spread_px + 0.5 * step, step)
    # both sides of focus where rows are signed: the nearest row of that |radius| will do
    wanted = np.abs(middles[:, np.newaxis] + offsets)
    nearest = np.abs(wanted[:, :, np.newaxis] - ascending).argmin(axis=2)
    share = np.zeros((middles.size, radius.size), np.float32)
    reached = (wanted <= ascending[-1] + 0.5 * step) & (wanted >= ascending[0] - 0.5 * step)
    np.add.at(share, (np.arange(middles.size)[:, np.newaxis], order[nearest]), reached.astype(np.float32))
    share /= share.sum(axis=1, keepdims=True)
    return np.asarray((share @ expected.reshape(radius.size, -1)).reshape(middles.size, *expected.shape[1:]))
