import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rawpy

from rigs.errors import CameraError, ConfigError, LimitError, NotHomedError, PanelError, SettingError
from rigs.protocols import Camera, Exposure, Panel, Pattern, Stage
from rigs.simulated.devices import SimulatedStage
from rigs.simulated.rig import SimulatedRig, make_rig
from rigs.simulated.scenes import plane_scene
from rigs.simulated.sensor import bayer
from rigs.simulated.world import SimulatedRigSettings

CENTRED = SimulatedRigSettings(stage_aside_mm=(0.0, 0.0), stage_misalignment=(0.0, 0.0), stage_repeatability_mm=0.0)
DOT = Pattern("dot")


def _rig(settings: SimulatedRigSettings = CENTRED, shape: tuple[int, int] = (320, 480)) -> SimulatedRig:
    rig = make_rig(settings)
    rig.world.resize(shape)
    rig.stage.home()
    return rig


def _raw(path: Path) -> np.ndarray:
    with rawpy.imread(str(path)) as raw:
        return raw.raw_image_visible.copy()


def _at(rig: SimulatedRig, depth_mm: float) -> None:
    s = rig.world.settings
    rig.stage.move_to_mm(depth_mm - s.stage_offset_mm - s.stage_zero_mm)


def test_devices_fulfil_the_protocols() -> None:
    rig = _rig()
    assert isinstance(rig.camera, Camera)
    assert isinstance(rig.stage, Stage)
    assert isinstance(rig.panel, Panel)
    with rig.rig() as whole:
        whole.check_reach((600.0, 3500.0))


def test_an_unhomed_stage_neither_knows_its_position_nor_moves() -> None:
    stage = make_rig().stage
    assert not stage.homed()
    with pytest.raises(NotHomedError):
        stage.position_mm()
    with pytest.raises(NotHomedError):
        stage.move_to_mm(100)
    stage.home()
    assert stage.move_to_mm(100) == 100
    stage.close()
    assert not stage.homed()


def test_limits_are_checked_before_anything_moves() -> None:
    rig = _rig()
    rig.stage.move_to_mm(1000)
    with pytest.raises(LimitError, match="travel"):
        rig.stage.move_to_mm(3001)
    assert rig.stage.position_mm() == 1000


def test_limits_of_rig_yaml_narrow_the_simulated_travel_and_never_widen_it() -> None:
    world = make_rig().world
    stage = SimulatedStage(world, (100.0, 2000.0))
    stage.home()
    assert stage.limits_mm() == (100.0, 2000.0)
    with pytest.raises(LimitError, match="100 to 2000 mm"):
        stage.move_to_mm(50)
    with pytest.raises(ConfigError, match="beyond the simulated rail"):
        SimulatedStage(world, (-10.0, 2000.0))


def test_the_stage_has_a_hidden_zero_and_scatters_by_its_repeatability() -> None:
    rig = _rig(replace(CENTRED, stage_repeatability_mm=0.05))
    errors = []
    for step in range(300):
        rig.stage.move_to_mm(100.0 + step)
        errors.append(rig.world.true_depth_mm - (500.0 + 100.0 + step))
    assert np.mean(errors) == pytest.approx(7.0, abs=0.02)
    assert np.std(errors) == pytest.approx(0.05, rel=0.2)
    rig.stage.move_to_mm(100.0)
    assert rig.world.true_depth_mm - 600.0 != errors[0]
    again = _rig(replace(CENTRED, stage_repeatability_mm=0.05))
    again.stage.move_to_mm(100.0)
    assert again.world.true_depth_mm - 600.0 == errors[0]


def test_travel_time_grows_with_distance() -> None:
    times = [_rig().stage.travel_time_s(d) for d in (0, 1, 10, 100, -1000)]
    assert times[0] == 0
    assert all(a < b for a, b in itertools.pairwise(times))


def test_flux_of_a_dot_follows_its_image_and_peak_its_blur() -> None:
    rig = _rig()
    flux, peak = {}, {}
    for depth_mm in (900.0, 1200.0, 1600.0, 2500.0):
        _at(rig, depth_mm)
        rig.panel.show(DOT)
        on = rig.world.light()
        rig.panel.show(Pattern("black"))
        point = (on - rig.world.light()).astype(float)
        flux[depth_mm], peak[depth_mm] = point.sum(), point.max()
    for depth_mm, value in flux.items():
        side_px = 0.1 * rig.world.lens.magnification(depth_mm) / 0.0043
        assert value == pytest.approx(side_px**2, rel=1e-4)
    blur = {d: flux[d] / rig.world.lens.cone_section(d) ** 2 for d in (900.0, 1200.0, 2500.0)}
    assert peak[900.0] / peak[1200.0] == pytest.approx(blur[900.0] / blur[1200.0], rel=0.05)
    assert peak[1600.0] > 50 * peak[2500.0]


def test_a_dot_can_be_exposed_well_from_the_nearest_depth_to_focus() -> None:
    rig = _rig(shape=(512, 512))
    for depth_mm, size in ((600.0, 1), (1600.0, 1), (3400.0, 2)):
        _at(rig, depth_mm)
        rig.panel.show(Pattern("dot", size_px=size))
        needed_s = 0.7 * rig.world.sensor.saturating_time_s / float(rig.world.light().max())
        times = rig.camera.exposure_times_s()
        assert times[0] < needed_s < times[-1]


