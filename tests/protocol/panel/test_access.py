"""Who gets in: token, origin, host; and what every answer carries."""

from __future__ import annotations

import socket

import httpx
import pytest
from websockets.exceptions import InvalidStatus

from rigs.browser_panel import BrowserPanel, BrowserPanelSettings
from rigs.errors import ConfigError, DeviceBusyError
from rigs.web_server import effective_token, qr_text

TOKEN = "right-token_123"


def _base(panel) -> str:
    return panel.urls()[-1].split("/panel")[0]


def test_loopback_needs_no_token_and_serves_all_parts(make_panel):
    panel = make_panel()
    assert panel.urls()[0].startswith("http://127.0.0.1:")
    for path in ("/", "/panel", "/panel/panel.js", "/panel/panel.css", "/panel/alive"):
        assert httpx.get(_base(panel) + path).is_success, path
    for path in (
        "/panel/..%2fpanel.html",
        "/panel/panel.html",
        "/etc/passwd",
        "/panel/picture?sequence=1&width=9&height=9",
    ):
        assert httpx.get(_base(panel) + path).status_code == 404, path
    assert httpx.get(_base(panel) + "/panel/picture?sequence=x").status_code == 400


def test_every_loopback_address_is_this_computer(make_panel):
    panel = make_panel(host="127.0.0.2")
    assert httpx.get(_base(panel) + "/panel").is_success
    other = {"Host": "workbench.example"}
    assert httpx.get(_base(panel) + "/panel", headers=other).status_code == 403


def test_network_address_always_gets_a_token(make_panel):
    panel = make_panel(host="0.0.0.0")
    url = panel.urls()[0]
    token = url.split("?token=")[1]
    assert len(token) >= 20
    assert httpx.get(panel.urls()[-1]).is_success
    assert httpx.get(_base(panel) + "/panel").status_code == 403
    assert token != make_panel(host="0.0.0.0").urls()[0].split("?token=")[1]


@pytest.mark.parametrize(
    "query", ["", "?token=", "?token=wrong-token_12", "?token=RIGHT-TOKEN_123", "?Token=" + TOKEN, "?token=%ff%00"]
)
def test_wrong_token_is_refused_everywhere(make_panel, make_page, query):
    panel = make_panel(token=TOKEN)
    for path in ("/", "/panel", "/panel/panel.js", "/panel/alive", "/panel/picture"):
        answer = httpx.get(_base(panel) + path + query)
        assert answer.status_code == 403, path
        assert TOKEN not in answer.text
    with pytest.raises(InvalidStatus) as refused:
        make_page(panel, url=_base(panel) + "/panel" + query)
    assert refused.value.response.status_code == 403
    assert not panel.status().connected


def test_right_token_opens_page_parts_and_socket(make_panel, make_page):
    panel = make_panel(token=TOKEN)
    html = httpx.get(panel.urls()[0]).text
    assert f"panel/panel.js?token={TOKEN}" in html
    assert httpx.get(f"{_base(panel)}/panel/panel.js?token={TOKEN}").is_success
    make_page(panel).report()
    assert panel.wait_ready(2).connected


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://127.0.0.1.evil.example"]
)
def test_foreign_pages_cant_drive_the_panel(make_panel, make_page, origin):
    panel = make_panel()
    with pytest.raises(InvalidStatus) as refused:
        make_page(panel, origin=origin)
    assert refused.value.response.status_code == 403
    assert httpx.get(panel.urls()[0], headers={"origin": origin}).status_code == 403


def test_own_origin_is_welcome(make_panel, make_page):
    panel = make_panel()
    make_page(panel, origin=_base(panel)).report()
    assert panel.wait_ready(2).connected


def test_foreign_name_for_loopback_is_refused(make_panel):
    panel = make_panel()
    assert httpx.get(panel.urls()[0], headers={"host": "evil.example"}).status_code == 403
    assert httpx.get(panel.urls()[0], headers={"host": "a b"}).status_code in (400, 403)
    assert httpx.get(panel.urls()[0], headers={"host": "localhost:9000"}).is_success


@pytest.mark.parametrize("path", ["/panel", "/panel/panel.js", "/panel/alive", "/nowhere"])
def test_nothing_is_cached_and_nothing_comes_from_elsewhere(make_panel, path):
    headers = httpx.get(_base(make_panel()) + path).headers
    assert headers["cache-control"] == "no-store"
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["referrer-policy"] == "no-referrer"
    assert "server" not in headers


def test_page_isnt_a_mirror_for_markup(make_panel):
    panel = make_panel()
    assert "<b>" not in httpx.get(_base(panel) + "/panel?token=%3Cb%3E").text


def test_taken_port_is_named_with_the_way_out():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(DeviceBusyError, match=rf"127.0.0.1:{port} is taken .* set panel.port"):
            BrowserPanel(BrowserPanelSettings(port=port))


@pytest.mark.parametrize("host", ["no.such.host.invalid", "192.0.2.77"])
def test_foreign_address_is_a_configuration_error(make_panel, host):
    with pytest.raises(ConfigError, match=r"panel\.host"):
        make_panel(host=host)


@pytest.mark.parametrize("token", ["short", "white space and more", "ümlaut-token"])
def test_unfit_token_is_a_configuration_error(token):
    with pytest.raises(ConfigError, match=r"panel\.token"):
        effective_token("panel", "127.0.0.1", token)


def test_terminal_gets_address_and_code(make_panel):
    panel = make_panel(host="0.0.0.0", token=TOKEN)
    text = panel.invitation()
    assert panel.urls()[0] in text
    assert "█" in text or "127.0.0.1" in text  # a machine without a network has nobody to invite
    lines = qr_text(panel.urls()[0]).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert set("".join(lines)) <= set("█▀▄ ")
    assert "\x1b" not in text


def test_address_that_no_other_device_can_reach_has_no_code(make_panel):
    panel = make_panel()
    assert panel.invitation() == f"panel: open {panel.urls()[0]} in a browser on this computer, then tap the page once"
