"""Which acknowledgements count, and what the operator reads when none comes."""

from __future__ import annotations

import time

import pytest

from rigs.browser_panel import BrowserPanel, BrowserPanelSettings
from rigs.errors import NotAcknowledgedError, PanelError
from rigs.protocols import Panel, Pattern

DOT = Pattern("dot", size_px=3, x_px=10, y_px=-5)


def test_shown_once_the_page_says_painted(make_panel, make_page, background):
    panel = make_panel()
    assert isinstance(panel, Panel)
    page = make_page(panel)
    showing = background(lambda: panel.show(DOT))
    order = page.next("show")
    assert order["pattern"] == {
        "kind": "dot", "colour": "#ffffff", "size_px": 3, "x_px": 10, "y_px": -5, "points_px": [],
    }  # fmt: skip
    assert showing.value is None
    page.paint(order["sequence"])
    ack = showing.result()
    assert (ack.pattern, ack.width_px, ack.height_px, ack.device_pixel_ratio) == (DOT, 1280, 800, 1.5)
    assert ack.fullscreen
    assert 0 < ack.painted_after_s < 3
    assert panel.identify().extra["size_px"] == "1280x800"


def test_late_acknowledgement_of_an_older_pattern_never_counts(make_panel, make_page, background):
    panel = make_panel(ack_timeout_s=0.4)
    page = make_page(panel)
    first = background(lambda: panel.show(DOT))
    old = page.next("show")["sequence"]
    page.report()
    with pytest.raises(NotAcknowledgedError, match="doesn't confirm"):
        first.result()
    second = background(lambda: panel.show(Pattern("black")))
    assert page.next("show")["sequence"] > old
    page.paint(old)
    with pytest.raises(NotAcknowledgedError):
        second.result()


def test_acknowledgement_of_a_number_never_asked_for_doesnt_count(make_panel, make_page, background):
    panel = make_panel(ack_timeout_s=0.3)
    page = make_page(panel)
    showing = background(lambda: panel.show(DOT))
    page.paint(page.next("show")["sequence"] + 1)
    with pytest.raises(NotAcknowledgedError):
        showing.result()


@pytest.mark.parametrize(
    ("unfit", "says"),
    [
        ({"visible": False}, "the page is hidden"),
        ({"fullscreen": False}, "isn't full screen: tap it once"),
        ({"zoom": 1.6}, "zoomed to 160 %"),
    ],
)
def test_acknowledgement_of_an_unfit_page_doesnt_count_until_it_is_fit(make_panel, make_page, background, unfit, says):
    panel = make_panel(ack_timeout_s=0.4)
    page = make_page(panel)
    fit = dict(page.state)
    showing = background(lambda: panel.show(DOT))
    page.paint(page.next("show")["sequence"], **unfit)
    with pytest.raises(NotAcknowledgedError, match=says):
        showing.result()
    assert says in panel.status().problem
    again = background(lambda: panel.show(DOT))
    sequence = page.next("show")["sequence"]
    page.paint(sequence)
    page.paint(sequence, **fit)
    again.result()
    assert panel.status().problem == ""


def test_full_screen_may_be_waived(make_panel, make_page, background):
    panel = make_panel(require_fullscreen=False)
    page = make_page(panel)
    assert page.next("hello")["require_fullscreen"] is False
    showing = background(lambda: panel.show(DOT))
    page.paint(page.next("show")["sequence"], fullscreen=False)
    assert not showing.result().fullscreen


def test_without_a_page_the_operator_is_told_to_open_it(make_panel):
    panel = make_panel(ack_timeout_s=0.1)
    with pytest.raises(NotAcknowledgedError, match="no page is connected: open the panel's address"):
        panel.show(DOT)
    with pytest.raises(NotAcknowledgedError, match=r"not ready after 0\.1 s: no page is connected"):
        panel.wait_ready(0.1)
    assert not panel.status().connected
    assert panel.identify().kind == "browser"


def test_lost_page_is_named_and_may_come_back_in_time(make_panel, make_page, background):
    panel = make_panel(ack_timeout_s=2)
    page = make_page(panel)
    page.report()
    panel.wait_ready(2)
    page.close()
    showing = background(lambda: panel.show(DOT))
    time.sleep(0.2)
    assert "the connection to the page at 127.0.0.1 is lost" in panel.status().problem
    returned = make_page(panel)
    returned.paint(returned.next("show")["sequence"])
    showing.result()


def test_what_an_earlier_page_painted_doesnt_count_for_its_successor(make_panel, make_page, background):
    panel = make_panel(ack_timeout_s=0.5)
    first = make_page(panel)
    showing = background(lambda: panel.show(DOT))
    sequence = first.next("show")["sequence"]
    second = make_page(panel)
    assert second.next("show")["sequence"] == sequence
    assert first.closing_code() == 4001
    with pytest.raises(NotAcknowledgedError):
        showing.result()


