import errno
from pathlib import Path

import numpy as np
import pytest
import rawpy
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rigs.errors import CaptureError
from rigs.simulated.dng import Compression, FrameTags, encode_dng, write_dng

TAGS = FrameTags(1 / 125, 400, 50.0, 3.6, 0.0043, "Depth Workbench", "Simulated small", "SIM000001", 2048, 15000)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    height=st.integers(32, 900),
    width=st.integers(32, 900),
    low=st.integers(0, 16383),
    high=st.integers(0, 16383),
    compression=st.sampled_from(["ljpeg", "none"]),
    seed=st.integers(0, 1000),
)
def test_libraw_reads_back_exactly_what_was_written(
    tmp_path: Path, height: int, width: int, low: int, high: int, compression: Compression, seed: int
) -> None:
    low, high = min(low, high), max(low, high)
    mosaic = np.random.default_rng(seed).integers(low, high + 1, (height, width)).astype(np.uint16)
    write_dng(tmp_path / "frame.dng", mosaic, TAGS, compression=compression)
    with rawpy.imread(str(tmp_path / "frame.dng")) as raw:
        np.testing.assert_array_equal(raw.raw_image_visible, mosaic)


@pytest.mark.parametrize("compression", ["ljpeg", "none"])
def test_the_file_states_exposure_camera_levels_and_pitch(tmp_path: Path, compression: Compression) -> None:
    path = tmp_path / "frame.dng"
    write_dng(path, np.arange(480 * 640, dtype=np.uint16).reshape(480, 640) % 15000, TAGS, compression=compression)
    with rawpy.imread(str(path)) as raw:
        assert raw.raw_pattern.tolist() == [[0, 1], [3, 2]]
        assert raw.color_desc == b"RGBG"
        assert raw.black_level_per_channel == [2048] * 4
        assert raw.white_level == 15000
        assert raw.other.shutter_speed == pytest.approx(1 / 125)
        assert raw.other.iso_speed == 400
        assert raw.other.focal_length == 50
    with tifffile.TiffFile(path) as tif:
        tags = tif.pages.first.tags
        assert tags["Make"].value == "Depth Workbench"
        assert tags["Model"].value == tags["UniqueCameraModel"].value == "Simulated small"
        exif = tags["ExifTag"].value
    per_unit, unit = exif["FocalPlaneXResolution"], exif["FocalPlaneResolutionUnit"]
    assert unit == 3
    assert 10.0 * per_unit[1] / per_unit[0] == pytest.approx(0.0043, rel=1e-6)


@pytest.mark.parametrize("exposure_s", [1 / 4000, 0.3, 30.0])
def test_short_and_long_exposures_are_kept(tmp_path: Path, exposure_s: float) -> None:
    tags = FrameTags(exposure_s, 12800, 50.0, 3.6, 0.0043, "a", "b", "c", 2048, 15000)
    write_dng(tmp_path / "frame.dng", np.full((64, 64), 3000, np.uint16), tags)
    with rawpy.imread(str(tmp_path / "frame.dng")) as raw:
        assert raw.other.shutter_speed == pytest.approx(exposure_s, rel=1e-5)
        assert raw.other.iso_speed == 12800


def test_same_frame_same_bytes() -> None:
    mosaic = np.random.default_rng(1).integers(2000, 9000, (600, 700)).astype(np.uint16)
    assert encode_dng(mosaic, TAGS) == encode_dng(mosaic.copy(), TAGS)


def test_too_small_or_too_deep_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="32 x 32"):
        encode_dng(np.zeros((16, 64), np.uint16), TAGS)
    with pytest.raises(ValueError, match="14 bits"):
        encode_dng(np.full((64, 64), 16384, np.uint16), TAGS)


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("rigs.simulated.dng.os.fsync", full)
    with pytest.raises(CaptureError, match="No space left"):
        write_dng(tmp_path / "frame.dng", np.full((64, 64), 3000, np.uint16), TAGS)
    assert list(tmp_path.iterdir()) == []
