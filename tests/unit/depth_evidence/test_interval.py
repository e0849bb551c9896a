"""How wide the interval is: what it holds of the posterior, and what widens or narrows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from calibration.bank import Bank
from calibration.pupil import interpolator_of_bank
from tests.unit.depth_evidence.synthetic import leaves, make_bank, photograph, with_pupil
from workbench.depth.evidence import estimate_evidence, prepare
from workbench.depth.evidence_model import EvidenceOptions, Learned
from workbench.depth.evidence_observation import observe
from workbench.depth.evidence_posterior import least_error_px, log_prior, signed_posterior, summarise
from workbench.depth.evidence_uniform import trust_in_one_blur
from workbench.depth.methods import estimate_depths
from workbench.depth.regions import from_roi, whole

SIDE = 128 + 40


@pytest.mark.parametrize("se_px", [0.03, 0.05, 0.2])
@pytest.mark.parametrize("between_steps", [0.0, 0.3, 0.5])
def test_interval_holds_95_percent_of_a_posterior_hardly_wider_than_its_steps(
    bank: Bank, se_px: float, between_steps: float
) -> None:
    options = EvidenceOptions()
    model = prepare(bank, options)
    step = 0.02
    sigma = np.arange(2.0, 8.0, step)
    log_post = -0.5 * ((sigma - 5.0 - between_steps * step) / 0.02) ** 2
    found = summarise(sigma, log_post, log_post, 1000, se_px, model, Learned(outlier=0.0), options, {})
    low, high = (model.psfs.radius_px(end) for end in found.interval_mm)
    half = norm.ppf(0.975) * np.hypot(se_px, 0.02)
    assert (high - low) / 2 == pytest.approx(half, rel=0.03)
    assert (high + low) / 2 == pytest.approx(5.0 + between_steps * step, abs=0.1 * step)


def test_blur_that_shows_its_zeros_is_trusted_more_than_one_that_does_not(bank: Bank) -> None:
    """Noise hides them: what lies above it falls as the blur's slope does."""
    options = EvidenceOptions()
    model = prepare(bank, options)
    planes = [photograph(leaves(SIDE, 5), 2600.0, noise=noise).luminance for noise in (0.003, 0.1)]
    seen = [observe(plane, np.ones(plane.shape, bool), model, options, as_one=True) for plane in planes]
    shown, hidden = (one for one in seen if one is not None)
    assert shown.varied < -10.0 < hidden.varied
    assert trust_in_one_blur(shown.varied) > 1.0 > trust_in_one_blur(hidden.varied)


def test_trust_falls_as_a_mixture_fits_better() -> None:
    trust = [trust_in_one_blur(gain) for gain in (-300.0, -30.0, -3.0, 0.0, 5.0)]
    assert trust == sorted(trust, reverse=True)
    assert trust[0] > 1.0 > trust[-1] == trust[-2] > 0.0


def test_a_mode_keeps_its_height_however_much_it_is_trusted(bank: Bank) -> None:
    options = EvidenceOptions()
    model = prepare(bank, options)
    modes = [5, 20]
    radius = model.row_radius_px
    rows = np.maximum(-((radius - radius[5]) ** 2), -3.0 - (radius - radius[20]) ** 2)
    sides = np.zeros(2), np.zeros(2)
    sigma, plain, _ = signed_posterior(rows, modes, *sides, model, options)
    heights, widths = [], []
    for trust in (0.5, 1.0, 2.0):
        likelihood = signed_posterior(rows, modes, *sides, model, options, about_modes=trust)[2]
        likelihood = likelihood - log_prior(model, sigma, options.prior_power)
        heights.append([likelihood[np.abs(sigma - radius[mode]) < 0.5].max() for mode in modes])
        below = likelihood[np.abs(sigma - radius[5]).argmin()] - likelihood[np.abs(sigma - radius[5] - 0.6).argmin()]
        widths.append(below)
    assert plain.shape == sigma.shape
    assert np.ptp(heights, axis=0) == pytest.approx(0.0, abs=1e-3)
    assert widths == pytest.approx([0.18, 0.36, 0.72], rel=0.05)


@pytest.mark.parametrize("step_px", [0.15, 0.3, 0.6])
def test_width_does_not_depend_on_the_grid_of_radii(bank: Bank, step_px: float) -> None:
    image = photograph(leaves(SIDE, 8), 2600.0, noise=0.02)
    found = estimate_evidence(image, bank, whole(image.shape), EvidenceOptions(radius_step_px=step_px))[1]
    usual = estimate_evidence(image, bank, whole(image.shape))[1]
    assert np.ptp(found.interval_mm) == pytest.approx(np.ptp(usual.interval_mm), rel=0.1)


