"""The workbench's own small web server: one ASGI application on one address, in a thread of its own."""

from __future__ import annotations

import asyncio
import errno
import secrets
import socket
import threading
import time
from contextlib import suppress
from io import StringIO
from urllib.parse import urlsplit

import segno
import uvicorn
from starlette.types import ASGIApp

from rigs.errors import ConfigError, DeviceBusyError, RigError
from rigs.web_access import AccessControl, is_loopback

_SHORTEST_TOKEN = 8
_START_TIMEOUT_S = 10.0
_STOP_TIMEOUT_S = 5.0


def effective_token(section: str, host: str, token: str) -> str:
    """The token that guards an address: the configured one, or a fresh one where the network can reach it.

    Raises
    ------
    ConfigError
        The configured token is too short to guard anything or has characters that a URL can't carry.
    """
    if not token:
        return "" if is_loopback(host) else secrets.token_urlsafe(16)
    if len(token) < _SHORTEST_TOKEN or not all(c.isascii() and (c.isalnum() or c in "-_") for c in token):
        raise ConfigError(
            f"{section}.token: needs at least {_SHORTEST_TOKEN} letters, digits, - or _; "
            "leave it empty to have one made"
        )
    return token


class WebServer:
    """Serves an application until closed; listens from construction on.

    Parameters
    ----------
    name
        What is served, as error messages begin.
    application
        What is served, behind token, Origin and Host checks (:class:`rigs.web_access.AccessControl`).
    host, port
        Address; port 0 takes a free one.
    token
        Guards the address; empty: none on loopback, a fresh random one elsewhere.
    section
        Section of rig.yaml that host and token come from; error messages name it.
    port_setting
        Where the operator sets the port.

    Raises
    ------
    DeviceBusyError
        Another program has the port.
    ConfigError
        The address isn't one of this computer's, or the token is unfit.
    """

    def __init__(
        self,
        name: str,
        application: ASGIApp,
        *,
        host: str,
        port: int,
        token: str,
        section: str = "panel",
        port_setting: str = "panel.port",
    ) -> None:
        self._host = host
        self.token = effective_token(section, host, token)
        self._socket = _listen(name, host, port, f"{section}.host", port_setting)
        self.port: int = self._socket.getsockname()[1]
        guarded = AccessControl(application, token=self.token, loopback_only=is_loopback(host))
        self._server = uvicorn.Server(
            uvicorn.Config(
                guarded,
                log_config=None,
                log_level="error",
                access_log=False,
                server_header=False,
                lifespan="off",
                loop="asyncio",
                ws="websockets-sansio",
                # The pages beat at their own level: a script can't see pings.
                ws_ping_interval=None,
                ws_max_size=1 << 16,
                timeout_graceful_shutdown=1,
            )
        )
        self._thread = threading.Thread(target=self._serve, name=f"{name} web server", daemon=True)
        self._thread.start()
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > deadline:
                self.close()
                raise RigError(f"{name}: the web server on {host}:{self.port} didn't start; try another {port_setting}")
            time.sleep(0.005)

    def _serve(self) -> None:
        asyncio.run(self._server.serve(sockets=[self._socket]))

    def urls(self, path: str) -> tuple[str, ...]:
        """Addresses of a page, best first; the token is part of them."""
        query = f"?token={self.token}" if self.token else ""
        return tuple(f"http://{_bracketed(host)}:{self.port}/{path}{query}" for host in _reachable_at(self._host))

    def close(self) -> None:
        """Stop serving and free the port; safe to call twice."""
        self._server.should_exit = True
        if self._thread is not threading.current_thread():
            self._thread.join(_STOP_TIMEOUT_S)
        self._socket.close()


def invitation(name: str, url: str, then: str) -> str:
    """What the operator needs to open a page: its address, and a code to scan where another device can reach it.

    Parameters
    ----------
    name, url
        Whose page it is, and where.
    then
        What to do next, e.g. ``; Ctrl-C ends``.
    """
    if is_loopback(urlsplit(url).hostname or ""):
        return f"{name}: open {url} in a browser on this computer{then}"
    return f"{qr_text(url)}\n{name}: open {url} (the code above holds it){then}"


def qr_text(url: str) -> str:
    """QR code of a URL as lines of block characters, for a terminal of either background."""
    text = StringIO()
    segno.make(url, micro=False, error="l").terminal(out=text, compact=True, border=2)
    return text.getvalue()


def _listen(name: str, host: str, port: int, host_setting: str, port_setting: str) -> socket.socket:
    address = f"{host}:{port}"
    try:
        family, kind, protocol, _, target = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
    except OSError as error:
        raise ConfigError(
            f"{host_setting}: {host!r} is no address of this computer ({error.strerror}); "
            "use 127.0.0.1, or 0.0.0.0 for the network"
        ) from None
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(target)
        listener.listen(64)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise DeviceBusyError(
                f"{name}: {address} is taken by another program (another workbench?); end it or set {port_setting}"
            ) from None
        if error.errno == errno.EACCES:
            raise ConfigError(f"{port_setting}: {port} needs administrator rights; choose one above 1023") from None
        raise ConfigError(f"{host_setting}: can't listen on {address} ({error.strerror}); see `ip address`") from None
    return listener


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _reachable_at(host: str) -> tuple[str, ...]:
    """Addresses to type for a listening address; the wildcard stands for every interface of this computer."""
    if host not in ("0.0.0.0", "::"):
        return (host,)
    found: list[str] = []
    # Connecting a datagram socket sends nothing; it only asks which interface faces the network.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect(("192.0.2.1", 9))
        found.append(probe.getsockname()[0])
    with suppress(OSError):
        found += [str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)]
    outside = [address for address in dict.fromkeys(found) if not is_loopback(address)]
    return (*outside, "127.0.0.1")
