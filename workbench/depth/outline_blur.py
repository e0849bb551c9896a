"""How an outline is blurred: the likelihood of each PSF for the step in brightness across it.

A step blurred by a PSF is its edge spread function: the integral of its line spread function across the outline. An
asymmetric aperture makes it asymmetric, so that a single plain edge tells what no spectrum does, the side of focus.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from calibration.pupil import PsfModel
from workbench.depth.outlines import Profiles

FloatArray = NDArray[np.float64]
Curves = NDArray[np.float32]

_DIRECTIONS = 32
_FINE = 8
"""Bins of a line spread per pixel."""
_PER_PX = 4
"""Places per pixel at which an edge spread is kept, and a step may lie."""
_SHIFT_PX = 12
"""The step may lie so far from where the outline was found: half-shadows are about as wide. What would lie farther off
fits best at either end, where skewed PSFs pass for it, and is left out."""
_END = _PER_PX // 2
"""Places from either end that count as the end."""
_WEIGHT, _MOST = 0.5, 1.0
"""Nats per unit of a profile's log residual, and its largest excess that counts: textures, shadows and other outlines
spoil single profiles, and neighbouring ones are alike. Chosen on ray-traced scenes; half and twice are nearly as good.
"""


def edge_spreads(psf: NDArray[np.float32]) -> Curves:
    """Edge spread functions of a PSF: a step from 0 to 1 that it blurred, for outlines in every direction.

    Parameters
    ----------
    psf
        float32 (K, K), K odd.

    Returns
    -------
    float32 (directions, n), n odd
        At even places about the PSF's centre; beyond them it is 0 and 1. The step rises along the angles ``2 pi k /
        directions`` from x towards y.
    """
    half = psf.shape[0] // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    room = int(np.ceil(half * np.sqrt(2.0))) + 2
    angle = 2 * np.pi * np.arange(_DIRECTIONS)[:, np.newaxis] / _DIRECTIONS
    along = np.cos(angle) * x.ravel() + np.sin(angle) * y.ravel()
    bins = np.rint((along + room) * _FINE).astype(np.intp)
    count = 2 * room * _FINE + 1
    flat = (bins + count * np.arange(_DIRECTIONS)[:, np.newaxis]).ravel()
    masses = np.tile(psf.ravel() / float(psf.sum()), _DIRECTIONS)
    spread = np.bincount(flat, masses, minlength=count * _DIRECTIONS).reshape(_DIRECTIONS, count)
    risen = np.cumsum(spread, axis=1) - 0.5 * spread
    seen = uniform_filter1d(risen, _FINE + 1, axis=1, mode="nearest")  # a pixel is as wide, but for an eighth
    return np.asarray(seen[:, :: _FINE // _PER_PX], np.float32)


class EdgeSpreads:
    """:func:`edge_spreads` of a bank's PSFs by depth, each drawn once."""

    def __init__(self, psfs: PsfModel) -> None:
        self.psfs = psfs
        self._drawn: dict[float, Curves] = {}

    def at(self, depth_mm: float) -> Curves:
        """float32 (directions, n), of one depth."""
        if depth_mm not in self._drawn:
            self._drawn[depth_mm] = edge_spreads(self.psfs.psf_at(depth_mm, self.psfs.side_px(depth_mm) | 1))
        return self._drawn[depth_mm]


def blur_log_likelihood(profiles: Profiles, spreads: Sequence[Curves]) -> FloatArray:
    """Log-likelihood of each PSF, the best one's 0.

    Each profile is fitted by a level and a step of any height, at the place that suits it best, blurred by the PSF; its
    residual ``r`` (sum of squares) stands for the noise, which is unknown. Over profiles ``i`` whose step is in reach

        log L_k = -0.5 sum_i min(log r_ik - min_k log r_ik, 1).

    Parameters
    ----------
    profiles
        Brightness across an outline.
    spreads
        :func:`edge_spreads` of each PSF.

    Returns
    -------
    float64 (len(spreads),), nats.
    """
    turn = np.rint(profiles.angle / (2 * np.pi) * _DIRECTIONS).astype(int) % _DIRECTIONS
    values = (profiles.values - profiles.values.mean(axis=1, keepdims=True)).astype(np.float32)
    reach = values.shape[1] // 2
    curves = np.stack([_to_length(curve, (reach + _SHIFT_PX) * _PER_PX) for curve in spreads])
    explained, within = np.empty((len(values), len(spreads))), np.empty(len(values), np.bool_)
    for direction in np.unique(turn):
        own = np.flatnonzero(turn == direction)
        shifted = sliding_window_view(curves[:, direction], 2 * reach * _PER_PX + 1, axis=1)[..., ::_PER_PX]
        shifted = shifted - shifted.mean(axis=2, keepdims=True)
        unit = shifted / np.maximum(np.linalg.norm(shifted, axis=2, keepdims=True), 1e-6)
        by_place = np.tensordot(values[own], unit, axes=(1, 2)) ** 2
        explained[own] = by_place.max(axis=2)
        place = by_place.max(axis=1).argmax(axis=1)
        within[own] = (place > _END) & (place < by_place.shape[2] - 1 - _END)
    power = (values.astype(np.float64) ** 2).sum(axis=1, keepdims=True)
    excess = np.log(np.maximum(power - explained, 1e-6 * power + 1e-30))
    excess -= excess.min(axis=1, keepdims=True)
    total = -_WEIGHT * np.minimum(excess[within], _MOST).sum(axis=0)
    return np.asarray(total - total.max())


def _to_length(curves: Curves, half: int) -> Curves:
    """Curves (directions, n) with ``half`` places to both sides of the middle."""
    missing = half - curves.shape[1] // 2
    if missing <= 0:
        return curves[:, -missing : curves.shape[1] + missing]
    ends = ((0, 0), (missing, missing))
    return np.asarray(np.pad(curves, ends, constant_values=((0, 0), (0.0, 1.0))))
