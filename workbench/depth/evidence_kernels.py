"""What blurs leave of a texture's autocorrelation on pixels.

Pixels are coarse for a small blur: what it passes beyond half a cycle per pixel folds back (aliases). In a sampled PSF
it folds with its phase and at full strength, as if the texture were one point. A texture has less there, by its
spectrum's fall, and out of step with what it folds onto, so that powers add up. With the sampled PSF's own power
textures read 0.03 to 0.05 px less blurred than they are where the blur is 5 to 9 px, and charts with ridges up to 0.09
px off. Left out altogether aliases cost little for falling spectra; they are kept for flat ones, which have more.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from calibration.pupil import PsfModel, PupilModel
from workbench.depth.evidence_spectrum import EXPECTED_SLOPE

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]

_FINER = 2
"""Pupils are drawn this many times finer than the pixels: what they pass beyond a cycle per pixel is lost in the
pixels' own boxes."""


def drawn_finer(psfs: PsfModel) -> tuple[PsfModel, int]:
    """The PSFs on finer pixels, as far as they can be drawn so, and how many of these make a pixel's side."""
    return (psfs.finer(_FINER), _FINER) if isinstance(psfs, PupilModel) else (psfs, 1)


def kernel_lags(psfs: PsfModel, depths_mm: FloatArray, size: int, error: float) -> Float32:
    """What each blur leaves of a texture, relative to the texture's own power at each frequency of the pixels.

    Frequencies f + m that fold onto f count as much less as a texture has of them, ``(|f| / |f + m|)^2.4``, the fall
    that :mod:`~workbench.depth.evidence_spectrum` expects. Measured PSFs that no pupil describes can't be drawn finer:
    theirs fold as they were sampled.

    Parameters
    ----------
    psfs
        PSF at any depth.
    depths_mm
        float64 (D,).
    size
        Side of the largest PSF.
    error
        The PSFs' own error relative to their values, white for want of better knowledge.

    Returns
    -------
    float32 (D, 2 size - 1, 2 size - 1)
        As autocorrelations, lag 0 in the middle.
    """
    fine, finer = drawn_finer(psfs)
    lags = np.zeros((depths_mm.size, 2 * size - 1, 2 * size - 1), np.float32)
    for row, depth_mm in enumerate(depths_mm):
        side = min(size, psfs.side_px(float(depth_mm)))  # small PSFs on few pixels
        part = slice(size - side, size + side - 1)
        psf = fine.psf_at(float(depth_mm), finer * side)
        lags[row, part, part] = _folded(psf, side) if finer > 1 else _autocorrelation(psf)
    lags[:, size - 1, size - 1] *= 1.0 + error**2
    return lags


def _autocorrelation(psf: Float32) -> Float32:
    k = psf.shape[0]
    size = fft.next_fast_len(2 * k, real=True)
    lags = fft.irfft2(np.abs(fft.rfft2(psf.astype(np.float64), s=(size, size))) ** 2, s=(size, size))
    return _central(lags, k)


def _folded(fine: Float32, side: int) -> Float32:
    """Autocorrelation (2 side - 1, 2 side - 1) at every second lag of a PSF on pixels of half the size."""
    size = 2 * fft.next_fast_len(side)
    power = np.abs(fft.rfft2(fine, s=(2 * size, 2 * size))) ** 2 * _passed(size)
    rows = power[:size] + power[size:]
    half = size // 2 + 1
    # a real picture's power at -f is that at f: columns beyond half a cycle per pixel fold back turned over
    turned = rows[-np.arange(size), size : size - half : -1]
    return _central(fft.irfft2(rows[:, :half] + turned, s=(size, size)), side)


@lru_cache(maxsize=64)
def _passed(size: int) -> Float32:
    """What a pixel made of 2 x 2 fine ones passes, and a texture has, of the power at f; float32 (2 size, size + 1)."""
    fy, fx = _FINER * fft.fftfreq(_FINER * size)[:, np.newaxis], _FINER * fft.rfftfreq(_FINER * size)
    box = (np.cos(0.5 * np.pi * fy) * np.cos(0.5 * np.pi * fx)) ** 2
    true, seen = np.hypot(fy, fx), np.hypot(fy - np.rint(fy), fx - np.rint(fx))
    weaker = (seen / np.maximum(true, 1e-12)) ** -EXPECTED_SLOPE
    weaker[0, 0] = 1.0
    passed = np.asarray(box * weaker, np.float32)
    passed.setflags(write=False)
    return passed


def _central(lags: FloatArray | Float32, side: int) -> Float32:
    index = np.arange(-(side - 1), side) % lags.shape[0]
    return np.asarray(lags[np.ix_(index, index)], np.float32)
