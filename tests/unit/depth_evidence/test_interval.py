"""How wide the interval is: what it holds of the posterior, and what widens or narrows it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from calibration.bank import Bank
from tests.unit.depth_evidence.synthetic import leaves, photograph
from workbench.depth.evidence import observe, prepare
from workbench.depth.evidence_model import EvidenceOptions, Learned
from workbench.depth.evidence_posterior import Refined, least_error_px, summarise
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
    found = summarise(sigma, log_post, 1000, se_px, model, Learned(outlier=0.0), options, {})
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


def test_a_mode_keeps_its_height_however_much_it_is_trusted() -> None:
    part = Refined(np.arange(3.0), np.array([1.0, 5.0, 3.0]))
    assert part.weighed(1.0, 0.5).log_likelihood.tolist() == [3.0, 5.0, 4.0]
    assert part.weighed(0.5, 2.0).log_likelihood.tolist() == [-5.5, 2.5, -1.5]


def test_errors_that_the_likelihood_does_not_know_add_in_quadrature(bank: Bank) -> None:
    model, learned = prepare(bank, EvidenceOptions()), Learned()

    def error(sigma_px: float = 8.0, line_share: float = 0.0, *, ridged: bool = False, found: bool = False) -> float:
        return least_error_px(sigma_px, line_share, 1, model, learned, is_ridged=ridged, is_found=found)

    plain = error()
    assert plain >= learned.floor_px
    ridged, found, both = error(ridged=True), error(found=True), error(ridged=True, found=True)
    assert both**2 - plain**2 == pytest.approx(ridged**2 + found**2 - 2 * plain**2)
    assert error(line_share=0.6) > error(line_share=0.3) > plain == error(line_share=0.05)
    assert error(sigma_px=0.3) > error(sigma_px=3.0) > 0


def test_outlines_that_were_found_widen_the_interval_and_move_nothing(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 8), 2600.0)
    labels = from_roi(image.shape, (4, 4, 120, 120))
    drawn = estimate_depths(image, bank, labels, "evidence", {})[1]
    found = estimate_depths(image, bank, labels, "evidence", {}, found=True)[1]
    assert found.interval_mm[0] < drawn.interval_mm[0] < drawn.interval_mm[1] < found.interval_mm[1]
    assert found.depth_mm == pytest.approx(drawn.depth_mm, rel=1e-3)


def test_methods_that_know_nothing_of_outlines_are_not_told(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 8), 2600.0)
    labels = whole(image.shape)
    drawn = estimate_depths(image, bank, labels, "zhuo-sim", {})[1]
    assert estimate_depths(image, bank, labels, "zhuo-sim", {}, found=True)[1].depth_mm == drawn.depth_mm