def test_interval_follows_the_trust(bank: Bank, monkeypatch: pytest.MonkeyPatch) -> None:
    image = photograph(leaves(SIDE, 8), 2600.0, noise=0.02)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    widths = []
    for trust in (0.5, 1.0, 20.0):
        monkeypatch.setattr("workbench.depth.evidence_findings.trust_in_one_blur", lambda _, trust=trust: trust)
        other = estimate_evidence(image, bank, whole(image.shape))[1]
        assert (other.depth_mm, other.status) == (found.depth_mm, found.status)
        widths.append(np.ptp(other.interval_mm))
    assert widths[0] > 1.2 * widths[1] > 1.4 * widths[2]


@pytest.mark.parametrize("first_mm", [700.0, 2000.0, 2500.0])
def test_trust_does_not_depend_on_where_the_bank_ends(first_mm: float) -> None:
    """But for a sixth of the width: mixtures hold what blurs the bank has, none of them twice."""
    plane = photograph(leaves(SIDE, 8), 2600.0, noise=0.02).luminance
    lost = []
    for start in (700.0, first_mm):
        bank = with_pupil(make_bank(depths_mm=np.arange(start, 3501.0, 100.0)))
        model = prepare(bank, EvidenceOptions())
        seen = observe(plane, np.ones(plane.shape, bool), model, EvidenceOptions(), as_one=True)
        assert seen is not None
        lost.append(seen.varied)
    assert trust_in_one_blur(lost[1]) == pytest.approx(trust_in_one_blur(lost[0]), rel=0.35)


def test_bank_without_a_range_of_blurs_changes_no_width() -> None:
    assert trust_in_one_blur(float("nan")) == 1.0


def test_errors_that_the_likelihood_does_not_know_add_in_quadrature(bank: Bank) -> None:
    model, learned = replace(prepare(bank, EvidenceOptions()), psf_error=0.02), Learned()

    def error(sigma_px: float = 8.0, line_share: float = 0.0, *, found: bool = False) -> float:
        return least_error_px(sigma_px, line_share, 1, model, learned, outlines_found=found)

    plain = error()
    lens = float(np.interp(8.0, model.sigma_px, model.sigma_se_px))
    assert plain == pytest.approx(np.hypot(learned.floor_px, lens), abs=1e-3)
    lines, found, both = error(line_share=0.3), error(found=True), error(line_share=0.3, found=True)
    assert both**2 - plain**2 == pytest.approx(lines**2 + found**2 - 2 * plain**2)
    assert error(line_share=0.6) > error(line_share=0.3) > plain == error(line_share=0.05)
    assert error(sigma_px=0.3) > 0.09 > 3 * error(sigma_px=5.0)
    assert least_error_px(0.3, 0.0, 2, model, learned, outlines_found=False) < 0.75 * error(sigma_px=0.3)
    blended = replace(model, psfs=interpolator_of_bank(bank, 0))
    coarse = least_error_px(8.0, 0.0, 1, blended, learned, outlines_found=False)
    assert coarse**2 - plain**2 == pytest.approx(0.06**2)
    odd = replace(model, psf_error=float(np.hypot(0.025, 0.06)))
    errors = [least_error_px(sigma, 0.0, 1, odd, learned, outlines_found=False) for sigma in (8.0, 12.0)]
    assert errors[0] == pytest.approx(np.hypot(plain, 0.06 * (1.2 + 0.2 * 8.0)))
    assert errors[1] > errors[0]


def test_outlines_that_were_found_widen_the_interval_and_move_nothing(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 8), 2600.0)
    labels = from_roi(image.shape, (4, 4, 120, 120))
    drawn = estimate_depths(image, bank, labels, "evidence", {})[1]
    found = estimate_depths(image, bank, labels, "evidence", {}, outlines_found=True)[1]
    assert found.interval_mm[0] < drawn.interval_mm[0] < drawn.interval_mm[1] < found.interval_mm[1]
    assert found.depth_mm == pytest.approx(drawn.depth_mm, rel=1e-3)


def test_a_bank_over_the_field_tells_it_too(bank: Bank) -> None:
    places = np.array([(-0.4, -0.4), (0.4, 0.4)])
    psf, se = np.repeat(bank.psf, 2, axis=0), np.repeat(bank.psf_se, 2, axis=0)
    field = replace(bank, psf=psf, psf_se=se, field_yx=places, extras={})
    image = photograph(leaves(SIDE, 8), 2600.0)
    drawn, found = (
        estimate_depths(image, field, whole(image.shape), "evidence", {}, outlines_found=told)[1]
        for told in (False, True)
    )
    assert np.ptp(found.interval_mm) > 1.2 * np.ptp(drawn.interval_mm)


def test_methods_that_know_nothing_of_outlines_are_not_told(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 8), 2600.0)
    labels = whole(image.shape)
    drawn = estimate_depths(image, bank, labels, "zhuo-sim", {})[1]
    assert estimate_depths(image, bank, labels, "zhuo-sim", {}, outlines_found=True)[1].depth_mm == drawn.depth_mm
