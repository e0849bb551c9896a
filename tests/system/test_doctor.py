"""What the operator reads of a rig's trouble before a calibration is started."""

from __future__ import annotations

import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from command_line import FEW, Outcome, arguments, call, done, listing, refused

from rigs.serial_link import SerialLink
from tests.standins.grbl_firmware import GrblFirmware
from tests.standins.panel_page import PanelPage
from tests.standins.pty_server import PtyServer
from tests.standins.rail import Rail
from tests.standins.zaber_device import ZaberChain
from workbench.project import Project

GRBL = "  kind: grbl\n  port: {port}\n  depth: {{offset: 3505 mm}}\n"


def found(outcome: Outcome) -> dict[str, dict[str, str]]:
    """Findings by id."""
    return {finding["id"]: finding for finding in outcome.only["findings"]}


def rewrite(project: Path, section: str, lines: str) -> None:
    """Write a section of rig.yaml anew."""
    text = (project / "rig.yaml").read_text()
    before, rest = text.split(f"\n{section}:\n")
    after = rest.split("\n\n", 1)[1]
    (project / "rig.yaml").write_text(f"{before}\n{section}:\n{lines}\n{after}")


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A new project on the simulated rig."""
    done("init", tmp_path / "rig")
    return tmp_path / "rig"


OnGrbl = Callable[..., AbstractContextManager[tuple[PtyServer, Path]]]


@pytest.fixture
def on_grbl(rig: Path) -> OnGrbl:
    """Plug a GRBL rail into the project."""

    @contextmanager
    def plug_in(more: str = "", **settings: Any) -> Iterator[tuple[PtyServer, Path]]:
        numbers = {130: 3000.0} | {int(name[1:]): value for name, value in settings.items()}
        with PtyServer(GrblFirmware(Rail(carriage_mm=60.0), numbers)) as line:
            rewrite(rig, "stage", GRBL.format(port=line.path) + more)
            yield line, rig

    return plug_in


def unmoved(line: PtyServer) -> bool:
    firmware = line.device
    assert isinstance(firmware, GrblFirmware)
    asked = bytes(line.sent).replace(b"?", b"")
    return firmware.rail.carriage_mm == 60.0 and not any(word in asked for word in (b"$H", b"$X", b"$J", b"G"))


def test_simulated_rig_is_ready_and_says_what_is_missing(rig: Path) -> None:
    before = listing(rig)
    outcome = done("-C", rig, "doctor")
    assert outcome.out.splitlines()[-1].endswith("Ready to calibrate.")
    assert "none is active" in outcome.out
    assert "`workbench calibrate` makes one" in outcome.out
    assert listing(rig) == before


def test_json_is_one_object_in_a_fixed_form(rig: Path) -> None:
    answer = done("-C", rig, "doctor", "--json").only
    assert list(answer) == ["ready", "worst", "counts", "devices", "plugged_in", "versions", "findings"]
    assert answer["ready"] is True
    assert answer["worst"] == "note"
    assert answer["devices"] == {"camera": "simulated", "stage": "simulated", "panel": "simulated"}
    assert set(answer["plugged_in"]) == {"cameras", "serial_ports", "browsers"}
    words = ["ok", "note", "warning", "error"]
    assert list(answer["counts"]) == words
    for finding in answer["findings"]:
        assert list(finding) == ["id", "severity", "seen", "mend"]
        assert finding["severity"] in words
        assert finding["seen"]
        assert finding["mend"] or finding["severity"] in ("ok", "note")
    assert sum(answer["counts"].values()) == len(answer["findings"])
    subjects = [finding["id"].split(".")[0] for finding in answer["findings"]]
    assert list(dict.fromkeys(subjects)) == ["project", "computer", "camera", "stage", "panel"]


def test_calibrated_project_has_its_bank_verified(project: Path) -> None:
    bank = found(done("-C", project, "doctor", "--json"))["project.bank"]
    assert bank["severity"] == "ok"
    assert "every byte" in bank["seen"]
    psf = next((project / "banks").rglob("psf.npy"))
    psf.write_bytes(psf.read_bytes()[:-1] + b"x")
    bank = found(done("-C", project, "doctor", "--json"))["project.bank"]
    assert bank["severity"] == "warning"
    assert "psf.npy" in bank["seen"]


def test_rail_after_power_up_is_ready_and_nothing_moves(on_grbl: OnGrbl) -> None:
    with on_grbl() as (line, rig):
        findings = found(done("-C", rig, "doctor", "--json"))
        assert unmoved(line)
    assert findings["stage.connection"]["seen"].startswith("GRBL, firmware 1.1h")
    assert findings["stage.state"]["severity"] == "note"
    assert "locked until it is homed" in findings["stage.state"]["seen"]
    assert findings["stage.homing"]["severity"] == findings["stage.soft-limits"]["severity"] == "ok"
    assert findings["stage.travel"]["seen"] == "reaches 51 to 350.5 cm; the plan needs 60 to 350 cm"


def test_rail_deaf_in_an_alarm_is_told(on_grbl: OnGrbl) -> None:
    with on_grbl() as (line, rig):
        assert isinstance(line.device, GrblFirmware)
        with line.lock:
            line.device._kill("Alarm", 1)
        findings = found(call("-C", rig, "doctor", "--json"))
        assert unmoved(line)
    assert "deaf until it was reset" in findings["stage.last-alarm"]["seen"]
    assert "look why" in findings["stage.last-alarm"]["mend"]


def test_power_up_alarm_without_homing_cannot_be_left(on_grbl: OnGrbl) -> None:
    with on_grbl(_22=0, _20=0) as (line, rig):
        outcome = call("-C", rig, "doctor", "--json")
        assert unmoved(line)
    assert outcome.code == 3
    findings = found(outcome)
    assert "$22=1" in findings["stage.homing"]["mend"]
    assert "$20=1" in findings["stage.soft-limits"]["mend"]
    assert "stage.limits" in findings["stage.travel"]["mend"]
    assert "stage homing, stage soft limits, stage travel" in outcome.err.splitlines()[-1]


def test_missing_protection_that_rig_yaml_allows_is_a_warning(on_grbl: OnGrbl) -> None:
    allowed = "  limits: [-3000 mm, 0 mm]\n  allow_without_homing: true\n  allow_without_soft_limits: true\n"
    with on_grbl(allowed, _22=0, _20=0) as (_, rig):
        findings = found(done("-C", rig, "doctor", "--json"))
    assert findings["stage.homing"]["severity"] == findings["stage.soft-limits"]["severity"] == "warning"
    assert findings["stage.travel"]["severity"] == "ok"


def test_travel_too_short_for_the_plan(on_grbl: OnGrbl) -> None:
    with on_grbl(_130=2000.0) as (_, rig):
        outcome = call("-C", rig, "doctor", "--json")
    assert outcome.code == 3
    travel = found(outcome)["stage.travel"]
    assert travel["severity"] == "error"
    assert travel["seen"] == "reaches 151 to 350.5 cm; the plan needs 60 to 350 cm"
    assert "calibration.from" in travel["mend"]


def test_missing_port_is_a_finding_and_the_rest_is_still_checked(rig: Path) -> None:
    rewrite(rig, "stage", GRBL.format(port="/dev/no-such-port"))
    outcome = call("-C", rig, "doctor", "--json")
    assert outcome.code == 3
    findings = found(outcome)
    assert "/dev/no-such-port can't be opened" in findings["stage.connection"]["seen"]
    assert "check plug" in findings["stage.connection"]["mend"]
    assert findings["panel.server"]["severity"] == "ok"
    assert "Traceback" not in outcome.err


def test_zaber_is_asked_without_moving(rig: Path) -> None:
    chain = ZaberChain()
    with PtyServer(chain) as line:
        rewrite(rig, "stage", f"  kind: zaber\n  port: {line.path}\n  microstep: 0.5 um\n  depth: {{offset: 50 cm}}")
        findings = found(done("-C", rig, "doctor", "--json"))
        assert not any(word in line.sent for word in (b"home", b"move", b"set"))
    assert findings["stage.connection"]["seen"].startswith("Zaber device id 50081, firmware 7.38, serial 100235")
    assert "position unknown" in findings["stage.state"]["seen"]
    assert findings["stage.travel"]["severity"] == "ok"


def test_manual_stage_needs_somebody_to_ask(rig: Path) -> None:
    rewrite(rig, "stage", "  kind: manual\n  depth: {offset: 50 cm}")
    findings = found(done("-C", rig, "doctor", "--json"))
    assert findings["stage.connection"]["seen"] == "moved by hand, 30 times"
    assert findings["stage.operator"]["severity"] == "note"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return int(taken.getsockname()[1])


@pytest.fixture
def panel_port(rig: Path) -> int:
    """The project shows its patterns in a browser."""
    port = free_port()
    rewrite(rig, "panel", f"  kind: browser\n  port: {port}\n  ack_timeout: 1 s")
    return port


def test_page_paints_a_dot_and_is_left_black(rig: Path, panel_port: int) -> None:
    with PanelPage(panel_port) as page:
        outcome = done("-C", rig, "doctor", "--json")
    findings = found(outcome)
    assert outcome.only["plugged_in"]["browsers"] == ["Firefox at 127.0.0.1"]
    assert findings["panel.full-screen"]["seen"] == "1280 x 800 px, 12.8 x 8.0 cm by panel.pixel_pitch"
    assert findings["panel.pixel-ratio"]["seen"] == "2"
    assert [pattern["kind"] for pattern in page.shown] == ["dot", "black"]
    with socket.create_server(("127.0.0.1", panel_port)):
        pass  # the port is free again


def test_no_page_is_told_with_the_way_to_open_one(rig: Path, panel_port: int) -> None:
    outcome = call("-C", rig, "doctor", "--json", "--panel-wait", "0.1s")
    assert outcome.code == 3
    assert found(outcome)["panel.page"]["seen"] == "none connected within 0.1 s"
    assert f"http://127.0.0.1:{panel_port}/panel" in outcome.err


def test_page_in_a_window_and_page_that_does_not_paint(rig: Path, panel_port: int) -> None:
    with PanelPage(panel_port, fullscreen=False):
        page = found(call("-C", rig, "doctor", "--json", "--panel-wait", "2s"))["panel.page"]
    assert page["severity"] == "error"
    assert page["seen"] == "the page isn't full screen"
    assert page["mend"].startswith("tap it once")
    with PanelPage(panel_port, paints=False):
        painting = found(call("-C", rig, "doctor", "--json"))["panel.painting"]
    assert painting["severity"] == "error"
    assert "nothing painted within 1 s" in painting["seen"]


def test_token_is_shown_to_the_operator_only(rig: Path) -> None:
    port = free_port()
    rewrite(rig, "panel", f"  kind: browser\n  host: 0.0.0.0\n  port: {port}\n  token: not-for-machines")
    with PanelPage(port, token="not-for-machines"):
        outcome = done("-C", rig, "doctor", "--json")
    assert "not-for-machines" in outcome.err
    assert "not-for-machines" not in outcome.out


def test_taken_panel_port_is_a_finding(rig: Path, panel_port: int) -> None:
    with socket.create_server(("127.0.0.1", panel_port)):
        outcome = call("-C", rig, "doctor", "--json")
    assert outcome.code == 3
    assert "taken by another program" in found(outcome)["panel.server"]["seen"]


def test_rig_in_use_is_not_touched(on_grbl: OnGrbl) -> None:
    with on_grbl() as (line, rig):
        with Project(rig).lock_rig():
            outcome = call("-C", rig, "doctor", "--json")
        assert not line.sent
    assert outcome.code == 3
    assert "in use by another workbench" in found(outcome)["project.rig"]["seen"]


def test_unreadable_rig_yaml_and_wrong_time_are_bad_input(rig: Path) -> None:
    refused(call("-C", rig, "doctor", "--panel-wait", "soon"), "soon", "time")
    refused(call("-C", rig, "doctor", "--panel-wait", "-1s"), "below 0")
    (rig / "rig.yaml").write_text("camra: {}\n")
    refused(call("-C", rig, "doctor"), "camra", "camera")


@pytest.fixture
def virtual_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The virtual camera of the real library is plugged in."""
    folder = tmp_path / "virtual" / "DCIM" / "100NIKON"
    folder.mkdir(parents=True)
    (folder / "a.jpg").write_bytes(b"frame")
    monkeypatch.setenv("VCAMERADIR", str(tmp_path / "virtual"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "xdg"))


