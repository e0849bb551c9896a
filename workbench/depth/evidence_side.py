"""On which side of focus: deconvolve with a PSF and with its mirror, and compare how sparse the results are.

The two PSFs are turned by 180 degrees, so both restorations have the same power spectrum and differ in phase only. The
wrong one turns edges into ripples. Restorations are seen through several families of filters (Wiener-restored and
whitened derivatives along four directions, band-passes); for each, moments of |g| of order 0.8 (Levin et al. 2007 use
the same exponent as the prior of gradients) and of order 4 are compared at equal mean square.

Light is never negative, and with the wrong phases a restoration of dark and bright detail dips below zero. How much of
the image that part explains is compared, too, blurred again so that ripples which the PSF takes away don't count.

What counts is not the difference of the two restorations but the difference over its standard error, as found from
the scatter between tiles of the region: a page with three letters on it makes large differences by chance, gravel makes
small ones that are the same everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from workbench.compiled import compiled
from workbench.depth.evidence_restoration import (
    TILES,
    Patches,
    cut_patches,
    inner,
    root_mean_square_gain,
    texture_over_noise,
    tile_sums,
    transfer_of,
    wiener,
)
from workbench.depth.evidence_spectrum import TextureSpectrum
from workbench.depth.evidence_windows import Window

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]
Plane = NDArray[np.float32]
Complex = NDArray[np.complex64]

FAMILIES = ("whitened", "wiener", "band 0.35", "band 0.18")
"""Filter families, four directions each."""
SPARSENESS = tuple(f"{family}, order {order:g}" for family in FAMILIES for order in (0.8, 4.0))
STATISTICS = (*SPARSENESS, "negative light")
"""What :attr:`Comparison.favour` holds."""
_SPARSE, _PEAKED = 0.8, 4.0
_FLOORS = (0.003, 0.015)
"""Standard errors of the two orders that no scatter undercuts: PSFs are not that well known."""
_MOST = 4.0
"""Standard errors beyond which a difference says little more."""
_WAVES = -0.205, -0.225
"""Log of mean |g|^0.8 over (mean g^2)^0.4 within tiles: -0.109 for a wave and -0.229 for Gaussian noise of any colour
(-0.226 in tiles of some 30 pixels), less for edges. Nothing is said from the first on, all from the second."""
_BANDS = (0.35, 0.18)
_DIRECTIONS, _SLOPES = 4, 2
_DARKEST, _DARKEST_NOISE, _NEGATIVE_FLOOR = -0.05, 2.0, 5e-4
"""Light counts as negative below so much of a window's level, since PSFs are not that well known, less so many
standard deviations of the restored noise. And the standard error of its share of the contrast's energy that no scatter
undercuts."""
_ALL_TILES = (-3, -2, -1)
"""Axes of :class:`_Moments` over windows and their tiles."""
_TINY = 1e-30


@dataclass(frozen=True, slots=True)
class Comparison:
    """How sparse the restorations with two PSFs are.

    Attributes
    ----------
    sparse
        float64 (2, len(FAMILIES)): mean over directions of log(mean |g|^0.8 / (mean g^2)^0.4); smaller is sparser.
    favour
        float64 (len(STATISTICS),): how many standard errors sparser the first PSF's restoration is, below 4 in size;
        nearer to 0 where there are waves instead of edges to judge by. The last one, of negative light, instead: how
        much less of it, over the root of the sum of its tiles' squares; what is the same in n tiles is worth n^0.5.
    negative
        float64 (2,): share of the contrast's energy that the negative part of the restored light accounts for.
    halves
        float64 (2, 2, len(STATISTICS)): ``favour`` of the upper and the lower half of what was looked at by themselves,
        and of the left and the right one.
    """

    sparse: FloatArray
    favour: FloatArray
    negative: FloatArray
    halves: FloatArray


@dataclass(frozen=True, slots=True)
class _Moments:
    """Sums under the squared tapers: of restorations' responses, each float64 (P, F, directions, W, tiles, tiles)."""

    sparse: FloatArray
    square: FloatArray
    peaked: FloatArray
    negative: FloatArray
    """What the negative part of the restored light explains, squared, float64 (P, W, tiles, tiles)."""
    contrast: FloatArray
    """Of the image about its level, squared, float64 (W, tiles, tiles)."""
    weight: FloatArray
    """Of the squared tapers alone, float64 (W, tiles, tiles)."""

    def of_window(self, index: int) -> _Moments:
        """Those of one window alone."""
        one = slice(index, index + 1)
        return _Moments(*(sums[..., one, :, :] for sums in self._all))

    def within(self, tiles: Mask) -> _Moments:
        """Those of some tiles alone, bool (W, tiles, tiles)."""
        return _Moments(*(sums * tiles for sums in self._all))

    @property
    def _all(self) -> tuple[FloatArray, ...]:
        return self.sparse, self.square, self.peaked, self.negative, self.contrast, self.weight


