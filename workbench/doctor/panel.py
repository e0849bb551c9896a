"""The panel: a page is connected, in front and full screen, and confirms that it painted a dot."""

from __future__ import annotations

from contextlib import suppress

from rigs.browser_panel import BrowserPanel, PanelStatus
from rigs.errors import NotAcknowledgedError, RigError
from rigs.panel_messages import PageState, WakeLock
from rigs.protocols import PanelAck, Pattern
from rigs.web_access import is_loopback
from workbench.config import PanelConfig
from workbench.devices import Tell, browser_panel_settings
from workbench.doctor.findings import Finding, Subject

PANEL = Subject("panel")

_SLOW_S = 1.0
_BROWSERS = (("Firefox", "Firefox"), ("Edg", "Edge"), ("OPR", "Opera"), ("Chrome", "Chrome"), ("Safari", "Safari"))
"""Marks in a user agent, the most telling first: most call themselves Chrome and Safari, too."""


def panel_findings(
    config: PanelConfig, pattern: Pattern, *, wait_s: float, tell: Tell
) -> tuple[list[Finding], tuple[str, ...]]:
    """Check the panel that rig.yaml names.

    Parameters
    ----------
    config
        The panel.
    pattern
        What is shown: of the plan's patterns the widest, which has to fit on the panel.
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
    reach = ": this computer's browsers only" if is_loopback(config.host) else ""
    found = [PANEL.ok("server", f"listens on {config.host}, port {config.port}{reach}")]
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
        return _look(panel, found, config, pattern, wait_s=wait_s, tell=tell)
    finally:
        panel.close()


def _look(
    panel: BrowserPanel, found: list[Finding], config: PanelConfig, pattern: Pattern, *, wait_s: float, tell: Tell
) -> tuple[list[Finding], tuple[str, ...]]:
    tell(panel.invitation())
    with suppress(NotAcknowledgedError):
        panel.wait_ready(wait_s)
    status = panel.status()
    if status.last_heard_s is None:
        patience = "`workbench doctor --panel-wait 2min`"
        mend = f"run {patience}, and open the address that it shows on the terminal"
        if is_loopback(config.host) and not config.token:
            mend = f"run {patience}, and open {panel.urls()[0]} on this computer; a tablet needs panel.host: 0.0.0.0"
        return [*found, PANEL.error("page", f"none connected within {wait_s:g} s", mend)], ()
    if status.problem:
        seen, _, mend = status.problem.partition(": ")
        return [*found, PANEL.error("page", seen, mend)], (_browser(status),) if status.connected else ()
    browser = _browser(status)
    found = [*found, PANEL.ok("page", browser)]
    try:
        painted = panel.show(pattern)
        page = panel.status().page
        panel.show(Pattern("black"))
    except RigError as error:
        return [*found, PANEL.failure("painting", error)], (browser,)
    return [*found, *painted_findings(painted, page, pitch_mm=config.pixel_pitch_mm)], (browser,)


def _browser(status: PanelStatus) -> str:
    name = next((name for mark, name in _BROWSERS if mark in status.user_agent), "browser")
    return f"{name} at {status.address}"


def painted_findings(painted: PanelAck, page: PageState | None, *, pitch_mm: float) -> list[Finding]:
    """Judge what the page said when it had painted the dot."""
    width_cm, height_cm = (0.1 * pitch_mm * pixels for pixels in (painted.width_px, painted.height_px))
    size = f"{painted.width_px} x {painted.height_px} px"
    found = []
    if painted.painted_after_s > _SLOW_S:
        seen = f"a dot took {painted.painted_after_s:.1f} s to be confirmed"
        found.append(PANEL.warning("painting", seen, "a nearer or quieter network, or USB; raise panel.ack_timeout"))
    else:
        found.append(PANEL.ok("painting", f"a dot was confirmed after {1000 * painted.painted_after_s:.0f} ms"))
    if painted.fullscreen:
        found.append(PANEL.ok("full screen", f"{size}, {width_cm:.1f} x {height_cm:.1f} cm by panel.pixel_pitch"))
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
    if page is not None:
        found.append(_awake(page.wake_lock))
    return found


def _awake(wake_lock: WakeLock) -> Finding:
    timeout = "set the tablet's screen timeout to never"
    match wake_lock:
        case "lock":
            return PANEL.ok("wake lock", "the browser keeps the screen on")
        case "video":
            return PANEL.note("wake lock", "an invisible video keeps the screen on, which isn't a promise", timeout)
        case "none":
            return PANEL.warning("wake lock", "nothing keeps the screen on", timeout)
