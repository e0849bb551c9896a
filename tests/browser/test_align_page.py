"""The align page in a real browser: pushed samples appear, old ones are called old, presses arrive."""

from __future__ import annotations

import threading

import cv2
import numpy as np
import pytest

from rigs.align_feed import AlignFeed, AlignSample
from rigs.align_server import AlignServer, AlignSettings
from rigs.errors import PanelError

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]


@pytest.fixture
def feed():
    return AlignFeed()


@pytest.fixture
def served(feed):
    pressed = threading.Event()

    def refuse() -> None:
        raise PanelError("panel: no page is connected")

    server = AlignServer(AlignSettings(port=0), feed, {"Dot": pressed.set, "Cross-hair": refuse})
    yield server, pressed
    server.close()


def sample(**changes) -> AlignSample:
    values = {
        "frame_width_px": 1001, "frame_height_px": 801, "centroid_px": (503.0, 396.0), "peak": 0.62, "width_px": 4.25,
        "exposure_s": 1 / 60, "iso": 100,
    }  # fmt: skip
    return AlignSample(**{**values, **changes})


def texts(page) -> dict[str, str]:
    ids = ("offset", "peak", "width", "saturated")
    return {i: page.locator(f"#{i} b").inner_text() for i in ids} | {"headline": page.locator("#headline").inner_text()}


def test_pushed_samples_appear(served, feed, open_page, screenshot):
    server, _ = served
    page = open_page(server.urls()[0], viewport={"width": 1280, "height": 800})
    assert page.locator("#headline").inner_text() == "Waiting for the first frame"
    green = np.zeros((80, 100, 3), dtype=np.uint8)
    green[:, :, 1] = 200
    feed.push(sample(image=cv2.imencode(".png", green)[1].tobytes(), crop_px=(453, 356, 100, 80)))
    page.get_by_text("Centred within 20 px").wait_for(timeout=5000)
    assert texts(page) == {
        "offset": "5.0",
        "peak": "62",
        "width": "4.3",
        "saturated": "0",
        "headline": "Centred within 20 px",
    }
    assert "1/60 s, ISO 100" in page.locator("#peak").inner_text()
    page.wait_for_timeout(200)
    box = page.locator("#image").bounding_box()
    inside = screenshot(page)[
        int(box["y"]) : int(box["y"] + box["height"]), int(box["x"]) : int(box["x"] + box["width"])
    ]
    assert np.mean(np.all(inside == (0, 200, 0), axis=2)) > 0.4
    feed.push(sample(saturated_px=214, peak=1.0))
    page.get_by_text("Saturated: shorten the exposure").wait_for(timeout=5000)
    assert page.locator("#verdict").get_attribute("class") == "bad"
    assert texts(page)["saturated"] == "214"
    feed.push(sample(centroid_px=None, width_px=None))
    page.get_by_text("No point").first.wait_for(timeout=5000)
    assert texts(page)["offset"] == "–"


def test_page_opened_late_shows_the_newest_sample_at_once(served, feed, open_page):
    for width in (9.0, 5.0, 7.0):
        feed.push(sample(width_px=width))
    page = open_page(served[0].urls()[0])
    page.get_by_text("narrowest 5.0").wait_for(timeout=5000)
    assert texts(page)["width"] == "7.0"
    page.get_by_role("button", name="Forget narrowest").click()
    feed.push(sample(width_px=7.0))
    page.get_by_text("narrowest 7.0").wait_for(timeout=5000)


def test_frame_that_failed_shows_why_and_keeps_the_picture(served, feed, open_page):
    page = open_page(served[0].urls()[0])
    feed.push(sample(panel_mm_per_px=0.5, centroid_px=(900.0, 396.0)))
    page.get_by_text("200 mm on the panel").first.wait_for(timeout=5000)
    feed.push(AlignSample(1001, 801, note="camera: did not release", failed=True))
    page.get_by_text("No frame · camera: did not release").wait_for(timeout=5000)
    assert texts(page)["headline"] == "No frame: camera: did not release"


