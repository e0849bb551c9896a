"""Who may talk to the workbench's web server, and with what headers it answers."""

from __future__ import annotations

import ipaddress
import re
import secrets
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import HTMLResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_PLAIN_HOST = re.compile(r"[A-Za-z0-9.\-]+(:\d+)?|\[[0-9A-Fa-f:]+\](:\d+)?")

_REFUSAL = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="dark">
<title>Refused</title>
<h1>Refused</h1>
<p>{reason}</p>
</html>
"""
"""Dark without a style sheet: it may come up on a panel."""


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this computer only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class AccessControl:
    """ASGI middleware: refuses what lacks the token or comes from a foreign page, and forbids caching.

    - Token: ``?token=`` in the URL, compared in constant time; without it HTTP 403, for WebSockets too.
    - Origin, where a browser sends one, has to be the address itself: a foreign page in the same browser can't
      drive the panel.
    - On loopback without token the Host header has to name this computer: a foreign name that resolves to
      127.0.0.1 (DNS rebinding) is refused.
    """

    def __init__(self, application: ASGIApp, *, token: str, loopback_only: bool) -> None:
        self._application = application
        self._token = token.encode()
        self._loopback_only = loopback_only

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse or pass on."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if (reason := self._refusal(scope, host, headers.get("origin"))) is not None:
            await _refuse(scope, receive, send, reason)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                _guard(MutableHeaders(scope=message), host)
            await send(message)

        await self._application(scope, receive, send_guarded)

    def _refusal(self, scope: Scope, host: str, origin: str | None) -> str | None:
        if not _PLAIN_HOST.fullmatch(host):
            return "no proper Host header"
        if self._loopback_only and not is_loopback(urlsplit(f"//{host}").hostname or ""):
            return "this address is for the workbench's own computer only"
        if origin is not None and urlsplit(origin).netloc != host:
            return "the request comes from a page of another origin"
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if self._token and not secrets.compare_digest(given.encode(), self._token):
            return "wrong token: scan the code that the workbench prints, or copy its address again"
        return None


async def _refuse(scope: Scope, receive: Receive, send: Send, reason: str) -> None:
    if scope["type"] == "websocket":
        # Closing before accepting is answered as HTTP 403.
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": reason})
        return
    response = HTMLResponse(_REFUSAL.format(reason=reason), status_code=403)
    _guard(response.headers, "")
    await response(scope, receive, send)


def _guard(headers: MutableHeaders, host: str) -> None:
    # Old Safari doesn't count WebSockets of the same host as 'self'.
    sockets = f" ws://{host}" if host else ""
    headers["Content-Security-Policy"] = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
        f"connect-src 'self'{sockets}; media-src 'self' blob: mediastream:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    headers["Cache-Control"] = "no-store"
    headers["Referrer-Policy"] = "no-referrer"
    headers["X-Content-Type-Options"] = "nosniff"
    headers["Cross-Origin-Resource-Policy"] = "same-origin"
