"""What a panel's acknowledgement says about the screen."""

from __future__ import annotations

from typing import Any

import pytest

from rigs.panel_messages import PageState
from rigs.protocols import PanelAck, Pattern
from workbench.doctor.findings import Finding
from workbench.doctor.panel import painted_findings


def findings(**changes: Any) -> dict[str, Finding]:
    said: dict[str, Any] = {
        "width_px": 2560, "height_px": 1600, "device_pixel_ratio": 2.0, "fullscreen": True, "visible": True, "zoom": 1,
        "wake_lock": "lock", "painted_after_s": 0.05,
    } | changes  # fmt: skip
    after_s = said.pop("painted_after_s")
    page = PageState(**said)
    painted = PanelAck(
        Pattern("dot"), page.width_px, page.height_px, page.device_pixel_ratio, page.fullscreen, painted_after_s=after_s
    )
    return {finding.check: finding for finding in painted_findings(painted, page, pitch_mm=0.1)}


def test_full_screen_that_stays_awake_is_wholly_well() -> None:
    found = findings()
    assert not any(finding.severity for finding in found.values())
    assert found["full screen"].seen == "2560 x 1600 px, 25.6 x 16.0 cm by panel.pixel_pitch"
    assert found["painting"].seen == "a dot was confirmed after 50 ms"


@pytest.mark.parametrize(
    ("changes", "check", "severity", "words"),
    [
        ({"fullscreen": False}, "full screen", "warning", "tap the page"),
        ({"device_pixel_ratio": 1.25}, "pixel ratio", "note", "native resolution"),
        ({"wake_lock": "video"}, "wake lock", "note", "screen timeout"),
        ({"wake_lock": "none"}, "wake lock", "warning", "screen timeout"),
        ({"painted_after_s": 2.5}, "painting", "warning", "network"),
    ],
)
def test_each_trouble_has_its_severity_and_its_way_out(
    changes: dict[str, Any], check: str, severity: str, words: str
) -> None:
    found = findings(**changes)
    assert {name: finding.severity.word for name, finding in found.items() if finding.severity} == {check: severity}
    assert words in found[check].mend
