"""A panel in any browser: tablet, phone, or a small computer with a monitor on the carriage."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from rigs.errors import ConfigError, NotAcknowledgedError, PanelError
from rigs.panel_patterns import Picture, drawing, outside
from rigs.panel_server import PageLink, PanelStatus, panel_application
from rigs.protocols import DeviceIdentity, PanelAck, Pattern
from rigs.web_server import WebServer, invitation

__all__ = ["BrowserPanel", "BrowserPanelSettings", "PanelStatus"]


@dataclass(frozen=True, slots=True)
class BrowserPanelSettings:
    """Where the panel's page is served, and when an acknowledgement counts."""

    host: str = "127.0.0.1"
    """Address to listen on. Loopback: this computer only. ``0.0.0.0``: every network, always with a token."""
    port: int = 8650
    """0 takes a free one."""
    token: str = ""
    """Part of the page's address; empty: none on loopback, a fresh random one otherwise."""
    ack_timeout_s: float = 5.0
    require_fullscreen: bool = True
    settle_s: float = 0.1
    """Waited after the acknowledgement: the browser knows when its frame is out, not when the crystals have turned."""
    heartbeat_s: float = 1.0
    """Either side takes the other for lost after four missing beats."""

    def __post_init__(self) -> None:
        """Check what would otherwise fail late."""
        if self.ack_timeout_s <= 0 or self.heartbeat_s <= 0 or self.settle_s < 0:
            raise ConfigError("panel: ack_timeout and heartbeat have to be above 0 s, settle not below 0 s")


class BrowserPanel:
    """The page, its server, and the promise that a pattern is painted when :meth:`show` returns.

    The server listens from construction to :meth:`close`.

    Parameters
    ----------
    settings
        Where, and when an acknowledgement counts.
    on_notice
        Hears of what the operator should look at: another size of the page than before.

    Raises
    ------
    DeviceBusyError
        The port is taken.
    ConfigError
        Host, port or token can't be used.
    """

    def __init__(self, settings: BrowserPanelSettings, *, on_notice: Callable[[str], None] = lambda _: None) -> None:
        self._settings, self._on_notice = settings, on_notice
        self._size_px: tuple[int, int] | None = None
        self._showing = threading.Lock()
        self._link = PageLink(
            require_fullscreen=settings.require_fullscreen,
            heartbeat_s=settings.heartbeat_s,
            hint="open the panel's address, which the workbench printed at its start",
        )
        self._server = WebServer(
            "panel", panel_application(self._link), host=settings.host, port=settings.port, token=settings.token
        )

    def urls(self) -> tuple[str, ...]:
        """Addresses of the page, best first, with the token where there is one."""
        return self._server.urls("panel")

    def invitation(self) -> str:
        """What the operator needs to open the page: its address, and a code where a tablet can reach it."""
        return invitation("panel", self.urls()[0], ", then tap the page once")

    def status(self) -> PanelStatus:
        """How the page is doing now; touches nothing."""
        return self._link.status()

    def wait_ready(self, timeout_s: float) -> PanelStatus:
        """Wait until a page is connected, visible and, where required, full screen.

        Raises
        ------
        NotAcknowledgedError
            Not in time; says what is missing.
        """
        return self._link.wait_ready(timeout_s)

    def identify(self) -> DeviceIdentity:
        """Browser and screen as the page reports them; without a page, only the kind."""
        status = self._link.status()
        extra = {"address": status.address, "user_agent": status.user_agent}
        if status.page is not None:
            extra["size_px"] = f"{status.page.width_px}x{status.page.height_px}"
            extra["device_pixel_ratio"] = f"{status.page.device_pixel_ratio:g}"
        return DeviceIdentity(kind="browser", extra={key: value for key, value in extra.items() if value})

    def show(self, pattern: Pattern) -> PanelAck:
        """Paint a pattern; returns when the page has confirmed it and the display has settled.

        A page that loses its connection meanwhile may come back and confirm within the time. Sizes are rounded to
        whole device pixels and dots are placed on the pixel grid: a lit pixel is lit fully, whatever the screen's
        gamma.

        Raises
        ------
        NotAcknowledgedError
            No page, a hidden one, one that isn't full screen, or no word from it in time.
        PanelError
            The pattern can't be shown: a bad value, an unreadable picture, a dot outside the panel.
        """
        drawn = drawing(pattern)
        picture = Picture(pattern) if pattern.kind == "picture" else None
        started = time.monotonic()
        with self._showing:
            sequence = self._link.request(drawn, picture)
            page = self._link.wait_painted(sequence, self._settings.ack_timeout_s)
            painted_after_s = time.monotonic() - started
        self._look_at_size((page.width_px, page.height_px))
        if (point := outside(pattern, page.width_px, page.height_px)) is not None:
            way_out = "move it inwards"
            if len(pattern.points_px) > 1:
                way_out = f"set panel.pixels: [{page.width_px}, {page.height_px}] and plan anew"
            raise PanelError(
                f"panel: a dot of {pattern.size_px:g} px at ({point[0]:g}, {point[1]:g}) isn't wholly on the panel of "
                f"{page.width_px} x {page.height_px} px (origin at its centre); {way_out}"
            )
        time.sleep(self._settings.settle_s)
        return PanelAck(
            pattern=pattern,
            width_px=page.width_px,
            height_px=page.height_px,
            device_pixel_ratio=page.device_pixel_ratio,
            fullscreen=page.fullscreen,
            painted_after_s=painted_after_s,
        )

    def check_shown(self) -> None:
        """After an exposure: the page is still there, in front, and as large as when it painted.

        Raises
        ------
        NotAcknowledgedError
            It isn't: the frame may show something else.
        """
        state = self._link.still_painted()
        if (state.width_px, state.height_px) != self._size_px:
            raise NotAcknowledgedError(
                "panel: its page changed its size during the exposure: lock the tablet's rotation"
            )

    def _look_at_size(self, size_px: tuple[int, int]) -> None:
        """A tablet that was turned, or another one, moves every dot but that in the middle, or makes it larger."""
        before, self._size_px = self._size_px, size_px
        if before not in (None, size_px):
            now, then = (f"{width} x {height} px" for width, height in (size_px, before))
            self._on_notice(f"panel: its page is {now} now, and was {then}: is it the same screen, not turned?")

    def close(self) -> None:
        """Stop the server and free the port; safe to call twice."""
        self._link.close()
        self._server.close()
