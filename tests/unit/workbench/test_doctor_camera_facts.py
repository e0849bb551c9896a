"""What a camera's words mean for a calibration; the camera is an EOS 650D with a lens without contacts."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import pytest

from rigs.gphoto2_config import Gphoto2Settings
from workbench.doctor.camera_facts import Demand, bank_finding, facts_findings, pixel_pitch_finding
from workbench.doctor.findings import Finding

FACTS = {
    "model": "Canon EOS 650D", "serial": "53123456789", "firmware": "3-1.0.1", "mode_dial": "Manual",
    "image_format": "RAW", "image_formats": "Large Fine JPEG, RAW + Large Fine JPEG, RAW", "exposure_time": "1/60",
    "exposure_times_s": "0.00025 to 30", "iso": "100", "isos": "100, 200, 400", "aperture": "implicit auto",
    "lens": "absent", "focus": "Manual", "drive": "Single", "capture_target": "Memory card", "battery": "100%",
    "available_shots": "412", "auto_power_off": "0", "mirror_lockup": "0", "datetime": "2026-05-04 12:00:00",
    "port": "usb:001,005", "identified_as": "Canon EOS 650D", "library": "libgphoto2 2.5.34",
    "free_mb": "8000", "free_images": "321",
}  # fmt: skip
SETTINGS = Gphoto2Settings()
DEMAND = Demand(frames=165, bytes=3.5e9, iso=100)
NOW = datetime(2026, 5, 4, 12, 1)


def findings(settings: Gphoto2Settings = SETTINGS, demand: Demand = DEMAND, **facts: str) -> dict[str, Finding]:
    return {finding.check: finding for finding in facts_findings({**FACTS, **facts}, settings, demand, now=NOW)}


def test_camera_as_it_should_be_has_nothing_but_its_lens_to_remark() -> None:
    found = findings()
    assert {check: finding.severity.word for check, finding in found.items() if finding.severity} == {"lens": "note"}
    assert found["connection"].seen == "Canon EOS 650D, serial 53123456789, firmware 3-1.0.1 at usb:001,005"
    assert found["exposure times"].seen == "1/4000 s to 30 s"
    assert "mask is the stop" in found["lens"].mend


@pytest.mark.parametrize(
    ("facts", "check", "severity", "words"),
    [
        ({"mode_dial": "P"}, "mode dial", "error", "turn it to M"),
        ({"mode_dial": "TV"}, "mode dial", "note", "M is the safe choice"),
        ({"mode_dial": "absent"}, "mode dial", "note", "M"),
        ({"exposure_times_s": "absent"}, "exposure times", "error", "mode dial to M"),
        ({"isos": "200, 400"}, "iso", "error", "camera.iso"),
        ({"isos": "absent"}, "iso", "note", "set ISO 100 on the camera"),
        ({"image_formats": "Large Fine JPEG, Small JPEG"}, "image format", "error", "mode dial to M"),
        ({"image_formats": "absent", "image_format": "absent"}, "image format", "warning", "image quality to RAW"),
        ({"image_formats": "Large Fine JPEG, RAW + Large Fine JPEG"}, "image format", "note", "plain RAW"),
        ({"aperture": "5.6", "lens": "EF50mm f/1.8"}, "lens", "note", "iris is fully open"),
        ({"focus": "One Shot"}, "focus switch", "warning", "lens switch to MF"),
        ({"focus": "absent"}, "focus switch", "note", "MF"),
        ({"battery": "Low"}, "battery", "warning", "mains adapter"),
        ({"battery": "12%"}, "battery", "warning", "mains adapter"),
        ({"free_mb": "2000"}, "card", "error", "format the card"),
        ({"free_images": "164"}, "card", "error", "format the card"),
        ({"free_mb": "3600"}, "card", "warning", "format the card"),
        ({"free_images": "180"}, "card", "warning", "format the card"),
        ({"free_mb": "absent", "free_images": "absent", "capture_target": "Internal RAM"}, "card", "warning",
         "put one in"),
        ({"auto_power_off": "30"}, "auto power off", "warning", "`disable`"),
        ({"auto_power_off": "absent"}, "auto power off", "note", "`disable`"),
        ({"mirror_lockup": "1"}, "mirror lock-up", "error", "switch it off"),
        ({"datetime": "2026-05-04 14:00:00"}, "clock", "note", "menu"),
        ({"datetime": "2012-08-09 17:00:02"}, "clock", "note", "set the camera's"),
    ],
)  # fmt: skip
def test_each_trouble_has_its_severity_and_its_way_out(
    facts: dict[str, str], check: str, severity: str, words: str
) -> None:
    found = findings(**facts)
    assert found[check].severity.word == severity
    assert words in found[check].mend
    others = {name for name, finding in found.items() if finding.severity and name not in (check, "lens")}
    assert not others


def test_jpeg_on_a_camera_that_offers_raw_is_no_trouble() -> None:
    found = findings(image_format="Large Fine JPEG")["image format"]
    assert found.severity.word == "ok"
    assert found.seen == "RAW is offered, and will be set (now Large Fine JPEG)"


def test_what_rig_yaml_demands_and_the_camera_lacks_is_an_error() -> None:
    strict = replace(SETTINGS, may_be_absent=(), capture_target="card", image_format="RAW (Small)")
    lacking = {"isos": "absent", "free_mb": "absent", "free_images": "absent"}
    found = findings(strict, **lacking)
    assert {name for name, finding in found.items() if finding.severity.word == "error"} == {
        "iso", "image format", "card",
    }  # fmt: skip
    assert "camera.image_format" in found["image format"].mend


def test_aperture_wish_needs_a_lens_with_contacts() -> None:
    wish = replace(SETTINGS, aperture=2.8)
    assert findings(wish)["lens"].severity.word == "warning"
    assert (
        findings(wish, aperture="5.6", apertures="1.8, 2.8, 5.6", lens="EF50mm f/1.8")["lens"].seen
        == "EF50mm f/1.8, f/2.8 will be set (now f/5.6)"
    )
    other = findings(replace(SETTINGS, aperture=3.0), aperture="5.6", apertures="1.8, 2.8, 5.6")["lens"]
    assert other.severity.word == "error"
    assert "1.8, 2.8, 5.6" in other.mend


def test_card_matters_only_as_far_as_frames_stay_on_it() -> None:
    full = {"free_mb": "100", "free_images": "4"}
    assert findings(replace(SETTINGS, keep_on_card=False), **full)["card"].severity.word == "ok"
    assert findings(replace(SETTINGS, capture_target="memory"), **full)["card"].severity.word == "ok"
    assert findings(**full)["card"].severity.word == "error"


def test_pitch_of_another_camera_in_rig_yaml_is_noticed() -> None:
    assert pixel_pitch_finding(0.0043, FACTS).severity.word == "ok"
    assert pixel_pitch_finding(None, FACTS).severity.word == "ok"
    wrong = pixel_pitch_finding(0.0043, FACTS | {"identified_as": "Nikon DSC D750"})
    assert wrong.severity.word == "warning"
    assert "5.97 um" in wrong.seen
    unknown = FACTS | {"identified_as": "Pentax K-5"}
    assert pixel_pitch_finding(None, unknown).severity.word == "note"
    assert pixel_pitch_finding(0.0048, unknown).severity.word == "ok"


@pytest.mark.parametrize(
    ("made_with", "word"),
    [
        (("Canon", "Canon EOS 650D"), "ok"),
        (("NIKON CORPORATION", "NIKON D750"), "warning"),
        (("Depth Workbench", "Simulated small"), "warning"),
        (("", ""), None),
        (("Pentax", "K-5"), None),
    ],
)
def test_bank_of_another_camera_is_named(made_with: tuple[str, str], word: str | None) -> None:
    found = bank_finding(made_with, FACTS)
    assert (found.severity.word if found else None) == word
