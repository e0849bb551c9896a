"""Blur from the power of two photographs, one of them through a small aperture: Pentland 1987.

A. P. Pentland, "A new sense for depth of field", IEEE Transactions on Pattern Analysis and Machine Intelligence 9, 523
(1987), his second method. A Gaussian blur of standard deviation s takes ``exp(-4 pi**2 f**2 s**2)`` of the power at
frequency f. Whatever the scene shows, the ratio of both photographs' local power in a band is then
``ln(P2 / P1) = 4 pi**2 f**2 (s1**2 - s2**2)``. The powers are those of band-passed photographs, squared and summed over
the region's inner pixels, less what noise gives; the slope of their log ratio against ``4 pi**2 f**2`` is fitted over
the bands in which both stand above the noise.

Which photograph is the sharper doesn't matter, only the sign does. Both banks tell how wide blur is at each depth, so
that the difference of variances becomes |sigma|, and :mod:`workbench.depth.references.blur_size` tells the rest. With
an aperture that isn't Gaussian the law holds only as far as the second moment goes: to log ratios of about one.
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
from workbench.depth.references.blur_size import blur_scale, estimate_from_blur
from workbench.depth.references.second_view import SecondViewOptions, second_view
from workbench.depth.screening import FloatImage, Region, expanded, no_depth, noise_level, screen

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PentlandOptions(SecondViewOptions):
    """Constants of the method; the paper leaves all of them open.

    Attributes
    ----------
    lowest_cycles
        Lowest band, in cycles per the region's side.
    bands_per_octave
        Bands are rings in the frequency plane, in equal ratios up to half a cycle a pixel.
    least_signal
        Bands count, from the lowest up, as long as both powers are so many times that of noise,
    most_log_ratio
        and as long as the log ratio of the powers is at most this; beyond, no aperture is like a Gaussian.
    """

    lowest_cycles: float = 3.0
    bands_per_octave: float = 3.0
    least_signal: float = 2.0
    most_log_ratio: float = 1.5

    def __post_init__(self) -> None:
        SecondViewOptions.__post_init__(self)
        require(
            self,
            lowest_cycles=self.lowest_cycles > 0,
            bands_per_octave=self.bands_per_octave > 0,
            least_signal=self.least_signal > 0,
            most_log_ratio=self.most_log_ratio > 0,
        )


def estimate_pentland(
    image: LinearImage, bank: Bank, labels: NDArray[np.int32], options: PentlandOptions | None = None
) -> dict[int, DepthEstimate]:
    """Depth of each region from the loss of power between two apertures.

    Parameters
    ----------
    image
        Through the first aperture, developed by the bank's recipe; luminance is used.
    bank
        Of the first aperture.
    labels
        int32 (H, W), 0 = no region.
    options
        Must hold the second photograph and its bank.

    Returns
    -------
    dict
        Estimates by label, without intervals: the paper gives none. ``diagnostics``: ``band_frequency``,
        ``band_log_ratio`` and ``band_used`` (B,), ``blur_std_px``, ``radius_px``.

    Raises
    ------
    MismatchError
        The second photograph or bank is missing, doesn't belong to the first, or has as large an aperture.
    """
    options = options or PentlandOptions()
    second, second_bank = second_view(image, bank, options, "pentland")
    planes = image.luminance, second.luminance
    scale, second_scale = blur_scale(bank), blur_scale(second_bank)
    # Both radii in pixels are their scale times (1 - focus / z): what the second is relative to the first.
    relative = second_scale.share * second_bank.lens.scale_px / bank.lens.scale_px
    gain = scale.share**2 - relative**2
    offset = scale.core_px**2 - second_scale.core_px**2
    screened = screen(image, bank, labels, options)
    noises = screened.noise, noise_level(planes[1])
    estimates = dict(screened.refused)
    for region in screened.regions:
        frequency, log_ratio, usable = _log_ratios(planes, noises, region, options)
        found = {"band_frequency": frequency, "band_log_ratio": log_ratio, "band_used": usable.astype(np.float64)}
        if not usable.any() or abs(gain) < 1e-3 * scale.share**2:
            reason = "no band in which both photographs stand above the noise and differ by a moderate ratio"
            estimates[region.label] = no_depth(bank, region.pixels, reason)
            continue
        x, y = 4.0 * np.pi**2 * frequency[usable] ** 2, log_ratio[usable]
        more = float((x * y).sum() / (x * x).sum())
        radius = float(np.sqrt(max((more - offset) / gain, 0.0)))
        std = float(scale.std_px(np.array(radius)))
        error = float(np.sqrt(((y - more * x) ** 2).sum() / max(x.size - 1, 1) / (x * x).sum()))
        estimates[region.label] = estimate_from_blur(
            bank, region, options, scale, std, error / max(2.0 * std, 1e-6), found
        )
    return dict(sorted(estimates.items()))


def _log_ratios(
    planes: tuple[FloatImage, FloatImage], noises: tuple[float, float], region: Region, options: PentlandOptions
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Frequency, ln(P second / P first) and whether it counts, per band."""
    side = float(np.sqrt(region.pixels))
    lowest = options.lowest_cycles / side
    count = max(1, int(options.bands_per_octave * np.log2(0.5 / lowest))) if lowest < 0.5 else 1
    edges = lowest * 2.0 ** (np.arange(count + 1) / options.bands_per_octave)
    outer, place = expanded(region.box, 32, planes[0].shape)
    light = [float(plane[region.box][region.inside].mean(dtype=np.float64)) for plane in planes]
    powers = np.zeros((2, count))
    gains = np.zeros(count)
    centre = np.zeros(count)
    for index, plane in enumerate(planes):
        picture = np.pad(plane[outer] / np.float32(light[index]) - np.float32(1.0), 32, mode="reflect")
        spectrum = fft.rfft2(picture)
        fy, fx = fft.fftfreq(picture.shape[0])[:, np.newaxis], fft.rfftfreq(picture.shape[1])[np.newaxis]
        frequency = np.hypot(fy, fx)
        double = np.where((fx > 0) & (fx < 0.5), 2.0, 1.0) * np.ones_like(frequency)
        inner = tuple(slice(part.start + 32, part.stop + 32) for part in place)
        for band in range(count):
            ring = (frequency >= edges[band]) & (frequency < edges[band + 1])
            passed = fft.irfft2(np.where(ring, spectrum, 0), s=picture.shape)[inner][region.inside]
            gains[band] = float(double[ring].sum()) / picture.size
            noise = gains[band] * (noises[index] / light[index]) ** 2
            powers[index, band] = float((passed.astype(np.float64) ** 2).mean()) - noise
            if powers[index, band] < options.least_signal * noise:
                powers[index, band] = np.nan
            weight = np.abs(spectrum[ring]) ** 2
            centre[band] = np.sqrt(float((weight * frequency[ring] ** 2).sum() / max(float(weight.sum()), 1e-30)))
    ratio = np.log(powers[1]) - np.log(powers[0])
    good = np.isfinite(ratio) & (np.abs(np.nan_to_num(ratio)) <= options.most_log_ratio)
    return centre, ratio, np.logical_and.accumulate(good)
