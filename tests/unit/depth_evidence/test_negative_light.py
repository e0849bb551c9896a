"""Light is never negative: what that says about the side of focus, where sparseness says little."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.unit.depth_evidence.synthetic import photograph
from tests.unit.depth_evidence.test_side import FAR, NEAR, SIDE, psfs, texture_spectrum
from workbench.depth.evidence_side import STATISTICS, compare, favour_by_window
from workbench.depth.evidence_windows import place_windows

INDEX = STATISTICS.index("negative light")
NOISE = 0.003


def specks(seed: int, *, ground: float = 0.0) -> NDArray[np.float64]:
    """Gaussian noise, cut off below nothing: half of it is as dark as the ground."""
    size = SIDE + 64
    generator = np.random.default_rng(seed)
    modulus = np.hypot(np.fft.fftfreq(size)[:, np.newaxis], np.fft.rfftfreq(size))
    noise = np.fft.irfft2(np.fft.rfft2(generator.standard_normal((size, size))) / np.maximum(modulus, 0.05))
    return np.asarray(ground + 0.3 * np.maximum(noise / noise.std(), 0.0))


def favour(texture: NDArray[np.float64], depth_mm: float, *, is_light: bool = True) -> float:
    plane = photograph(texture, depth_mm, noise=NOISE).luminance
    soft = np.ones(plane.shape, np.float32)
    windows = place_windows(soft > 0, soft, 128, least_weight=0.3)
    return float(compare(plane, soft, windows, psfs(), texture_spectrum(), is_light=is_light).favour[INDEX])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_dark_ground_tells_the_side(seed: int) -> None:
    assert favour(specks(seed), FAR) > 1.0
    assert favour(specks(seed), NEAR) < -1.0


@pytest.mark.parametrize("depth_mm", [FAR, NEAR])
def test_bright_ground_says_nothing(depth_mm: float) -> None:
    assert favour(specks(1, ground=2.0), depth_mm) == pytest.approx(0.0, abs=1e-3)


def test_difference_of_colours_says_nothing_since_it_may_be_negative() -> None:
    assert favour(specks(1), FAR, is_light=False) == 0.0


@pytest.mark.parametrize("level", [0.0, -0.2])
def test_noise_without_light_says_nothing_on_average(level: float) -> None:
    """As where the dark frame is brighter than the photograph."""
    generator = np.random.default_rng(0)
    plane = (level + NOISE * generator.standard_normal((4 * SIDE, 4 * SIDE))).astype(np.float32)
    soft = np.ones(plane.shape, np.float32)
    windows = place_windows(soft > 0, soft, 128, least_weight=0.3)
    each = favour_by_window(plane, soft, windows, psfs(), texture_spectrum())[:, INDEX]
    assert abs(each.mean()) < 0.3
    assert np.abs(each).max() < 2.0
