"""The panel in a real browser: what it says it has painted is what the screen shows, pixel for pixel."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from rigs.charts import chart
from rigs.errors import NotAcknowledgedError
from rigs.protocols import Pattern

from .conftest import ARGUMENTS

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]


def assert_disc(image: np.ndarray, x_px: float, y_px: float, diameter: int) -> None:
    """Exactly one disc of full white, as near to (x, y) from the centre as the pixel grid allows; black elsewhere."""
    lit = image.max(axis=2) > 0
    rows, columns = np.nonzero(lit)
    assert np.all(image[lit] == 255)
    for indices, length, offset in ((columns, image.shape[1], x_px), (rows, image.shape[0], y_px)):
        assert indices.max() - indices.min() + 1 == diameter
        assert abs((indices.min() + indices.max() + 1) / 2 - (length / 2 + offset)) <= 0.5
    axis = np.arange(diameter) + 0.5 - diameter / 2
    disc = axis[:, None] ** 2 + axis[None, :] ** 2 <= diameter**2 / 4
    box = lit[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    np.testing.assert_array_equal(box, disc)


@pytest.mark.parametrize(
    ("ratio", "size_px"), [(1, (641, 401)), (1.5, (962, 602)), (2, (1282, 802)), (2.625, (1683, 1053))]
)
def test_dot_is_where_it_should_be_and_black_elsewhere(make_panel, open_page, screenshot, ratio, size_px):
    panel = make_panel()
    page = open_page(panel.urls()[0], viewport={"width": 641, "height": 401}, device_scale_factor=ratio)
    for x, y, diameter in ((0, 0, 1), (0, 0, 2), (-300.4, 17, 1), (55.5, -120.5, 3), (100, 80, 9)):
        ack = panel.show(Pattern("dot", size_px=diameter, x_px=x, y_px=y))
        assert (ack.width_px, ack.height_px) == size_px
        assert ack.device_pixel_ratio == ratio
        image = screenshot(page)
        assert image.shape[:2] == size_px[::-1]
        assert_disc(image, x, y, diameter)


def test_dot_is_exact_on_a_screen_of_odd_scale(playwright, chromium_path, make_panel, screenshot):
    """No emulation: the browser itself runs at 1.25, in a window that isn't a whole number of CSS pixels."""
    panel = make_panel()
    arguments = [*ARGUMENTS, "--force-device-scale-factor=1.25", "--window-size=535,411"]
    browser = playwright.chromium.launch(executable_path=chromium_path, args=arguments)
    try:
        page = browser.new_context(no_viewport=True).new_page()
        page.goto(panel.urls()[0])
        ack = panel.show(Pattern("dot", size_px=1, x_px=31, y_px=-12))
        assert ack.device_pixel_ratio == 1.25
        # The window has 672 device pixels; innerWidth rounds them to 538 CSS pixels, which would make 673.
        assert ack.width_px == round(1.25 * page.evaluate("visualViewport.width"))
        assert_disc(screenshot(page)[: ack.height_px, : ack.width_px], 31, -12, 1)
        panel.show(Pattern("picture", picture="chart"))
        shown = screenshot(page)[: ack.height_px, : ack.width_px, 0]
        np.testing.assert_array_equal(shown, chart(ack.width_px, ack.height_px))
    finally:
        browser.close()


def test_grid_shows_every_dot(make_panel, open_page, screenshot):
    panel = make_panel()
    page = open_page(panel.urls()[0], device_scale_factor=2)
    points = tuple((x, y) for y in (-300, 0, 300) for x in (-500, -250, 0, 250, 500))
    ack = panel.show(Pattern("grid", size_px=3, points_px=points))
    image = screenshot(page)
    count, _, stats, middles = cv2.connectedComponentsWithStats((image.max(axis=2) > 0).astype(np.uint8))
    assert count - 1 == len(points)
    assert np.all(stats[1:, cv2.CC_STAT_AREA] == 9)
    found = middles[1:] + 0.5 - (ack.width_px / 2, ack.height_px / 2)
    assert np.abs(found - points).max() <= 0.5


