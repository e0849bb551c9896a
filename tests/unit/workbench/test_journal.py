import errno
import hashlib
import io
import json
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.errors import InputError
from workbench.journal import Journal, fold, read_journal, verified_shots


def _filled(path: Path, shots: int = 3) -> None:
    journal = Journal(path)
    journal.append("started", plan_hash="p", devices={"camera": {}})
    for index in range(shots):
        data = bytes([index]) * 10
        (path.parent / f"f{index}").write_bytes(data)
        journal.append(
            "shot", shot=f"s{index}", file=f"f{index}", sha256=hashlib.sha256(data).hexdigest(), bytes=10, depth_mm=1.0
        )
    journal.close()


def test_what_is_appended_is_folded_back(tmp_path: Path) -> None:
    _filled(tmp_path / "j")
    records, size = read_journal(tmp_path / "j")
    state = fold(records)
    assert size == (tmp_path / "j").stat().st_size
    assert list(state.shots) == ["s0", "s1", "s2"]
    assert state.plan_hash == "p"


@settings(max_examples=40, deadline=None)
@given(cut=st.integers(min_value=1, max_value=200))
def test_a_torn_last_line_is_dropped_and_the_journal_goes_on(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    path = tmp_path_factory.mktemp("j") / "j"
    _filled(path)
    lines = path.read_bytes().splitlines(keepends=True)
    torn = lines[-1][: min(cut, len(lines[-1]) - 1)]
    path.write_bytes(b"".join(lines[:-1]) + torn)
    journal = Journal(path)
    assert list(journal.state().shots) == ["s0", "s1"]
    journal.append("finished", shots=2)
    journal.close()
    assert fold(read_journal(path)[0]).finished


def test_ctrl_c_while_a_record_is_written_leaves_a_whole_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(tmp_path / "journal.jsonl")
    journal.append("started")

    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupted)
        with pytest.raises(KeyboardInterrupt):
            journal.append("shot", id="a")
    journal.append("interrupted")
    journal.close()
    assert [record["type"] for record in read_journal(tmp_path / "journal.jsonl")[0]] == ["started", "interrupted"]


def test_a_changed_record_in_the_middle_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "j"
    _filled(path)
    path.write_bytes(path.read_bytes().replace(b'"shot":"s1"', b'"shot":"s9"'))
    with pytest.raises(InputError, match="record 3"):
        read_journal(path)


def test_a_removed_record_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "j"
    _filled(path)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([lines[0], *lines[2:]]))
    with pytest.raises(InputError, match="record 2"):
        read_journal(path)


def test_every_line_is_json_with_the_hash_of_the_line_before(tmp_path: Path) -> None:
    _filled(tmp_path / "j")
    records = [json.loads(line) for line in (tmp_path / "j").read_text().splitlines()]
    assert [record["prev"] for record in records[1:]] == [record["hash"] for record in records[:-1]]


def test_a_frame_that_is_missing_short_or_changed_is_not_verified(tmp_path: Path) -> None:
    _filled(tmp_path / "j")
    (tmp_path / "f0").unlink()
    (tmp_path / "f1").write_bytes(b"x" * 10)
    good, bad = verified_shots(fold(read_journal(tmp_path / "j")[0]), tmp_path)
    assert list(good) == ["s2"]
    assert bad == ["s0", "s1"]


def test_a_record_that_does_not_fit_leaves_none_of_it_and_the_reason_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(tmp_path / "j")
    journal.append("opened")
    before = (tmp_path / "j").read_bytes()

    class Limited:
        """A file that takes ten more bytes."""

        def __init__(self, handle: io.RawIOBase) -> None:
            self.handle, self.room = handle, 10

        def write(self, data: bytes) -> int:
            if not self.room:
                raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
            written, self.room = self.handle.write(data[: self.room]) or 0, 0
            return written

    monkeypatch.setattr(journal, "_handle", Limited(journal._handle))
    with pytest.raises(OSError, match="too large") as caught:
        journal.append("shot")
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(tmp_path / "j"))
    assert (tmp_path / "j").read_bytes() == before
