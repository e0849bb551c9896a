"""A tablet and the one who holds it: opens the panel's page in Chromium, taps it once, and looks at its screen."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigs.protocols import Pattern

VIEWPORT = {"width": 640, "height": 400}
PIXEL_RATIO = 2
_LIT = 40
"""A screen value above this is part of a pattern."""


class Tablet:
    """Runs in a thread of its own from entry to exit of its block, as Playwright's pages belong to one thread.

    Parameters
    ----------
    url
        Address of the panel's page; it is tried until somebody serves it.
    chromium, arguments
        The browser.
    """

    def __init__(self, url: str, chromium: str, arguments: list[str]) -> None:
        self._url, self._chromium, self._arguments = url, chromium, arguments
        self._wishes: queue.Queue[Callable[[Any], Any] | None] = queue.Queue()
        self._answers: queue.Queue[Any] = queue.Queue()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._leaving = False

    def __enter__(self) -> Tablet:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._leaving = True
        self._wishes.put(None)
        self._thread.join(30)
        assert not self._thread.is_alive()

    def pattern(self) -> Pattern:
        """What the screen shows now, told from a screenshot: black, or one dot."""
        return seen_pattern(self.screenshot())

    def screenshot(self) -> NDArray[np.uint8]:
        """The page as (height, width, 3) RGB, one element per device pixel."""
        self._wishes.put(lambda page: page.screenshot(scale="device"))
        answer = self._answers.get(timeout=30)
        if isinstance(answer, Exception):
            raise answer
        decoded = cv2.imdecode(np.frombuffer(answer, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        return np.asarray(decoded[:, :, ::-1], np.uint8)

    def _run(self) -> None:
        from playwright.sync_api import Error, sync_playwright

        with sync_playwright() as api:
            browser = api.chromium.launch(executable_path=self._chromium, args=self._arguments)
            page = browser.new_context(viewport=VIEWPORT, device_scale_factor=PIXEL_RATIO).new_page()
            while not self._leaving:
                try:
                    page.goto(self._url)
                    page.mouse.click(VIEWPORT["width"] / 2, VIEWPORT["height"] / 2)
                    break
                except Error:  # nobody serves it yet
                    time.sleep(0.1)
            while (wish := self._wishes.get()) is not None:
                try:
                    self._answers.put(wish(page))
                except Error as error:
                    self._answers.put(error)
            browser.close()


def seen_pattern(screen: NDArray[np.uint8]) -> Pattern:
    """The pattern on a screen (height, width, 3): black, or a dot where and as large as it is lit."""
    rows, columns = np.nonzero(screen.max(axis=2) > _LIT)
    if rows.size == 0:
        return Pattern("black")
    height, width = screen.shape[:2]
    across, down = np.ptp(columns) + 1, np.ptp(rows) + 1
    assert abs(int(across) - int(down)) <= 1, f"no dot: {across} x {down} px are lit"
    colour = screen[rows, columns].max(axis=0)
    return Pattern(
        "dot",
        size_px=float(across),
        colour=f"#{bytes(colour).hex()}",
        x_px=float(columns.min() + across / 2 - width / 2),
        y_px=float(rows.min() + down / 2 - height / 2),
    )
