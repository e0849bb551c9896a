"""The physical limit: how well depth can be known from a texture's spectrum, whatever the estimator.

A stationary Gaussian texture of known power spectrum S, blurred by the PSF of its depth z and photographed with white
noise n, has periodogram ordinates that are independent and exponential with mean ``M_z(f) = |K_z(f)|^2 S(f) + n``.
Their Fisher information about z is (Whittle's approximation; Kay, Fundamentals of Statistical Signal Processing I,
3.11)::

    I(z) = 1/2 sum over f of (d ln M_z(f) / dz)^2

over all frequencies of the region but zero, one per pixel. The Cramer-Rao bound is ``1 / sqrt(I)``. The derivative is
taken in 1/z, in which the blur's radius is linear. The bound says nothing about the side of focus, takes a known
texture for granted, and holds for Gaussian textures: real ones have edges, whose phases say more.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from calibration.pupil import PsfModel
from rigs.protocols import Exposure
from rigs.simulated.scene import SceneObject
from rigs.simulated.sensor import Sensor
from rigs.simulated.textures import texture

FloatArray = NDArray[np.float64]

SPECTRUM_SIDE = 128
"""Frequencies a side of the grid on which the bound is summed, developed pixels."""
_RADIUS_STEP_PX = 0.1


def depth_bound_mm(psfs: PsfModel, depth_mm: float, spectrum: FloatArray, noise: float, pixels: int) -> float:
    """Cramer-Rao bound of a region's depth.

    Parameters
    ----------
    psfs
        PSF at any depth.
    depth_mm
        True depth.
    spectrum
        float64 (N, N): power spectrum of the sharp texture in developed pixels, frequencies as of ``fft2``, normalised
        so that its mean is the texture's variance. Zero frequency is left out.
    noise
        Variance of the noise of a pixel, same unit squared.
    pixels
        Of the region.

    Returns
    -------
    float
        Standard error in mm; infinite where the spectrum doesn't depend on depth.
    """
    side = spectrum.shape[0]
    # a step in 1/z that changes the radius by a tenth of a pixel
    step = _RADIUS_STEP_PX / abs(psfs.radius_px(1.0) - psfs.radius_px(1e12))
    nearer, farther = (
        np.log(kernel_power(psfs, 1.0 / (1.0 / depth_mm + sign * step), side) * spectrum + noise) for sign in (1, -1)
    )
    slope = (nearer - farther) / (2.0 * step)
    slope[0, 0] = 0.0
    information = 0.5 * float((slope**2).sum()) * pixels / side**2
    return depth_mm**2 / np.sqrt(information) if information > 0 else float("inf")


def kernel_power(psfs: PsfModel, depth_mm: float, side: int) -> FloatArray:
    """|K|^2 of the PSF at a depth, float64 (side, side), frequencies as of ``fft2``."""
    size = 2 * int(np.ceil(1.3 * abs(psfs.radius_px(depth_mm)) + 4)) + 1
    psf = psfs.psf_at(depth_mm, size).astype(np.float64)
    # a PSF wider than the grid is folded: the transform at these frequencies is the same
    rows = -(-size // side) * side
    padded = np.zeros((rows, rows))
    padded[:size, :size] = psf
    folded = padded.reshape(rows // side, side, rows // side, side).sum(axis=(0, 2))
    return np.asarray(np.abs(fft.fft2(folded)) ** 2, np.float64)


@lru_cache(maxsize=32)
def texture_spectrum(
    name: str, shape: tuple[int, int], side: int = SPECTRUM_SIDE, drawings: int = 4
) -> tuple[FloatArray, float]:
    """Power spectrum and mean of a texture (values 0 to 1) in developed (2 x 2) pixels.

    The mean periodogram of half overlapping Hann windows of several drawings at photosite pitch; of it the frequencies
    that a developed pixel can hold.

    Parameters
    ----------
    name
        See :mod:`rigs.simulated.textures`.
    shape
        Photosites (height, width) of a drawing; the details of some textures grow with it.
    side
        Of the spectrum; a drawing must hold a window of twice as many photosites.
    drawings
        How many, of the seeds 0, 1, ...

    Returns
    -------
    (float64 (side, side), float)
        Frequencies as of ``fft2``; the spectrum's mean is the variance that these frequencies carry. Mean value.
    """
    window_side = 2 * side
    taper = np.hanning(window_side + 1)[:-1]
    window = np.outer(taper, taper)
    powers, means = [], []
    for seed in range(drawings):
        picture = texture(name, shape, seed).astype(np.float64)
        means.append(picture.mean())
        for top in range(0, shape[0] - window_side + 1, side):
            for left in range(0, shape[1] - window_side + 1, side):
                cut = picture[top : top + window_side, left : left + window_side]
                powers.append(np.abs(fft.fft2((cut - cut.mean()) * window)) ** 2)
    power = np.mean(powers, axis=0) / float((window**2).sum())
    index = fft.fftfreq(side, 1.0 / side).astype(int)
    # the same power in a band of a quarter of the frequencies: a quarter of the density per normalised frequency
    return np.asarray(power[np.ix_(index, index)] / 4.0, np.float64), float(np.mean(means))


def signal_and_noise(
    item: SceneObject, mean: float, sensor: Sensor, illumination: float, exposure: Exposure
) -> tuple[float, float]:
    """What one unit of texture and its noise are in the developed luminance of a photograph.

    Parameters
    ----------
    item
        A grey object that fills the frame.
    mean
        Of its texture.
    sensor, illumination, exposure
        As photographed.

    Returns
    -------
    (float, float)
        Gain (fraction of white per unit of texture), and variance of a developed pixel's noise at the texture's mean:
        shot noise, read noise, non-uniformity and rounding of four photosites, averaged.
    """
    per_light = exposure.time_s / sensor.saturating_time_s * exposure.iso / 100.0 * illumination
    dark, light = float(np.mean(item.dark)), float(np.mean(item.light))
    gain = per_light * (light - dark)
    level = per_light * dark + gain * mean
    span = sensor.white - sensor.black
    per_dn = sensor.electrons_per_dn(exposure.iso)
    shot = level / (per_dn * span)
    read = (np.hypot(sensor.read_noise_e / per_dn, sensor.read_noise_dn) ** 2 + 1.0 / 12.0) / span**2
    return gain, (shot + float(read) + (sensor.prnu * level) ** 2) / 4.0
