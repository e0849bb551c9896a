"""How findings are named, ordered and taken out of error messages."""

from __future__ import annotations

import pytest

from rigs.gphoto2_faults import RESPONSES, FaultError, failure
from workbench.doctor.findings import Checkup, PluggedIn, Severity, Subject, in_order, split_message

STAGE, CAMERA = Subject("stage"), Subject("camera")


@pytest.mark.parametrize(
    ("message", "seen", "mend"),
    [
        ("the rail is gone; plug it in", "the rail is gone", "plug it in"),
        ("usb:2341:0043 is not plugged in; serial ports found: none", "usb:2341:0043 is not plugged in",
         "serial ports found: none"),
        ("/dev/x can't be opened ([Errno 2] no port: '/dev/x'); check plug; serial ports found: none",
         "/dev/x can't be opened ([Errno 2] no port: '/dev/x')", "check plug; serial ports found: none"),
        ("answers 'ok; nothing', not as it should; check the cable", "answers 'ok; nothing', not as it should",
         "check the cable"),
        ("another program holds it: close it (open: -53 Could not claim)",
         "another program holds it (open: -53 Could not claim)", "close it"),
        ("nothing but words", "nothing but words", ""),
        ("nothing but words (and a bracket)", "nothing but words (and a bracket)", ""),
    ],
)  # fmt: skip
def test_message_is_split_into_what_was_seen_and_the_way_out(message: str, seen: str, mend: str) -> None:
    assert split_message(message) == (seen, mend)


def test_every_fault_of_a_camera_becomes_a_finding_with_a_way_to_mend_it() -> None:
    for fault in RESPONSES:
        finding = CAMERA.failure("connection", failure(FaultError(fault, "open", "-1 Unspecified error")))
        assert finding.severity is Severity.ERROR
        assert "(open: -1 Unspecified error)" in finding.seen
        assert finding.mend
        assert "resume" not in finding.mend
        assert not finding.seen.startswith("camera:")


def test_report_is_ordered_by_subject_and_its_worst_finding_decides() -> None:
    findings = in_order([STAGE.ok("homing", "on"), CAMERA.warning("mode dial", "Tv", "turn it"), STAGE.note("a", "b")])
    assert [finding.id for finding in findings] == ["camera.mode-dial", "stage.homing", "stage.a"]
    checkup = Checkup({}, findings, PluggedIn(), {})
    assert checkup.ready
    assert checkup.worst is Severity.WARNING
    worse = Checkup({}, (*findings, STAGE.error("travel", "short", "longer rail")), PluggedIn(), {})
    assert not worse.ready
    assert worse.as_json()["counts"] == {"ok": 1, "note": 1, "warning": 1, "error": 1}
