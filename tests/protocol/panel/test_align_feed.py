"""The align page's server: samples out, presses in, verdicts in words."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from rigs.align_feed import AlignFeed, AlignSample, AlignTolerance, judge
from rigs.align_server import AlignServer, AlignSettings
from rigs.errors import ConfigError, DeviceBusyError, PanelError


def sample(**changes) -> AlignSample:
    values = {
        "frame_width_px": 1001,
        "frame_height_px": 801,
        "centroid_px": (503.0, 396.0),
        "peak": 0.7,
        "width_px": 4.0,
    }
    return AlignSample(**{**values, **changes})


@pytest.mark.parametrize(
    ("changes", "level", "text"),
    [
        ({}, "good", "centred within 20 px"),
        ({"centroid_px": (470.0, 440.4)}, "warn", "off centre: 30 px left and 40 px down"),
        ({"centroid_px": (900.0, 400.0)}, "bad", "off centre: 400 px right"),
        ({"saturated_px": 214, "peak": 1.0}, "bad", "saturated: shorten the exposure (214 px at white)"),
        ({"peak": 0.95}, "warn", "nearly saturated: shorten the exposure (95 % of white)"),
        ({"peak": 0.1}, "warn", "dim: lengthen the exposure (10 % of white)"),
        (
            {"peak": 0.1, "longest": True},
            "warn",
            "dim at the longest exposure: brighten the panel, enlarge the dot, or raise the ISO (10 % of white)",
        ),
        ({"width_px": 6.0}, "warn", "wider: 1.50 times the narrowest, 4.0 px"),
        ({"task": "cross-hair: turn the camera", "centroid_px": None}, "info", "cross-hair: turn the camera"),
        ({"task": "white: in view?", "saturated_px": 9}, "bad", "saturated: shorten the exposure (9 px at white)"),
        ({"failed": True, "note": "camera: no image arrived"}, "bad", "no frame: camera: no image arrived"),
        ({"centroid_px": None}, "bad", "no point: is the dot on, and the panel in view?"),
        ({"centroid_px": None, "note": "two points found"}, "bad", "no point: two points found"),
        ({"target_px": (600.0, 396.0)}, "warn", "off centre: 97 px left"),
    ],
)
def test_most_urgent_finding_comes_first_and_says_what_to_do(changes, level, text):
    first = judge(sample(**changes), AlignTolerance(), narrowest_px=4.0)[0]
    assert (first.level, first.text) == (level, text)


def test_narrowest_width_is_remembered_until_forgotten():
    feed = AlignFeed()
    for width in (8.0, 4.0, 6.0):
        findings = feed.push(sample(width_px=width))
    assert any("1.50 times the narrowest" in finding.text for finding in findings)
    feed.forget_narrowest()
    assert all(finding.level == "good" for finding in feed.push(sample(width_px=6.0)))
    assert len(feed.history()) == 1


Serve = Callable[..., tuple[AlignServer, ClientConnection]]


@pytest.fixture
def serve() -> Iterator[Serve]:
    opened = ExitStack()

    def start(feed: AlignFeed, actions=None) -> tuple[AlignServer, ClientConnection]:
        server = AlignServer(AlignSettings(port=0), feed, actions or {})
        opened.callback(server.close)
        return server, opened.enter_context(connect(server.urls()[0].replace("http", "ws") + "/socket", open_timeout=5))

    with opened:
        yield start


def hear(socket: ClientConnection, kind: str) -> dict:
    while True:
        data = socket.recv(timeout=5)
        if isinstance(data, str) and (message := json.loads(data))["type"] == kind:
            return message


def test_page_gets_history_newest_sample_and_picture(serve):
    feed = AlignFeed()
    feed.push(sample(width_px=9.0))
    feed.push(sample(image=b"\xff\xd8picture"))
    _, socket = serve(feed)
    assert [point["width_px"] for point in hear(socket, "hello")["history"]] == [9.0, 4.0]
    shown = hear(socket, "sample")
    assert shown["sample"]["centroid_px"] == [503.0, 396.0]
    assert shown["sample"]["distance_px"] == 5.0
    assert shown["age_s"] >= 0
    assert socket.recv(timeout=5) == b"\xff\xd8picture"
    feed.push(sample(width_px=5.0))
    assert hear(socket, "sample")["narrowest_px"] == 4.0


def test_press_calls_the_given_action_and_reports_its_trouble(serve):
    pressed = threading.Event()

    def refuse() -> None:
        raise PanelError("panel: no page is connected")

    def break_down() -> None:
        raise ZeroDivisionError

    _, socket = serve(AlignFeed(), {"Dot": pressed.set, "Cross-hair": refuse, "Broken": break_down})
    assert hear(socket, "hello")["actions"] == ["Dot", "Cross-hair", "Broken"]
    for name, active, trouble in (
        ("Dot", "Dot", ""),
        ("Cross-hair", "Dot", "panel: no page is connected"),
        ("Broken", "Dot", "Broken failed; the terminal says why"),
    ):
        socket.send(json.dumps({"type": "action", "name": name}))
        assert hear(socket, "action") == {"type": "action", "name": name, "active": active, "trouble": trouble}
    assert pressed.is_set()


@pytest.mark.parametrize("nonsense", ["{", "[]", '{"type": "action", "name": "rm"}', '{"type": "other"}'])
def test_nonsense_from_a_page_is_ignored(serve, nonsense):
    feed = AlignFeed()
    _, socket = serve(feed, {"Dot": lambda: None})
    socket.send(nonsense)
    feed.push(sample())
    assert hear(socket, "sample")["number"] == 1


def test_align_page_on_the_network_needs_its_token():
    server = AlignServer(AlignSettings(host="0.0.0.0", port=0), AlignFeed())
    try:
        url = server.urls()[-1]
        assert httpx.get(url).is_success
        bare = url.split("?")[0]
        assert httpx.get(bare).status_code == 403
        with pytest.raises(InvalidStatus), connect(bare.replace("http", "ws") + "/socket"):
            pass
        invitation = server.invitation()
        assert "█" in invitation or "127.0.0.1" in server.urls()[0]  # a machine without a network has nobody to invite
        assert f"align: open {server.urls()[0]}" in invitation
    finally:
        server.close()


def test_taken_port_and_a_foreign_address_name_what_can_be_changed():
    first = AlignServer(AlignSettings(port=0), AlignFeed())
    try:
        port = int(first.urls()[0].split(":")[2].split("/")[0])
        with pytest.raises(DeviceBusyError, match=rf"align: 127.0.0.1:{port} is taken .* end it or set --port"):
            AlignServer(AlignSettings(port=port), AlignFeed())
    finally:
        first.close()
    with pytest.raises(ConfigError, match=r"panel\.host: can't listen on 192\.0\.2\.77"):
        AlignServer(AlignSettings(host="192.0.2.77", port=0), AlignFeed())
