"""Commands that make a project and drive the rig: init, plan, calibrate, resume."""

from __future__ import annotations

from pathlib import Path

import click

from workbench.cli.common import LENGTH, Context, command_options
from workbench.planning import cost, make_plan
from workbench.project import create_project
from workbench.units import bytes_text, cm, seconds_text


@click.command()
@click.argument("target", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--preset", type=click.Choice(["small", "eos650d"]), default="small", show_default=True,
              help="Size of the simulated camera.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the simulated rig.")
@command_options
def init(context: Context, target: Path, preset: str, seed: int) -> None:
    """Make a project with a commented rig.yaml (simulated rig)."""
    project = create_project(context.directory / target, preset=preset, seed=seed)
    context.say(f"Made {project.rig_file}. Next: workbench -C {project.root} calibrate")
    context.emit({"project": str(project.root), "rig": str(project.rig_file)})


def plan_options(function: click.decorators.FC) -> click.decorators.FC:
    """--from, --to, --step and --repeats, shared by plan and calibrate."""
    for option in reversed(
        (
            click.option("--from", "from_mm", type=LENGTH, default=None, help="Nearest depth, e.g. 60cm."),
            click.option("--to", "to_mm", type=LENGTH, default=None, help="Farthest depth, e.g. 350cm."),
            click.option("--step", "step_mm", type=LENGTH, default=None, help="Step between depths, e.g. 10cm."),
            click.option("--repeats", type=click.IntRange(1, 100), default=None, help="Point frames per depth."),
        )
    ):
        function = option(function)
    return function


@click.command()
@plan_options
@command_options
def plan(
    context: Context, from_mm: float | None, to_mm: float | None, step_mm: float | None, repeats: int | None
) -> None:
    """Show the shots that calibrate would take; touches nothing."""
    config = context.project().config()
    made = make_plan(config, from_mm=from_mm, to_mm=to_mm, step_mm=step_mm, repeats=repeats)
    estimate = cost(made, config)
    rows = [
        (cm(depth, 0), f"{dot.size_px:g} px", f"{made.repeats}", f"{made.off_frames}")
        for depth, dot in zip(made.depths_mm, made.dots, strict=True)
    ]
    context.table(("depth", "dot", "point frames", "panel-off frames"), rows)
    context.say(
        f"{len(made.depths_mm)} depths, {estimate.shots} shots and their metering: "
        f"about {seconds_text(estimate.seconds)}, {bytes_text(estimate.bytes)}. Nothing was touched."
    )
    context.emit(
        {
            "plan": made.model_dump(mode="json"),
            "shots": [shot.model_dump(mode="json") for shot in made.shots()],
            "seconds": round(estimate.seconds, 1),
            "bytes": round(estimate.bytes),
        }
    )
