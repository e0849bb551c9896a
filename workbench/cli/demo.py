"""demo: the whole product on the simulated rig, in one command."""

from __future__ import annotations

import math
from pathlib import Path

import click

from workbench.banks import open_bank
from workbench.cli.common import Context, command_options
from workbench.cli.measure import measure_photograph
from workbench.cli.rig import run_session
from workbench.demo import compare
from workbench.devices import open_scene_camera, simulated_scene_truth
from workbench.errors import InputError
from workbench.frame_reader import FrameReader
from workbench.measure import MeasureOptions
from workbench.photograph import next_photograph, photograph
from workbench.planning import make_plan
from workbench.project import Project, create_project, open_project
from workbench.truth_files import write_truth_images
from workbench.units import cm


@click.command()
@click.argument("target", metavar="[DIR]", default="workbench-demo", type=click.Path(path_type=Path))
@click.option("--preset", type=click.Choice(["small", "eos650d"]), default="small", show_default=True,
              help="Size of the simulated camera.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the simulated rig.")
@command_options
def demo(context: Context, target: Path, preset: str, seed: int) -> None:
    """Simulated rig: calibrate, photograph, measure, report; no hardware, about a minute."""
    root = context.directory / target
    project = open_project(root) if (root / "rig.yaml").exists() else create_project(root, preset=preset, seed=seed)
    config = project.config()
    if config.camera.kind != "simulated":
        raise InputError(f"{root}: its rig.yaml names a real camera; the demo is simulated: name another directory")
    run_session(context, project, make_plan(config))
    context.say()
    _measure_scene(context, project)


def _measure_scene(context: Context, project: Project) -> None:
    config = project.config()
    bank, _ = open_bank(project, "active")
    frames = FrameReader(config.camera.pixel_pitch_mm)
    camera = open_scene_camera(config, tell=context.note, frames=frames)
    destination = next_photograph(project.photographs)
    taken = photograph(camera, destination, base_iso=config.camera.iso, read=frames.read)
    camera.close()
    measurement = measure_photograph(context, project, bank, "active", MeasureOptions(), taken.path, None)
    truth = simulated_scene_truth(config)
    write_truth_images(project.photographs, destination.stem, truth.depth_mm, truth.object_id)
    results = compare(measurement, truth)
    rows = []
    for result in results:
        difference = result.measured_mm - result.true_mm
        shown = f"{difference / 10:+.1f} cm" if math.isfinite(difference) else "-"
        rows.append((result.name, cm(result.true_mm), cm(result.measured_mm), shown, result.status))
    context.say()
    context.table(("object", "true", "measured", "difference", "status"), rows, title="What is true, what was measured")
    context.say(f"bank report:        {project.banks / bank.id / 'report.html'}")
    context.say(f"measurement report: {measurement.files['report']}")
    context.emit(
        {
            "objects": [
                {
                    "name": result.name,
                    "true_mm": result.true_mm,
                    "measured_mm": result.measured_mm,
                    "status": result.status,
                }
                for result in results
            ]
        }
    )
