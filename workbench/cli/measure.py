"""measure: one photograph in, absolute depths out."""

from __future__ import annotations

from pathlib import Path

import click

from workbench.cli.common import Context, command_options
from workbench.depth.methods import DEFAULT_METHOD
from workbench.units import cm


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


@click.command()
@click.argument("raws", metavar="RAW...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--bank", "bank_ref", default="active", show_default=True, help="Bank id, version (v3) or active.")
@click.option("--method", default=DEFAULT_METHOD, show_default=True, help="Depth estimator.")
@click.option("--set", "settings", multiple=True, callback=parse_settings, metavar="NAME=VALUE",
              help="Option of the method; repeatable.")  # fmt: skip
@click.option("--roi", callback=parse_roi, metavar="X,Y,W,H", help="Measure this rectangle of the developed image.")
@click.option("--labels", type=click.Path(path_type=Path), help="Label image: regions to measure.")
@click.option("--whole", is_flag=True, help="Take the whole frame as one region.")
@click.option("--q", "srm_q", type=click.FloatRange(min=0.1), default=32.0, show_default=True,
              help="Region merging: larger finds more regions.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Directory for the files.")
@command_options
def measure(
    context: Context, raws: tuple[Path, ...], bank_ref: str, method: str, settings: tuple[tuple[str, str], ...],
    roi: tuple[int, int, int, int] | None, labels: Path | None, whole: bool, srm_q: float, out: Path | None,
) -> None:  # fmt: skip
    """Measure the depth of what ONE defocused photograph shows."""
    from workbench.banks import open_bank
    from workbench.depth.methods import make_options
    from workbench.measure import MeasureOptions, save
    from workbench.measure import measure as measure_one

    project = context.project()
    make_options(method, dict(settings))
    photographs = [context.existing(path, "photograph") for path in raws]
    labels = context.existing(labels, "label image") if labels else None
    options = MeasureOptions(method, settings, roi, labels, whole, srm_q)
    bank, _ = open_bank(project, bank_ref)
    for path in photographs:
        measurement = measure_one(path, bank, bank_ref, options)
        directory = out / path.stem if out and len(raws) > 1 else out
        measurement = save(measurement, bank, project, directory)
        context.emit(measurement.as_json(project.relative))
        rows = [
            (
                str(label),
                cm(e.depth_mm),
                f"{cm(e.interval_mm[0])} to {cm(e.interval_mm[1])}",
                f"{e.confidence:.2f}",
                cm(e.mirror_mm),
                str(e.pixels),
                e.status,
            )
            for label, e in sorted(measurement.estimates.items())
        ]
        context.table(
            ("region", "depth", "95 % interval", "confidence", "mirror", "pixels", "status"), rows,
            title=f"{path.name}: {method}, bank {bank.id[:12]}, {measurement.seconds:.1f} s",
        )  # fmt: skip
        for label, estimate in sorted(measurement.estimates.items()):
            if estimate.reason:
                context.say(f"region {label}: {estimate.reason}")
        context.say(f"report: {measurement.files['report']}")
