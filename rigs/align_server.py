"""The align page: what the camera sees of the point, live, in numbers that can be read from across the lab.

Measured values come from outside through an :class:`rigs.align_feed.AlignFeed`; what the page's buttons do is given
from outside as well.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from rigs.align_feed import AlignFeed
from rigs.errors import RigError
from rigs.web_pages import asset, page_response
from rigs.web_server import WebServer, invitation

_log = logging.getLogger(__name__)
_BEAT_S = 1.0


class _Press(BaseModel):
    """What the page sends."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    type: Literal["action", "forget"]
    name: str = ""


_PRESS = TypeAdapter(_Press)


@dataclass(frozen=True, slots=True)
class AlignSettings:
    """Where the align page is served; see :class:`rigs.browser_panel.BrowserPanelSettings` for host and token."""

    host: str = "127.0.0.1"
    port: int = 8651
    token: str = ""


class AlignServer:
    """Serves the align page of one feed until closed.

    Parameters
    ----------
    settings, feed
        Where to serve, and what.
    actions
        Buttons: label -> what a press does, called in a thread of its own, one press at a time. A
        :class:`~rigs.errors.RigError` is shown on the page.
    active
        Label of what holds from the beginning.

    Raises
    ------
    DeviceBusyError
        The port is taken.
    ConfigError
        Host, port or token can't be used.
    """

    def __init__(
        self,
        settings: AlignSettings,
        feed: AlignFeed,
        actions: Mapping[str, Callable[[], None]] = MappingProxyType({}),
        active: str = "",
    ) -> None:
        self._feed, self._actions = feed, dict(actions)
        self._pressing = threading.Lock()
        self._active = active
        application = Starlette(
            routes=[
                Route("/", self._page),
                Route("/align", self._page),
                Route("/align/{name:str}", asset),
                WebSocketRoute("/align/socket", self._serve),
            ]
        )
        self._server = WebServer(
            "align", application, host=settings.host, port=settings.port, token=settings.token, port_setting="--port"
        )

    def urls(self) -> tuple[str, ...]:
        """Addresses of the page, best first, with the token where there is one."""
        return self._server.urls("align")

    def invitation(self) -> str:
        """What the operator needs to open the page: its address, and a code where another device can reach it."""
        return invitation("align", self.urls()[0], "; Ctrl-C ends")

    def close(self) -> None:
        """Stop serving and free the port; safe to call twice."""
        self._server.close()

    async def _page(self, request: Request) -> Response:
        return page_response("align.html", request)

    async def _serve(self, socket: WebSocket) -> None:
        await socket.accept()
        news = asyncio.Event()
        stop = self._feed.listen(asyncio.get_running_loop(), news)
        sender = asyncio.create_task(self._send(socket, news))
        try:
            while True:
                await self._press(socket, await socket.receive_text())
        except (WebSocketDisconnect, KeyError):
            pass
        finally:
            stop()
            sender.cancel()
            with suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sender

    async def _send(self, socket: WebSocket, news: asyncio.Event) -> None:
        hello = {"type": "hello", "actions": list(self._actions), "active": self._active}
        await socket.send_json({**hello, "history": self._feed.history()})
        shown, image = 0, b""
        while True:
            news.clear()
            latest = self._feed.latest()
            # A slow page misses samples, never the newest.
            if latest is not None and latest.number != shown:
                shown = latest.number
                age_s = time.monotonic() - latest.at_s
                await socket.send_json({**latest.text, "age_s": age_s, "news": self._feed.news()})
                if latest.image is not image:
                    image = latest.image
                    await socket.send_bytes(image)
            else:
                await socket.send_json({"type": "beat", "active": self._active, "news": self._feed.news()})
            with suppress(TimeoutError):
                await asyncio.wait_for(news.wait(), _BEAT_S)

    async def _press(self, socket: WebSocket, text: str) -> None:
        try:
            press = _PRESS.validate_json(text)
        except ValidationError:
            return
        if press.type == "forget":
            self._feed.forget_narrowest()
            return
        if press.name not in self._actions:
            return
        trouble = await run_in_threadpool(self._act, press.name)
        await socket.send_json({"type": "action", "name": press.name, "active": self._active, "trouble": trouble})

    def _act(self, name: str) -> str:
        with self._pressing:
            try:
                self._actions[name]()
            except RigError as error:
                return str(error)
            except Exception:
                # A page must not die of what a button does; the terminal gets the whole story.
                _log.exception("align: %r failed", name)
                return f"{name} failed; the terminal says why"
            self._active = name
            return ""
