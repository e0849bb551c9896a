"""measure and capture: one photograph in, absolute depths out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import click

from calibration.bank import Bank
from workbench.banks import is_bad, open_bank, quality_reasons
from workbench.cli.common import Context, command_options
from workbench.depth.methods import DEFAULT_METHOD, make_options
from workbench.errors import InputError
from workbench.measure import MeasureOptions, open_second_view, save
from workbench.measure import measure as measure_one
from workbench.measurement import Measurement
from workbench.project import Project
from workbench.units import cm, exposure_text


def parse_roi(_ctx: click.Context, _param: click.Parameter, text: str | None) -> tuple[int, int, int, int] | None:
    """x,y,w,h as four whole numbers."""
    if text is None:
        return None
    try:
        x, y, w, h = (int(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r}: give four whole numbers x,y,width,height") from None
    return x, y, w, h


def parse_settings(_ctx: click.Context, _param: click.Parameter, texts: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """name=value pairs."""
    pairs = []
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise click.BadParameter(f"{text!r}: give name=value")
        pairs.append((name.strip().replace("-", "_"), value.strip()))
    return tuple(pairs)


def measure_options(function: click.decorators.FC) -> click.decorators.FC:
    """What can be chosen for a measurement, shared by measure and capture."""
    for option in reversed(
        (
            click.option("--bank", "bank_ref", default="active", show_default=True,
                         help="Bank id, version (v3) or active."),
            click.option("--method", default=DEFAULT_METHOD, show_default=True, help="Depth estimator."),
            click.option("--set", "settings", multiple=True, callback=parse_settings, metavar="NAME=VALUE",
                         help="Option of the method; repeatable."),
            click.option("--roi", callback=parse_roi, metavar="X,Y,W,H",
                         help="Measure this rectangle of the developed image."),
            click.option("--labels", type=click.Path(path_type=Path), help="Label image: regions to measure."),
            click.option("--whole", is_flag=True, help="Take the whole frame as one region."),
            click.option("--segment", type=click.Choice(["depth", "colour"]), default="depth", show_default=True,
                         help="Find regions by colour and blur, or by colour alone."),
            click.option("--q", "srm_q", type=click.FloatRange(min=0.1, max=1e6), default=32.0, show_default=True,
                         help="Region merging by colour: larger cuts finer."),
            click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Directory for the files."),
        )
    ):  # fmt: skip
        function = option(function)
    return function


@click.command()
@click.argument("raws", metavar="RAW...", nargs=-1, required=True, type=click.Path(path_type=Path))
@measure_options
@command_options
def measure(context: Context, raws: tuple[Path, ...], out: Path | None, **chosen: Any) -> None:
    """Measure the depth of what ONE defocused photograph shows."""
    project, bank, bank_ref, options = _prepare(context, **chosen)
    photographs = [context.existing(path, "photograph") for path in raws]
    stems = [path.stem for path in photographs]
    twice = next((path for path in photographs if stems.count(path.stem) > 1), None)
    if out and twice:
        raise InputError(
            f"{twice.name}: named twice, and --out {out} makes one directory per name; measure them one by one"
        )
    for path in photographs:
        directory = out / path.stem if out and len(raws) > 1 else out
        measure_photograph(context, project, bank, bank_ref, options, path, directory)


@click.command()
@measure_options
@command_options
def capture(context: Context, out: Path | None, **chosen: Any) -> None:
    """Photograph the scene with the rig, then measure it."""
    from workbench.devices import open_scene_camera
    from workbench.frame_reader import FrameReader
    from workbench.photograph import next_photograph, photograph

    project, bank, bank_ref, options = _prepare(context, **chosen)
    config = project.config()
    with project.lock_rig():
        frames = FrameReader(config.camera.pixel_pitch_mm)
        camera = open_scene_camera(config, tell=context.note, frames=frames)
        try:
            destination = next_photograph(project.photographs)
            taken = photograph(camera, destination, base_iso=config.camera.iso, read=frames.read)
        finally:
            camera.close()
    context.note(f"{taken.path}: {exposure_text(taken.exposure.time_s)}, ISO {taken.exposure.iso}")
    measure_photograph(context, project, bank, bank_ref, options, taken.path, out)


def _prepare(
    context: Context, *, bank_ref: str, method: str, settings: tuple[tuple[str, str], ...],
    roi: tuple[int, int, int, int] | None, labels: Path | None, whole: bool, segment: Literal["depth", "colour"],
    srm_q: float,
) -> tuple[Project, Bank, str, MeasureOptions]:  # fmt: skip
    """Check everything that can be checked before a file is read or a camera is opened."""
    project = context.project()
    opened = open_second_view(project, method, settings)
    make_options(method, dict(opened))
    labels = context.existing(labels, "label image") if labels else None
    options = MeasureOptions(method, opened, roi, labels, whole, segment, srm_q)
    bank, _ = open_bank(project, bank_ref)
    return project, bank, bank_ref, options


def measure_photograph(
    context: Context, project: Project, bank: Bank, bank_ref: str, options: MeasureOptions, path: Path,
    out: Path | None,
) -> Measurement:  # fmt: skip
    """Measure one photograph, write its files, show the result."""
    measurement = save(measure_one(path, bank, bank_ref, options), bank, project, out)
    if is_bad(bank):
        context.note(
            f"the quality of bank {bank.id} is bad ({quality_reasons(bank)}): depths measured with it may be wrong"
        )
    context.emit(measurement.as_json(project.relative))
    rows = [
        (
            str(label),
            cm(e.depth_mm),
            f"{cm(e.interval_mm[0])} to {cm(e.interval_mm[1])}" if math.isfinite(e.interval_mm[0]) else "-",
            f"{e.confidence:.2f}",
            cm(e.mirror_mm),
            str(e.pixels),
            e.status,
        )
        for label, e in sorted(measurement.estimates.items())
    ]
    context.table(
        ("region", "depth", "95 % interval", "confidence", "mirror", "pixels", "status"), rows,
        title=f"{path.name}: {options.method}, bank {bank.id}, {measurement.seconds:.1f} s",
    )  # fmt: skip
    for label, estimate in sorted(measurement.estimates.items()):
        if estimate.reason:
            context.say(f"region {label}: {estimate.reason}")
    context.say(f"report: {measurement.files['report']}")
    return measurement
