"""A panel's page without a browser: connects when the workbench serves, reports itself, paints what it is shown."""

from __future__ import annotations

import json
import threading
import time
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect


class PanelPage:
    """Runs in a thread from entry to exit of its block, and comes back when a server goes."""

    def __init__(self, port: int, *, token: str = "", paints: bool = True, **state: Any) -> None:
        query = f"?token={token}" if token else ""
        self._url = f"ws://127.0.0.1:{port}/panel/socket{query}"
        self._paints, self._running = paints, False
        self.state = {
            "width_px": 1280, "height_px": 800, "device_pixel_ratio": 2.0, "fullscreen": True, "visible": True,
            "zoom": 1.0, "wake_lock": "lock", **state,
        }  # fmt: skip
        self.shown: list[dict[str, Any]] = []
        """Patterns in the order in which they were asked for."""
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> PanelPage:
        self._running = True
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._running = False
        self._thread.join(10)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        while self._running:
            try:
                with connect(self._url, open_timeout=5, user_agent_header="Mozilla/5.0 Firefox/128.0") as socket:
                    self._serve(socket)
            except (OSError, ConnectionClosed):
                time.sleep(0.05)

    def _serve(self, socket: Any) -> None:
        while self._running:
            try:
                message = json.loads(socket.recv(timeout=0.1))
            except TimeoutError:
                continue
            if message["type"] == "show":
                self.shown.append(message["pattern"])
                if self._paints:
                    answer = {"type": "painted", "sequence": message["sequence"], "state": self.state}
                    socket.send(json.dumps(answer))
            else:
                socket.send(json.dumps({"type": "state", "state": self.state}))