def compare(
    patches: Patches,
    windows: Sequence[Window],
    psfs: Sequence[Plane],
    texture: TextureSpectrum,
    *,
    is_light: bool = True,
) -> Comparison:
    """Compare the restorations of a region.

    Parameters
    ----------
    patches
        The windows and what is about them, cut out of the region's plane.
    windows
        Where to look; moments are pooled over them, weighted by their squared tapers.
    psfs
        The two PSFs, float32 (K, K), unit sum.
    texture
        Texture and noise as fitted to the region (:mod:`workbench.depth.evidence_spectrum`).
    is_light
        Whether the plane is never negative but for noise; a difference of colours may be.
    """
    moments = _moments(patches, psfs, texture, is_light)
    moment, square = (m.sum(_ALL_TILES) / moments.weight.sum() for m in (moments.sparse, moments.square))
    halves = np.array([[_favour(moments.within(half), windows) for half in pair] for pair in _halves(windows)])
    sparse = _log_ratio(moment, square, _SPARSE).mean(axis=-1)
    negative = moments.negative.sum(_ALL_TILES) / (moments.contrast.sum() + _TINY)
    return Comparison(sparse, _favour(moments, windows), negative, halves)


def favour_by_window(
    plane: Plane,
    soft: Plane,
    windows: Sequence[Window],
    psfs: Sequence[Plane],
    texture: TextureSpectrum,
) -> FloatArray:
    """:attr:`Comparison.favour` of each window by itself, float64 (len(windows), len(STATISTICS)).

    For windows that look across outlines: another depth's edges, restored with a PSF that is not theirs, would be
    negative light on either side, so that is not asked for.
    """
    moments = _moments(cut_patches(plane, soft, windows), psfs, texture, is_light=False)
    return np.stack([_favour(moments.of_window(i), windows[i : i + 1]) for i in range(len(windows))])


def _log_ratio(moment: FloatArray, square: FloatArray, order: float) -> FloatArray:
    """Log of a moment over that of order 2 to the same power."""
    return np.asarray(np.log(moment + _TINY) - order / 2 * np.log(square + _TINY))


def _favour(moments: _Moments, windows: Sequence[Window]) -> FloatArray:
    """Differences of the two log ratios over their standard errors, by family and order; then that of negative light.

    The standard error of a ratio of sums over a region follows from the scatter of its linearised parts (Cochran 1977,
    Sampling Techniques, 6.3), here of tiles a quarter of a window wide.
    """
    places = _places(windows)
    square = moments.square.sum(_ALL_TILES)
    trust = _edginess(moments)
    parts = moments.square / (square + _TINY)[..., np.newaxis, np.newaxis, np.newaxis]
    found = []
    for order, moment, sign, floor in ((_SPARSE, moments.sparse, 1.0, _FLOORS[0]),
                                       (_PEAKED, moments.peaked, -1.0, _FLOORS[1])):  # fmt: skip
        whole = moment.sum(_ALL_TILES)
        ratio = _log_ratio(whole, square, order)
        linear = moment / (whole + _TINY)[..., np.newaxis, np.newaxis, np.newaxis] - order / 2 * parts
        difference = sign * (ratio[1] - ratio[0]).mean(axis=-1)
        scatter = (linear[1] - linear[0]).mean(axis=1)
        found.append(trust * _in_errors(difference, scatter, places, floor))
    excess = (moments.negative[1] - moments.negative[0]) / (moments.contrast.sum() + _TINY)
    darker = _in_errors(excess.sum(), excess[np.newaxis], places, _NEGATIVE_FLOOR)
    return np.concatenate([np.stack(found, axis=-1).ravel(), darker])


