"""bench raytrace: photographs for the accuracy tables that neither simulator nor estimator had a hand in."""

from __future__ import annotations

from pathlib import Path

import click

from workbench.cli.bench import bench
from workbench.cli.common import Context, command_options
from workbench.errors import InputError
from workbench.files import staged_files


def power_of_two(_ctx: click.Context, _param: click.Parameter, number: int) -> int:
    """Check one command line value."""
    if number.bit_count() != 1:
        raise click.BadParameter(f"{number}: give a power of two, e.g. 256")
    return number


@bench.command("raytrace")
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
@click.option("--scenes", type=click.IntRange(0, 1000), default=10, show_default=True, help="Still lifes.")
@click.option("--planes", type=click.IntRange(0, 1000), default=0, show_default=True, help="Single planes.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Photograph k is of seed + k.")
@click.option(
    "--rays",
    type=click.IntRange(1, 1 << 16),
    callback=power_of_two,
    default=256,
    show_default=True,
    help="Per photosite, a power of two.",
)
@command_options
def raytrace(context: Context, out: Path, scenes: int, planes: int, seed: int, rays: int) -> None:
    """Trace RAW files of known depths into OUT: points for a bank, planes, still lifes.

    Measure them with `workbench bench accuracy --raws OUT`.
    """
    from workbench.raytrace.photographs import write_photographs

    if scenes + planes == 0:
        raise InputError("bench raytrace: nothing to trace; give --scenes N or --planes N")
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: is not empty; name a new directory")
    with context.progress("tracing rays") as observer, staged_files(out) as directory:
        write_photographs(directory, scenes=scenes, planes=planes, seed=seed, rays=rays, observer=observer)
    context.say(f"written: {out}; measure it with: workbench bench accuracy --raws {out}")
    context.emit({"directory": str(out), "scenes": scenes, "planes": planes, "seed": seed, "rays": rays})
