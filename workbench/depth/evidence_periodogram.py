"""A region's pooled periodogram, with the tapers' own autocorrelation.

A taper smears the spectrum and fills the zeros that carry the depth; the model is therefore smeared alike. That is
cheap in the lag domain: the expected periodogram is the transform of the image's autocovariance times the taper's
autocorrelation, whatever the taper's shape, so that windows may be cut by a region's outline, by holes and by
saturated pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from workbench.compiled import compiled
from workbench.depth.evidence_windows import Window, cut_out, hann

FloatArray = NDArray[np.float64]
Plane = NDArray[np.float32]

_COUNTS = 1.13
"""What a pixel's worth of white noise counts. With it a full Hann window's frequencies count 0.3 each (0.26 by its own
correlation); what is compared with log-likelihoods is set in these units."""


@dataclass(frozen=True, slots=True)
class Pooled:
    """Average periodogram of a region's windows.

    Attributes
    ----------
    power
        float64 (N, N // 2 + 1): squared modulus over the tapers' energy.
    averages
        Number of periodograms that the average is worth.
    taper_lags
        float64 (2 L + 1, 2 L + 1): autocorrelation of the tapers, 1 at zero lag, for lags up to L.
    independent_share
        Share of the frequencies that tell something of their own: a taper makes neighbours alike, a narrow one more of
        them.
    """

    power: FloatArray
    averages: float
    taper_lags: FloatArray
    independent_share: float

    @property
    def trusted(self) -> float:
        """What the average is taken to be worth: somewhat less, textures being no stationary noise."""
        return max(1.0, 0.7 * self.averages)


def pooled_periodogram(plane: NDArray[np.float32], windows: Sequence[Window], lags: int) -> Pooled:
    """Average the windows' periodograms.

    The image is differenced along both axes before it is tapered, and the spectrum divided by the differences' response
    (prewhitening, Blackman and Tukey 1958): power falls steeply with frequency, and what the taper's side lobes carry
    from the lowest frequencies would otherwise drown the highest. A plane is subtracted first under each taper.

    Parameters
    ----------
    plane
        float32 (H, W).
    windows
        At least one.
    lags
        Longest lag (px) of the taper's autocorrelation that is needed.
    """
    size = windows[0].taper.shape[0]
    reach = min(lags, size - 1)
    apart = fft.next_fast_len(size + reach, real=True)
    total, energy = np.zeros((size, size // 2 + 1)), 0.0
    correlation = np.zeros((apart, apart // 2 + 1))
    steps = np.empty((2, size, size), np.float32)
    full: _Taper | None = None
    for window in windows:
        taper = full if full is not None and window.weight == 1.0 else _Taper.of(window.taper, apart)
        if window.weight == 1.0:
            full = taper
        context = cut_out(plane, window.row - 1, window.column - 1, size + 1, size + 1)
        _tapered_steps(np.ascontiguousarray(context), window.taper, taper.plane_fit, steps)
        _add_power(total, fft.rfft2(steps))
        energy += taper.energy
        correlation += taper.spectrum
    lag = fft.irfft2(correlation, s=(apart, apart)) / energy
    wanted = np.arange(-lags, lags + 1)
    inside = np.abs(wanted) <= reach
    picked = lag[np.ix_(wanted * inside, wanted * inside)] * np.outer(inside, inside)
    turn = 2.0 * np.pi * np.fft.fftfreq(size)
    response = 4.0 - 2.0 * np.cos(turn)[:, np.newaxis] - 2.0 * np.cos(turn[: size // 2 + 1])
    response[0, 0] = 1.0
    worth = _worth(windows)
    share = _COUNTS * effective_pixels(windows) / (worth * size**2)
    return Pooled(total / response / energy, worth, np.asarray(picked, np.float64), share)


def _worth(windows: Sequence[Window]) -> float:
    """Independent periodograms that these windows amount to (Welch 1967): overlapping ones repeat each other."""
    size = windows[0].taper.shape[0]
    own = hann(size)
    lags = np.correlate(own, own, "full") / float(own @ own)
    far = np.zeros(2 * size + 1)
    far[1:-1] = lags
    weight = np.array([w.weight for w in windows])
    share = np.outer(weight, weight)
    for places in (np.array([w.row for w in windows]), np.array([w.column for w in windows])):
        share = share * far[np.clip(places[:, np.newaxis] - places, -size, size) + size] ** 2
    return float(weight.sum() ** 2 / share.sum())


def effective_pixels(windows: Sequence[Window]) -> float:
    """Effective sample size of some tapered windows together: pixels of white noise that tell its power as well.

    The total power is a weighted sum of the pixels' squares, of weight ``q = sum_i w_i^2`` where w_i are the tapers; it
    is worth ``sum(q)^2 / sum(q^2)`` of equal weight (its equivalent degrees of freedom, Blackman and Tukey 1958). The
    covariances of N x N periodograms i and j at frequencies d apart, ``|sum(w_i w_j exp(-2 pi i d x))|^2``, say the
    same: over all pairs and all d they add up to ``N^2 sum(q^2)`` (Parseval).
    """
    size = windows[0].taper.shape[0]
    top, left = min(w.row for w in windows), min(w.column for w in windows)
    weight = np.zeros(
        (max(w.row for w in windows) - top + size, max(w.column for w in windows) - left + size), np.float32
    )
    for window in windows:
        row, column = window.row - top, window.column - left
        _add_squares(weight[row : row + size, column : column + size], window.taper)
    return float(weight.sum(dtype=np.float64) ** 2 / np.square(weight).sum(dtype=np.float64))


@dataclass(frozen=True, slots=True)
class _Taper:
    """What is the same for all windows of one taper.

    Its energy; squared modulus of its spectrum when padded to M pixels, float32 (M, M // 2 + 1); inverse of the normal
    equations of a plane under it, float64 (3, 3).
    """

    energy: float
    spectrum: NDArray[np.float32]
    plane_fit: FloatArray

    @classmethod
    def of(cls, taper: Plane, padded: int) -> _Taper:
        size = taper.shape[0]
        spectrum = fft.rfft2(taper, s=(padded, padded))
        terms = np.stack([np.ones(size), _ramp(size)])
        along, across = terms @ taper.sum(axis=1, dtype=np.float64), terms @ taper.sum(axis=0, dtype=np.float64)
        normal = np.diag([along[0], 0.0, 0.0])
        normal[0, 1:] = normal[1:, 0] = along[1], across[1]
        normal[1, 1], normal[2, 2] = terms[1] ** 2 @ taper.sum(axis=1), terms[1] ** 2 @ taper.sum(axis=0)
        normal[1, 2] = normal[2, 1] = terms[1] @ taper @ terms[1]
        return cls(
            float((taper.astype(np.float64) ** 2).sum()),
            spectrum.real**2 + spectrum.imag**2,
            np.asarray(np.linalg.inv(normal + 1e-9 * np.eye(3)), np.float64),
        )


def _ramp(size: int) -> FloatArray:
    return np.asarray((np.arange(size) - (size - 1) / 2.0) / size)


@compiled
def _add_power(total: FloatArray, spectra: NDArray[np.complex64]) -> None:
    for k in range(spectra.shape[0]):
        for i in range(total.shape[0]):
            row, spectrum = total[i], spectra[k, i]
            for j in range(row.size):
                row[j] += spectrum[j].real ** 2 + spectrum[j].imag ** 2


@compiled
def _add_squares(total: Plane, values: Plane) -> None:
    for i in range(total.shape[0]):
        row, own = total[i], values[i]
        for j in range(row.size):
            row[j] += own[j] * own[j]


@compiled
def _tapered_steps(context: Plane, taper: Plane, plane_fit: FloatArray, steps: Plane) -> None:
    # Differences along rows and along columns, (2, N, N), less the plane that fits best under the taper (shading is no
    # texture), times the taper.
    size = taper.shape[0]
    ramp = np.empty(size, np.float32)
    for i in range(size):
        ramp[i] = (i - (size - 1) / 2.0) / size
    for axis in range(2):
        level, down, right = 0.0, 0.0, 0.0
        for i in range(size):
            here, weight, step = context[i + 1], taper[i], steps[axis, i]
            before = context[i] if axis == 0 else here
            shift = 1 if axis == 0 else 0
            sum_level, sum_right = np.float32(0.0), np.float32(0.0)
            for j in range(size):
                step[j] = here[j + 1] - before[j + shift]
                weighed = weight[j] * step[j]
                sum_level += weighed
                sum_right += weighed * ramp[j]
            level += float(sum_level)
            down += float(sum_level * ramp[i])
            right += float(sum_right)
        tilt = np.empty(3, np.float32)
        for k in range(3):
            tilt[k] = plane_fit[k, 0] * level + plane_fit[k, 1] * down + plane_fit[k, 2] * right
        for i in range(size):
            weight, step = taper[i], steps[axis, i]
            start = tilt[0] + tilt[1] * ramp[i]
            for j in range(size):
                step[j] = (step[j] - start - tilt[2] * ramp[j]) * weight[j]
