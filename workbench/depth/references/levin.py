"""Depth from the error that deconvolution with a sparse prior leaves: Levin, Fergus, Durand and Freeman 2007.

"Image and depth from a conventional camera with a coded aperture", ACM Transactions on Graphics 26, 70 (SIGGRAPH 2007).
The picture y is deconvolved with the PSF f_k of each depth (:mod:`~workbench.depth.references.sparse_deconvolution`);
the error ``E_k = |y - f_k * x_k|**2`` is summed over a window; the depth is that of the least ``lambda_k E_k``. Small
PSFs explain anything, so that errors of different depths don't compare: the weights lambda_k make them, learned so that
depths of training pictures are classified well.

The paper trains on photographs. Here nothing but the bank is used: generated textures blurred by its PSFs, with noise
of random strength, all from a seed. The weights are those under which the true depth is most probable among a random
choice of depths (a conditional logit). They are learned at the first use of a bank and kept in memory.

The window is the region's inner part, or tiles of it: where it is large, the tiles with most contrast stand for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import logsumexp

from calibration.bank import Bank
from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate
from workbench.depth.evidence_textures import blurred_texture
from workbench.depth.options import require
from workbench.depth.references.from_cost import estimate_from_cost
from workbench.depth.references.sparse_deconvolution import SparsePrior, sparse_deconvolve
from workbench.depth.screening import FloatImage, Mask, Region, ScreeningOptions, expanded, screen

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LevinOptions(ScreeningOptions):
    """Constants of the method.

    Attributes
    ----------
    exponent
        Of the prior: the paper's 0.8.
    smoothness
        Weight of the prior: 0.001 in the authors' example, for pictures from 0 to 1.
    prior_weight, floor
        0.1 and 0.01 in the authors' program: factor of the reweighted prior, and the least derivative that counts.
    reweightings
        2 in the authors' program, after a first solution with equal weights.
    iterations
        Of conjugate gradients for each solution. Up to 200 in the authors' program, which starts from the blurred
        picture; ours starts from the solution in the frequency domain, and few are enough.
    tile_px, tiles
        Ours: a larger region is judged by at most so many tiles of this side.
    samples, choices, seed
        Ours: training pictures, depths among which each is classified, and the seed.
    roughness
        Ours: expected second difference of ``log lambda`` between planes far from focus.
    ambiguity
        Ours: a second minimum within this fraction of the best makes a region ambiguous.
    """

    exponent: float = 0.8
    smoothness: float = 0.001
    prior_weight: float = 0.1
    floor: float = 0.01
    reweightings: int = 2
    iterations: int = 8
    tile_px: int = 128
    tiles: int = 2
    samples: int = 64
    choices: int = 10
    seed: int = 0
    roughness: float = 0.3
    ambiguity: float = 0.01

    def __post_init__(self) -> None:
        ScreeningOptions.__post_init__(self)
        require(
            self,
            exponent=0 < self.exponent <= 2,
            smoothness=self.smoothness > 0,
            prior_weight=self.prior_weight > 0,
            floor=self.floor > 0,
            reweightings=self.reweightings >= 0,
            iterations=self.iterations >= 1,
            tile_px=self.tile_px >= 16,
            tiles=self.tiles >= 1,
            samples=self.samples >= 1,
            choices=self.choices >= 2,
            roughness=self.roughness > 0,
            ambiguity=0 < self.ambiguity < 1,
        )

    @property
    def prior(self) -> SparsePrior:
        """What deconvolution needs of them."""
        return SparsePrior(
            self.exponent, self.smoothness, self.prior_weight, self.floor, self.reweightings, self.iterations
        )


_TRAINING_PX = 64
_learned: dict[tuple[str, LevinOptions], FloatArray] = {}


def estimate_levin(
    image: LinearImage, bank: Bank, labels: NDArray[np.int32], options: LevinOptions | None = None
) -> dict[int, DepthEstimate]:
    """Depth of each region from the error of sparse deconvolution.

    Parameters
    ----------
    image
        Developed by the bank's recipe; its luminance is used.
    bank
        Its central set of PSFs is used, and trained on at the first call.
    labels
        int32 (H, W), 0 = no region.
    options
        See :class:`LevinOptions`.

    Returns
    -------
    dict
        Estimates by label, without intervals: the paper gives none. ``diagnostics``: ``cost`` (D,) weighed error,
        ``error`` (D,) before weighing, ``lambda`` (D,).
    """
    options = options or LevinOptions()
    screened = screen(image, bank, labels, options)
    estimates = dict(screened.refused)
    if screened.regions:
        weight = error_weights(bank, options)
        kernels = _cropped(bank)
        luminance = image.luminance
        for region in screened.regions:
            error = _region_error(luminance, image.saturated, region, kernels, options)
            estimates[region.label] = estimate_from_cost(
                bank, region, weight * error, options.ambiguity, options.max_saturated,
                {"error": error, "lambda": weight},
            )  # fmt: skip
    return dict(sorted(estimates.items()))


def error_weights(bank: Bank, options: LevinOptions) -> FloatArray:
    """The weights lambda of a bank's depths, float64 (D,), geometric mean 1; learned once per bank and options."""
    key = (bank.id, options)
    if key not in _learned:
        _learned[key] = _learn(bank, options)
    return _learned[key]


