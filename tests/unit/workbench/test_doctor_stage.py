"""What a stage's controller says about itself, judged against rig.yaml and the plan."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rigs.protocols import DeviceIdentity
from rigs.stage_facts import StageFacts
from workbench.config import StageConfig
from workbench.doctor.findings import Finding
from workbench.doctor.stage import controller_findings

FACTS = StageFacts(
    identity=DeviceIdentity(kind="grbl", model="GRBL", firmware="1.1h"), state="Idle", referenced=False, homing=True,
    soft_limits=True, hard_limits=True, travel_mm=(-2995.0, 0.0), max_speed_mm_s=100.0,
)  # fmt: skip
DEPTHS = (600.0, 2000.0, 3500.0)


def findings(facts: StageFacts, **rig_yaml: Any) -> dict[str, Finding]:
    config = StageConfig(kind="grbl", port="/dev/rail", **{"depth": {"offset": "3505 mm"}, **rig_yaml})
    return {finding.check: finding for finding in controller_findings(config, facts, DEPTHS)}


def test_protected_idle_controller_is_wholly_well() -> None:
    found = findings(FACTS)
    assert not any(finding.severity for finding in found.values())
    assert found["connection"].seen == "GRBL, firmware 1.1h at /dev/rail"
    assert found["travel"].seen == "reaches 51 to 350.5 cm; the plan needs 60 to 350 cm"


@pytest.mark.parametrize(
    ("changes", "check", "severity", "words"),
    [
        ({"state": "Alarm"}, "state", "note", "homes it"),
        ({"disturbance": ("is paused: calibrate ends that", "press resume")}, "state", "warning", "press resume"),
        ({"problem": ("is being jogged", "wait until it stands")}, "state", "error", "wait until it stands"),
        ({"hard_limits": False}, "hard limits", "note", "$21=1"),
        ({"soft_limits": False}, "soft limits", "error", "$20=1"),
        ({"travel_mm": (-2000.0, 0.0)}, "travel", "error", "calibration.from"),
        ({"remarks": (("motors", "switched off", "$1=255"),)}, "motors", "note", "$1=255"),
    ],
)
def test_each_trouble_has_its_severity_and_its_way_out(
    changes: dict[str, Any], check: str, severity: str, words: str
) -> None:
    found = findings(replace(FACTS, **changes))
    assert {name: finding.severity.word for name, finding in found.items() if finding.severity} == {check: severity}
    assert words in found[check].mend


def test_without_homing_only_rig_yaml_knows_the_travel() -> None:
    unhomed = replace(FACTS, homing=False)
    assert {name for name, finding in findings(unhomed).items() if finding.severity} == {"homing", "travel"}
    found = findings(unhomed, allow_without_homing=True, limits=["-3000 mm", "0 mm"])
    assert {name: finding.severity.word for name, finding in found.items() if finding.severity} == {"homing": "warning"}


def test_limits_of_rig_yaml_are_held_against_the_controllers() -> None:
    beyond = findings(FACTS, limits=["-3100 mm", "0 mm"])
    assert {name: finding.severity.word for name, finding in beyond.items() if finding.severity} == {"limits": "error"}
    assert "limits" not in findings(FACTS, limits=["-2995.01 mm", "0 mm"])
    positive = findings(FACTS, limits=["10 mm", "2900 mm"])
    assert positive["travel"].severity.word == "error"
    assert "counts below zero" in positive["travel"].mend
    narrow = findings(FACTS, limits=["-2000 mm", "0 mm"])
    assert narrow["travel"].seen == "reaches 150.5 to 350.5 cm; the plan needs 60 to 350 cm"


def test_speed_beyond_the_controllers_is_told() -> None:
    assert findings(FACTS, speed="200 mm/s")["speed"].severity.word == "note"
    assert "speed" not in findings(FACTS, speed="50 mm/s")