def test_trouble_of_many_words_stays_within_its_place(served, feed, open_page):
    page = open_page(served[0].urls()[0], viewport={"width": 1280, "height": 800})
    feed.push(AlignSample(1001, 801, note="camera: " + 6 * "something long is wrong; do this and that ", failed=True))
    page.locator("#headline.long").wait_for(timeout=5000)
    headline, verdict = (page.locator(name).bounding_box() for name in ("#headline", "#verdict"))
    assert headline["y"] >= verdict["y"]
    assert headline["y"] + headline["height"] <= verdict["y"] + verdict["height"]


def test_pattern_without_a_point_is_no_trouble(served, feed, open_page):
    page = open_page(served[0].urls()[0])
    feed.push(sample(centroid_px=None, width_px=None, task="cross-hair: turn the camera"))
    page.locator("#verdict.info").wait_for(timeout=5000)
    assert texts(page)["headline"] == "Cross-hair: turn the camera"
    assert page.locator("#others").inner_text() == "Press Dot to measure"


def test_what_the_panel_shows_is_marked_from_the_beginning(feed, open_page):
    server = AlignServer(AlignSettings(port=0), feed, {"Dot": lambda: None, "White": lambda: None}, active="White")
    try:
        page = open_page(server.urls()[0])
        page.locator("button[aria-pressed=true]", has_text="White").wait_for(timeout=5000)
    finally:
        server.close()


def test_old_numbers_are_called_old(served, feed, open_page):
    feed.push(sample())
    page = open_page(served[0].urls()[0])
    page.get_by_text("no new frame for").wait_for(timeout=9000)
    assert page.locator("body").get_attribute("class") == "stale"
    feed.push(sample())
    page.get_by_text("live", exact=True).wait_for(timeout=5000)


def test_press_reaches_the_rig_and_its_trouble_the_operator(served, open_page):
    server, pressed = served
    page = open_page(server.urls()[0])
    page.get_by_role("button", name="Dot").click()
    assert pressed.wait(5)
    page.locator("button[aria-pressed=true]", has_text="Dot").wait_for(timeout=5000)
    page.get_by_role("button", name="Cross-hair").click()
    page.get_by_text("panel: no page is connected").wait_for(timeout=5000)
    assert page.locator("button[aria-pressed=true]").inner_text() == "Dot"


def test_page_says_when_the_workbench_is_gone(served, feed, open_page):
    server, _ = served
    feed.push(sample())
    page = open_page(server.urls()[0], quiet=False)
    page.get_by_text("live", exact=True).wait_for(timeout=5000)
    server.close()
    page.get_by_text("no connection to the workbench", exact=True).wait_for(timeout=5000)
    assert texts(page)["headline"] == "No connection to the workbench"


def test_long_exposure_is_not_called_old_before_its_time(served, feed, open_page):
    feed.push(sample(exposure_s=30.0))
    page = open_page(served[0].urls()[0])
    page.get_by_text("live", exact=True).wait_for(timeout=5000)
    page.wait_for_timeout(6000)
    assert page.locator("#live").inner_text() == "live"


def test_what_a_device_says_stands_on_the_page_until_a_frame_comes(served, feed, open_page, expect):
    feed.push(sample())
    page = open_page(served[0].urls()[0])
    feed.tell("camera: frozen; SWITCH THE CAMERA OFF AND ON NOW")
    page.get_by_text("SWITCH THE CAMERA OFF AND ON NOW").wait_for(timeout=5000)
    feed.push(sample(failed=True, note="camera: no image arrived"))
    page.get_by_text("No frame: camera").wait_for(timeout=5000)
    assert "SWITCH" in page.locator("#trouble").inner_text()
    feed.push(sample())
    # not wait_for_function: where it has to wait it evaluates a string, which the page's policy forbids
    expect(page.locator("#trouble")).to_have_text("", timeout=5000)
