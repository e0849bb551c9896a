from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import FrameError
from rigs.simulated.dng import FrameTags, write_dng
from workbench import frame_reader
from workbench.frame_reader import FrameReader

TAGS = FrameTags(
    exposure_s=0.01, iso=100, focal_length_mm=50.0, f_number=3.6, pitch_mm=0.0043, make="Maker", model="One",
    serial="1", black=2048, white=15000,
)  # fmt: skip


def _frame(path: Path, size: tuple[int, int] = (64, 96), tags: FrameTags = TAGS) -> Path:
    mosaic = np.random.default_rng(1).integers(2000, 9000, size).astype(np.uint16)
    write_dng(path, mosaic, tags, compression="none")
    return path


def test_a_checked_frame_is_decoded_once_and_goes_by_its_new_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part, final = _frame(tmp_path / ".part.dng"), tmp_path / "final.dng"
    reader = FrameReader(0.0043)
    reader.check(part)
    part.rename(final)
    with monkeypatch.context() as patch:
        patch.setattr(frame_reader, "develop", None)
        image = reader.read(final)
    assert image.info.path == str(final)
    assert image.shape == (32, 48)
    assert reader.read(final).planes.tobytes() == image.planes.tobytes()


def test_a_file_that_was_written_again_is_decoded_again(tmp_path: Path) -> None:
    path = _frame(tmp_path / "a.dng")
    reader = FrameReader(None)
    reader.check(path)
    path.write_bytes(b"something else")
    with pytest.raises(FrameError, match=r"a\.dng"):
        reader.read(path)


def test_a_frame_of_another_size_than_the_first_is_refused(tmp_path: Path) -> None:
    reader = FrameReader(None)
    reader.check(_frame(tmp_path / "first.dng"))
    with pytest.raises(FrameError, match=r"second\.dng: 48 x 32 photosites, the frames before it 96 x 64"):
        reader.check(_frame(tmp_path / "second.dng", (32, 48)))
    reader.check(_frame(tmp_path / "third.dng"))


def test_a_reduced_frame_of_a_known_camera_is_refused_from_the_first_on(tmp_path: Path) -> None:
    tags = replace(TAGS, make="Canon", model="Canon EOS 650D")
    with pytest.raises(FrameError, match=r"96 x 64 photosites, a whole frame of Canon EOS 650D has 5184 x 3456"):
        FrameReader(None).check(_frame(tmp_path / "a.dng", tags=tags))


def test_rows_that_got_lost_on_the_way_are_noticed(tmp_path: Path) -> None:
    path = _frame(tmp_path / "a.dng")
    data = path.read_bytes()
    path.write_bytes(data[: -20 * 96 * 2] + bytes(20 * 96 * 2))
    with pytest.raises(FrameError, match=r"10 of 32 rows of pixels are empty"):
        FrameReader(None).check(path)


def test_rows_that_are_saturated_are_no_damage(tmp_path: Path) -> None:
    mosaic = np.random.default_rng(1).integers(2000, 9000, (64, 96)).astype(np.uint16)
    mosaic[:20] = 15000
    write_dng(tmp_path / "a.dng", mosaic, TAGS, compression="none")
    FrameReader(None).check(tmp_path / "a.dng")


def test_a_picture_that_is_no_raw_file_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.random.default_rng(1).random((64, 64, 3)).astype(np.float32))
    with pytest.raises(FrameError, match="no RAW file"):
        FrameReader(None).check(tmp_path / "a.npy")
