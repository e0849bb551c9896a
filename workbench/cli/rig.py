"""Commands that make a project and drive the rig: init, plan, calibrate, resume."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rigs.errors import LimitError, RigError
from workbench.cli.common import LENGTH, Context, command_options
from workbench.errors import InputError
from workbench.field_grid import reach_text
from workbench.planning import cost, make_plan
from workbench.project import Project, create_project
from workbench.units import bytes_text, cm, seconds_text

if TYPE_CHECKING:
    from workbench.calibrate import CalibrationResult
    from workbench.plan import Plan


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


class FieldType(click.ParamType[tuple[int, int]]):
    """Points across and down, as ``3x3``."""

    name = "NxM"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Parse the text."""
        across, cross, down = str(value).lower().partition("x")
        if not (cross and across.isdigit() and down.isdigit()):
            self.fail(f"{value}: give points across x down, e.g. 3x3", param, ctx)
        return int(across), int(down)


FIELD = FieldType()


def plan_options(function: click.decorators.FC) -> click.decorators.FC:
    """--from, --to, --step, --repeats and --field, shared by plan and calibrate."""
    for option in reversed(
        (
            click.option("--from", "from_mm", type=LENGTH, default=None, help="Nearest depth, e.g. 60cm."),
            click.option("--to", "to_mm", type=LENGTH, default=None, help="Farthest depth, e.g. 350cm."),
            click.option("--step", "step_mm", type=LENGTH, default=None, help="Step between depths, e.g. 10cm."),
            click.option("--repeats", type=click.IntRange(1, 100), default=None, help="Point frames per depth."),
            click.option(
                "--field",
                type=FIELD,
                default=None,
                metavar="NxM",
                help="Points across and down the panel, e.g. 3x3, for PSFs over the field.",
            ),
        )
    ):
        function = option(function)
    return function


@click.command()
@plan_options
@command_options
def plan(
    context: Context, from_mm: float | None, to_mm: float | None, step_mm: float | None, repeats: int | None,
    field: tuple[int, int] | None,
) -> None:  # fmt: skip
    """Show the shots that calibrate would take; touches nothing."""
    config = context.project().config()
    made = make_plan(config, from_mm=from_mm, to_mm=to_mm, step_mm=step_mm, repeats=repeats, field=field)
    estimate = cost(made, config)
    rows = [
        (cm(depth, 0), f"{dot.size_px:g} px", f"{made.repeats}", f"{made.off_frames}")
        for depth, dot in zip(made.depths_mm, made.dots, strict=True)
    ]
    context.table(("depth", "dot", "point frames", "panel-off frames"), rows)
    if made.dots[0].points_px:
        near, far = (reach_text(config, made.dots[i].points_px, made.depths_mm[i]) for i in (0, -1))
        context.say(
            f"{len(made.dots[0].points_px)} points per frame, reaching {near} of the half frame at the nearest depth "
            f"and {far} at the farthest: as far as the panel allows."
        )
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


@click.command()
@plan_options
@click.option("--frames", type=click.Path(path_type=Path), default=None,
              help="Make the bank from RAW files: psf_060cm.dng ..., dark*.dng, or a frames.csv.")  # fmt: skip
@click.option("--apply-zero", is_flag=True, help="With --frames: add the fitted stage zero to the depths.")
@command_options
def calibrate(
    context: Context, from_mm: float | None, to_mm: float | None, step_mm: float | None, repeats: int | None,
    field: tuple[int, int] | None, frames: Path | None, apply_zero: bool,
) -> None:  # fmt: skip
    """Drive the rig through the plan and make a bank; or make it from files (--frames)."""
    project = context.project()
    config = project.config()
    wishes = {"from_mm": from_mm, "to_mm": to_mm, "step_mm": step_mm, "repeats": repeats, "field": field}
    if frames is not None:
        from workbench.calibrate import calibrate_frames

        if any(value is not None for value in wishes.values()):
            raise InputError(
                "--frames: the depths come from the files; leave out --from, --to, --step, --repeats and --field"
            )
        result = calibrate_frames(
            project, context.existing(frames, "directory of frames"), config, apply_zero=apply_zero
        )
        _show_bank(context, project, result)
        return
    if apply_zero:
        raise InputError("--apply-zero: only with --frames; a session of the rig always applies the fitted zero")
    made = make_plan(config, from_mm=from_mm, to_mm=to_mm, step_mm=step_mm, repeats=repeats, field=field)
    run_session(context, project, made)


@click.command()
@click.argument("session", required=False)
@command_options
def resume(context: Context, session: str | None) -> None:
    """Go on with a session (default: the newest) where its journal stops."""
    project = context.project()
    run_session(context, project, project.latest_session() if session is None else session)


def run_session(context: Context, project: Project, what: Plan | str) -> None:
    """Start a session of a plan, or take what is missing of the session of this id; make and show its bank.

    A new session leaves no trace unless the rig can be opened and reaches every depth.
    """
    from workbench.calibrate import calibrate_session
    from workbench.device_news import DeviceNews
    from workbench.devices import open_rig
    from workbench.frame_reader import FrameReader
    from workbench.session import SessionRunner, create_session, load_plan

    made = load_plan(project.sessions / what) if isinstance(what, str) else what
    config = project.config()
    frames, news = FrameReader(config.camera.pixel_pitch_mm), DeviceNews(context.note)
    with project.lock_rig(), open_rig(config, tell=context.note, frames=frames, news=news) as rig:
        try:
            rig.check_reach(made.depths_mm)
        except LimitError as error:
            raise InputError(str(error)) from None
        if made.widest.points_px:
            rig.check_panel(made.widest.pattern())
        rig.camera.exposure_times_s()  # sets a real camera up: what is wrong with it is said before anything moves
        session = what if isinstance(what, str) else project.new_session_id()
        directory = project.sessions / session
        if not isinstance(what, str):
            create_session(directory, made)
        with context.progress(f"session {session}", asks=config.stage.kind == "manual") as observer:
            runner = SessionRunner(directory, made, rig, observer=observer, check=frames.read, news=news)
            try:
                state = runner.run()
            except RigError as error:
                error.args = (_resumable(str(error), by_hand=config.stage.kind == "manual"),)
                raise
    context.note("making the bank")
    result = calibrate_session(project, directory, made, state, config)
    _show_bank(context, project, result, session)


def _resumable(message: str, *, by_hand: bool) -> str:
    """An error that ended a session, with how to go on with it."""
    if "`workbench resume`" in message:
        return message
    if message.startswith("stage:") and not by_hand:
        return f"{message} (`workbench resume` homes it where needed, and goes on)"
    return f"{message}, then `workbench resume`"


def _show_bank(context: Context, project: Project, result: CalibrationResult, session: str = "") -> None:
    from workbench.cli.banks import check_activated, tell_bank

    facts = tell_bank(context, result.bank, result.entry)
    for rejected in result.built.rejected:
        context.say(f"left out: {rejected.message}")
    context.say(f"report: {result.report}")
    context.emit(
        {
            **facts,
            "session": session,
            "report": project.relative(result.report),
            "rejected": [{"file": r.path, "reason": r.reason, "message": r.message} for r in result.built.rejected],
        }
    )
    check_activated(result.bank, result.entry)
