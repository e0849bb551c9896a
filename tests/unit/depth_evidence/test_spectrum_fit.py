"""Fitting texture and noise for each blur: few steps must do, from wherever the scan comes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from workbench.depth import evidence_spectrum
from workbench.depth.evidence_spectrum import SUPERPIXELS, frequencies

SIZE = 128
fit_spectra = partial(evidence_spectrum.fit_spectra, independent_share=0.3)


def blurs(count: int) -> np.ndarray:
    """Squared transfer functions of discs of growing radius, float32 (count, N, N // 2 + 1)."""
    modulus, _, _ = frequencies(SIZE)
    turn = 2 * np.pi * modulus[np.newaxis] * np.linspace(0.2, 24.0, count)[:, np.newaxis, np.newaxis]
    with np.errstate(invalid="ignore", divide="ignore"):
        airy = np.where(turn < 1e-3, 1.0, 2.0 * np.sin(turn) / turn)
    return np.asarray(np.minimum(airy**2, 1.0) + 1e-6, np.float32)


def periodogram(power: np.ndarray, averages: float, seed: int) -> np.ndarray:
    return power * np.random.default_rng(seed).gamma(averages, 1.0 / averages, power.shape)


@pytest.mark.parametrize(("contrast", "slope"), [(1e-2, 2.4), (1e-3, 3.5), (1e-4, 1.0)])
def test_two_steps_from_either_end_and_twelve_find_the_same_likelihood(contrast: float, slope: float) -> None:
    """Rich spectra of large regions: averages of many windows, texture far above the noise."""
    expected = blurs(60)
    modulus, _, _ = frequencies(SIZE)
    texture = contrast * 1e-3 * np.maximum(modulus, 1 / SIZE) ** -slope
    power = periodogram(texture * expected[25] + 1e-6, 40.0, 1)
    up = fit_spectra(power, 40.0, expected).log_likelihood
    down = fit_spectra(power, 40.0, expected[::-1].copy()).log_likelihood[::-1]
    settled = fit_spectra(power, 40.0, expected, steps=12).log_likelihood
    close = settled > settled.max() - 70.0
    np.testing.assert_allclose(up[close], settled[close], atol=2.0)
    np.testing.assert_allclose(down[close], settled[close], atol=2.0)
    assert abs(int(up.argmax()) - 25) <= 1


def test_more_steps_never_lose() -> None:
    expected = blurs(40)
    modulus, _, _ = frequencies(SIZE)
    power = periodogram(1e-4 * np.maximum(modulus, 1 / SIZE) ** -3.0 * expected[10] + 1e-6, 30.0, 2)
    few, many = (fit_spectra(power, 30.0, expected, steps=steps).log_likelihood for steps in (2, 20))
    close = many > many.max() - 70.0
    assert (many > few - 1.0)[close].all()
    assert int(few.argmax()) == int(many.argmax()) == 10


@pytest.mark.parametrize("seed", range(4))
def test_texture_far_beyond_the_noise_is_not_taken_for_noise_below_everything(seed: int) -> None:
    """Clean renderings: power over noise beyond what the likelihood is tabulated for."""
    expected = blurs(40)
    modulus, _, _ = frequencies(SIZE)
    texture = np.maximum(modulus, 1 / SIZE) ** -3.0
    power = periodogram(texture / texture.max() * np.exp(22.0) * 1e-6 * expected[10] + 1e-6, 30.0, seed)
    assert int(fit_spectra(power, 30.0, expected).log_likelihood.argmax()) == 10


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_no_number_ends_as_no_answer_and_not_as_a_crash(bad: float) -> None:
    expected = blurs(5)
    power = periodogram(np.full((SIZE, SIZE // 2 + 1), 1e-6), 10.0, 4)
    power[9, 9] = bad
    with np.errstate(invalid="ignore"):
        assert not np.isfinite(fit_spectra(power, 10.0, expected).log_likelihood.max())


def test_ridges_are_kept_out_of_textures_without_a_direction() -> None:
    modulus, direction, used = frequencies(64)
    power = np.ones(modulus.shape)
    power[used] = 1e-4 / modulus[used] ** 2
    power[used] /= np.sqrt(1.0 + (modulus[used] * np.sin(direction[used]) / 0.05) ** 2)
    flat = np.ones((1, *modulus.shape), np.float32)
    with_axis, without = (
        fit_spectra(power, 20.0, flat, band=replace(SUPERPIXELS, ridges_from=least, more_ridges=False))
        for least in (0.0, 0.999)
    )
    assert len(with_axis.ridges) == 2
    assert np.abs(with_axis.coefficients[0, -2:]).max() > 0.1
    assert without.ridges == ()
    assert without.likelihood_weight == 1.0 > with_axis.likelihood_weight > 0.5
    assert without.coefficients.shape[1] == with_axis.coefficients.shape[1] - 2
