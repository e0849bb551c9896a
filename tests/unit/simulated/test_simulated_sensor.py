from dataclasses import replace

import numpy as np
import pytest

from rigs.simulated.sensor import Sensor, bayer, expose, fixed_pattern, times_cell

SENSOR = Sensor(240, 320, prnu=0.0, hot_fraction=0.0)


def _flat(level: float, sensor: Sensor = SENSOR) -> np.ndarray:
    return np.full(sensor.shape, level, np.float32)


def test_signal_is_proportional_to_light_time_and_iso() -> None:
    def signal(light: float, time_s: float, iso: int) -> float:
        return float(expose(_flat(light), SENSOR, time_s=time_s, iso=iso, shot=1).mean()) - SENSOR.black

    base = signal(0.1, 1 / 125, 100)
    assert base == pytest.approx(0.1 * (SENSOR.white - SENSOR.black), rel=0.002)
    assert signal(0.2, 1 / 125, 100) == pytest.approx(2 * base, rel=0.003)
    assert signal(0.1, 3 / 125, 100) == pytest.approx(3 * base, rel=0.003)
    assert signal(0.1, 1 / 125, 400) == pytest.approx(4 * base, rel=0.003)


@pytest.mark.parametrize(("level", "iso"), [(0.5, 100), (0.1, 400), (0.004, 100), (0.0005, 1600)])
def test_shot_noise_is_the_mean_over_the_gain(level: float, iso: int) -> None:
    frame = expose(_flat(level), SENSOR, time_s=1 / 125, iso=iso, shot=2).astype(np.float64) - SENSOR.black
    per_dn = SENSOR.electrons_per_dn(iso)
    read = (SENSOR.read_noise_e / per_dn) ** 2 + SENSOR.read_noise_dn**2 + 1 / 12
    electrons = level * SENSOR.full_well_e
    assert frame.mean() * per_dn == pytest.approx(electrons, rel=0.02, abs=0.1)
    assert frame.var() == pytest.approx(electrons / per_dn**2 + read, rel=0.03)


def test_raising_iso_lowers_the_read_noise_in_electrons() -> None:
    noise = {
        iso: expose(_flat(0.0), SENSOR, time_s=1 / 4000, iso=iso, shot=3).std() * SENSOR.electrons_per_dn(iso)
        for iso in (100, 1600)
    }
    assert noise[100] > 1.5 * noise[1600]
    assert noise[1600] == pytest.approx(SENSOR.read_noise_e, rel=0.1)


def test_dark_frame_has_the_black_level_and_dark_current() -> None:
    short = expose(_flat(0.0), SENSOR, time_s=1 / 4000, iso=100, shot=4)
    assert short.mean() == pytest.approx(SENSOR.black, abs=0.05)
    long = expose(_flat(0.0), replace(SENSOR, dark_current_e_s=10.0), time_s=30.0, iso=100, shot=4)
    assert long.mean() - SENSOR.black == pytest.approx(300 / SENSOR.electrons_per_dn(100), rel=0.02)


def test_saturated_photosites_stand_at_white() -> None:
    frame = expose(_flat(3.0), SENSOR, time_s=1 / 125, iso=100, shot=5)
    assert (frame == SENSOR.white).all()


def test_non_uniformity_and_hot_pixels_belong_to_the_camera_and_noise_to_the_shot() -> None:
    sensor = Sensor(200, 300, hot_fraction=5e-4, seed=3)
    first, second = (expose(_flat(0.5, sensor), sensor, time_s=1 / 125, iso=100, shot=n).astype(float) for n in (1, 2))
    assert not np.array_equal(first, second)
    sensitivity, hot, current = fixed_pattern(sensor)
    assert sensitivity.std() == pytest.approx(sensor.prnu, rel=0.05)
    assert np.corrcoef((first + second).ravel(), sensitivity.ravel())[0, 1] > 0.6
    dark = expose(_flat(0.0, sensor), sensor, time_s=10.0, iso=100, shot=3).ravel()
    assert (dark[hot] > sensor.black + 50).mean() > 0.9
    assert current.min() >= 30
    other = expose(_flat(0.0, sensor), replace(sensor, seed=4), time_s=10.0, iso=100, shot=3).ravel()
    assert (other[hot] > sensor.black + 50).mean() < 0.2


def test_same_seed_and_shot_give_the_same_values() -> None:
    light = np.linspace(0, 1, 240 * 320, dtype=np.float32).reshape(240, 320)
    frames = [expose(light, Sensor(240, 320, seed=9), time_s=0.005, iso=200, shot=17) for _ in range(2)]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], expose(light, Sensor(240, 320, seed=10), time_s=0.005, iso=200, shot=17))


def test_colours_fall_on_the_rggb_cell_wherever_a_patch_lies() -> None:
    plane = np.ones((5, 4), np.float32)
    cell = bayer((1.0, 2.0, 3.0))
    whole = np.tile(cell, (6, 6))
    for corner in ((0, 0), (1, 0), (2, 3)):
        expected = whole[corner[0] : corner[0] + 5, corner[1] : corner[1] + 4]
        np.testing.assert_array_equal(times_cell(plane, cell, corner), expected)