def _learn(bank: Bank, options: LevinOptions) -> FloatArray:
    depths = len(bank.depths_mm)
    kernels = _cropped(bank)
    stiffness = _stiffness(bank, options)
    rows: list[tuple[FloatArray, NDArray[np.intp]]] = []
    for sample in range(options.samples):
        generator = np.random.default_rng([options.seed, sample])
        true = int(generator.integers(depths))
        far = np.flatnonzero(np.abs(np.arange(depths) - true) > 1)
        others = generator.permutation(far)[: options.choices - 1]
        chosen = np.concatenate([[true], others]).astype(np.intp)
        reach = max(kernel.shape[0] for kernel in kernels) // 2
        picture = _training_picture(kernels[true], _TRAINING_PX + 2 * reach, generator)
        box = (slice(reach, reach + _TRAINING_PX),) * 2
        inside = np.zeros(picture.shape, np.bool_)
        inside[box] = True
        errors = np.array([_error(picture, inside, box, kernels[k], options) for k in chosen])
        rows.append((np.log(errors), chosen))

    def loss(p: FloatArray) -> tuple[float, FloatArray]:
        slope = np.zeros_like(p)
        lost = 0.0
        sharp = np.exp(p[0])
        for log_error, chosen in rows:
            cost = log_error + p[1:][chosen]
            scores = -sharp * cost
            share = np.exp(scores - logsumexp(scores))
            lost -= float(np.log(max(share[0], 1e-30)))
            share[0] -= 1.0
            slope[0] -= sharp * float(share @ cost)
            slope[1:] -= sharp * np.bincount(chosen, share, depths)
        bend = np.diff(p[1:], 2)
        pull = stiffness * bend
        lost += float(pull @ bend)
        slope[1:-2] += 2 * pull
        slope[2:-1] -= 4 * pull
        slope[3:] += 2 * pull
        return lost, slope

    # Weights that make the typical errors of all depths equal are a good start.
    start = np.zeros(depths)
    for depth in range(depths):
        found = [log_error[chosen == depth] - log_error.mean() for log_error, chosen in rows]
        known = np.concatenate(found)
        start[depth] = -float(known.mean()) if known.size else 0.0
    first = np.concatenate([[np.log(4.0)], start])
    log_weight = minimize(loss, first, jac=True, method="L-BFGS-B").x[1:]
    return np.asarray(np.exp(log_weight - log_weight.mean()), np.float64)


def _stiffness(bank: Bank, options: LevinOptions) -> FloatArray:
    """Weight of the squared second differences of ``log lambda``, float64 (D - 2,).

    A sharp PSF explains every picture: towards focus the weights rise like a power of the radius, and second
    differences like the square of its relative step.
    """
    radius = np.abs(bank.lens.radius_px)
    step = 0.5 * np.abs(bank.lens.radius_px[2:] - bank.lens.radius_px[:-2]) / np.maximum(radius[1:-1], 0.1)
    return np.asarray(0.5 / (options.roughness + 10.0 * step**2) ** 2, np.float64)


