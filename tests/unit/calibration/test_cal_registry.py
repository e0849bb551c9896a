from __future__ import annotations

from pathlib import Path

import pytest

from calibration.errors import BankError
from calibration.registry import activate, certify, read_registry, register, revoke

A, B, C = "aaaa1111bbbb2222", "aaab1111bbbb2222", "cccc1111bbbb2222"


def test_versions_count_up_and_a_known_bank_keeps_its_own(tmp_path: Path) -> None:
    assert register(tmp_path, A).version == 1
    assert register(tmp_path, B).version == 2
    assert register(tmp_path, A).version == 1
    assert len((tmp_path / "registry.jsonl").read_text().splitlines()) == 2


def test_banks_are_found_by_id_prefix_version_and_state(tmp_path: Path) -> None:
    for bank in (A, B, C):
        register(tmp_path, bank)
    activate(tmp_path, "v2")
    registry = read_registry(tmp_path)
    assert registry.resolve("active").id == B
    assert registry.resolve("V3").id == C
    assert registry.resolve("cccc").id == C
    assert registry.resolve(A).version == 1
    for reference, expected in (("aaa", "no bank 'aaa'"), ("v9", "no bank"), ("", "no bank")):
        with pytest.raises(BankError, match=expected):
            registry.resolve(reference)


def test_an_ambiguous_prefix_names_the_candidates(tmp_path: Path) -> None:
    register(tmp_path, "aaaa11110000")
    register(tmp_path, "aaaa11112222")
    with pytest.raises(BankError, match="ambiguous"):
        read_registry(tmp_path).resolve("aaaa1")


def test_rolling_back_is_activating_an_older_version(tmp_path: Path) -> None:
    register(tmp_path, A)
    register(tmp_path, B)
    for reference in ("v1", "v2", "v1"):
        activate(tmp_path, reference)
    states = {entry.id: entry.state for entry in read_registry(tmp_path).entries}
    assert states == {A: "active", B: "registered"}


def test_a_revoked_bank_is_neither_active_nor_usable_again(tmp_path: Path) -> None:
    register(tmp_path, A)
    certify(tmp_path, "v1", "f/1.8, 20 C, until December")
    activate(tmp_path, "v1")
    assert read_registry(tmp_path).entries[0].certificate == "f/1.8, 20 C, until December"
    revoke(tmp_path, "v1", "lens was refocused")
    with pytest.raises(BankError, match="no bank is active"):
        read_registry(tmp_path).resolve("active")
    for act in (lambda: activate(tmp_path, "v1"), lambda: certify(tmp_path, "v1", "again")):
        with pytest.raises(BankError, match="lens was refocused"):
            act()


@pytest.mark.parametrize("torn", [b'{"act": "activ', b'{"act": "revoke", "id": "aaaa1111bbbb2222", "reason": "x"}'])
def test_a_torn_last_line_is_ignored_now_and_after_the_next_act(tmp_path: Path, torn: bytes) -> None:
    register(tmp_path, A)
    with (tmp_path / "registry.jsonl").open("ab") as stream:
        stream.write(torn)
    assert read_registry(tmp_path).entries[0].state == "registered"
    register(tmp_path, B)
    activate(tmp_path, "v1")
    assert [e.state for e in read_registry(tmp_path).entries] == ["active", "registered"]


def test_a_damaged_line_in_the_middle_is_named(tmp_path: Path) -> None:
    register(tmp_path, A)
    register(tmp_path, B)
    path = tmp_path / "registry.jsonl"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0][:20], lines[1]]) + "\n")
    with pytest.raises(BankError, match="line 1: is damaged"):
        read_registry(tmp_path)


def test_an_absent_registry_is_empty(tmp_path: Path) -> None:
    registry = read_registry(tmp_path)
    assert registry.entries == ()
    with pytest.raises(BankError, match="calibrate"):
        registry.resolve("active")