def test_newest_page_takes_over_and_the_operator_can_see_it(make_panel, make_page, background):
    panel = make_panel()
    first = make_page(panel)
    first.next("hello")
    second = make_page(panel)
    assert first.closing_code() == 4001
    assert "took over from" in panel.status().notice
    showing = background(lambda: panel.show(DOT))
    second.paint(second.next("show")["sequence"])
    showing.result()


def test_page_of_another_size_than_before_is_pointed_out(background, make_page):
    notices = []
    panel = BrowserPanel(BrowserPanelSettings(port=0, settle_s=0, require_fullscreen=False), on_notice=notices.append)
    try:
        page = make_page(panel)
        for width in (1280, 1280, 800):
            showing = background(lambda: panel.show(DOT))
            page.paint(page.next("show")["sequence"], width_px=width)
            showing.result()
        assert notices == [
            "panel: its page is 800 x 800 px now, and was 1280 x 800 px: is it the same screen, not turned?"
        ]
    finally:
        panel.close()


def _painted(panel, page, background):
    showing = background(lambda: panel.show(DOT))
    page.paint(page.next("show")["sequence"])
    showing.result()


def _told(panel, page, **state):
    page.report(**state)
    wanted = {**page.state, **state}["width_px"], {**page.state, **state}["visible"]
    deadline = time.monotonic() + 5
    while (panel.status().page.width_px, panel.status().page.visible) != wanted and time.monotonic() < deadline:
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("meanwhile", "says"),
    [
        ({"visible": False}, "not seen to the end of the exposure: the page is hidden"),
        ({"width_px": 800}, "changed its size during the exposure: lock the tablet's rotation"),
    ],
)
def test_pattern_that_went_during_the_exposure_is_noticed_after_it(make_panel, make_page, background, meanwhile, says):
    panel = make_panel()
    page = make_page(panel)
    _painted(panel, page, background)
    panel.check_shown()
    _told(panel, page, **meanwhile)
    with pytest.raises(NotAcknowledgedError, match=says):
        panel.check_shown()


def test_page_lost_or_replaced_during_the_exposure_is_noticed_after_it(make_panel, make_page, background):
    panel = make_panel()
    first = make_page(panel)
    _painted(panel, first, background)
    second = make_page(panel)
    second.next("hello")  # it is in control now
    second.report()
    panel.wait_ready(2)
    with pytest.raises(NotAcknowledgedError, match=r"took over .* leave one page open"):
        panel.check_shown()
    second.close()
    deadline = time.monotonic() + 5
    while panel.status().connected and time.monotonic() < deadline:
        time.sleep(0.01)
    with pytest.raises(NotAcknowledgedError, match=r"to the end of the exposure: the connection .* is lost"):
        panel.check_shown()


def test_silent_page_is_given_up(make_panel, make_page):
    panel = make_panel(heartbeat_s=0.05)
    page = make_page(panel)
    page.report()
    panel.wait_ready(1)
    assert page.closing_code() == 4003
    status = panel.status()
    assert not status.connected
    assert "is silent" in status.notice
    assert status.page.width_px == 1280


@pytest.mark.parametrize(
    "nonsense",
    ["", "{", '{"type": "painted"}', '{"type": "state", "state": {"width_px": -1}}', "[]", b"\x00\xff", "x" * 5000],
)
def test_nonsense_ends_that_connection_alone(make_panel, make_page, background, nonsense):
    panel = make_panel()
    page = make_page(panel)
    page.socket.send(nonsense)
    assert page.closing_code() == 4002
    assert "sent what no panel page sends" in panel.status().notice
    good = make_page(panel)
    showing = background(lambda: panel.show(DOT))
    good.paint(good.next("show")["sequence"])
    showing.result()


def test_page_that_cant_draw_says_why_at_once(make_panel, make_page, background):
    panel = make_panel(ack_timeout_s=30)
    page = make_page(panel)
    showing = background(lambda: panel.show(Pattern("picture", picture="chart")))
    page.fail(page.next("show")["sequence"], "the picture didn't load")
    with pytest.raises(PanelError, match="the picture didn't load"):
        showing.result()


def test_dot_beyond_the_edge_is_refused_once_the_size_is_known(make_panel, make_page, background):
    panel = make_panel()
    page = make_page(panel)
    showing = background(lambda: panel.show(Pattern("grid", size_px=3, points_px=((0, 0), (639.5, 0)))))
    page.paint(page.next("show")["sequence"])
    with pytest.raises(PanelError, match=r"\(639.5, 0\) isn't wholly on the panel of 1280 x 800 px"):
        showing.result()


def test_closing_releases_whoever_waits_and_frees_the_port(make_panel, make_page, background):
    panel = make_panel(ack_timeout_s=30)
    page = make_page(panel)
    showing = background(lambda: panel.show(DOT))
    page.next("show")
    port = int(panel.urls()[0].split(":")[2].split("/")[0])
    panel.close()
    panel.close()
    with pytest.raises(PanelError, match="closed"):
        showing.result()
    assert page.closing_code() in (1001, 1012)
    assert make_panel(port=port).urls()[0].endswith(f":{port}/panel")
