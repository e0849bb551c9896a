"""The panel: a page is connected, in front and full screen, and confirms that it painted a dot."""

from __future__ import annotations

from rigs.browser_panel import BrowserPanel
from rigs.errors import RigError
from rigs.panel_messages import PageState
from rigs.protocols import PanelAck, Pattern
from rigs.web_server import is_loopback
from workbench.config import PanelConfig
from workbench.devices import Tell, browser_panel_settings
from workbench.doctor.findings import Finding, Subject

PANEL = Subject("panel")

_SLOW_S = 1.0


def panel_findings(
    config: PanelConfig, dot_px: float, *, wait_s: float, tell: Tell
) -> tuple[list[Finding], tuple[str, ...]]:
    """Check the panel that rig.yaml names.

    Parameters
    ----------
    config
        The panel.
    dot_px
        Diameter of the dot that is shown (panel pixels).
    wait_s
        How long a page may take to connect and to be ready.
    tell
        Shows the operator the page's address, token included; no finding holds it.

    Returns
    -------
    tuple
        Findings, and the browsers that are connected.
    """
    if config.kind == "simulated":
        return [PANEL.ok("server", "simulated panel")], ()
    found = [_reach(config)]
    if not config.token and not is_loopback(config.host):
        found.append(
            PANEL.note(
                "token",
                "made anew at each start: a tablet has to scan the code each time",
                "set panel.token in rig.yaml, and the page comes back by itself",
            )
        )
    try:
        panel = BrowserPanel(browser_panel_settings(config))
    except RigError as error:
        return [PANEL.failure("server", error)], ()
    try:
        return _look(panel, found, config, dot_px, wait_s=wait_s, tell=tell)
    finally:
        panel.close()


def _reach(config: PanelConfig) -> Finding:
    where = f"listens on {config.host}, port {config.port}"
    if is_loopback(config.host):
        return PANEL.note("server", f"{where}: this computer's browsers only", "for a tablet set panel.host: 0.0.0.0")
    return PANEL.ok("server", where)


def _look(
    panel: BrowserPanel, found: list[Finding], config: PanelConfig, dot_px: float, *, wait_s: float, tell: Tell
) -> tuple[list[Finding], tuple[str, ...]]:
    tell(panel.invitation())
    try:
        panel.wait_ready(wait_s)
    except RigError:
        status = panel.status()
        if not status.connected:
            seen = f"no page connected within {wait_s:g} s"
            mend = "open the address printed above on the tablet; --panel-wait 2min gives time for it"
            return [*found, PANEL.error("page", seen, mend)], ()
        seen, _, mend = status.problem.partition(": ")
        return [*found, PANEL.error("page", seen, mend)], (_browser(panel),)
    browser = _browser(panel)
    try:
        painted = panel.show(Pattern("dot", size_px=dot_px, colour=config.dot.colour))
        panel.show(Pattern("black"))
    except RigError as error:
        return [*found, PANEL.ok("page", browser), PANEL.failure("painting", error)], (browser,)
    page = panel.status().page
    found.append(PANEL.ok("page", browser))
    found += painted_findings(painted, page, pitch_mm=config.pixel_pitch_mm)
    return found, (browser,)


def _browser(panel: BrowserPanel) -> str:
    status = panel.status()
    agent = status.user_agent
    name = next((name for name in ("Firefox", "Edg", "OPR", "Chrome", "Safari") if name in agent), "browser")
    return f"{ {'Edg': 'Edge', 'OPR': 'Opera'}.get(name, name) } at {status.address}".lstrip()


def painted_findings(painted: PanelAck, page: PageState | None, *, pitch_mm: float) -> list[Finding]:
    """Judge what the page said when it had painted the dot."""
    size = f"{painted.width_px} x {painted.height_px} px"
    long_mm, short_mm = (pitch_mm * max(painted.width_px, painted.height_px),
                         pitch_mm * min(painted.width_px, painted.height_px))  # fmt: skip
    found = []
    if painted.painted_after_s > _SLOW_S:
        seen = f"a dot took {painted.painted_after_s:.1f} s to be confirmed"
        found.append(PANEL.warning("painting", seen, "a nearer or quieter network, or USB; raise panel.ack_timeout"))
    else:
        found.append(PANEL.ok("painting", f"a dot was confirmed after {1000 * painted.painted_after_s:.0f} ms"))
    if painted.fullscreen:
        found.append(PANEL.ok("full screen", size))
    else:
        found.append(
            PANEL.warning("full screen", f"no: {size} of a window; its frame lights the room", "tap the page once")
        )
    ratio = painted.device_pixel_ratio
    if ratio == round(ratio):
        found.append(PANEL.ok("pixel ratio", f"{ratio:g}"))
    else:
        found.append(
            PANEL.note(
                "pixel ratio",
                f"{ratio:g}: usual for phones; on a laptop the system may scale the screen",
                "there choose the screen's native resolution and 100 %",
            )
        )
    found.append(
        PANEL.note(
            "size",
            f"{long_mm / 10:.1f} x {short_mm / 10:.1f} cm, by panel.pixel_pitch {pitch_mm:g} mm",
            "hold a ruler to the screen; correct panel.pixel_pitch if it differs",
        )
    )
    if page is not None and page.wake_lock == "none":
        found.append(
            PANEL.warning("wake lock", "nothing keeps the screen on", "set the tablet's screen timeout to never")
        )
    return found