def test_black_white_colour_and_brightness(make_panel, open_page, screenshot):
    panel = make_panel()
    page = open_page(panel.urls()[0])
    for pattern, value in (
        (Pattern("white"), (255, 255, 255)),
        (Pattern("black"), (0, 0, 0)),
        (Pattern("white", brightness=0.5, colour="#ff8000"), (188, 92, 0)),
    ):
        panel.show(pattern)
        assert np.all(screenshot(page) == value)


def test_crosshair_marks_the_centre_and_every_edge(make_panel, open_page, screenshot):
    panel = make_panel()
    page = open_page(panel.urls()[0], viewport={"width": 641, "height": 401})
    panel.show(Pattern("crosshair"))
    lit = screenshot(page).min(axis=2) == 255
    assert lit[200, 320]
    assert lit[200, [0, 640]].all()
    assert lit[[0, 400], 320].all()
    np.testing.assert_array_equal(lit, lit[:, ::-1])
    np.testing.assert_array_equal(lit, lit[::-1, :])


def test_built_in_chart_is_shown_pixel_for_pixel(make_panel, open_page, screenshot):
    panel = make_panel()
    page = open_page(panel.urls()[0], device_scale_factor=1.5)
    ack = panel.show(Pattern("picture", picture="chart"))
    np.testing.assert_array_equal(screenshot(page)[:, :, 0], chart(ack.width_px, ack.height_px))


def test_picture_file_is_shown_in_the_middle_and_shrunk_only_if_it_must(make_panel, open_page, screenshot, tmp_path):
    panel = make_panel()
    page = open_page(panel.urls()[0])
    noise = np.random.default_rng(1).integers(1, 256, (100, 200, 3), dtype=np.uint8)
    small, large = str(tmp_path / "small.png"), str(tmp_path / "large.png")
    cv2.imwrite(small, noise[:, :, ::-1])
    cv2.imwrite(large, np.full((1000, 1000, 3), 255, dtype=np.uint8))
    panel.show(Pattern("picture", picture=small))
    image = screenshot(page)
    np.testing.assert_array_equal(image[150:250, 220:420], noise)
    assert image.astype(int).sum() == noise.astype(int).sum()
    panel.show(Pattern("picture", picture=large))
    assert screenshot(page)[:, 120:520].min() == 255


def test_full_screen_is_asked_for_and_one_tap_gives_it(make_panel, open_page, screenshot):
    panel = make_panel(require_fullscreen=True, ack_timeout_s=0.5)
    page = open_page(panel.urls()[0])
    with pytest.raises(NotAcknowledgedError, match="isn't full screen: tap it once"):
        panel.show(Pattern("dot"))
    assert page.get_by_text("Tap for full screen").is_visible()
    page.mouse.click(300, 200)
    assert panel.wait_ready(5).page.fullscreen
    assert panel.show(Pattern("dot", size_px=5)).fullscreen
    assert_disc(screenshot(page), 0, 0, 5)
    assert not page.locator("#card").is_visible()
    assert page.evaluate("getComputedStyle(document.getElementById('panel')).cursor") == "none"


def test_pattern_survives_a_change_of_size(make_panel, open_page, screenshot, expect):
    panel = make_panel()
    page = open_page(panel.urls()[0])
    panel.show(Pattern("dot", size_px=3, x_px=50))
    page.set_viewport_size({"width": 501, "height": 301})
    expect(page.locator("#panel")).to_have_js_property("width", 501)
    assert_disc(screenshot(page), 50, 0, 3)
    deadline = time.monotonic() + 5
    while panel.status().page.width_px != 501 and time.monotonic() < deadline:
        time.sleep(0.02)
    assert panel.status().page.width_px == 501
    with pytest.raises(NotAcknowledgedError, match="changed its size during the exposure"):
        panel.check_shown()