def _training_picture(psf: FloatImage, side: int, generator: np.random.Generator) -> FloatImage:
    """A generated texture blurred by a PSF, with noise of random strength, float32 (side, side)."""
    picture = blurred_texture(side, psf, generator)
    noise = np.exp(generator.uniform(np.log(1e-3), np.log(6e-3)))
    return _to_unit(np.asarray(picture + noise * generator.standard_normal(picture.shape), np.float32), np.s_[:, :])


def _to_unit(picture: FloatImage, box: tuple[slice, slice]) -> FloatImage:
    """Scale brightness so that white is about 1 within the box: the prior's constants are for such pictures."""
    return picture / np.float32(max(float(np.percentile(picture[box], 99)), 1e-6))


def _cropped(bank: Bank) -> list[FloatImage]:
    """Central PSFs without their empty rims, of unit sum."""
    half = bank.psf.shape[-1] // 2
    kernels = []
    for psf, radius in zip(bank.central, bank.lens.radius_px, strict=True):
        reach = min(half, int(np.ceil(1.1 * abs(radius) + 4.0)))
        part = np.maximum(psf[half - reach : half + reach + 1, half - reach : half + reach + 1], np.float32(0))
        kernels.append(np.asarray(part / part.sum(), np.float32))
    return kernels


def _region_error(
    luminance: FloatImage, saturated: Mask, region: Region, kernels: list[FloatImage], options: LevinOptions
) -> FloatArray:
    """Mean square error of every depth over the region's tiles, float64 (D,)."""
    total = np.zeros(len(kernels))
    for box, inside in _tiles(luminance, region, options):
        usable = inside & ~saturated[box]
        picture = _to_unit(luminance, box)
        full = np.zeros(luminance.shape, np.bool_)
        full[box] = usable
        total += usable.sum() * np.array([_error(picture, full, box, kernel, options) for kernel in kernels])
    return np.asarray(total / total.sum(), np.float64)


def _error(
    picture: FloatImage, inside: Mask, box: tuple[slice, slice], kernel: FloatImage, options: LevinOptions
) -> float:
    """Mean square error of one PSF over a box; the picture around it, as far as there is any, is explained as well."""
    outer, place = expanded(box, kernel.shape[0] // 2, (picture.shape[0], picture.shape[1]))
    _, error = sparse_deconvolve(picture[outer], kernel, options.prior)
    return float((error[place][inside[box]].astype(np.float64) ** 2).mean())


def _tiles(luminance: FloatImage, region: Region, options: LevinOptions) -> list[tuple[tuple[slice, slice], Mask]]:
    """Boxes in the frame, at most ``tile_px`` a side, and the region's inner pixels in them; those of most contrast."""
    rows, columns = np.flatnonzero(region.inside.any(axis=1)), np.flatnonzero(region.inside.any(axis=0))
    found = []
    for top, bottom in _parts(int(rows[0]), int(rows[-1]) + 1, options.tile_px):
        for left, right in _parts(int(columns[0]), int(columns[-1]) + 1, options.tile_px):
            inside = region.inside[top:bottom, left:right]
            if inside.any():
                first, second = region.box
                box = (
                    slice(first.start + top, first.start + bottom),
                    slice(second.start + left, second.start + right),
                )
                found.append((float(luminance[box][inside].var()) * int(inside.sum()), box, inside))
    found.sort(key=lambda tile: -tile[0])
    return [(box, inside) for _, box, inside in found[: options.tiles]]


def _parts(start: int, stop: int, most: int) -> list[tuple[int, int]]:
    """Equal parts of an interval, none longer than ``most``."""
    edges = np.linspace(start, stop, -(-(stop - start) // most) + 1).round().astype(int)
    return [(int(a), int(b)) for a, b in pairwise(edges)]
