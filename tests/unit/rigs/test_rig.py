"""A rig as a whole: how it lets go of its devices."""

from __future__ import annotations

import pytest

from rigs.rig import DepthAxis, Rig
from rigs.simulated.rig import make_rig


def test_an_interrupt_while_one_device_is_closed_leaves_none_open(monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_rig()
    rig = Rig(made.camera, made.stage, made.panel, DepthAxis())
    closed: list[str] = []

    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(made.stage, "close", interrupted)
    monkeypatch.setattr(made.panel, "close", lambda: closed.append("panel"))
    monkeypatch.setattr(made.camera, "close", lambda: closed.append("camera"))
    with pytest.raises(KeyboardInterrupt):
        rig.close()
    assert closed == ["panel", "camera"]
