"""A region's windows cut out and made ready to be restored with any PSF, and what restores them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from workbench.depth.evidence_spectrum import TextureSpectrum, frequencies
from workbench.depth.evidence_windows import Window, cut_out, hann

Plane = NDArray[np.float32]
Complex = NDArray[np.complex64]

TILES = 4
"""Tiles along each side of a window."""
_CONTEXT = 32
"""Pixels about a window that its restoration sees."""
_FADE = 16


@dataclass(frozen=True, slots=True)
class Patches:
    """Windows with the pixels about them, faded out where the region ends; N = side + 2 * 32 pixels.

    Attributes
    ----------
    values
        float32 (W, N, N): what lies above or below the window's level, 0 outside the region.
    spectra
        complex64 (W, N, N // 2 + 1): their transforms.
    levels
        float32 (W,): mean of the region's pixels in each.
    weights
        float32 (W, side, side): the windows' squared tapers.
    """

    values: Plane
    spectra: Complex
    levels: Plane
    weights: Plane

    @property
    def size(self) -> int:
        """N."""
        return int(self.values.shape[1])

    def filtered(self, filter_: Complex) -> Plane:
        """All patches through one filter complex64 (N, N // 2 + 1); float32 (W, N, N)."""
        return np.asarray(fft.irfft2(self.spectra * filter_, s=(self.size, self.size)))

    def by_tile(self, values: Plane) -> NDArray[np.float64]:
        """Sums of (W, N, N) under the squared tapers over each tile; float64 (W, TILES, TILES)."""
        return tile_sums(inner(values) * self.weights)


def cut_patches(plane: Plane, soft: Plane, windows: Sequence[Window]) -> Patches:
    """Cut windows and their surroundings out of a plane.

    Parameters
    ----------
    plane
        float32 (H, W).
    soft
        float32 (H, W): the region, 1 inside, falling to 0 at its edge. What lies beyond is kept out: a restoration
        would carry a neighbour's edges into the window, the farther the larger its PSF.
    windows
        All of one side.
    """
    size = windows[0].taper.shape[0] + 2 * _CONTEXT
    fade = np.ones(size)
    fade[:_FADE] = hann(2 * _FADE)[:_FADE]
    fade[-_FADE:] = fade[:_FADE][::-1]
    edge = np.outer(fade, fade)
    patches = np.stack([cut_out(plane, w.row - _CONTEXT, w.column - _CONTEXT, size, size) for w in windows])
    seen = np.stack([cut_out(soft, w.row - _CONTEXT, w.column - _CONTEXT, size, size) for w in windows]) * edge
    levels = (patches * seen).sum(axis=(1, 2)) / seen.sum(axis=(1, 2))
    values = ((patches - levels[:, np.newaxis, np.newaxis]) * seen).astype(np.float32)
    weights = np.stack([w.taper**2 for w in windows])
    return Patches(values, fft.rfft2(values), levels.astype(np.float32), weights)


def inner(values: Plane) -> Plane:
    """Patches without the pixels about their windows."""
    return values[..., _CONTEXT:-_CONTEXT, _CONTEXT:-_CONTEXT]


def tile_sums(values: Plane) -> NDArray[np.float64]:
    """Sums over the tiles of windows (W, side, side); float64 (W, TILES, TILES)."""
    count, side = values.shape[0], values.shape[1] // TILES
    whole = values[:, : TILES * side, : TILES * side].reshape(count, TILES, side, TILES, side)
    return np.asarray(whole.sum(axis=(2, 4), dtype=np.float64))


def transfer_of(psf: Plane, size: int) -> Complex:
    """Transfer function of a PSF about its middle, complex64 (size, size // 2 + 1)."""
    half = psf.shape[0] // 2
    folded = np.zeros((size, size))
    index = np.arange(-half, half + 1) % size
    np.add.at(folded, (index[:, np.newaxis], index[np.newaxis, :]), psf)
    return np.asarray(fft.rfft2(folded), np.complex64)


def texture_over_noise(texture: TextureSpectrum, size: int) -> Plane:
    """float32 (N, N // 2 + 1); clipped so that extrapolation to the lowest frequencies stays finite."""
    modulus, direction, _ = frequencies(size)
    level = texture.log_power(np.maximum(modulus, 1.0 / size).ravel(), direction.ravel())
    return np.exp(np.clip(level.reshape(modulus.shape) - texture.log_noise, -30.0, 30.0)).astype(np.float32)


def wiener(transfer: Complex, ratio: Plane) -> Complex:
    """The filter that restores a texture of that power over noise with the least mean square error (Wiener 1949)."""
    return np.asarray(np.conj(transfer) * ratio / (np.abs(transfer) ** 2 * ratio + 1.0), np.complex64)


def root_mean_square_gain(filter_: Complex) -> float:
    """Standard deviation of white noise of unit variance behind a filter of real images, complex64 (N, N // 2 + 1)."""
    power = np.abs(filter_).astype(np.float64) ** 2
    size = power.shape[0]
    mirrored = power[:, 1 : (size + 1) // 2]  # columns that stand for their negative frequencies, too
    return float(np.sqrt((power.sum() + mirrored.sum()) / size**2))
