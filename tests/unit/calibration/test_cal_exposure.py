from __future__ import annotations

import numpy as np
import pytest
from drawn_points import as_frame, draw_psf
from hypothesis import given
from hypothesis import strategies as st

from calibration.exposure import Metered, choose_exposure, meter

TIMES = tuple(2.0 ** (k / 3) / 1000 for k in range(36))
ISOS = (100, 200, 400, 800, 1600, 3200)


def test_the_next_exposure_brings_the_peak_to_seventy_percent() -> None:
    choice = choose_exposure(Metered(0.1, False, 1e-4), time_s=0.01, iso=100, times_s=TIMES, isos=ISOS)
    assert choice.iso == 100
    assert not choice.done
    assert not choice.limited
    assert choice.expected_peak == pytest.approx(0.7, rel=0.15)
    assert choice.time_s / 0.01 * 0.1 == pytest.approx(choice.expected_peak)


def test_a_good_frame_needs_no_further_one() -> None:
    choice = choose_exposure(Metered(0.62, False, 1e-4), time_s=0.01, iso=200, times_s=TIMES, isos=ISOS)
    assert (choice.done, choice.time_s, choice.iso) == (True, 0.01, 200)


def test_a_saturated_frame_is_cut_to_an_eighth() -> None:
    choice = choose_exposure(Metered(1.0, True, 1e-4), time_s=0.8, iso=100, times_s=TIMES, isos=ISOS)
    assert choice.time_s * choice.iso == pytest.approx(0.8 * 100 / 8, rel=0.15)


def test_iso_rises_only_when_the_longest_time_is_not_enough() -> None:
    choice = choose_exposure(Metered(0.02, False, 1e-4), time_s=max(TIMES), iso=100, times_s=TIMES, isos=ISOS)
    assert choice.iso > 100
    assert choice.expected_peak <= 0.85
    hopeless = choose_exposure(Metered(0.0005, False, 1e-4), time_s=max(TIMES), iso=100, times_s=TIMES, isos=(100, 200))
    assert hopeless.limited


@given(
    peak=st.floats(1e-4, 0.97),
    time_s=st.sampled_from(TIMES),
    iso=st.sampled_from(ISOS),
)
def test_no_choice_is_expected_to_saturate_where_a_shorter_one_exists(peak: float, time_s: float, iso: int) -> None:
    choice = choose_exposure(Metered(peak, False, 1e-5), time_s=time_s, iso=iso, times_s=TIMES, isos=ISOS)
    shortest = peak * min(TIMES) * min(ISOS) / (time_s * iso)
    assert choice.expected_peak <= max(0.85, shortest) * 1.0001


def test_metering_sees_the_point_and_not_a_hot_photosite() -> None:
    light = draw_psf(8.0, (64, 64), (32, 32), 0.5)
    frame = as_frame(light / light.max() * 0.4)
    frame.planes[5, 6, 0] = 0.98
    assert meter(frame).peak == pytest.approx(0.4, rel=0.08)
    frame.saturated[5, 6] = True
    assert not meter(frame).saturated
    bright = as_frame(light / light.max() * 1.3)
    assert meter(bright).saturated


def test_a_black_frame_asks_for_more_light() -> None:
    dark = meter(as_frame(np.zeros((64, 64))))
    choice = choose_exposure(dark, time_s=0.01, iso=100, times_s=TIMES, isos=ISOS)
    assert choice.time_s * choice.iso > 10 * 0.01 * 100
