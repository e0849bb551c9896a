"""bench: accuracy and speed tables, side by side with the reference methods."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from calibration.bank import Bank, save_bank
from calibration.photograph import develop_photograph
from rigs.simulated.rig import render_scene_frame
from workbench.banks import open_bank
from workbench.bench.accuracy import Run, View, run_cases
from workbench.bench.bench_banks import (
    SECOND_PUPILS,
    default_work,
    for_crops,
    raws_bank,
    rig_settings,
    simulated_bank,
)
from workbench.bench.cases import BLANK, LIGHTS, SIZES, TEXTURES, depth_list, make_cases
from workbench.bench.drawn_scenes import write_drawn_scenes
from workbench.bench.method_speed import MemoryRow, MethodRow, method_rows, peak_memory
from workbench.bench.one_thread import in_one_thread, sendable
from workbench.bench.scoring import Outcome
from workbench.bench.speed import speed_table
from workbench.bench.tables import (
    TableOf,
    accuracy_tables,
    markdown_page,
    singles_table,
    speed_tables,
    tables_json,
)
from workbench.bench.truth import TrueFiles, read_truth, run_truth
from workbench.cli.common import LENGTH, Context, command_options
from workbench.config import RigConfig
from workbench.depth.methods import DEFAULT_METHOD, METHODS, make_options, needs_second_view
from workbench.errors import InputError
from workbench.figures.bench import error_and_bound, measured_against_true, rates_by_texture
from workbench.figures.style import to_bytes
from workbench.files import staged_files, write_json
from workbench.processors import usable_processors
from workbench.units import cm, seconds_text

FIGURES = {
    "measured_against_true": measured_against_true,
    "rates_by_texture": rates_by_texture,
    "error_and_bound": error_and_bound,
}
Settings = Mapping[str, Mapping[str, str]]


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


@dataclass(frozen=True, slots=True)
class Form:
    """How much of everything an accuracy run takes."""

    methods: tuple[str, ...]
    depths: int
    lights: tuple[str, ...]
    every: int
    """Reference methods measure one case of so many."""


_OF_CASES = ("textures", "sizes", "lights", "depths", "from_mm", "to_mm", "every", "jobs")
"""Options of single simulated planes: neither files nor scenes have a use for them."""
_OF_RIG = ("full", "seed", "step_mm")
"""Options of what the simulated rig photographs, and of its bank: files have no use for them."""

QUICK = Form(methods=(DEFAULT_METHOD, "sharpness"), depths=3, lights=("normal",), every=3)
FULL = Form(methods=tuple(METHODS), depths=59, lights=tuple(LIGHTS), every=12)


@click.group()
def bench() -> None:
    """Accuracy and speed tables, side by side with the reference methods."""


def accuracy_options(function: click.decorators.FC) -> click.decorators.FC:
    """All options of ``bench accuracy``."""
    path = click.Path(path_type=Path, file_okay=False)
    for option in reversed(
        (
            click.option("--full", is_flag=True, help="Every depth for every texture and light: tens of minutes."),
            click.option("--raws", type=path,
                         help="Measure this directory's RAW files instead; its truth.json knows their depths."),
            click.option("--scenes", type=click.IntRange(1), default=None,
                         help="Measure so many scenes of several objects, drawn at random, through their regions."),
            click.option("--methods", type=NamesParam("methods", tuple(METHODS)), default=None,
                         help=f"Methods to compare, with commas, or all; quick {','.join(QUICK.methods)}, else all."),
            click.option("--textures", type=NamesParam("textures", (*TEXTURES, BLANK)), default="all",
                         show_default=True, help="Texture classes."),
            click.option("--sizes", type=NamesParam("sizes", SIZES), default="all", show_default=True,
                         help="Sizes of regions in developed pixels."),
            click.option("--lights", type=NamesParam("lights", tuple(LIGHTS)), default=None,
                         help="Light levels; quick form: normal, full form: all."),
            click.option("--depths", type=click.IntRange(1, 59), default=None,
                         help=f"Depths per texture; quick {QUICK.depths}, full {FULL.depths}."),
            click.option("--from", "from_mm", type=LENGTH, default=None, help="Leave nearer depths out, e.g. 140cm."),
            click.option("--to", "to_mm", type=LENGTH, default=None, help="Leave farther depths out, e.g. 180cm."),
            click.option("--reference-every", "every", type=click.IntRange(1), default=None,
                         help=f"Beside {DEFAULT_METHOD}, other methods measure one case of so many; quick "
                         f"{QUICK.every}, full {FULL.every}."),
            click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True,
                         help="Of textures, depths, shapes and noise."),
            click.option("--bank", "bank_ref", default=None,
                         help="Bank of the project (-C). Default: made of the simulated rig, or of psf/ in --raws."),
            click.option("--bank-step", "step_mm", type=LENGTH, default="10cm", show_default=True,
                         help="Between the planes of the simulated rig's bank."),
            click.option("--work", type=path, default=None,
                         help="Where banks are kept for the next run; default: the user's cache directory."),
            click.option("--set", "settings", multiple=True, callback=parse_method_settings,
                         metavar="METHOD.NAME=VALUE", help="Option of a method; repeatable."),
            click.option("--jobs", type=click.IntRange(1), default=None, help="Processes; default: at most two."),
            click.option("--out", type=path, help="Directory for accuracy.json, accuracy.md and figures."),
        )
    ):  # fmt: skip
        function = option(function)
    return function


@bench.command()
@accuracy_options
@command_options
def accuracy(
    context: Context, full: bool, raws: Path | None, scenes: int | None, methods: tuple[str, ...] | None,
    bank_ref: str | None, work: Path | None, settings: Settings, out: Path | None, **chosen: Any,
) -> None:  # fmt: skip
    """Measure scenes of known depth with every method.

    Scenes are photographed by the simulated rig; no project is needed. The quick form takes about a minute.
    """
    work = work or default_work()
    if bank_ref is not None:
        _refuse_given(("step_mm",), "--bank")
    methods = methods or (FULL if full or raws is not None else QUICK).methods
    if raws is not None:
        if scenes is not None:
            raise click.UsageError("--raws and --scenes: give one of them")
        _refuse_given((*_OF_CASES, *_OF_RIG), "--raws")
        files = read_truth(context.existing(raws, "directory"))
        if bank_ref is None:
            context.note(f"bank: from {raws / 'psf'}")
        bank = raws_bank(work, raws / "psf") if bank_ref is None else open_bank(context.project(), bank_ref)[0]
        _measure_files(context, files, bank, methods, settings, out, {"files": str(raws)})
    elif scenes is not None:
        _refuse_given(_OF_CASES, "--scenes")
        seed = int(chosen["seed"])
        bank, config = _bank_of_rig(context, bank_ref, work, chosen["step_mm"])
        with tempfile.TemporaryDirectory(prefix="workbench-bench-") as scratch:
            with context.progress("photographing scenes") as observer:
                write_drawn_scenes(Path(scratch), scenes, seed, rig_settings(config), observer)
            about = {"scenes": f"{scenes}, seeds {seed} to {seed + scenes - 1}"}
            _measure_files(context, read_truth(Path(scratch)), bank, methods, settings, out, about)
    else:
        _measure_simulated(context, FULL if full else QUICK, methods, settings, bank_ref, work, out, **chosen)


def _refuse_given(names: Sequence[str], beside: str) -> None:
    """Refuse options of the current command that were given though they have no use beside another one.

    Raises
    ------
    click.UsageError
        Naming the first of them.
    """
    current = click.get_current_context()
    flags = {param.name: param.opts[0] for param in current.command.params}
    for name in names:
        if current.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"{flags[name]} has no use beside {beside}: leave it out")


def _measure_simulated(
    context: Context, form: Form, methods: tuple[str, ...], settings: Settings, bank_ref: str | None, work: Path,
    out: Path | None, *, textures: tuple[str, ...], sizes: tuple[str, ...], lights: tuple[str, ...] | None,
    depths: int | None, from_mm: float | None, to_mm: float | None, every: int | None, seed: int, step_mm: float,
    jobs: int | None,
) -> None:  # fmt: skip
    started = time.monotonic()
    _depths_between(depth_list(0.0, seed), from_mm, to_mm)  # refused before a bank is made
    bank, config = _bank_of_rig(context, bank_ref, work, step_mm)
    rig = rig_settings(config)
    wanted = _depths_between(depth_list(rig.stage_zero_mm, seed), from_mm, to_mm)
    per_texture = min(depths or form.depths, len(wanted))
    cases = make_cases(textures, wanted, per_texture, seed)
    # the first cases hold every texture equally often
    first = -(-per_texture // (every or form.every)) * len(textures)
    references = [name for name in methods if name != DEFAULT_METHOD and len(methods) > 1]
    run = Run(methods, sizes, lights or form.lights, dict.fromkeys(references, first), settings)
    second = {}
    for name in (name for name in methods if name in SECOND_PUPILS):
        pupil = SECOND_PUPILS[name]
        with context.progress(f"calibrating the second aperture of {name}") as observer:
            other, _ = simulated_bank(work, seed=rig.seed, step_mm=step_mm, observer=observer, pupil=pupil)
        second[name] = View(other, replace(rig, pupil=pupil))
    with context.progress("bench accuracy") as observer:
        outcomes = run_cases(
            cases, run, View(bank, rig), second=second, jobs=jobs or min(2, usable_processors()), observer=observer
        )
    facts = {
        **_bank_facts(bank),
        "cases": f"{len(cases)} frames, seed {seed}, light {', '.join(run.lights)}, "
        f"{cm(min(case.true_mm for case in cases))} to {cm(max(case.true_mm for case in cases))}",
        "took": seconds_text(time.monotonic() - started),
    }
    _report(context, outcomes, bank.lens.focus_mm, facts, out)


def _depths_between(
    offered: list[tuple[float, bool]], from_mm: float | None, to_mm: float | None
) -> list[tuple[float, bool]]:
    low = offered[0][0] if from_mm is None else from_mm
    high = offered[-1][0] if to_mm is None else to_mm
    wanted = [(z, on_grid) for z, on_grid in offered if low <= z <= high]
    if not wanted:
        ends = f"{cm(offered[0][0], 0)} to {cm(offered[-1][0], 0)}"
        raise InputError(f"--from, --to: the bench has no depth from {cm(low)} to {cm(high)}; it has {ends}")
    return wanted


def _bank_of_rig(context: Context, bank_ref: str | None, work: Path, step_mm: float) -> tuple[Bank, RigConfig]:
    """The project's bank, or one of the simulated rig, and the rig."""
    if bank_ref is not None:
        project = context.project()
        return for_crops(open_bank(project, bank_ref)[0]), project.config()
    with context.progress("calibrating the simulated rig") as observer:
        return simulated_bank(work, seed=1, step_mm=step_mm, observer=observer)


