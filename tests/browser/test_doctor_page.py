"""The doctor's look at a panel in a real browser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from rigs.protocols import Pattern
from workbench.config import PanelConfig
from workbench.doctor.findings import Finding
from workbench.doctor.panel import panel_findings

pytestmark = pytest.mark.browser


def look_at(open_page: Callable[..., Any], pattern: Pattern) -> tuple[dict[str, Finding], tuple[str, ...]]:
    told: list[str] = []
    outcome: list[tuple[list[Finding], tuple[str, ...]]] = []
    config = PanelConfig.model_validate({"kind": "browser", "port": 0, "require_fullscreen": False})

    def look() -> None:
        outcome.append(panel_findings(config, pattern, wait_s=20.0, tell=told.append))

    looking = threading.Thread(target=look, daemon=True)
    looking.start()
    while not told and looking.is_alive():
        time.sleep(0.01)
    url = next(word for word in told[0].split() if word.startswith("http://"))
    page = open_page(url, quiet=False, device_scale_factor=2)
    while looking.is_alive():
        page.wait_for_timeout(50)
    found, browsers = outcome[0]
    return {finding.check: finding for finding in found}, browsers


def test_dot_is_painted_and_a_window_is_told(open_page: Callable[..., Any]) -> None:
    by_check, browsers = look_at(open_page, Pattern("dot", size_px=3.0))
    assert browsers == ("Chrome at 127.0.0.1",)
    assert by_check["painting"].severity.word in ("ok", "warning")  # how soon is the machine's business
    assert by_check["full screen"].severity.word == "warning"
    assert by_check["full screen"].seen.startswith("no: 1280 x 800 px")
    assert by_check["pixel ratio"].seen == "2"


def test_grid_that_the_panel_cannot_hold_is_an_error(open_page: Callable[..., Any]) -> None:
    wide = Pattern("grid", size_px=3.0, points_px=((-900.0, 0.0), (0.0, 0.0), (900.0, 0.0)))
    by_check, _ = look_at(open_page, wide)
    assert by_check["painting"].severity.word == "error"
    assert "isn't wholly on the panel of 1280 x 800 px" in by_check["painting"].seen
    assert "panel.pixels: [1280, 800]" in by_check["painting"].mend
