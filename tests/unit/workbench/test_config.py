from pathlib import Path

import pytest

from rigs.gphoto2_config import Gphoto2Settings
from workbench.config import load_rig_config
from workbench.devices import gphoto2_settings
from workbench.errors import InputError
from workbench.project import create_project, open_project


def _write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    return path


def test_the_template_is_valid_and_means_what_it_says(tmp_path: Path) -> None:
    config = create_project(tmp_path / "p", preset="eos650d", seed=7).config()
    assert config.simulation.preset == "eos650d"
    assert config.simulation.seed == 7
    assert config.camera.pixel_pitch_mm == pytest.approx(0.0043)
    assert (config.calibration.from_mm, config.calibration.to_mm, config.calibration.step_mm) == (600, 3500, 100)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("stage: {limts: [0 mm, 1 m]}", ("stage", "'limts'", "'limits'")),
        ("camra: {}", ("'camra'", "'camera'")),
        ("calibration: {from: 60}", ("calibration.from", "no unit", "60cm")),
        ("calibration: {from: 60 s}", ("calibration.from", "'s'", "unit")),
        ("calibration: {repeats: many}", ("calibration.repeats", "integer", "'many'")),
        ("camera: {kind: film}", ("camera.kind", "'film'")),
        ("camera: {kind: gphoto2, serial: 053071001234}", ("camera.serial", "in quotes")),
        ("camera: {kind: gphoto2, port: /dev/ttyUSB0}", ("camera.port", "usb:", "'/dev/ttyUSB0'")),
        ("camera: {kind: gphoto2, capture_target: sd}", ("camera.capture_target", "'card'", "'sd'")),
        ("camera: {kind: gphoto2, aperture: wide}", ("camera.aperture", "number", "'wide'")),
        ("camera: {kind: gphoto2, aperture: 0}", ("camera.aperture", "greater than 0")),
        ("camera: {kind: gphoto2, release: bulb}", ("camera.release", "'without-autofocus'", "'bulb'")),
        ("camera: {kind: gphoto2, may_be_absent: [shutter]}", ("camera.may_be_absent", "'iso'", "'shutter'")),
        ("camera: {kind: gphoto2, arrive_timeout: 20 mm}", ("camera.arrive_timeout", "'mm'", "time")),
        ("camera: {kind: gphoto2, restart_every: -1}", ("camera.restart_every", "greater than or equal to 0")),
        ("camera: {pixel_pitch: 4.3}", ("camera.pixel_pitch", "4.3 is no pitch", "4.3um")),
        ("camera: {pixel_pitch: 4.3 mm}", ("camera.pixel_pitch", "4.3 mm is no pitch", "4.3um")),
        ("camera: {pixel_pitch: -4.3 um}", ("camera.pixel_pitch", "no pitch")),
        ("panel: {pixel_pitch: 0.2 m}", ("panel.pixel_pitch", "less than or equal to 10")),
        ("camera: {modell: 650D}", ("camera", "'modell'", "'model'")),
        ("stage: {depth: {sign: 2}}", ("stage.depth.sign",)),
        ("stage: {kind: grbl}", ("stage", "port is missing", "/dev/ttyUSB0", "usb:VID:PID")),
        ("stage: {kind: grbl, port: /dev/x, axis: 2}", ("stage", "axis 2", "X, Y, Z")),
        ("stage: {kind: zaber, port: /dev/x, microstep: 0.5 um, axis: X}", ("stage", "axis X", "1 to 9")),
        ("stage: {kind: zaber, port: /dev/x}", ("stage", "microstep is missing", "data sheet")),
        ("stage: {kind: grbl, port: /dev/x, speed: 50 mm}", ("stage.speed", "'50 mm'", "50 mm/s")),
        ("stage: {kind: grbl, port: /dev/x, speed: 0 mm/s}", ("stage.speed", "greater than 0")),
        ("stage: {limits: [1 m, 20 cm]}", ("stage", "1000 to 200 mm", "smaller one first")),
        ("camera:\n  kind: gphoto2\n  kind: simulated\n", ("line 3", "kind: is there twice")),
        ("stage: {}\nstage:\n  kind: manual\n", ("line 2", "stage: is there twice")),
        ("panel: {dot: {size: .inf}}", ("panel.dot.size: a diameter", "auto", "inf")),
        ("panel: {dot: {size: 3 px}}", ("panel.dot.size: a diameter", "'3 px'")),
        ("stage: {depth: {scale: .inf}}", ("stage.depth.scale", "finite")),
        ("stage: {kind: grbl, port: /dev/x, axis: x}", ("stage.axis: ", "'X', 'Y' or 'Z'")),
        ("stage: {limits: [1 m, 2 m, 3 m]}", ("stage.limits: the smallest and the largest",)),
        ("panel: {dot: {colour: '#000000'}}", ("panel.dot.colour", "black dot", "#ffffff")),
        ("panel: {pixels: 1280}", ("panel.pixels: width and height",)),
        ("calibration: {field: 3}", ("calibration.field: points across and down",)),
        ("camera: {kind: gphoto2, model: 650}", ("camera.model", "in quotes")),
        ("[1, 2]", ("rig.yaml", "list")),
        ("a: [", ("rig.yaml", "YAML")),
    ],
)
def test_a_wrong_key_type_or_unit_is_named(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as caught:
        load_rig_config(_write(tmp_path, text))
    for word in words:
        assert word in str(caught.value)


def test_stages_on_a_serial_line_are_read_with_their_units(tmp_path: Path) -> None:
    text = (
        "stage: {kind: zaber, port: 'usb:0403:6001', microstep: 0.49609375 um, speed: 0.1 m/s, limits: [-1 m, 20 cm]}"
    )
    stage = load_rig_config(_write(tmp_path, text)).stage
    assert (stage.microstep_mm, stage.speed_mm_s, stage.limits_mm) == (pytest.approx(0.00049609375), 100, (-1000, 200))
    grbl = load_rig_config(_write(tmp_path, "stage: {kind: grbl, port: 'socket://rail:23', speed: 3000 mm/min}")).stage
    assert (grbl.speed_mm_s, grbl.axis, grbl.baud_rate) == (50, None, 115200)
    assert not grbl.allow_without_homing
    assert not grbl.allow_without_soft_limits


def test_a_camera_on_usb_is_read_in_the_operators_words(tmp_path: Path) -> None:
    text = """
camera:
  kind: gphoto2
  model: 650D
  serial: "053071001234"
  port: usb:001,005
  aperture: f/2.8
  may_be_absent: [image_format]
  arrive_timeout: 1 min
"""
    settings = gphoto2_settings(load_rig_config(_write(tmp_path, text)).camera)
    assert (settings.model, settings.serial, settings.port) == ("650D", "053071001234", "usb:001,005")
    assert settings.aperture == 2.8
    assert settings.may_be_absent == ("image_format",)
    assert settings.arrive_timeout_s == 60


def test_what_is_left_out_of_a_camera_is_the_drivers_own_default(tmp_path: Path) -> None:
    assert gphoto2_settings(load_rig_config(_write(tmp_path, "camera: {kind: gphoto2}")).camera) == Gphoto2Settings()


def test_a_directory_without_rig_yaml_is_no_project(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="workbench init"):
        open_project(tmp_path)
    with pytest.raises(InputError, match="no such directory"):
        open_project(tmp_path / "nowhere")


def test_init_never_overwrites_a_project(tmp_path: Path) -> None:
    create_project(tmp_path)
    with pytest.raises(InputError, match="already"):
        create_project(tmp_path)


def test_a_real_cameras_lens_is_not_held_against_the_simulated_focus(tmp_path: Path) -> None:
    long = "optics: {focal_length: 1 m}\n"
    load_rig_config(_write(tmp_path, long + "camera: {kind: gphoto2}\n"))
    with pytest.raises(InputError, match=r"simulation\.focus"):
        load_rig_config(_write(tmp_path, long))
