"""A panel page played by a plain WebSocket client: the bytes that a browser would send, at moments that we choose."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from rigs.browser_panel import BrowserPanel, BrowserPanelSettings


class FakePage:
    """Answers nothing by itself; tests say what it sends."""

    def __init__(self, url: str, **connect_options: Any) -> None:
        address = url.replace("http://", "ws://").replace("/panel", "/panel/socket", 1)
        self._stack = ExitStack()
        self.socket: ClientConnection = self._stack.enter_context(connect(address, open_timeout=5, **connect_options))
        self.state = {
            "width_px": 1280, "height_px": 800, "device_pixel_ratio": 1.5, "fullscreen": True, "visible": True,
            "zoom": 1.0, "wake_lock": "lock",
        }  # fmt: skip

    def next(self, kind: str) -> dict[str, Any]:
        """The next message of a kind; others before it are skipped."""
        while True:
            message = json.loads(self.socket.recv(timeout=5))
            if message["type"] == kind:
                return message

    def report(self, **changes: Any) -> None:
        self.state |= changes
        self.socket.send(json.dumps({"type": "state", "state": self.state}))

    def paint(self, sequence: int, **changes: Any) -> None:
        self.state |= changes
        self.socket.send(json.dumps({"type": "painted", "sequence": sequence, "state": self.state}))

    def fail(self, sequence: int, reason: str) -> None:
        self.socket.send(json.dumps({"type": "failed", "sequence": sequence, "reason": reason, "state": self.state}))

    def closing_code(self) -> int | None:
        """Read until the server closes; its code."""
        try:
            while True:
                self.socket.recv(timeout=5)
        except ConnectionClosed as closed:
            return closed.rcvd.code if closed.rcvd else None

    def close(self) -> None:
        self._stack.close()


class Background:
    """A call in a thread, and its outcome."""

    def __init__(self, call: Callable[[], Any]) -> None:
        self.value: Any = None
        self.error: BaseException | None = None

        def run() -> None:
            try:
                self.value = call()
            except BaseException as error:
                self.error = error

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def result(self) -> Any:
        self._thread.join(10)
        assert not self._thread.is_alive(), "still waiting"
        if self.error is not None:
            raise self.error
        return self.value


@pytest.fixture
def make_panel() -> Iterator[Callable[..., BrowserPanel]]:
    made: list[BrowserPanel] = []

    def make(**changes: Any) -> BrowserPanel:
        panel = BrowserPanel(BrowserPanelSettings(**{"port": 0, "settle_s": 0, "ack_timeout_s": 3, **changes}))
        made.append(panel)
        return panel

    yield make
    for panel in made:
        panel.close()


@pytest.fixture
def make_page() -> Iterator[Callable[..., FakePage]]:
    made: list[FakePage] = []

    def make(panel: BrowserPanel, *, url: str | None = None, **options: Any) -> FakePage:
        page = FakePage(url or panel.urls()[-1], **options)
        made.append(page)
        return page

    yield make
    for page in made:
        page.close()


@pytest.fixture
def background() -> Callable[[Callable[[], Any]], Background]:
    return Background