def _measure_files(
    context: Context, files: TrueFiles, bank: Bank, methods: tuple[str, ...], settings: Settings, out: Path | None,
    about: Mapping[str, str],
) -> None:  # fmt: skip
    two = [name for name in methods if needs_second_view(name)]
    if two:
        context.note(f"left out, since they need two photographs: {', '.join(two)}")
        methods = tuple(name for name in methods if name not in two)
    with context.progress("bench accuracy") as observer:
        singles = run_truth(files, bank, methods, settings, observer)
    table = singles_table([(single.name, single.outcome) for single in singles])
    facts = {**about, **_bank_facts(bank)}
    _report(context, [single.outcome for single in singles], bank.lens.focus_mm, facts, out, [table])


def _bank_facts(bank: Bank) -> dict[str, str]:
    near, far = bank.depths_mm[0] / 10, bank.depths_mm[-1] / 10
    return {
        "bank": f"{bank.id}, {len(bank.depths_mm)} planes from {near:.1f} to {far:.1f} cm",
        "focus": f"{bank.lens.focus_mm / 10:.2f} cm",
    }


def _report(
    context: Context, outcomes: Sequence[Outcome], focus_mm: float, facts: Mapping[str, str], out: Path | None,
    first: Sequence[TableOf] = (),
) -> None:  # fmt: skip
    """Show the tables, write the files."""
    tables = [*first, *accuracy_tables(outcomes, focus_mm)]
    for table in tables:
        context.table(table.columns, table.rows, title=table.title)
        context.say()
    for name, fact in facts.items():
        context.say(f"{name}: {fact}")
    result = {**facts, "focus_mm": focus_mm, "tables": tables_json(outcomes, focus_mm)}
    if out is not None:
        textured = [outcome for outcome in outcomes if outcome.texture != BLANK]
        with staged_files(out) as directory:
            raw = [asdict(outcome) for outcome in outcomes]
            write_json(directory / "accuracy.json", {**result, "outcomes": raw})
            page = markdown_page("Accuracy", facts, tables, [f"{name}.png" for name in FIGURES if textured])
            (directory / "accuracy.md").write_text(page, encoding="utf-8")
            for name, draw in FIGURES.items() if textured else ():
                figure = draw(textured, focus_mm)
                (directory / f"{name}.png").write_bytes(to_bytes(figure, "png"))
                (directory / f"{name}.svg").write_bytes(to_bytes(figure, "svg"))
        context.say(f"written: {out}")
    context.emit(result)


