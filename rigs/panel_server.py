"""The server side of the panel's page: one controlling page, numbered patterns, acknowledgements.

::

    show(sequence n) ──► page paints, waits two animation frames ──► painted(n) ──► counts if it comes from the
                                                                                    controlling page, n is the latest,
                                                                                    and the page is fit (see _unfit)
One page is in control: the newest connection. A tablet that comes back after a lost connection must never be locked
out by its own dead one. The page that was in control is told so and stays away until it is tapped; the operator
also reads it in :attr:`PanelStatus.notice`.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from rigs.errors import NotAcknowledgedError, PanelError
from rigs.panel_messages import FailedMessage, PageState, PaintedMessage, parse
from rigs.panel_patterns import Picture
from rigs.web_pages import asset, page_response

_log = logging.getLogger(__name__)
_TAKEN_OVER, _BAD_MESSAGE, _SILENT, _GOING_DOWN = 4001, 4002, 4003, 1001
_SILENT_BEATS = 4


@dataclass(frozen=True, slots=True)
class PanelStatus:
    """How the panel's page is doing; for the doctor and for error messages."""

    connected: bool
    address: str = ""
    user_agent: str = ""
    page: PageState | None = None
    """The page's last report; kept after the connection is lost."""
    last_heard_s: float | None = None
    """Seconds since the page's last message; None: never."""
    notice: str = ""
    """The last change of control or loss of connection, as a line for the operator."""
    problem: str = ""
    """Why a pattern would not be acknowledged now, with the way out; empty: ready."""


@dataclass(eq=False)
class _Page:
    """One connection."""

    socket: WebSocket
    loop: asyncio.AbstractEventLoop
    news: asyncio.Event = field(default_factory=asyncio.Event)


@dataclass(frozen=True, slots=True)
class _Request:
    sequence: int
    drawing: dict[str, Any]
    picture: Picture | None