def test_camera_that_rig_yaml_does_not_name_is_listed(rig: Path, virtual_camera: None) -> None:
    outcome = done("-C", rig, "doctor", "--json")
    assert outcome.only["plugged_in"]["cameras"] == ["Nikon DSC D750 at usb:001,001"]
    assert "Nikon DSC D750" in found(outcome)["camera.connection"]["seen"]


CAMERA = "  kind: gphoto2\n  model: {model}\n  keep_on_card: false\n"


def test_camera_is_opened_and_read(rig: Path, virtual_camera: None, tmp_path: Path) -> None:
    rewrite(rig, "camera", CAMERA.format(model="D750"))
    before = listing(rig, tmp_path / "virtual")
    findings = found(done("-C", rig, "doctor", "--json"))
    assert findings["camera.connection"]["seen"].startswith("Nikon DSC D750, serial 0.1, firmware 2.5.11")
    assert findings["camera.battery"]["seen"] == "50%"
    assert findings["camera.pixel-pitch"]["seen"] == "5.97 um by its data sheet"
    assert findings["project.devices"]["severity"] == "warning"  # it sees nothing of a simulated panel
    assert listing(rig, tmp_path / "virtual") == before


def test_missing_or_other_camera_is_a_finding_and_the_rest_is_still_checked(
    rig: Path, virtual_camera: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    rewrite(rig, "camera", CAMERA.format(model="No such"))
    outcome = call("-C", rig, "doctor", "--json")
    assert outcome.code == 3
    camera = found(outcome)["camera.connection"]
    assert "found Nikon DSC D750 at usb:001,001" in camera["mend"]
    assert "camera.model" in camera["mend"]
    monkeypatch.delenv("VCAMERADIR")
    outcome = call("-C", rig, "doctor", "--json")
    assert outcome.code == 3
    findings = found(outcome)
    assert findings["camera.connection"]["severity"] == "error"
    assert findings["stage.travel"]["severity"] == findings["panel.server"]["severity"] == "ok"
    assert outcome.err.splitlines()[-1] == "workbench: not ready to calibrate: camera connection"


def test_plan_that_cannot_be_is_a_finding(rig: Path) -> None:
    rewrite(rig, "calibration", "  from: 60 cm\n  to: 90 cm\n  step: 50 cm")
    outcome = call("-C", rig, "doctor", "--json")
    assert outcome.code == 3
    findings = found(outcome)
    assert "too few" in findings["project.plan"]["seen"]
    assert findings["stage.travel"]["seen"] == "reaches 50 to 350 cm"


def test_session_that_stopped_is_remembered(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def pull_the_plug(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("rigs.simulated.devices.SimulatedCamera.capture", pull_the_plug)
    assert call("-C", rig, "calibrate", *FEW).code == 130
    session = found(done("-C", rig, "doctor", "--json"))["project.session"]
    assert session["severity"] == "note"
    assert session["seen"] == "s0001 stopped after 0 shots"
    assert session["mend"] == "`workbench resume s0001` goes on with it"


@pytest.mark.parametrize("settings", [{"_22": 0, "_20": 0}, {"_20": 0}, {"_130": 2000.0}], ids=str)
def test_what_the_doctor_calls_an_error_stops_a_calibration(on_grbl: OnGrbl, settings: dict[str, float]) -> None:
    with on_grbl(**settings) as (_, rig):
        assert call("-C", rig, "doctor").code == 3
        stopped = call("-C", rig, "calibrate")
    assert stopped.code in (2, 4)
    assert not list(rig.rglob("*.dng"))


def children() -> set[str]:
    return {pid for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()}


def test_no_thread_process_or_port_is_left_behind(on_grbl: OnGrbl, panel_port: int, virtual_camera: None) -> None:
    with on_grbl() as (line, rig), PanelPage(panel_port) as page:
        rewrite(rig, "camera", CAMERA.format(model="D750"))
        threads, processes = set(threading.enumerate()), children()
        done("-C", rig, "doctor")
        assert page.shown[-1]["kind"] == "black"
        assert {thread for thread in threading.enumerate() if thread.is_alive()} <= threads
        assert children() <= processes
        link = SerialLink(line.path, 115200)  # a port that is still open elsewhere would be busy
        link.close()


def test_interrupted_wait_for_a_page_frees_the_port(rig: Path, panel_port: int) -> None:
    command = arguments("-C", rig, "doctor", "--panel-wait", "60")
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "panel: open" in line:
                break
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 130
        assert "Traceback" not in process.stderr.read()
    with socket.create_server(("127.0.0.1", panel_port)):
        pass
