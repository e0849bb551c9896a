from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_points import DEPTHS_MM, FOCUS_MM, as_frame, draw_psf, point_image

from calibration.build import BuildOptions, BuiltBank, PointFrame, build_bank
from calibration.errors import DepthListError, FrameError, PointError
from calibration.frames import find_frames
from calibration.image import LinearImage
from calibration.quality import asymmetry


def test_bank_of_a_drawn_lens_has_its_focus_and_chief_rays(built: BuiltBank) -> None:
    bank = built.bank
    assert bank.lens.focus_mm == pytest.approx(FOCUS_MM, rel=0.003)
    assert bank.psf.shape[0] == 1
    assert bank.psf.shape[2] % 2 == 1
    np.testing.assert_allclose(bank.psf.sum(axis=(2, 3)), 1.0, atol=1e-5)
    # all depths share the fraction (0.2, -0.1) of a pixel
    np.testing.assert_allclose(bank.extras["chief_yx"][0], [(0.2, -0.1)] * len(DEPTHS_MM), atol=0.08)
    assert bank.manifest["quality"]["verdict"] in ("good", "suspect")
    assert bank.manifest["frames"][0]["name"] == "psf_060cm.dng"


def test_the_same_frames_give_the_same_bank(built: BuiltBank) -> None:
    again = build_bank([PointFrame(z, (point_image(z),)) for z in reversed(DEPTHS_MM)])
    assert again.bank.id == built.bank.id


def test_stage_zero_is_found_and_applied_for_an_own_rig() -> None:
    frames = [PointFrame(z, (point_image(z, zero_mm=18.0),)) for z in DEPTHS_MM]
    bank = build_bank(frames, (), BuildOptions(apply_zero=True)).bank
    assert bank.lens.zero_mm == pytest.approx(18.0, abs=5.0)
    np.testing.assert_allclose(bank.depths_mm, np.array(DEPTHS_MM) + bank.lens.zero_mm)
    assert bank.lens.focus_mm == pytest.approx(FOCUS_MM, rel=0.01)


def test_lateral_drift_of_the_stage_does_not_move_the_chief_ray() -> None:
    frames = [PointFrame(z, (point_image(z, centre=(46 + 3000 / z, 50 - 1500 / z)),)) for z in DEPTHS_MM]
    bank = build_bank(frames).bank
    assert bank.lens.focus_mm == pytest.approx(FOCUS_MM, rel=0.003)
    assert np.abs(bank.extras["chief_yx"]).max() < 1.0


def test_a_large_dot_does_not_bias_the_lens() -> None:
    # 0.6 mm at 60 cm is 6 px across through 51.6 mm of image distance
    image_distance = 50.0 * 1600 / 1550
    frames = [
        PointFrame(z, (point_image(z, dot_radius_px=0.3 * image_distance / z / 0.0086),), dot_mm=0.6) for z in DEPTHS_MM
    ]
    known = build_bank(frames, (), BuildOptions(apply_zero=True)).bank
    ignored = build_bank([replace(f, dot_mm=0.0) for f in frames], (), BuildOptions(apply_zero=True)).bank
    assert known.lens.focus_mm == pytest.approx(FOCUS_MM, rel=0.005)
    assert abs(known.lens.zero_mm) < 5.0
    assert np.sqrt(np.mean(known.lens.residual_px**2)) < np.sqrt(np.mean(ignored.lens.residual_px**2))


def test_a_wrong_depth_is_named_in_the_quality() -> None:
    frames = [PointFrame(z, (point_image(2400.0 if z == 1800.0 else z),)) for z in DEPTHS_MM]
    built = build_bank(frames)
    assert built.bank.lens.suspect.index(True) == DEPTHS_MM.index(1800.0)
    assert built.quality.verdict == "bad"
    assert any(reason.startswith("180 cm: ") and "residual" in reason for reason in built.quality.reasons)


def test_a_bad_frame_stops_or_is_left_out_and_named() -> None:
    empty = as_frame(np.zeros((96, 96)), name="psf_130cm.dng")
    frames = [PointFrame(z, (empty if z == 1300.0 else point_image(z),)) for z in DEPTHS_MM]
    with pytest.raises(PointError, match="psf_130cm"):
        build_bank(frames)
    built = build_bank(frames, (), BuildOptions(on_bad="skip"))
    assert [(r.reason, r.depth_nominal_mm) for r in built.rejected] == [("missing", 1300.0)]
    assert 1300.0 not in built.bank.depths_mm
    few = [PointFrame(z, (empty if z > 800 else point_image(z),)) for z in DEPTHS_MM]
    with pytest.raises(DepthListError, match="only 2 depths"):
        build_bank(few, (), BuildOptions(on_bad="skip"))


