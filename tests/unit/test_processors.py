"""How many processors are to be used."""

from __future__ import annotations

import os

import pytest

from workbench.processors import usable_processors


def test_those_that_the_process_is_bound_to_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {3, 5, 7}, raising=False)
    assert usable_processors() == 3


@pytest.mark.parametrize(("counted", "used"), [(6, 6), (None, 1)])
def test_all_count_where_nothing_is_known_of_binding(
    monkeypatch: pytest.MonkeyPatch, counted: int | None, used: int
) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: counted)
    assert usable_processors() == used
