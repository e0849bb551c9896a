"""The Cramer-Rao bound: against a formula, against the scatter of maximum likelihood, and the spectra that go in."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from bench_drawings import GaussianLens
from scipy import fft, optimize

from rigs.protocols import Exposure
from rigs.simulated.rig import render_scene_frame
from rigs.simulated.scenes import plane_scene
from rigs.simulated.sensor import Sensor
from rigs.simulated.textures import texture
from rigs.simulated.world import SimulatedRigSettings
from workbench.bench.bound import depth_bound_mm, kernel_power, signal_and_noise, texture_spectrum

SIDE = 48
LENS = GaussianLens()


def falling_spectrum(side: int = SIDE) -> np.ndarray:
    f = np.hypot(fft.fftfreq(side)[:, None], fft.fftfreq(side)[None, :])
    return 0.02 * np.maximum(f, 1 / side) ** -2.2 / 300


def test_without_noise_it_is_what_the_formula_of_a_gaussian_blur_says() -> None:
    # ln M = ln S - s^2 w^2 with s the deviation: I_s = 1/2 sum (2 s w^2)^2
    depth = 2000.0
    w2 = (2 * np.pi) ** 2 * (fft.fftfreq(SIDE)[:, None] ** 2 + fft.fftfreq(SIDE)[None, :] ** 2)
    s = LENS.deviation_px(depth)
    slope = (LENS.deviation_px(depth + 0.5) - LENS.deviation_px(depth - 0.5)) / 1.0
    expected = 1.0 / np.sqrt(0.5 * ((2 * s * w2) ** 2).sum() * slope**2)
    # S is low-passed so that float32 rounding of the PSF doesn't stand in for noise
    fine = GaussianLens(core_px=0.7)
    bound = depth_bound_mm(fine, depth, falling_spectrum(), 1e-14, SIDE**2)
    assert bound == pytest.approx(expected, rel=0.05)


def test_maximum_likelihood_scatters_as_much_as_it_allows() -> None:
    depth, noise, trials = 2200.0, 2e-4, 150
    spectrum = falling_spectrum()
    bound = depth_bound_mm(LENS, depth, spectrum, noise, SIDE**2)
    grid = 1 / np.linspace(1 / (depth + 8 * bound), 1 / (depth - 8 * bound), 41)
    models = np.stack([np.log(kernel_power(LENS, float(z), SIDE) * spectrum + noise) for z in grid])
    truth = np.sqrt(kernel_power(LENS, depth, SIDE) * spectrum + noise)
    generator = np.random.default_rng(1)
    found = []
    for _ in range(trials):
        picture = fft.ifft2(fft.fft2(generator.standard_normal((SIDE, SIDE))) * truth).real
        power = np.abs(fft.fft2(picture)) ** 2 / SIDE**2
        cost = np.array(
            [(m + power * np.exp(-m))[np.arange(SIDE)[:, None] + np.arange(SIDE) > 0].sum() for m in models]
        )
        best = int(np.clip(cost.argmin(), 1, len(grid) - 2))
        curve = np.polyfit(grid[best - 1 : best + 2] - depth, cost[best - 1 : best + 2], 2)
        found.append(-curve[1] / (2 * curve[0]))
    # the sample deviation of 150 trials is known to 6 %
    assert np.std(found) == pytest.approx(bound, rel=0.2)
    assert abs(np.mean(found)) < 0.3 * bound


def test_four_times_the_pixels_halve_it_and_noise_raises_it() -> None:
    spectrum = falling_spectrum()
    one = depth_bound_mm(LENS, 1000.0, spectrum, 1e-4, 4096)
    assert depth_bound_mm(LENS, 1000.0, spectrum, 1e-4, 4 * 4096) == pytest.approx(one / 2)
    assert depth_bound_mm(LENS, 1000.0, spectrum, 1e-2, 4096) > 2 * one


def test_no_texture_has_no_depth() -> None:
    assert depth_bound_mm(LENS, 1000.0, np.zeros((SIDE, SIDE)), 1e-4, 4096) == float("inf")


def test_a_spectrum_carries_the_variance_of_what_a_developed_pixel_holds() -> None:
    spectrum, mean = texture_spectrum("gravel", (384, 640))
    pictures = [texture("gravel", (384, 640), seed) for seed in range(4)]
    smooth = [cv2.GaussianBlur(p, (0, 0), 6) for p in pictures]
    # low frequencies only, where pixels of either size hold the same: compare the band's power
    f = np.hypot(fft.fftfreq(128)[:, None], fft.fftfreq(128)[None, :])
    passed = np.exp(-((2 * np.pi * f * 3) ** 2))  # 6 photosites are 3 developed pixels
    assert (spectrum * passed).mean() == pytest.approx(np.mean([s.var() for s in smooth]), rel=0.3)
    assert mean == pytest.approx(np.mean(pictures), rel=1e-6)


def test_noise_is_that_of_a_developed_photograph() -> None:
    settings, exposure = SimulatedRigSettings(), Exposure(1 / 60, 100)
    scene = plane_scene("blank", 2000.0, seed=4)
    frame = render_scene_frame(scene, settings, exposure=exposure, frame_shape=(400, 400))
    values = (frame.mosaic.astype(float) - 2048) / (15000 - 2048)
    developed = values.reshape(200, 2, 200, 2).mean(axis=(1, 3))
    level = float(texture("blank", (8, 8), 4).mean())
    gain, noise = signal_and_noise(scene.objects[0], level, Sensor(400, 400), settings.scene_illumination, exposure)
    difference = np.median(np.abs(np.diff(developed, axis=0))) / 0.6745 / np.sqrt(2)
    assert np.sqrt(noise) == pytest.approx(difference, rel=0.05)
    dark = 0.05 * gain / 0.85
    assert developed.mean() == pytest.approx(dark + gain * level, rel=0.02)


def test_optimiser_agrees_that_the_bound_is_the_curvature() -> None:
    # expected information is the curvature of the expected cost at the truth
    depth, noise = 1200.0, 3e-4
    spectrum = falling_spectrum()
    keep = np.ones((SIDE, SIDE), bool)
    keep[0, 0] = False
    truth = kernel_power(LENS, depth, SIDE) * spectrum + noise

    def cost(z: float) -> float:
        model = kernel_power(LENS, z, SIDE) * spectrum + noise
        return float(0.5 * (np.log(model) + truth / model)[keep].sum())

    step = 4.0
    curvature = (cost(depth + step) - 2 * cost(depth) + cost(depth - step)) / step**2
    assert depth_bound_mm(LENS, depth, spectrum, noise, SIDE**2) == pytest.approx(curvature**-0.5, rel=0.05)
    found = optimize.minimize_scalar(cost, bounds=(1000.0, 1400.0), method="bounded")
    assert found.x == pytest.approx(depth, abs=1.0)