def _in_errors(
    difference: FloatArray | np.float64, scatter: FloatArray, places: NDArray[np.intp], floor: float
) -> FloatArray:
    """Differences over their standard errors by the scatter of their parts, float64 (F, W, tiles, tiles); at most 4."""
    rows, columns = places.max(axis=0) + TILES
    joined = np.zeros((scatter.shape[0], rows, columns))
    for index, (row, column) in enumerate(places):  # overlapping windows see the same pixels
        joined[:, row : row + TILES, column : column + TILES] += scatter[:, index]
    errors = difference / np.sqrt((joined**2).sum(axis=(1, 2)) + floor**2)
    return np.asarray(errors / np.sqrt(1.0 + (errors / _MOST) ** 2))


def _places(windows: Sequence[Window]) -> NDArray[np.intp]:
    """Row and column of each window's first tile on a grid over all of them, (W, 2)."""
    tile = windows[0].taper.shape[0] // TILES
    corners = np.array([(w.row, w.column) for w in windows])
    return np.asarray((corners - corners.min(axis=0) + tile // 2) // tile, np.intp)


def _halves(windows: Sequence[Window]) -> list[tuple[Mask, Mask]]:
    """Tiles of the upper and of the lower half, and of the left and of the right one; bool (W, tiles, tiles) each."""
    places = _places(windows)
    within = np.arange(TILES)
    tiles = places[:, 0, np.newaxis, np.newaxis] + within[:, np.newaxis], places[:, 1, np.newaxis, np.newaxis] + within
    pairs = []
    for place in (np.broadcast_to(axis, (len(windows), TILES, TILES)) for axis in tiles):
        middle = place.max() / 2
        pairs.append((place < middle, place > middle))
    return pairs


def _edginess(moments: _Moments) -> FloatArray:
    """Of each family, 1 where the sparser restoration is sparse within its tiles, too, 0 where it is a wave there.

    Rings and zone plates are waves everywhere, of a frequency that changes from place to place. The right restoration
    makes them even, the wrong one does not, and so looks sparser: they have no edges to judge by.
    """
    even = (moments.square / (moments.weight + _TINY)) ** (_SPARSE / 2) * moments.weight
    local = np.log((moments.sparse.sum(_ALL_TILES) + _TINY) / (even.sum(_ALL_TILES) + _TINY)).mean(axis=-1)
    waves, noise = _WAVES
    return np.asarray(np.clip((waves - local.min(axis=0)) / (waves - noise), 0.0, 1.0))


def _moments(patches: Patches, psfs: Sequence[Plane], texture: TextureSpectrum, is_light: bool) -> _Moments:
    count = len(patches.levels)
    found = np.zeros((3, len(psfs), len(FAMILIES), _DIRECTIONS, count, TILES, TILES))
    negative = np.zeros((len(psfs), count, TILES, TILES))
    ratio = texture_over_noise(texture, patches.size)
    for i, psf in enumerate(psfs):
        transfer = transfer_of(psf, patches.size)
        restoring = wiener(transfer, ratio)
        for j, filters in enumerate(_filters(transfer, restoring, ratio)):
            for k, response in enumerate(_responses(patches, filters)):
                square = response * response
                root = np.exp(np.float32(_SPARSE / 2) * np.log(square + np.float32(_TINY)))  # quicker than a power
                _add_moments(root, square, patches.weights, found[:, i, j, k])
        if is_light:
            negative[i] = patches.by_tile(_explained_by_negative(patches, transfer, restoring, texture.log_noise) ** 2)
    contrast = patches.by_tile(patches.values**2)
    return _Moments(found[0], found[1], found[2], negative, contrast, tile_sums(patches.weights))


def _responses(patches: Patches, filters: Sequence[Complex]) -> Iterator[Plane]:
    """Patches through the filters of a family, float32 (W, N, N) each; two slopes along the diagonals, too."""
    if len(filters) == _SLOPES:
        along, across = (inner(patches.filtered(slope)) for slope in filters)
        yield from (along, across, along + across, along - across)
    else:
        yield from (inner(patches.filtered(lobe)) for lobe in filters)


def _explained_by_negative(patches: Patches, transfer: Complex, restoring: Complex, log_noise: float) -> Plane:
    """The part of each patch that the negative part of its restored light would account for, float32 (W, N, N)."""
    noise = np.exp(0.5 * log_noise) * root_mean_square_gain(restoring)
    least = (_DARKEST - 1.0) * np.maximum(patches.levels, 0.0) - _DARKEST_NOISE * noise
    below = np.minimum(
        patches.filtered(restoring) - least[:, np.newaxis, np.newaxis].astype(np.float32), np.float32(0.0)
    )
    explained = np.zeros_like(patches.values)
    some = below.any(axis=(1, 2))
    if some.any():
        explained[some] = fft.irfft2(fft.rfft2(below[some]) * transfer, s=(patches.size, patches.size))
    return explained


@compiled
def _add_moments(root: Plane, square: Plane, weights: Plane, sums: FloatArray) -> None:
    # Weighted sums of |g|^0.8, g^2 and g^4 over each tile of each window: (3, W, tiles, tiles).
    tile = weights.shape[1] // TILES
    for w in range(weights.shape[0]):
        for row in range(TILES * tile):
            for b in range(TILES):
                part = slice(b * tile, (b + 1) * tile)
                weight, small, middle = weights[w, row, part], root[w, row, part], square[w, row, part]
                sparse, even, peaked = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                for u in range(tile):
                    weighed = weight[u] * middle[u]
                    sparse += weight[u] * small[u]
                    even += weighed
                    peaked += weighed * middle[u]
                sums[0, w, row // tile, b] += sparse
                sums[1, w, row // tile, b] += even
                sums[2, w, row // tile, b] += peaked


def _filters(transfer: Complex, restoring: Complex, ratio: Plane) -> Iterator[list[Complex]]:
    """Family by family, the filters that restore what a transfer function blurred: two slopes, or four directions.

    ``restoring`` is its Wiener filter, ``ratio`` the power of texture over noise, float32 (N, N // 2 + 1).
    """
    shapes = _shapes(ratio.shape[0])
    modulus = np.abs(transfer)
    gain = modulus**2 * ratio
    snr = gain / (gain + 1.0)
    phase = np.conj(transfer) / np.maximum(modulus, np.float32(1e-9))
    white = phase * snr / np.sqrt(gain + 1.0)
    softer = phase * np.sqrt(snr) / np.sqrt(gain + 1.0)
    for restored, shape in ((white, shapes[0]), (restoring, shapes[1]),
                            *((softer, shape) for shape in shapes[2:])):  # fmt: skip
        yield [restored * direction for direction in shape]


@lru_cache(maxsize=8)
def _shapes(size: int) -> tuple[list[Complex], ...]:
    """What the families filter besides restoring: unit derivatives, derivatives, and bands in all directions."""
    fy, fx = fft.fftfreq(size)[:, np.newaxis], fft.rfftfreq(size)[np.newaxis, :]
    modulus, direction = np.hypot(fy, fx), np.arctan2(fy + 0 * fx, fx + 0 * fy)
    safe = np.maximum(modulus, 1.0 / size)
    slopes = (fx + 0 * fy, fy + 0 * fx)
    lobes = [np.cos(direction - turn * np.pi / _DIRECTIONS) ** 3 for turn in range(_DIRECTIONS)]
    bands = [np.exp(-(np.log(safe / centre) ** 2) / 0.572) for centre in _BANDS]
    families = [[slope / safe for slope in slopes], list(slopes), *([band * lobe for lobe in lobes] for band in bands)]
    return tuple([(1j * shape).astype(np.complex64) for shape in family] for family in families)
