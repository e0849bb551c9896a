"""Chromium through Playwright; without either, these tests skip and say so."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from rigs.browser_panel import BrowserPanel, BrowserPanelSettings

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip


@pytest.fixture(scope="session")
def expect() -> Any:
    """Playwright's assertions, which wait for what they assert."""
    return pytest.importorskip("playwright.sync_api").expect


@pytest.fixture(scope="session")
def chromium_path() -> str:
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine (Debian: apt install chromium)")
    return CHROMIUM


@pytest.fixture(scope="session")
def playwright() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="playwright isn't installed (pip install playwright)")
    with api.sync_playwright() as started:
        yield started


@pytest.fixture(scope="session")
def browser(playwright: Any, chromium_path: str) -> Iterator[Any]:
    launched = playwright.chromium.launch(executable_path=chromium_path, args=ARGUMENTS)
    yield launched
    launched.close()


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens a page in a fresh profile; fails the test if it complained or fetched anything from elsewhere."""
    contexts, complaints = [], []

    def open_(url: str, *, script: str = "", quiet: bool = True, **options: Any) -> Any:
        context = browser.new_context(**{"viewport": {"width": 640, "height": 400}, **options})
        contexts.append(context)
        page = context.new_page()
        if script:
            page.add_init_script(script)
        if quiet:
            page.on("console", lambda message: complaints.append(message.text))
            page.on("pageerror", lambda error: complaints.append(str(error)))
        origin = "/".join(url.split("/")[:3])
        page.on("request", lambda r: None if r.url.startswith((origin, "blob:", "data:")) else complaints.append(r.url))
        page.goto(url)
        return page

    yield open_
    for context in contexts:
        context.close()
    assert complaints == []


@pytest.fixture
def make_panel() -> Iterator[Callable[..., BrowserPanel]]:
    made: list[BrowserPanel] = []

    def make(**changes: Any) -> BrowserPanel:
        settings = {"port": 0, "settle_s": 0.05, "ack_timeout_s": 10, "require_fullscreen": False, **changes}
        made.append(BrowserPanel(BrowserPanelSettings(**settings)))
        return made[-1]

    yield make
    for panel in made:
        panel.close()


@pytest.fixture(scope="session")
def screenshot() -> Callable[[Any], np.ndarray]:
    """The page as (height, width, 3) RGB, one element per device pixel."""

    def take(page: Any) -> np.ndarray:
        encoded = np.frombuffer(page.screenshot(scale="device"), dtype=np.uint8)
        return cv2.cvtColor(cv2.imdecode(encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)

    return take