def test_frames_of_two_cameras_are_refused() -> None:
    frames = [PointFrame(z, (point_image(z),)) for z in DEPTHS_MM]
    other = point_image(1000.0)
    other = replace(other, info=replace(other.info, model="Other"))
    frames[2] = PointFrame(1000.0, (other,))
    with pytest.raises(FrameError, match="one camera"):
        build_bank(frames)


def test_a_grid_of_points_gives_a_set_per_field_position() -> None:
    def grid(z: float) -> PointFrame:
        radius = 9.0 * (1 - FOCUS_MM / z)
        light = np.zeros((200, 200))
        for row in (-1, 1):
            for column in (-1, 1):
                one = draw_psf(radius, (200, 200), (100 + 45 * row, 100 + 45 * column), 0.4, 30_000)
                light += one / one.max() * 0.6
        return PointFrame(z, (as_frame(light, name=f"psf_{z / 10:.0f}cm.dng", seed=int(z)),))

    bank = build_bank(
        [grid(z) for z in (700.0, 1000.0, 1300.0, 2000.0, 3000.0)], (), BuildOptions(expected_points=4)
    ).bank
    assert bank.psf.shape[:2] == (4, 5)
    np.testing.assert_allclose(bank.field_yx, [(-0.45, -0.45), (-0.45, 0.45), (0.45, -0.45), (0.45, 0.45)], atol=0.01)


def test_asymmetry_tells_a_seven_from_a_disc() -> None:
    assert asymmetry(draw_psf(12.0, (41, 41), (20.3, 19.6), 0.4)) > 0.25
    yy, xx = np.mgrid[-20:21, -20:21]
    disc = (np.hypot(yy, xx) < 12).astype(float)
    assert asymmetry(disc / disc.sum()) < 1e-9


def test_frames_are_listed_by_name_with_repeats_and_darks(tmp_path: Path) -> None:
    for name in ("psf_060cm.dng", "psf_0700mm.npy", "psf_1.2m.tif", "psf_060cm_2.dng", "dark_1.dng", "notes.txt"):
        (tmp_path / name).write_bytes(name.encode())
    frames = find_frames(tmp_path)
    assert [depth for depth, _ in frames.points] == [600.0, 700.0, 1200.0]
    assert [p.name for p in frames.points[0][1]] == ["psf_060cm.dng", "psf_060cm_2.dng"]
    assert [p.name for p in frames.darks] == ["dark_1.dng"]


def test_two_files_for_the_same_repeat_of_a_depth_are_refused(tmp_path: Path) -> None:
    for name in ("psf_060cm.dng", "psf_070cm.dng", "psf_080cm.dng", "psf_80cm.dng"):
        (tmp_path / name).write_bytes(name.encode())
    with pytest.raises(FrameError, match=r"psf_80cm.dng: stands for 80 cm like psf_080cm.dng; .*psf_080cm_2.dng"):
        find_frames(tmp_path)


def test_a_frame_that_is_there_twice_is_refused() -> None:
    again = point_image(800.0)
    again = replace(again, info=replace(again.info, path="psf_080cm_2.dng"))
    frames = [PointFrame(z, (point_image(z), again) if z == 800.0 else (point_image(z),)) for z in DEPTHS_MM]
    with pytest.raises(FrameError, match=r"psf_080cm_2.dng: is a copy of psf_080cm.dng, byte for byte"):
        build_bank(frames)


def _dark(light: np.ndarray, exposure_s: float = 0.02) -> LinearImage:
    image = as_frame(light, name="dark_1.dng")
    return replace(image, info=replace(image.info, exposure_s=exposure_s, iso=100.0))


def _bright_spot() -> np.ndarray:
    light = np.zeros((96, 96))
    light[40:50, 40:50] = 0.4
    return light


