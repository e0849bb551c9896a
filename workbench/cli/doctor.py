"""doctor: what is wrong with this rig, and how to mend it."""

from __future__ import annotations

import sys
import textwrap
from typing import Any

import click
from rich.text import Text

from workbench.cli.common import Context, command_options
from workbench.doctor.examine import examine
from workbench.doctor.findings import Checkup, Finding, Severity
from workbench.errors import CheckFailedError, InputError
from workbench.units import duration_s

_WORD, _SUBJECT, _NARROWEST = 9, 10, 30
"""Widths of columns, and of the narrowest text."""
_STYLE = {Severity.OK: "green", Severity.NOTE: "cyan", Severity.WARNING: "yellow", Severity.ERROR: "bold red"}


class DurationParam(click.ParamType[float]):
    """A time with or without its unit; a bare number is seconds."""

    name = "time"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse one command line value."""
        if isinstance(value, float):
            return value
        try:
            seconds = duration_s(value, default_unit="s")
        except InputError as error:
            self.fail(str(error), param, ctx)
        if not seconds >= 0:
            self.fail(f"{value!r}: a time below 0", param, ctx)
        return seconds


@click.command()
@click.option("--panel-wait", "panel_wait_s", type=DurationParam(), default=8.0, metavar="TIME",
              help="How long to wait for the panel's page in a browser, e.g. 2min.  [default: 8s]")  # fmt: skip
@command_options
def doctor(context: Context, panel_wait_s: float) -> None:
    """Check rig and project: what is wrong, and how to mend it; moves nothing."""
    project = context.project()
    config = project.config()
    with context.progress("checking") as observer:
        checkup = examine(
            project,
            config,
            panel_wait_s=panel_wait_s,
            operator_present=sys.stdin.isatty(),
            tell=context.note,
            observer=observer,
        )
    _show(context, checkup)
    context.emit(checkup.as_json())
    if not checkup.ready:
        errors = [f"{finding.subject} {finding.check}" for finding in checkup.of(Severity.ERROR)]
        raise CheckFailedError(f"not ready to calibrate: {', '.join(errors)}")


def _show(context: Context, checkup: Checkup) -> None:
    """Worst last, where the eye is when the prompt comes back."""
    seen = checkup.plugged_in
    for name, things in (("cameras", seen.cameras), ("serial ports", seen.serial_ports), ("browsers", seen.browsers)):
        context.say(f"{name + ':':{_WORD + _SUBJECT}}{', '.join(things) or 'none'}")
    console = context.console
    check_width = max((len(finding.check) for finding in checkup.findings), default=0) + 2
    for severity in Severity:
        for number, finding in enumerate(checkup.of(severity)):
            if number == 0:
                context.say()
            console.print(_lines(finding, check_width, console.width))
    context.say()
    context.say(_summary(checkup))


def _lines(finding: Finding, check_width: int, width: int) -> Text:
    """One finding: what was seen, and below it the way to mend it, wrapped within their column."""
    indent = _WORD + _SUBJECT + check_width
    text = Text()
    text.append(f"{finding.severity.word:{_WORD}}", style=_STYLE[finding.severity])
    text.append(f"{finding.subject:{_SUBJECT}}{finding.check:{check_width}}")
    seen = textwrap.wrap(finding.seen, max(width - indent, _NARROWEST), break_on_hyphens=False)
    mend = textwrap.wrap(
        finding.mend, max(width - indent, _NARROWEST), break_on_hyphens=False, initial_indent="-> ",
        subsequent_indent="   ",
    )  # fmt: skip
    text.append(("\n" + " " * indent).join([*seen, *mend]))
    return text


def _summary(checkup: Checkup) -> str:
    counts = [
        f"{checkup.count(severity)} {severity.word}{'s' if checkup.count(severity) != 1 else ''}"
        for severity in (Severity.ERROR, Severity.WARNING, Severity.NOTE)
        if checkup.count(severity)
    ]
    found = f"{checkup.count(Severity.OK)} checks passed{''.join(f', {text}' for text in counts)}."
    return f"{found} {'Ready to calibrate.' if checkup.ready else 'A calibration would stop.'}"
