"""align: centre the point and find focus, live."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import click

from workbench.cli.common import LENGTH, Context, command_options
from workbench.cli.doctor import DurationParam


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
    from workbench.devices import open_rig
    from workbench.frame_reader import FrameReader
    from workbench.planning import make_plan
    from workbench.session import StopRequest

    project = context.project()
    config = project.config()
    reader = FrameReader(config.camera.pixel_pitch_mm)
    dot = make_plan(config).dots[0]
    feed = AlignFeed()
    with (
        project.lock_rig(),
        tempfile.TemporaryDirectory(prefix="workbench-align-") as scratch,
        open_rig(config, tell=context.note, frames=reader) as rig,
    ):
        if at_mm is not None:
            rig.check_reach((at_mm,))
            if not rig.stage.homed():
                context.note("stage: finding its reference")
                rig.stage.home()
            rig.stage.move_to_mm(rig.axis.position_mm(at_mm))
        aligner = Aligner(
            rig.camera, rig.panel, dot, feed, reader.read, Path(scratch),
            exposure_s=exposure_s, iso=config.camera.iso, live_view=live_view,
        )  # fmt: skip
        server = AlignServer(AlignSettings(config.panel.host, port, config.panel.token), feed, aligner.actions())
        try:
            context.note(f"open {server.urls()[0]} in a browser; Ctrl-C ends")
            stop = StopRequest()
            with stop.heard():
                aligner.show(pattern)
                for seen in aligner.looks(count):
                    context.emit(_as_json(seen))
                    context.say(_line(seen))
                    stop.check()
        except KeyboardInterrupt:
            context.note("ended")
        finally:
            server.close()


def _line(seen: Any) -> str:
    """One frame in one line."""
    sample = seen.sample
    offset = sample.offset_px()
    parts = [f"{seen.pattern:<10}"]
    if offset is not None:
        parts.append(f"off centre {offset[0]:+7.1f} {offset[1]:+7.1f} px")
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
        "frame_px": [sample.frame_width_px, sample.frame_height_px],
        "centroid_px": sample.centroid_px,
        "offset_px": offset,
        "distance_px": None if offset is None else math.hypot(*offset),
        "peak": sample.peak,
        "saturated_px": sample.saturated_px,
        "width_px": sample.width_px,
        "exposure_s": sample.exposure_s,
        "iso": sample.iso,
        "findings": [{"aspect": f.aspect, "level": f.level, "text": f.text} for f in seen.findings],
        "note": sample.note,
    }
