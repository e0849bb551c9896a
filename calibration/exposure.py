"""Choose the next exposure from a metered frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.image import LinearImage

TARGET = 0.70
"""Fraction of white that the brightest photosite should reach."""
TOLERANCE = (0.45, 0.85)
"""A metered peak in here is good enough: no further frame is spent on it."""


@dataclass(frozen=True, slots=True)
class Metered:
    """What a frame says about its exposure."""

    peak: float
    """Brightest channel value (fraction of white), single outliers left out."""
    saturated: bool
    noise: float
    """Standard deviation of the background, fraction of white."""


@dataclass(frozen=True, slots=True)
class ExposureChoice:
    """Next exposure; ``done`` when the metered one was good enough, ``limited`` when the list ends too early."""

    time_s: float
    iso: int
    done: bool
    limited: bool
    expected_peak: float


def meter(image: LinearImage) -> Metered:
    """Meter a developed frame: its brightest real pixel.

    A single hot photosite must not set the exposure: the place is that of the brightest second-brightest channel
    (a point lights all channels, a hot photosite one); with one channel, of the brightest value that has a neighbour
    of at least a tenth of it. The peak is the brightest channel there.
    """
    planes = image.planes
    values = planes.reshape(-1, planes.shape[2])
    noise = 1.4826 * float(np.median(np.abs(np.diff(image.luminance[::2], axis=1)))) / np.sqrt(2.0)
    if planes.shape[2] == 3:
        r, g, b = values.T
        second = np.maximum(np.minimum(r, g), np.minimum(np.maximum(r, g), b))
        place = int(second.argmax())
    else:
        flat = image.luminance
        padded = np.pad(flat, 1)
        neighbours = np.maximum.reduce([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
        place = int(np.where(neighbours > 0.1 * flat, flat, 0.0).argmax())
    y, x = divmod(place, planes.shape[1])
    area = (slice(max(0, y - 1), y + 2), slice(max(0, x - 1), x + 2))
    return Metered(peak=float(values[place].max()), saturated=bool(image.saturated[area].any()), noise=float(noise))


def choose_exposure(
    metered: Metered, *, time_s: float, iso: int, times_s: Sequence[float], isos: Sequence[int]
) -> ExposureChoice:
    """Choose exposure time and ISO so that the brightest pixel comes to about 70 % of white, and never above 85 %.

    The lowest ISO is preferred, since it collects the most light; a higher one is taken only where the longest time
    is not enough. A saturated frame says nothing about the peak: an eighth of its exposure is tried next.

    Parameters
    ----------
    metered
        From :func:`meter`, of a frame taken with ``time_s`` (s) and ``iso``.
    time_s, iso
        Exposure of the metered frame.
    times_s, isos
        What the camera offers, any order.

    Raises
    ------
    ValueError
        An empty list.
    """
    if not times_s or not isos:
        raise ValueError("the camera offers no exposure times or no ISO values")
    light = time_s * iso
    if metered.saturated or metered.peak >= 0.98:
        wanted, peak_now = light / 8.0, 8.0 * TARGET
    else:
        # a peak lost in the noise is taken for its upper limit
        peak_now = max(metered.peak, 3.0 * metered.noise, 1e-5)
        wanted = light * TARGET / peak_now
    if not metered.saturated and TOLERANCE[0] <= metered.peak <= TOLERANCE[1]:
        return ExposureChoice(time_s, iso, True, False, metered.peak)
    options = sorted({(i, t) for i in isos for t in times_s})
    ceiling = wanted * TOLERANCE[1] / TARGET

    def rank(option: tuple[int, float]) -> tuple[float, int]:
        amount = option[0] * option[1]
        # steps of a third of a stop are equally good: then the lower ISO decides
        return round(abs(np.log2(amount / wanted)) * 3.0), option[0]

    allowed = [o for o in options if o[0] * o[1] <= ceiling * (1 + 1e-9)]
    best = min(allowed or [min(options, key=lambda o: o[0] * o[1])], key=rank)
    expected = peak_now * best[0] * best[1] / light
    limited = not 0.5 * TOLERANCE[0] <= expected <= TOLERANCE[1] * (1 + 1e-9)
    return ExposureChoice(best[1], best[0], False, limited, float(expected))
