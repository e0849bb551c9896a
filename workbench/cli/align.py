"""align: centre the point and find focus, live."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from workbench.cli.common import LENGTH, Context, command_options
from workbench.cli.doctor import DurationParam
from workbench.units import exposure_text

if TYPE_CHECKING:
    from rigs.align_feed import AlignFeed
    from rigs.protocols import Camera, Panel
    from workbench.config import RigConfig
    from workbench.frame_reader import FrameReader


@click.command()
@click.option("--at", "at_mm", type=LENGTH, default=None, help="Move the stage to this depth first.")
@click.option("--show", "pattern", type=click.Choice(["dot", "cross-hair", "white", "black"]), default="dot",
              show_default=True, help="What the panel shows at first; the page's buttons change it.")  # fmt: skip
@click.option("--exposure", "exposure_s", type=DurationParam(), default=None, metavar="TIME",
              help="Exposure time, e.g. 0.02s; without it, it follows the point.")  # fmt: skip
@click.option("--live-view", is_flag=True, help="Take the camera's live view instead of RAW frames: faster, coarser.")
@click.option("--frames", "count", type=click.IntRange(1), default=None, help="End after so many frames.")
@click.option("--port", type=click.IntRange(0, 65535), default=8651, show_default=True, help="Of the page; 0: any.")
@command_options
def align(
    context: Context, at_mm: float | None, pattern: str, exposure_s: float | None, live_view: bool, count: int | None,
    port: int,
) -> None:  # fmt: skip
    """Show the point live in a browser: where it is, how bright, how wide; ends with Ctrl-C."""
    from rigs.align_feed import AlignFeed
    from rigs.align_server import AlignServer, AlignSettings
    from workbench.align import Aligner
    from workbench.frame_reader import FrameReader
    from workbench.planning import make_plan
    from workbench.session import StopRequest

    project = context.project()
    config = project.config()
    reader = FrameReader(config.camera.pixel_pitch_mm)
    dot = make_plan(config).dots[0]
    feed = AlignFeed()
    stop = StopRequest()
    with ExitStack() as opened:
        opened.enter_context(project.lock_rig())
        scratch = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="workbench-align-")))
        opened.enter_context(stop.heard())
        camera, panel = _open_devices(opened, context, config, reader, feed, at_mm)
        aligner = Aligner(
            camera, panel, dot, feed, reader.read, scratch,
            exposure_s=exposure_s, iso=config.camera.iso, live_view=live_view,
            panel_scale=None if at_mm is None else _panel_scale(config, at_mm),
        )  # fmt: skip
        if exposure_s is not None and not math.isclose(aligner.exposure_s, exposure_s, rel_tol=0.02):
            context.note(f"exposure: the camera offers no {exposure_s:g} s; taking {exposure_text(aligner.exposure_s)}")
        settings = AlignSettings(config.panel.host, port, config.panel.token)
        server = AlignServer(settings, feed, aligner.actions(), active=pattern.capitalize())
        opened.callback(server.close)
        context.note(server.invitation())
        try:
            aligner.show(pattern)
            for seen in aligner.looks(count):
                context.emit(_as_json(seen))
                context.say(_line(seen))
                stop.check()
        except KeyboardInterrupt:
            stop.withdraw()
            context.note("ended")


def _open_devices(
    opened: ExitStack, context: Context, config: RigConfig, reader: FrameReader, feed: AlignFeed, at_mm: float | None
) -> tuple[Camera, Panel]:
    """Camera and panel; the stage too, moved, where a depth is given, and left alone where not."""
    from workbench.device_news import DeviceNews
    from workbench.devices import open_camera_and_panel, open_rig

    def tell(text: str) -> None:
        context.note(text)
        feed.tell(text)  # the operator stands at the rig and looks at the page

    news = DeviceNews(tell)
    if at_mm is None:
        return opened.enter_context(open_camera_and_panel(config, tell=context.note, frames=reader, news=news))
    rig = opened.enter_context(open_rig(config, tell=context.note, frames=reader, news=news))
    rig.check_reach((at_mm,))
    if not rig.stage.homed():
        context.note("stage: finding its reference")
        rig.stage.home()
    rig.stage.move_to_mm(rig.axis.position_mm(at_mm))
    return rig.camera, rig.panel


def _panel_scale(config: RigConfig, depth_mm: float) -> Callable[[float], float]:
    from workbench.alignment import panel_mm_per_px

    optics = config.optics
    return lambda pitch_mm: panel_mm_per_px(pitch_mm, depth_mm, optics.focal_length_mm, optics.focus_mm)


def _line(seen: Any) -> str:
    """One frame in one line."""
    sample = seen.sample
    offset = sample.offset_px()
    parts = [f"{seen.pattern:<10}"]
    if offset is not None:
        parts.append(f"off centre {offset[0]:+7.1f} {offset[1]:+7.1f} px")
    on_panel = sample.offset_mm()
    if on_panel is not None:
        parts.append(f"= {on_panel[0]:+6.1f} {on_panel[1]:+6.1f} mm")
    if sample.width_px is not None:
        parts.append(f"width {sample.width_px:6.2f} px")
    if sample.peak is not None:
        parts.append(f"peak {sample.peak:4.0%}")
    worst = next((finding.text for finding in seen.findings if finding.level != "good"), "aligned")
    return "  ".join([*parts, worst])


def _as_json(seen: Any) -> dict[str, Any]:
    sample = seen.sample
    offset = sample.offset_px()
    return {
        "pattern": seen.pattern,
        "frame_px": [sample.frame_width_px, sample.frame_height_px] if sample.frame_width_px else None,
        "centroid_px": sample.centroid_px,
        "offset_px": offset,
        "offset_mm": sample.offset_mm(),
        "distance_px": None if offset is None else math.hypot(*offset),
        "peak": sample.peak,
        "saturated_px": sample.saturated_px,
        "width_px": sample.width_px,
        "exposure_s": sample.exposure_s,
        "iso": sample.iso,
        "findings": [{"aspect": f.aspect, "level": f.level, "text": f.text} for f in seen.findings],
        "note": sample.note,
    }
