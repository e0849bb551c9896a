"""bench: accuracy and speed tables, side by side with the reference methods."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from workbench.banks import open_bank
from workbench.bench.accuracy import Run, run_cases
from workbench.bench.cases import BLANK, LIGHTS, SIZES, TEXTURES, depth_list, make_cases
from workbench.bench.scoring import Outcome
from workbench.bench.simulated_bank import default_work, rig_settings, simulated_bank
from workbench.bench.tables import accuracy_tables, markdown_page, tables_json
from workbench.cli.common import LENGTH, Context, command_options
from workbench.depth.methods import DEFAULT_METHOD, METHODS, make_options
from workbench.files import staged_files, write_json
from workbench.units import seconds_text


class NamesParam(click.ParamType[tuple[str, ...]]):
    """Names with commas between them, or ``all``; each must be known."""

    def __init__(self, what: str, known: tuple[str, ...]) -> None:
        self.name = what
        self._known = known

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Parse one command line value."""
        if isinstance(value, tuple):
            return value
        names = self._known if value == "all" else tuple(dict.fromkeys(part.strip() for part in value.split(",")))
        for name in names:
            if name not in self._known:
                self.fail(f"{name!r}: known are {', '.join(self._known)}", param, ctx)
        return names


def parse_method_settings(
    _ctx: click.Context, _param: click.Parameter, texts: tuple[str, ...]
) -> dict[str, dict[str, str]]:
    """METHOD.NAME=VALUE, checked against the method's options."""
    settings: dict[str, dict[str, str]] = {}
    for text in texts:
        target, equals, value = text.partition("=")
        method, dot, name = target.partition(".")
        if not equals or not dot:
            raise click.BadParameter(f"{text!r}: give method.name=value")
        settings.setdefault(method.strip(), {})[name.strip().replace("-", "_")] = value.strip()
    for method, values in settings.items():
        make_options(method, values)
    return settings


@click.group()
def bench() -> None:
    """Accuracy and speed tables, side by side with the reference methods."""


QUICK = {"depths": 6, "lights": ("normal",), "every": 6}
FULL = {"depths": 59, "lights": tuple(LIGHTS), "every": 12}


@bench.command()
@click.option("--full", is_flag=True, help="Every depth for every texture and light level: tens of minutes.")
@click.option(
    "--methods",
    type=NamesParam("methods", tuple(METHODS)),
    default="all",
    show_default=True,
    help="Methods to compare, with commas.",
)
@click.option(
    "--textures",
    type=NamesParam("textures", (*TEXTURES, BLANK)),
    default="all",
    show_default=True,
    help="Texture classes.",
)
@click.option(
    "--sizes",
    type=NamesParam("sizes", SIZES),
    default="all",
    show_default=True,
    help="Sizes of regions in developed pixels.",
)
@click.option(
    "--lights",
    type=NamesParam("lights", tuple(LIGHTS)),
    default=None,
    help="Light levels; quick form: normal, full form: all.",
)
@click.option("--depths", type=click.IntRange(1, 59), default=None, help="Depths per texture; quick 6, full 59.")
@click.option(
    "--reference-every",
    "every",
    type=click.IntRange(1),
    default=None,
    help=f"Methods other than {DEFAULT_METHOD} measure one case of so many; quick 6, full 12.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of textures, depths, shapes and noise."
)
@click.option(
    "--bank",
    "bank_ref",
    default=None,
    help="Bank of the project (-C); default: the simulated rig is calibrated, once, in --work.",
)
@click.option(
    "--bank-step",
    "step_mm",
    type=LENGTH,
    default="10cm",
    show_default=True,
    help="Between the planes of the simulated rig's bank.",
)
@click.option(
    "--work",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Where the simulated rig's banks are kept; default: the user's cache directory.",
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    callback=parse_method_settings,
    metavar="METHOD.NAME=VALUE",
    help="Option of a method; repeatable.",
)
@click.option("--jobs", type=click.IntRange(1), default=None, help="Processes; default: two, or one core's worth.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Directory for accuracy.json, accuracy.md and figures.",
)
@command_options
def accuracy(
    context: Context, full: bool, methods: tuple[str, ...], textures: tuple[str, ...], sizes: tuple[str, ...],
    lights: tuple[str, ...] | None, depths: int | None, every: int | None, seed: int, bank_ref: str | None,
    step_mm: float, work: Path | None, settings: dict[str, dict[str, str]], jobs: int | None, out: Path | None,
) -> None:  # fmt: skip
    """Measure scenes of known depth with every method.

    Scenes are photographed by the simulated rig; no project is needed. The quick form takes about a minute.
    """
    started = time.monotonic()
    form: dict[str, Any] = FULL if full else QUICK
    lights = lights or form["lights"]
    if bank_ref is not None:
        project = context.project()
        bank, config = open_bank(project, bank_ref)[0], project.config()
    else:
        with context.progress("calibrating the simulated rig") as observer:
            bank, config = simulated_bank(work or default_work(), seed=1, step_mm=step_mm, observer=observer)
    rig = rig_settings(config)
    cases = make_cases(textures, depth_list(rig.stage_zero_mm, seed), depths or form["depths"], seed)
    rounds = -(-(depths or form["depths"]) // (every or form["every"]))
    references = [name for name in methods if name != DEFAULT_METHOD and len(methods) > 1]
    run = Run(methods, sizes, lights, dict.fromkeys(references, rounds * len(textures)), settings)
    with context.progress("bench accuracy") as observer:
        outcomes = run_cases(cases, run, bank, rig, jobs=jobs or min(2, os.cpu_count() or 1), observer=observer)
    facts = {
        "methods": ", ".join(methods),
        "bank": f"{bank.id}, {len(bank.depths_mm)} planes from {bank.depths_mm[0] / 10:.1f} to "
        f"{bank.depths_mm[-1] / 10:.1f} cm",
        "focus": f"{bank.lens.focus_mm / 10:.2f} cm",
        "cases": f"{len(cases)} frames, seed {seed}, light {', '.join(lights)}",
        "took": seconds_text(time.monotonic() - started),
    }
    report(context, outcomes, bank.lens.focus_mm, facts, out)


def report(context: Context, outcomes: list[Outcome], focus_mm: float, facts: dict[str, str], out: Path | None) -> None:
    """Show the tables, write the files."""
    tables = accuracy_tables(outcomes, focus_mm)
    for table in tables:
        context.table(table.columns, table.rows, title=table.title)
        context.say()
    for name, fact in facts.items():
        context.say(f"{name}: {fact}")
    result = {**facts, "focus_mm": focus_mm, "tables": tables_json(outcomes, focus_mm)}
    if out is not None:
        with staged_files(out) as directory:
            raw = [asdict(outcome) for outcome in outcomes]
            write_json(directory / "accuracy.json", {**result, "outcomes": raw})
            page = markdown_page("Accuracy", facts, tables, [])
            (directory / "accuracy.md").write_text(page, encoding="utf-8")
        context.say(f"written: {out}")
    context.emit(result)
