"""Depth from two photographs through two apertures: Zhou, Lin and Nayar 2009.

C. Zhou, S. Lin and S. K. Nayar, "Coded aperture pairs for depth from defocus", ICCV 2009. For each depth d, with the
transfer functions K_i of both apertures at d, the sharp picture is restored from both photographs F_i at once by a
generalised Wiener filter, ``F0 = sum_i conj(K_i) F_i / (sum_i |K_i|**2 + |C|**2)``, where |C|**2 is the power of the
noise over that of natural images, which falls as 1 / f**2. The depth is where both photographs are explained best:
least ``W = sum_i |irfft(F0 K_i - F_i)|**2``, summed over the region's inner pixels.

The paper takes the depth per pixel; a region is one window here. Both photographs are brought to the same brightness by
their means over the region, since apertures pass different amounts of light. Differing zeros of both apertures are what
the method lives from; two apertures of one shape and different size will do less well, as the paper shows. Both banks'
PSFs are taken about the same point of the frame, where the first bank sees the chief ray: camera and rail must not have
moved between the calibrations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from calibration.bank import Bank
from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate
from workbench.depth.options import require
from workbench.depth.references.from_cost import estimate_from_cost
from workbench.depth.references.second_view import SecondViewOptions, common_depths, second_view
from workbench.depth.screening import FloatImage, Region, expanded, noise_level, screen

FloatArray = NDArray[np.float64]
Spectrum = NDArray[np.complexfloating]


@dataclass(frozen=True, slots=True)
class PairOptions(SecondViewOptions):
    """Constants of the method.

    Attributes
    ----------
    noise
        Standard deviation of noise, fraction of white. Given in the paper; None: estimated from the photographs.
    texture_power
        Power of the sharp picture at one cycle a pixel, ``A(f) = texture_power / f**2`` in squared fractions of white.
        The paper takes it from pictures of its own; None: what spreads the first photograph's
        contrast as 1 / f**2.
    ambiguity
        Ours: a second minimum within this fraction of the best makes a region ambiguous.
    """

    noise: float | None = None
    texture_power: float | None = None
    ambiguity: float = 0.01

    def __post_init__(self) -> None:
        SecondViewOptions.__post_init__(self)
        require(
            self,
            noise=self.noise is None or self.noise > 0,
            texture_power=self.texture_power is None or self.texture_power > 0,
            ambiguity=0 < self.ambiguity < 1,
        )


def estimate_pair(
    image: LinearImage, bank: Bank, labels: NDArray[np.int32], options: PairOptions | None = None
) -> dict[int, DepthEstimate]:
    """Depth of each region from two photographs.

    Parameters
    ----------
    image
        Through the first aperture, developed by the bank's recipe; luminance is used.
    bank
        Of the first aperture; its central set of PSFs is used.
    labels
        int32 (H, W), 0 = no region.
    options
        Must hold the second photograph and its bank.

    Returns
    -------
    dict
        Estimates by label, without intervals: the paper gives none. ``diagnostics``: ``cost`` (D,).

    Raises
    ------
    MismatchError
        The second photograph or bank is missing, or doesn't belong to the first.
    """
    options = options or PairOptions()
    second, second_bank = second_view(image, bank, options, "pair")
    planes = image.luminance, second.luminance
    nearest = common_depths(bank, second_bank)
    kernels = bank.central, second_bank.central[nearest]
    chiefs = _common_points(bank, second_bank, nearest)
    screened = screen(image, bank, labels, options)
    noise = options.noise or float(np.hypot(screened.noise, noise_level(planes[1])) / np.sqrt(2.0))
    estimates = dict(screened.refused)
    for region in screened.regions:
        cost = _cost(planes, kernels, chiefs, region, max(noise, 1e-6), options)
        estimates[region.label] = estimate_from_cost(bank, region, cost, options.ambiguity, options.max_saturated, {})
    return dict(sorted(estimates.items()))


def _cost(
    planes: tuple[FloatImage, FloatImage],
    kernels: tuple[NDArray[np.float32], NDArray[np.float32]],
    chiefs: tuple[FloatArray, FloatArray],
    region: Region,
    noise: float,
    options: PairOptions,
) -> FloatArray:
    """W of every depth, mean square over the region's inner pixels, float64 (D,)."""
    reach = max(kernel.shape[-1] for kernel in kernels) // 2
    outer, place = expanded(region.box, reach, planes[0].shape)
    height, width = (part.stop - part.start for part in outer)
    size = fft.next_fast_len(height + 2 * reach, real=True), fft.next_fast_len(width + 2 * reach, real=True)
    light = [float(plane[region.box][region.inside].mean(dtype=np.float64)) for plane in planes]
    seen: list[Spectrum] = []
    pictures: list[FloatImage] = []
    for plane, level in zip(planes, light, strict=True):
        picture = plane[outer] * np.float32(light[0] / level) - np.float32(light[0])
        pictures.append(picture)
        seen.append(fft.rfft2(_periodic(picture, size)))
    frequency = np.hypot(fft.fftfreq(size[0])[:, np.newaxis], fft.rfftfreq(size[1])[np.newaxis]).astype(np.float32)
    power = options.texture_power or _texture_power(seen[0], frequency)
    ratio = (noise**2 / power) * frequency**2
    cost = np.zeros(len(kernels[0]))
    for depth in range(cost.size):
        transfers = [_transfer(k[depth], size, chief[depth]) for k, chief in zip(kernels, chiefs, strict=True)]
        restored = sum(np.conj(k) * f for k, f in zip(transfers, seen, strict=True))
        restored = restored / np.maximum(sum(np.abs(k) ** 2 for k in transfers) + ratio, 1e-12)
        for transfer, picture in zip(transfers, pictures, strict=True):
            predicted = fft.irfft2(restored * transfer, s=size)[:height, :width]
            error = (predicted - picture)[place][region.inside]
            cost[depth] += float((error.astype(np.float64) ** 2).mean())
    return cost