@pytest.mark.parametrize(
    ("dark", "words"),
    [
        (_dark(np.full((96, 96), 1.5)), "saturated"),
        (_dark(np.zeros((96, 96)), exposure_s=10.0), r"exposed 10 s at ISO 100, but the longest point frame 0.04 s"),
        (_dark(_bright_spot()), "shows a point"),
        (point_image(800.0, seed=7), "shows a point"),
    ],
    ids=["saturated", "exposed too long", "a spot", "a point frame"],
)
def test_a_dark_frame_that_is_none_is_named_with_the_reason(dark: LinearImage, words: str) -> None:
    frames = []
    for z in DEPTHS_MM:
        image = point_image(z)
        frames.append(PointFrame(z, (replace(image, info=replace(image.info, exposure_s=0.04, iso=100.0)),)))
    with pytest.raises(FrameError, match=rf"{dark.info.path}: given as a dark frame.*{words}"):
        build_bank(frames, (dark,))
    with pytest.raises(FrameError, match=words):
        build_bank([replace(frames[0], offs=(dark,)), *frames[1:]])


def test_a_dark_frame_with_stray_light_and_hot_pixels_is_taken() -> None:
    yy, xx = np.mgrid[:96, :96]
    light = 0.02 + 0.01 * xx / 96 + 0.02 * (yy > 60)
    dark = _dark(light)
    frames = []
    for z in DEPTHS_MM:
        image = point_image(z)
        lit = image.planes + np.multiply.outer(light, (0.6, 1.0, 0.7)).astype(np.float32)
        frames.append(PointFrame(z, (replace(image, planes=lit),)))
    dark.planes[20, 30, 0] = dark.planes[71, 8, 1] = 1.0
    dark.saturated[20, 30] = dark.saturated[71, 8] = True
    built = build_bank(frames, (dark,))
    assert {frame["dark"] for frame in built.bank.manifest["frames"]} == {"pixelwise"}


def _table(directory: Path, text: str) -> Path:
    for name in "abcd":
        (directory / f"{name}.dng").write_bytes(name.encode())
    (directory / "frames.csv").write_text("file,depth_cm,kind\n" + text)
    return directory


def test_frames_csv_says_which_file_is_what(tmp_path: Path) -> None:
    frames = find_frames(_table(tmp_path, "a.dng,60,psf\nb.dng,70,psf\nc.dng, 80 , psf\nd.dng,,dark\n"))
    assert [depth for depth, _ in frames.points] == [600.0, 700.0, 800.0]
    assert [p.name for p in frames.darks] == ["d.dng"]


@pytest.mark.parametrize(
    ("text", "error", "expected"),
    [
        ("a.dng,60,psf\nb.dng,70,psf\n", DepthListError, "at least 3"),
        ("a.dng,60,psf\nb.dng,70,psf\nz.dng,80,psf\n", FrameError, "line 4: no such file"),
        ("a.dng,60,psf\nb.dng,far,psf\nc.dng,80,psf\n", FrameError, "line 3: depth_cm is 'far'"),
        ("a.dng,60,psf\nb.dng,70,spot\nc.dng,80,psf\n", FrameError, "it must be psf or dark"),
        ("a.dng,60,psf\nb.dng,80,psf\nc.dng,70,psf\n", DepthListError, "out of order"),
        ("a.dng,0.6,psf\nb.dng,0.7,psf\nc.dng,0.8,psf\n", DepthListError, "metres"),
        ("a.dng,60,psf\nb.dng,70,psf\na.dng,80,psf\n", FrameError, "listed twice"),
    ],
)
def test_bad_frame_tables_are_named_by_line(tmp_path: Path, text: str, error: type[Exception], expected: str) -> None:
    with pytest.raises(error, match=expected):
        find_frames(_table(tmp_path, text))


def test_directories_without_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match="no such directory"):
        find_frames(tmp_path / "absent")
    with pytest.raises(FrameError, match=r"psf_060cm\.dng"):
        find_frames(tmp_path)
    (tmp_path / "psf_far.dng").write_bytes(b"x")
    with pytest.raises(FrameError, match="doesn't tell the depth"):
        find_frames(tmp_path)


def test_path_traced_points_give_the_true_lens(shared: Path) -> None:
    listed = find_frames(shared / "psf")
    frames = [PointFrame(depth, paths) for depth, paths in listed.points if depth % 200 == 0 or depth in (700, 3500)]
    built = build_bank(frames, listed.darks, BuildOptions(pixel_pitch_mm=0.0043))
    lens = built.bank.lens
    assert lens.focus_mm == pytest.approx(1600.0, abs=3.0)
    assert abs(lens.zero_mm) < 3.0
    assert built.bank.manifest["aperture"]["radius_mm"] == pytest.approx(7.0, rel=0.005)
    assert np.abs(built.bank.extras["chief_yx"]).max() < 0.15
    assert built.bank.manifest["frames"][0]["dark"] == "median level"
