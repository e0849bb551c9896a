"""On which side of focus: deconvolve with a PSF and with its mirror, and compare how sparse the results are.

The two PSFs are turned by 180 degrees, so both restorations have the same power spectrum and differ in phase only. The
wrong one turns edges into ripples. Restorations are seen through several families of filters (Wiener-restored and
whitened derivatives along four directions, band-passes), and for each the mean of |g|^0.8 is compared at equal mean
square (Levin et al. 2007 use the same exponent as the prior of gradients).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from workbench.depth.evidence_spectrum import TextureSpectrum
from workbench.depth.evidence_windows import Window, cut_out, hann

FloatArray = NDArray[np.float64]
Complex = NDArray[np.complex64]

FAMILIES = ("wiener half", "whitened", "wiener", "band 0.35", "band 0.18", "band 0.09")
"""Filter families, four directions each; one feature each."""
_EXPONENT = 0.8
_BANDS = (0.35, 0.18, 0.09)
_DIRECTIONS = 4
_CONTEXT = 32
_FADE = 16


def sparseness(
    plane: NDArray[np.float32],
    soft: NDArray[np.float32],
    windows: Sequence[Window],
    psfs: Sequence[NDArray[np.float32]],
    texture: TextureSpectrum,
) -> FloatArray:
    """Mean over directions of log(mean |g|^0.8 / (mean g^2)^0.4) per PSF and filter family; smaller is sparser.

    Parameters
    ----------
    plane
        float32 (H, W).
    soft
        float32 (H, W): the region, 1 inside, falling to 0 at its edge. What lies beyond is kept out: a restoration
        would carry a neighbour's edges into the window, the farther the larger its PSF.
    windows
        Where to look; moments are pooled over them, weighted by their squared tapers.
    psfs
        PSFs to compare, float32 (K, K), unit sum.
    texture
        Texture and noise as fitted to the region (:mod:`workbench.depth.evidence_spectrum`).

    Returns
    -------
    float64 (len(psfs), len(FAMILIES)).
    """
    lower, power, weight = _moments(plane, soft, windows, psfs, texture)
    return _log_ratio(lower.sum(axis=-1) / weight.sum(), power.sum(axis=-1) / weight.sum())


def sparseness_by_window(
    plane: NDArray[np.float32],
    soft: NDArray[np.float32],
    windows: Sequence[Window],
    psfs: Sequence[NDArray[np.float32]],
    texture: TextureSpectrum,
) -> FloatArray:
    """Like :func:`sparseness`, for each window by itself; float64 (len(windows), len(psfs), len(FAMILIES))."""
    lower, power, weight = _moments(plane, soft, windows, psfs, texture)
    by_window = (np.moveaxis(sums / weight, -1, 0) for sums in (lower, power))
    return _log_ratio(*by_window)


def _log_ratio(lower: FloatArray, power: FloatArray) -> FloatArray:
    """Mean over directions (last axis) of the log of a moment of order 0.8 over the mean square to the same power."""
    ratio = np.log(lower + 1e-30) - _EXPONENT / 2 * np.log(power + 1e-30)
    return np.asarray(ratio.mean(axis=-1))


def _moments(
    plane: NDArray[np.float32],
    soft: NDArray[np.float32],
    windows: Sequence[Window],
    psfs: Sequence[NDArray[np.float32]],
    texture: TextureSpectrum,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums of |g|^0.8 and of g^2 under the squared tapers, float64 (P, F, 4, W), and the tapers' own, float64 (W,)."""
    inner = windows[0].taper.shape[0]
    size = inner + 2 * _CONTEXT
    fade = np.ones(size)
    fade[:_FADE] = hann(2 * _FADE)[:_FADE]
    fade[-_FADE:] = fade[:_FADE][::-1]
    edge = np.outer(fade, fade)
    patches = np.stack([cut_out(plane, w.row - _CONTEXT, w.column - _CONTEXT, size, size) for w in windows])
    seen = np.stack([cut_out(soft, w.row - _CONTEXT, w.column - _CONTEXT, size, size) for w in windows]) * edge
    patches -= ((patches * seen).sum(axis=(1, 2)) / seen.sum(axis=(1, 2)))[:, np.newaxis, np.newaxis]
    spectra = fft.rfft2((patches * seen).astype(np.float32))
    weights = np.stack([w.taper**2 for w in windows])
    lower, power = np.zeros((2, len(psfs), len(FAMILIES), _DIRECTIONS, len(windows)))
    for i, psf in enumerate(psfs):
        for j, filters in enumerate(_filters(psf, size, texture)):
            for k, filt in enumerate(filters):
                response = fft.irfft2(spectra * filt, s=(size, size))[:, _CONTEXT:-_CONTEXT, _CONTEXT:-_CONTEXT]
                square = response * response
                power[i, j, k] = np.einsum("wyx,wyx->w", weights, square, dtype=np.float64)
                root = (square + np.float32(1e-30)) ** np.float32(_EXPONENT / 2)
                lower[i, j, k] = np.einsum("wyx,wyx->w", weights, root, dtype=np.float64)
    return lower, power, weights.sum(axis=(1, 2), dtype=np.float64)


def _filters(psf: NDArray[np.float32], size: int, texture: TextureSpectrum) -> list[list[Complex]]:
    fy, fx = fft.fftfreq(size)[:, np.newaxis], fft.rfftfreq(size)[np.newaxis, :]
    modulus, direction = np.hypot(fy, fx), np.arctan2(fy + 0 * fx, fx + 0 * fy)
    shape = modulus.shape
    level = texture.log_power(np.maximum(modulus, 1.0 / size).ravel(), direction.ravel())
    # texture over noise; clipped so that extrapolation to the lowest frequencies stays finite
    ratio = np.exp(np.clip(level.reshape(shape) - texture.log_noise, -30.0, 30.0)).astype(np.float32)
    transfer = _transfer(psf, size).astype(np.complex64)
    gain = np.abs(transfer) ** 2 * ratio
    snr = gain / (gain + 1.0)
    phase = np.conj(transfer) / np.maximum(np.abs(transfer), 1e-9)
    wiener = np.conj(transfer) * ratio / (gain + 1.0)
    white = phase * snr / np.sqrt(gain + 1.0)
    softer = phase * np.sqrt(snr) / np.sqrt(gain + 1.0)
    safe = np.maximum(modulus, 1.0 / size).astype(np.float32)
    slopes = (fx + 0 * fy, fy + 0 * fx, fx + fy, fx - fy)
    derivatives = [(1j * slope).astype(np.complex64) for slope in slopes]
    families = [
        [wiener * d / np.sqrt(safe) for d in derivatives],
        [white * d / safe for d in derivatives],
        [wiener * d for d in derivatives],
    ]
    for centre in _BANDS:
        band = np.exp(-(np.log(safe / centre) ** 2) / 0.572)
        lobes = (np.cos(direction - turn * np.pi / 4).astype(np.float32) ** 3 for turn in range(4))
        families.append([softer * band * np.complex64(1j) * lobe for lobe in lobes])
    return [[np.asarray(f, np.complex64) for f in family] for family in families]


def _transfer(psf: NDArray[np.float32], size: int) -> NDArray[np.complex128]:
    half = psf.shape[0] // 2
    folded = np.zeros((size, size))
    index = np.arange(-half, half + 1) % size
    np.add.at(folded, (index[:, np.newaxis], index[np.newaxis, :]), psf)
    return np.asarray(fft.rfft2(folded), np.complex128)