class PageLink:
    """The controlling page and what it was last asked to show. Methods not marked otherwise suit any thread."""

    def __init__(self, *, require_fullscreen: bool, heartbeat_s: float, hint: str) -> None:
        self._require_fullscreen, self._heartbeat_s, self._hint = require_fullscreen, heartbeat_s, hint
        self._changed = threading.Condition()
        self._page: _Page | None = None
        self._address = self._user_agent = self._notice = ""
        self._state: PageState | None = None
        self._heard: float | None = None
        self._request: _Request | None = None
        self._painted: PageState | None = None
        self._failure = ""
        self._closed = False

    def request(self, drawing: dict[str, Any], picture: Picture | None) -> int:
        """Ask the page to paint; returns the request's sequence number. Acknowledgements of older ones are void."""
        with self._changed:
            sequence = 1 if self._request is None else self._request.sequence + 1
            self._request = _Request(sequence, drawing, picture)
            self._painted, self._failure = None, ""
            page = self._page
        if page is not None:
            _wake(page)
        return sequence

    def wait_painted(self, sequence: int, timeout_s: float) -> PageState:
        """Wait for the acknowledgement of a request.

        Raises
        ------
        NotAcknowledgedError
            It didn't come in time; says why and what to do.
        PanelError
            The page can't draw the pattern, or the panel was closed.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while True:
                if self._closed:
                    raise PanelError("panel: closed while a pattern was being shown")
                assert self._request is not None
                if self._request.sequence != sequence:
                    raise NotAcknowledgedError("panel: another pattern was asked for before this one was painted")
                if self._failure:
                    raise PanelError(f"panel: the page can't show the pattern ({self._failure}); reload the page")
                if self._painted is not None and not self._unfit(self._painted):
                    return self._painted
                left = deadline - time.monotonic()
                if left <= 0:
                    why = self._problem() or (
                        f"the page at {self._address} doesn't confirm: reload it; if the network is slow, raise "
                        "panel.ack_timeout in rig.yaml"
                    )
                    raise NotAcknowledgedError(f"panel: nothing painted within {timeout_s:g} s: {why}")
                self._changed.wait(left)

    def still_painted(self) -> PageState:
        """What the page says of itself now.

        Raises
        ------
        NotAcknowledgedError
            What it has acknowledged may not be seen any more: it is lost, hidden, or another one came.
        """
        with self._changed:
            problem = self._problem()
            if not problem and self._painted is None:
                problem = f"{self._notice}: leave one page open, and lock the tablet's rotation"
            if problem or self._state is None:
                raise NotAcknowledgedError(f"panel: not seen to the end of the exposure: {problem}")
            return self._state

    def wait_ready(self, timeout_s: float) -> PanelStatus:
        """Wait until a page is connected, visible and (where required) full screen.

        Raises
        ------
        NotAcknowledgedError
            No such page in time; says what is missing.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or not self._problem(), timeout_s):
                raise NotAcknowledgedError(f"panel: not ready after {timeout_s:g} s: {self._problem()}")
            return self._status()

    def status(self) -> PanelStatus:
        """How the page is doing now."""
        with self._changed:
            return self._status()

    def close(self) -> None:
        """Release whoever waits."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            page = self._page
        if page is not None:
            _wake(page)

    def picture(self, sequence: int) -> Picture | None:
        """The picture of the latest request, if it has this number."""
        with self._changed:
            request = self._request
        return request.picture if request is not None and request.sequence == sequence else None

    async def serve(self, socket: WebSocket) -> None:
        """Talk to one page until it goes (event loop only)."""
        await socket.accept()
        page = _Page(socket, asyncio.get_running_loop())
        await self._take_control(page)
        sender = asyncio.create_task(self._send(page))
        try:
            await self._listen(page)
        except (WebSocketDisconnect, TimeoutError) as error:
            self._lose(page, "is silent" if isinstance(error, TimeoutError) else "went")
            await _shut(socket, _SILENT, "silent for too long")
        finally:
            sender.cancel()
            with suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sender

    async def _take_control(self, page: _Page) -> None:
        address = page.socket.client.host if page.socket.client is not None else "unknown address"
        with self._changed:
            before, former = self._page, self._address
            self._page, self._address = page, address
            self._user_agent = page.socket.headers.get("user-agent", "")
            self._state, self._heard = None, time.monotonic()
            # What an earlier page has painted isn't on this one.
            self._painted, self._failure = None, ""
            self._notice = f"page at {address} connected"
            if before is not None:
                self._notice = f"page at {address} took over from the page at {former}"
            _log.info("panel: %s", self._notice)
            self._changed.notify_all()
        if before is not None:
            await _shut(before.socket, _TAKEN_OVER, "another page took over")

    async def _send(self, page: _Page) -> None:
        await page.socket.send_json({"type": "hello", "require_fullscreen": self._require_fullscreen})
        sent = 0
        while True:
            page.news.clear()
            with self._changed:
                request, closed = self._request, self._closed
            if closed:
                await _shut(page.socket, _GOING_DOWN, "the workbench ends")
                return
            if request is not None and request.sequence != sent:
                sent = request.sequence
                await page.socket.send_json({"type": "show", "sequence": sent, "pattern": request.drawing})
            else:
                await page.socket.send_json({"type": "beat", "every_s": self._heartbeat_s})
            with suppress(TimeoutError):
                await asyncio.wait_for(page.news.wait(), self._heartbeat_s)

    async def _listen(self, page: _Page) -> None:
        while True:
            event = await asyncio.wait_for(page.socket.receive(), _SILENT_BEATS * self._heartbeat_s)
            if event["type"] == "websocket.disconnect":
                raise WebSocketDisconnect(event.get("code", 1005))
            message = parse(event.get("text") or "")
            if message is None:
                self._lose(page, "sent what no panel page sends (an old page? reload it)")
                await _shut(page.socket, _BAD_MESSAGE, "message not understood")
                return
            with self._changed:
                if self._page is not page:
                    return
                self._state, self._heard = message.state, time.monotonic()
                latest = self._request is not None and getattr(message, "sequence", None) == self._request.sequence
                if latest and isinstance(message, PaintedMessage):
                    self._painted = message.state
                elif latest and isinstance(message, FailedMessage):
                    self._failure = message.reason
                self._changed.notify_all()

    def _lose(self, page: _Page, how: str) -> None:
        with self._changed:
            if self._page is page:
                self._page, self._painted = None, None
                self._notice = f"page at {self._address} {how}"
                _log.info("panel: %s", self._notice)
                self._changed.notify_all()

    def _status(self) -> PanelStatus:
        silent = None if self._heard is None else time.monotonic() - self._heard
        return PanelStatus(
            connected=self._page is not None,
            address=self._address,
            user_agent=self._user_agent,
            page=self._state,
            last_heard_s=silent,
            notice=self._notice,
            problem=self._problem(),
        )

    def _problem(self) -> str:
        if self._page is None and self._heard is None:
            return f"no page is connected: {self._hint}"
        if self._page is None:
            ago = time.monotonic() - (self._heard or 0.0)
            return (
                f"the connection to the page at {self._address} is lost ({ago:.0f} s ago): wake the tablet and check "
                "its network, the page comes back by itself"
            )
        if self._state is None:
            return f"the page at {self._address} has only just connected: try again, or reload it"
        return self._unfit(self._state)

    def _unfit(self, state: PageState) -> str:
        """Why what this page paints isn't what the camera sees; empty: it is."""
        if not state.visible:
            return "the page is hidden (screen locked, or another window or tab in front): bring it to the front"
        if self._require_fullscreen and not state.fullscreen:
            return "the page isn't full screen: tap it once, or set panel.require_fullscreen: false in rig.yaml"
        if abs(state.zoom - 1.0) > 0.005:
            return f"the page is zoomed to {100 * state.zoom:.0f} %: pinch it back, or reload it"
        return ""


def panel_application(link: PageLink) -> Starlette:
    """The panel's page, its socket and its pictures as an ASGI application."""

    async def page(request: Request) -> Response:
        return page_response("panel.html", request)

    async def alive(_: Request) -> Response:
        return Response(status_code=204)

    async def picture(request: Request) -> Response:
        try:
            sequence, width, height = (int(request.query_params[key]) for key in ("sequence", "width", "height"))
        except (KeyError, ValueError):
            return Response(status_code=400)
        shown = link.picture(sequence)
        if shown is None:
            return Response(status_code=404)
        return Response(await run_in_threadpool(shown.png, width, height), media_type="image/png")

    return Starlette(
        routes=[
            Route("/", page),
            Route("/panel", page),
            Route("/panel/alive", alive),
            Route("/panel/picture", picture),
            Route("/panel/{name:str}", asset),
            WebSocketRoute("/panel/socket", link.serve),
        ]
    )


def _wake(page: _Page) -> None:
    # The loop may have ended with the server; then there is nobody to tell.
    with suppress(RuntimeError):
        page.loop.call_soon_threadsafe(page.news.set)


async def _shut(socket: WebSocket, code: int, reason: str) -> None:
    with suppress(RuntimeError, WebSocketDisconnect):
        await socket.close(code, reason)