def parse_size(_ctx: click.Context, _param: click.Parameter, text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT as (height, width)."""
    width, times, height = text.lower().partition("x")
    if not times or not width.isdigit() or not height.isdigit() or min(int(width), int(height)) < 128:
        raise click.BadParameter(f"{text!r}: give WIDTHxHEIGHT in pixels, at least 128x128")
    return int(height), int(width)


@bench.command()
@click.option(
    "--size",
    callback=parse_size,
    default="1296x864",
    show_default=True,
    help="Image for the deconvolution table, pixels.",
)
@click.option("--repeats", type=click.IntRange(1), default=5, show_default=True, help="Turns of the contenders.")
@click.option(
    "--frame",
    callback=parse_size,
    default="5184x3456",
    show_default=True,
    help="Photosites of the frame for whole methods; the default is a full EOS 650D frame.",
)
@click.option(
    "--methods",
    type=NamesParam("methods", ("none", *METHODS)),
    default="evidence,sharpness",
    show_default=True,
    help="Methods to time on that frame with six regions; none for none.",
)
@click.option(
    "--scikit-image-depths",
    type=click.IntRange(0),
    default=1,
    show_default=True,
    help="Depths at which the paper's method on scikit-image is timed; 0 leaves it out.",
)
@click.option("--memory/--no-memory", default=True, show_default=True, help="Measure the frame for its peak memory.")
@click.option(
    "--work",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Where banks are kept for the next run; default: the user's cache directory.",
)
@command_options
def speed(
    context: Context, size: tuple[int, int], repeats: int, frame: tuple[int, int], methods: tuple[str, ...],
    scikit_image_depths: int, memory: bool, work: Path | None,
) -> None:  # fmt: skip
    """Time deconvolution against scikit-image and bare transforms, and whole methods on a full frame."""
    context.note(f"deconvolution: {size[1]} x {size[0]} pixels, {repeats} turns")
    kernels = speed_table(size, repeats=repeats)
    rows: list[MethodRow] = []
    used: list[MemoryRow] = []
    methods = tuple(name for name in methods if name != "none" and not needs_second_view(name))
    if methods:
        with context.progress("calibrating the simulated rig") as observer:
            bank, config = simulated_bank(work or default_work(), seed=1, step_mm=100.0, observer=observer)
        context.note(f"rendering a frame of {frame[1]} x {frame[0]} photosites")
        with tempfile.TemporaryDirectory(prefix="workbench-bench-") as scratch:
            path = Path(scratch) / "frame.dng"
            render_scene_frame("four-objects", rig_settings(config), frame_shape=frame).write(path)
            bank_directory = save_bank(bank, Path(scratch))
            if memory:
                for method in methods:
                    context.note(f"measuring it with {method} for its peak memory")
                    used.append(peak_memory(bank_directory, path, method))
            context.note(f"timing {', '.join(methods)} on six regions")
            rows = in_one_thread(
                method_rows, develop_photograph(path, bank), sendable(bank), methods,
                scikit_image_depths=scikit_image_depths,
            )  # fmt: skip
    tables = speed_tables(kernels, rows, used, f"{frame[1]} x {frame[0]} photosites", usable_processors())
    for table in tables:
        context.table(table.columns, table.rows, title=table.title)
        context.say()
    context.emit({"deconvolution": [asdict(row) for row in kernels], "methods": [asdict(row) for row in rows],
                  "memory": [asdict(row) for row in used]})  # fmt: skip
