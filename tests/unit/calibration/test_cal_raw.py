from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from drawn_points import BLACK, WHITE, write_dng

from calibration.errors import FrameError
from calibration.image import LinearImage
from calibration.raw import average_darks, develop, subtract_dark


def _mosaic(shape: tuple[int, int] = (64, 96), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(600, 9000, shape).astype(np.uint16)


def test_superpixel_subtracts_each_channels_black_and_averages_the_greens(tmp_path: Path) -> None:
    mosaic = _mosaic()
    image = develop(write_dng(tmp_path / "a.dng", mosaic, black=(512, 500, 510, 520)))
    value = mosaic.astype(np.float64)
    red = (value[0::2, 0::2] - 512) / (WHITE - 512)
    green = 0.5 * ((value[0::2, 1::2] - 500) / (WHITE - 500) + (value[1::2, 0::2] - 510) / (WHITE - 510))
    blue = (value[1::2, 1::2] - 520) / (WHITE - 520)
    np.testing.assert_allclose(image.planes, np.stack([red, green, blue], axis=-1), atol=2e-7)
    assert image.info.raw_size == (64, 96)
    assert image.info.cfa == "RGGB"


@pytest.mark.parametrize(("cfa", "name"), [(b"\x02\x01\x01\x00", "BGGR"), (b"\x01\x00\x02\x01", "GRBG")])
def test_other_bayer_orders_put_each_photosite_in_its_channel(tmp_path: Path, cfa: bytes, name: str) -> None:
    mosaic = np.full((32, 32), BLACK, np.uint16)
    for i, colour in enumerate(cfa):
        mosaic[i // 2 :: 2, i % 2 :: 2] = BLACK + 1000 * (colour + 1)
    image = develop(write_dng(tmp_path / "a.dng", mosaic, cfa=cfa))
    assert image.info.cfa == name
    expected = np.array([1000.0, 2000.0, 3000.0]) / (WHITE - BLACK)
    np.testing.assert_allclose(image.planes.reshape(-1, 3), np.tile(expected, (256, 1)), rtol=1e-5)


def test_native_luminance_of_a_coloured_flat_field_has_no_checkerboard(tmp_path: Path) -> None:
    mosaic = np.full((32, 32), BLACK, np.uint16)
    for i, value in enumerate((1000, 4000, 4000, 2000)):
        mosaic[i // 2 :: 2, i % 2 :: 2] = BLACK + value
    mosaic[0, 0] += 1
    image = develop(write_dng(tmp_path / "a.dng", mosaic), recipe="native")
    assert image.shape == (32, 32)
    flat = image.luminance[4:, 4:]
    assert np.ptp(flat) < 1e-6
    np.testing.assert_allclose(flat.mean(), (1000 + 8000 + 2000) / 4 / (WHITE - BLACK), rtol=1e-5)


def test_a_single_saturated_photosite_marks_its_pixel(tmp_path: Path) -> None:
    mosaic = _mosaic()
    mosaic[10, 20] = WHITE
    path = write_dng(tmp_path / "a.dng", mosaic)
    assert np.argwhere(develop(path).saturated).tolist() == [[5, 10]]
    assert int(develop(path, recipe="native").saturated.sum()) == 9


def test_exif_and_pitch_come_from_the_file_and_known_cameras_win(tmp_path: Path) -> None:
    stated = develop(write_dng(tmp_path / "a.dng", _mosaic(), focal_plane=(200, 1)))
    assert stated.info.exposure_s == pytest.approx(0.02)
    assert (stated.info.iso, stated.info.focal_length_mm, stated.info.model) == (100.0, 50.0, "Test Body")
    assert stated.info.pixel_pitch_mm == pytest.approx(0.005)
    assert stated.pixel_pitch_mm == pytest.approx(0.010)
    known = develop(write_dng(tmp_path / "b.dng", _mosaic(), model="Canon EOS 650D", focal_plane=(200, 1)))
    assert known.pixel_pitch_mm == pytest.approx(0.0086)
    told = develop(tmp_path / "a.dng", recipe="native", pixel_pitch_mm=0.0061)
    assert told.pixel_pitch_mm == pytest.approx(0.0061)


def test_dark_of_the_same_size_is_subtracted_pixelwise_and_of_another_as_a_level(tmp_path: Path) -> None:
    image = develop(write_dng(tmp_path / "a.dng", _mosaic()))
    dark_mosaic = np.full((64, 96), BLACK + 29, np.uint16)
    dark_mosaic[2, 4] = BLACK + 5000
    dark = develop(write_dng(tmp_path / "dark.dng", dark_mosaic))
    same = subtract_dark(image, dark)
    assert same.info.dark == "pixelwise"
    np.testing.assert_allclose(same.planes, image.planes - dark.planes, atol=1e-7)
    big = np.full((128, 128), BLACK + 29, np.uint16)
    big[0, 0] = 9000
    other = develop(tmp_path / "a.dng", dark=develop(write_dng(tmp_path / "dark2.dng", big)))
    assert other.info.dark == "median level"
    np.testing.assert_allclose(other.planes, image.planes - 29 / (WHITE - BLACK), atol=1e-6)
    np.testing.assert_allclose(average_darks([dark, dark]).planes, dark.planes, atol=1e-7)


def test_linear_arrays_are_scaled_by_their_types_largest_value_unless_told(tmp_path: Path) -> None:
    values = np.arange(32 * 32, dtype=np.uint16).reshape(32, 32)
    np.save(tmp_path / "a.npy", values)
    tifffile.imwrite(tmp_path / "a.tif", values)
    for name in ("a.npy", "a.tif"):
        image = develop(tmp_path / name)
        assert image.recipe == "linear"
        np.testing.assert_allclose(image.planes[:, :, 0], values / 65535.0, rtol=1e-6)
    np.testing.assert_allclose(develop(tmp_path / "a.npy", white=1023).planes.max(), 1.0)
    np.save(tmp_path / "b.npy", np.moveaxis(np.random.default_rng(0).random((8, 9, 3), np.float32), 2, 0))
    assert develop(tmp_path / "b.npy").planes.shape == (8, 9, 3)


def _write_bytes(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda d: d / "absent.dng", "no such file"),
        (lambda d: d, "is a directory"),
        (lambda d: _write_bytes(d / "x.dng", b""), "is empty"),
        (lambda d: _write_bytes(d / "x.cr2", b"hello " * 1000), "not a RAW file"),
        (lambda d: _write_bytes(d / "x.npy", b"hello"), "can't be read as NPY"),
        (lambda d: _write_bytes(d / "x.tif", b"II*\x00" + b"\x00" * 50), "holds no image"),
        (lambda d: write_dng(d / "x.dng", np.zeros((64, 64), np.uint16)), "all zero"),
        (lambda d: write_dng(d / "x.dng", np.full((64, 64), 4000, np.uint16), black=0), "all equal"),
    ],
)
def test_unusable_files_are_named_in_one_line(tmp_path: Path, make: object, expected: str) -> None:
    path = make(tmp_path)  # type: ignore[operator]
    with pytest.raises(FrameError, match=expected) as caught:
        develop(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_frame_that_is_saturated_everywhere_is_a_frame(tmp_path: Path) -> None:
    image = develop(write_dng(tmp_path / "x.dng", np.full((64, 64), 16383, np.uint16)))
    assert image.saturated.all()


def test_a_truncated_raw_is_refused(tmp_path: Path) -> None:
    path = write_dng(tmp_path / "x.dng", _mosaic((256, 256)))
    path.write_bytes(path.read_bytes()[:40_000])
    with pytest.raises(FrameError, match="truncated or damaged"):
        develop(path)


def test_nan_in_an_array_is_refused(tmp_path: Path) -> None:
    values = np.ones((16, 16), np.float32)
    values[3, 4] = np.nan
    np.save(tmp_path / "x.npy", values)
    with pytest.raises(FrameError, match="NaN"):
        develop(tmp_path / "x.npy")


def test_dark_by_another_recipe_is_refused(tmp_path: Path) -> None:
    path = write_dng(tmp_path / "a.dng", _mosaic())
    dark: LinearImage = develop(path, recipe="native")
    with pytest.raises(FrameError, match="same recipe"):
        develop(path, dark=dark)


@pytest.mark.parametrize(("bad", "said"), [(np.nan, "NaN or infinite"), (-3.4e38, "marks of missing pixels")])
def test_linear_image_with_pixels_that_are_none_is_refused(tmp_path: Path, bad: float, said: str) -> None:
    pixels = np.full((32, 32), 0.2, np.float32)
    pixels[3, 4] = bad
    np.save(tmp_path / "a.npy", pixels)
    with pytest.raises(FrameError, match=said):
        develop(tmp_path / "a.npy")