def test_panel_positions_are_seen_right_and_down() -> None:
    rig = _rig()
    _at(rig, 1600.0)
    rig.panel.show(Pattern("dot", x_px=30, y_px=-20))
    row, column = np.unravel_index(int(np.argmax(rig.world.light())), (320, 480))
    step = 0.1 * rig.world.lens.magnification(1600.0) / 0.0043
    assert column + 0.5 == pytest.approx(240 + 30 * step, abs=0.6)
    assert row + 0.5 == pytest.approx(160 - 20 * step, abs=0.6)
    rig.panel.show(Pattern("grid", points_px=((-100, 0), (100, 0), (0, 120))))
    light = rig.world.light()
    assert [light[160, int(240 - 100 * step)], light[160, int(240 + 100 * step)], light[int(160 + 120 * step), 240]] > [
        0.01
    ] * 3


def test_the_chief_ray_drifts_with_a_misaligned_rail() -> None:
    rig = _rig(replace(CENTRED, stage_aside_mm=(2.0, 0.0), stage_misalignment=(0.001, 0.0)), (320, 640))
    places = {}
    for depth_mm in (1500.0, 1700.0, 3000.0):
        _at(rig, depth_mm)
        places[depth_mm] = rig.world.view().x_mm * rig.world.lens.magnification(depth_mm)
    assert places[1500.0] - places[3000.0] == pytest.approx(
        2.0 * rig.world.lens.sensor_distance_mm * (1 / 1500 - 1 / 3000)
    )


def test_colour_and_brightness_of_a_dot_act_in_linear_light() -> None:
    rig = _rig(replace(CENTRED, ambient=0.0))
    _at(rig, 1650.0)
    peaks = {}
    for colour, brightness in (("#ffffff", 1.0), ("#ffffff", 0.25), ("#ff0000", 1.0)):
        rig.panel.show(Pattern("dot", size_px=8, colour=colour, brightness=brightness))
        peaks[colour, brightness] = rig.world.light() - np.float32(1e-5)
    white = peaks["#ffffff", 1.0]
    np.testing.assert_allclose(peaks["#ffffff", 0.25], 0.25 * white, atol=1e-6)
    red = np.tile(bayer((1.0, 0.0, 0.0)), (160, 240))
    np.testing.assert_allclose(peaks["#ff0000", 1.0], white * red, atol=1e-6)


@pytest.mark.parametrize(
    "pattern", [Pattern("white"), Pattern("crosshair", size_px=3), Pattern("picture", picture="chart")]
)
def test_other_patterns_show_on_the_panel_and_end_at_its_border(pattern: Pattern) -> None:
    rig = _rig(shape=(700, 1000))
    _at(rig, 3400.0)
    rig.panel.show(pattern)
    light = rig.world.light()
    assert light.max() > 0.05
    assert light[2, 2] < 1e-3
    assert light.max() <= 1.001


def test_what_the_panel_cannot_show_is_refused_and_the_old_pattern_stays() -> None:
    rig = _rig()
    rig.panel.show(DOT)
    for wrong in (
        Pattern("dot", x_px=5000),
        Pattern("dot", colour="white"),
        Pattern("grid"),
        Pattern("picture", picture="/nowhere.png"),
    ):
        with pytest.raises(PanelError):
            rig.panel.show(wrong)
    assert rig.world.pattern == DOT


def test_frames_hold_what_the_sensor_saw_and_repeat_by_name(tmp_path: Path) -> None:
    results = {}
    for attempt in ("a", "b"):
        rig = _rig()
        _at(rig, 1600.0)
        rig.panel.show(DOT)
        (tmp_path / attempt).mkdir()
        for name in ("point-1.dng", "point-2.dng") if attempt == "a" else ("point-2.dng", "point-1.dng"):
            result = rig.camera.capture(Exposure(1 / 125, 100), tmp_path / attempt / name)
            results[attempt, name] = result
            assert result.bytes == result.path.stat().st_size
    assert results["a", "point-1.dng"].sha256 == results["b", "point-1.dng"].sha256
    assert results["a", "point-2.dng"].sha256 == results["b", "point-2.dng"].sha256
    assert results["a", "point-1.dng"].sha256 != results["a", "point-2.dng"].sha256
    frame = _raw(tmp_path / "a" / "point-1.dng")
    assert 2400 < frame.max() < 15000
    assert np.median(frame) == pytest.approx(2048, abs=2)


def test_retaking_a_frame_gives_new_noise(tmp_path: Path) -> None:
    rig = _rig()
    hashes = {rig.camera.capture(Exposure(1 / 125, 100), tmp_path / "x.dng").sha256 for _ in range(2)}
    assert len(hashes) == 2


@pytest.mark.parametrize("exposure", [Exposure(0.0071, 100), Exposure(1 / 125, 123), Exposure(0.0, 100)])
def test_an_exposure_that_is_not_offered_is_refused(tmp_path: Path, exposure: Exposure) -> None:
    with pytest.raises(SettingError, match="nearest"):
        _rig().camera.capture(exposure, tmp_path / "x.dng")
    assert list(tmp_path.iterdir()) == []


def test_the_camera_can_turn_to_a_scene_and_back(tmp_path: Path) -> None:
    rig = _rig(shape=(64, 96))
    with rig.scene_in_view(plane_scene("gravel", 2000.0)) as truth:
        assert (truth.depth_mm == 2000).all()
        bright = rig.world.light().mean()
        rig.camera.capture(Exposure(1 / 125, 100), tmp_path / "scene.dng")
    assert bright > 0.05
    assert rig.world.subject == "panel"
    assert rig.world.light().mean() < 1e-3


def test_preview_is_a_jpeg() -> None:
    data = _rig().camera.preview()
    assert data[:2] == b"\xff\xd8"


def test_a_closed_camera_and_panel_say_so(tmp_path: Path) -> None:
    rig = _rig()
    rig.rig().close()
    rig.rig().close()
    with pytest.raises(CameraError, match="closed"):
        rig.camera.capture(Exposure(1 / 125, 100), tmp_path / "x.dng")
    with pytest.raises(PanelError, match="closed"):
        rig.panel.show(DOT)