def test_page_comes_back_after_the_workbench_was_restarted(make_panel, open_page, screenshot):
    first = make_panel()
    page = open_page(first.urls()[0], quiet=False)
    first.show(Pattern("dot", size_px=3))
    port = int(first.urls()[0].split(":")[2].split("/")[0])
    first.close()
    time.sleep(0.3)
    # The loss alone puts no light on the panel.
    assert_disc(screenshot(page), 0, 0, 3)
    second = make_panel(port=port)
    second.show(Pattern("dot", size_px=5, x_px=20))
    assert_disc(screenshot(page), 20, 0, 5)


def test_wrong_token_is_refused_and_an_outdated_page_says_so(make_panel, open_page):
    panel = make_panel(token="first-token")
    page = open_page(panel.urls()[0], quiet=False)
    panel.wait_ready(5)
    port = int(panel.urls()[0].split(":")[2].split("/")[0])
    panel.close()
    panel = make_panel(port=port, token="second-token")
    page.get_by_text("scan the code in its terminal again").wait_for(timeout=10_000)
    assert page.goto(panel.urls()[0].replace("second", "third")).status == 403
    assert not panel.status().connected


def test_displaced_page_stays_away_until_it_is_tapped(make_panel, open_page):
    panel = make_panel()
    first = open_page(panel.urls()[0])
    panel.wait_ready(5)
    second = open_page(panel.urls()[0])
    first.get_by_text("Another page has taken over").wait_for(timeout=5000)
    panel.show(Pattern("white"))
    assert not second.locator("#card").is_visible()
    assert first.locator("#card").is_visible()
    first.mouse.click(300, 200)
    second.get_by_text("Another page has taken over").wait_for(timeout=5000)
    panel.show(Pattern("black"))
    assert not first.locator("#card").is_visible()


@pytest.mark.parametrize(("script", "expected"), [("", "lock"), ("delete Navigator.prototype.wakeLock", "video")])
def test_screen_is_kept_awake(make_panel, open_page, screenshot, script, expected):
    panel = make_panel()
    page = open_page(panel.urls()[0], script=script)
    panel.show(Pattern("white"))
    page.mouse.click(300, 200)
    deadline = time.monotonic() + 5
    while panel.status().page.wake_lock != expected and time.monotonic() < deadline:
        time.sleep(0.02)
    assert panel.status().page.wake_lock == expected
    panel.show(Pattern("black"))
    assert screenshot(page).max() == 0


def test_hidden_page_paints_nothing_and_nothing_is_counted(chromium_path, make_panel, tmp_path):
    """Tabs of a browser of our own: Playwright keeps every page visible."""
    panel = make_panel(ack_timeout_s=0.5)
    command = [chromium_path, "--headless=new", "--remote-debugging-port=0", f"--user-data-dir={tmp_path}", *ARGUMENTS]
    chromium = subprocess.Popen([*command, panel.urls()[0]], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        panel.wait_ready(30)
        panel.show(Pattern("dot"))
        port = Path(tmp_path, "DevToolsActivePort").read_text(encoding="ascii").split()[0]
        tabs = httpx.get(f"http://127.0.0.1:{port}/json/list").json()
        ours = next(tab["id"] for tab in tabs if tab["url"] == panel.urls()[0])
        assert httpx.put(f"http://127.0.0.1:{port}/json/new?about:blank").is_success
        with pytest.raises(NotAcknowledgedError, match="the page is hidden"):
            panel.show(Pattern("dot", x_px=9))
        assert not panel.status().page.visible
        with pytest.raises(NotAcknowledgedError, match="to the end of the exposure: the page is hidden"):
            panel.check_shown()
        assert httpx.get(f"http://127.0.0.1:{port}/json/activate/{ours}").is_success
        panel.wait_ready(5)
        panel.show(Pattern("dot", x_px=9))
        panel.check_shown()
    finally:
        chromium.terminate()
        chromium.wait(10)
