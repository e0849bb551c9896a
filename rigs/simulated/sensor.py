"""The simulated sensor: from light on photosites to raw values.

One photosite collects electrons in proportion to light and time. Shot noise is Poisson. The amplifier's gain follows
ISO. Read noise has a part before the amplifier (electrons) and one after it (raw values), so that raising ISO lifts
weak light above the second. Non-uniformity, hot pixels and dark current belong to the camera and follow from its seed;
noise follows from the seed and the shot.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
RawImage = NDArray[np.uint16]

_POISSON_BELOW_E = 64.0
"""Above so many electrons the Poisson distribution is drawn as a normal one of the same mean and variance."""


@dataclass(frozen=True)
class Sensor:
    """What is fixed by the camera.

    Attributes
    ----------
    height, width
        Photosites, even numbers; colour pattern RGGB.
    pitch_mm
        Photosite pitch.
    full_well_e
        Electrons that reach white level at ISO 100.
    saturating_time_s
        Exposure time in which light 1 (see :mod:`rigs.simulated.panel_view`) fills the full well of a green photosite.
    response
        Sensitivity of red, green and blue photosites to white light, relative.
    read_noise_e, read_noise_dn
        Standard deviations before and after the amplifier.
    prnu
        Relative standard deviation of the photosites' sensitivity.
    hot_fraction
        Share of photosites with a dark current of 30 to 3000 e-/s.
    dark_current_e_s
        Mean dark current of the others.
    black, white
        Raw values of no light and of saturation; 14 bits.
    seed
        The camera's own seed.
    """

    height: int
    width: int
    pitch_mm: float = 0.0043
    full_well_e: float = 25_000.0
    saturating_time_s: float = 1 / 125
    response: tuple[float, float, float] = (1.0, 1.0, 1.0)
    read_noise_e: float = 2.5
    read_noise_dn: float = 2.5
    prnu: float = 0.006
    hot_fraction: float = 2e-5
    dark_current_e_s: float = 0.1
    black: int = 2048
    white: int = 15_000
    seed: int = 1

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in photosites."""
        return self.height, self.width

    def electrons_per_dn(self, iso: float) -> float:
        """Electrons per step of the raw value."""
        return self.full_well_e / (self.white - self.black) * 100.0 / iso


def fixed_pattern(sensor: Sensor) -> tuple[FloatImage, NDArray[np.intp], FloatImage]:
    """Sensitivity of each photosite (height, width), indices and dark currents (e-/s) of the hot ones."""
    return _fixed_pattern(sensor.shape, sensor.seed, sensor.prnu, sensor.hot_fraction)


@lru_cache(maxsize=2)
def _fixed_pattern(
    shape: tuple[int, int], seed: int, prnu: float, hot_fraction: float
) -> tuple[FloatImage, NDArray[np.intp], FloatImage]:
    generator = np.random.default_rng([seed, 0x5E])  # 0x5E: a stream of its own, apart from the shots'
    sensitivity = generator.standard_normal(shape, np.float32)
    sensitivity *= np.float32(prnu)
    sensitivity += np.float32(1.0)
    count = round(hot_fraction * sensitivity.size)
    where = np.unique(generator.integers(0, sensitivity.size, count))
    current = (30.0 * 100.0 ** generator.random(where.size)).astype(np.float32)
    sensitivity.setflags(write=False)
    return sensitivity, where, current


def expose(light: FloatImage, sensor: Sensor, *, time_s: float, iso: int, shot: int) -> RawImage:
    """Raw values of one exposure.

    Parameters
    ----------
    light
        float32 (height, width): light on each photosite through its colour filter, 1 = fills the full well in the
        sensor's ``saturating_time_s``.
    sensor
        The camera.
    time_s, iso
        Exposure.
    shot
        Number of the shot; with the sensor's seed it determines the noise.

    Returns
    -------
    RawImage
        uint16 (height, width), at most ``sensor.white``.
    """
    sensitivity, hot, current = fixed_pattern(sensor)
    generator = np.random.Generator(np.random.SFC64([sensor.seed, 0xA1, shot]))
    electrons = light * np.float32(sensor.full_well_e * time_s / sensor.saturating_time_s)
    electrons *= sensitivity
    electrons += np.float32(sensor.dark_current_e_s * time_s)
    electrons.reshape(-1)[hot] += current * np.float32(time_s)
    per_dn = sensor.electrons_per_dn(iso)
    weak = electrons < _POISSON_BELOW_E
    counted = generator.poisson(np.maximum(electrons[weak], 0.0))
    deviation = np.sqrt(np.maximum(electrons, 0.0))
    deviation[weak] = 0.0
    electrons[weak] = counted
    electrons += deviation * generator.standard_normal(electrons.shape, np.float32)
    electrons *= np.float32(1.0 / per_dn)
    noise = np.hypot(sensor.read_noise_e / per_dn, sensor.read_noise_dn)
    electrons += np.float32(noise) * generator.standard_normal(electrons.shape, np.float32)
    electrons += np.float32(sensor.black)
    return np.asarray(np.clip(np.rint(electrons), 0, sensor.white), np.uint16)


def bayer(colour: tuple[float, float, float] | NDArray[np.float64]) -> FloatImage:
    """2x2 cell (RGGB) of a value per colour."""
    r, g, b = (float(value) for value in colour)
    return np.array([[r, g], [g, b]], np.float32)


def times_cell(plane: FloatImage, cell: FloatImage, corner: tuple[int, int] = (0, 0)) -> FloatImage:
    """Multiply each photosite of a plane by its colour's value.

    Parameters
    ----------
    plane
        float32 (H, W).
    cell
        float32 (2, 2), see :func:`bayer`.
    corner
        Row and column of the plane's first photosite in the frame; fixes the parity.
    """
    if (cell == cell[0, 0]).all():
        return np.asarray(plane * cell[0, 0], np.float32)
    result = np.empty_like(plane)
    for y in (0, 1):
        for x in (0, 1):
            value = cell[(y + corner[0]) % 2, (x + corner[1]) % 2]
            np.multiply(plane[y::2, x::2], value, out=result[y::2, x::2])
    return result