def _common_points(bank: Bank, second: Bank, nearest: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """The point about which both banks' PSFs are taken, from the middle pixel of each (px), float64 (D, 2) each."""
    first, other = _central_points(bank, "chief_yx"), _central_points(second, "chief_yx")[nearest]
    if "middle_yx" in bank.extras and "middle_yx" in second.extras:
        other = first + _central_points(bank, "middle_yx") - _central_points(second, "middle_yx")[nearest]
    return first, other


def _central_points(bank: Bank, name: str) -> FloatArray:
    points = bank.extras.get(name)
    return np.zeros((len(bank.depths_mm), 2)) if points is None else np.asarray(points[bank.central_index], np.float64)


def _transfer(psf: NDArray[np.float32], size: tuple[int, int], chief_yx: FloatArray) -> Spectrum:
    """Transfer function about the chief ray: that is what both photographs have in common, to a fraction of a pixel."""
    half = psf.shape[0] // 2
    padded = np.zeros(size, np.float32)
    padded[: psf.shape[0], : psf.shape[1]] = psf / psf.sum(dtype=np.float64)
    turn = fft.fftfreq(size[0])[:, np.newaxis] * chief_yx[0] + fft.rfftfreq(size[1])[np.newaxis] * chief_yx[1]
    about = fft.rfft2(np.roll(padded, (-half, -half), axis=(0, 1)))
    return np.asarray(about * np.exp(2j * np.pi * turn).astype(np.complex64))


def _periodic(picture: FloatImage, size: tuple[int, int]) -> FloatImage:
    """Continue a picture to a larger size so that opposite borders meet: its mirror images, blended."""
    for axis, side in enumerate(size):
        length = picture.shape[axis]
        more = side - length
        after = np.take(picture, np.clip(length - 1 - np.arange(more), 0, None), axis=axis)
        before = np.take(picture, np.clip(np.arange(more)[::-1], None, length - 1), axis=axis)
        share = ((np.arange(more) + 0.5) / max(more, 1)).astype(np.float32)
        share = share[:, np.newaxis] if axis == 0 else share[np.newaxis]
        picture = np.concatenate([picture, (1 - share) * after + share * before], axis=axis)
    return np.asarray(picture, np.float32)


def _texture_power(spectrum: Spectrum, frequency: NDArray[np.float32]) -> float:
    """A of ``A / f**2`` by which the picture's power is that of all its frequencies but zero."""
    pixels = frequency.shape[0] * (2 * (frequency.shape[1] - 1))
    varying = frequency > 0
    power = float((np.abs(spectrum[varying]) ** 2).sum())
    return power / float((1.0 / frequency[varying] ** 2).sum()) / float(pixels)
