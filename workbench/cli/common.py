"""What every command shares: global options in any position, output to the right stream, errors to exit codes."""

from __future__ import annotations

import errno
import functools
import json
import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from calibration.errors import CalibrationError
from rigs.errors import ConfigError, RigError
from workbench.errors import CheckFailedError, InputError
from workbench.files import json_ready
from workbench.progress import Step
from workbench.project import Project, open_project
from workbench.units import length_mm, pixel_pitch_mm, seconds_text

EXIT_INTERNAL, EXIT_INPUT, EXIT_CHECK, EXIT_DEVICE, EXIT_INTERRUPTED = 1, 2, 3, 4, 130
_NO_EDGE = 100_000
"""Columns that no line reaches."""
Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass(slots=True)
class Context:
    """Global options of one invocation."""

    directory: Path = Path()
    verbose: int = 0
    json: bool = False

    def project(self) -> Project:
        """The project that -C names."""
        return open_project(self.directory)

    def existing(self, path: Path, what: str) -> Path:
        """A path given on the command line: relative to the current directory, or else to the project.

        Raises
        ------
        InputError
            It is in neither.
        """
        for candidate in (path, self.directory / path):
            if candidate.exists():
                return candidate
        raise InputError(f"{path}: no such {what}")

    @property
    def console(self) -> Console:
        """Where people read: stdout, or stderr when stdout belongs to a machine."""
        return Console(stderr=self.json, soft_wrap=True, highlight=False)

    def say(self, text: str = "") -> None:
        """A line for people."""
        self.console.print(text, markup=False)

    def note(self, text: str) -> None:
        """A passing remark: on stderr, so that it never mixes with a result."""
        print(text, file=sys.stderr, flush=True)

    def emit(self, value: Any) -> None:
        """One JSON object on stdout (one line), only with --json."""
        if self.json:
            sys.stdout.write(json.dumps(json_ready(value), ensure_ascii=False, allow_nan=False) + "\n")
            sys.stdout.flush()

    def table(self, columns: Sequence[str], rows: Iterable[Sequence[object]], title: str | None = None) -> None:
        """A table for people; the first column is left aligned, the others right."""
        table = Table(
            title=title, title_justify="left", box=None, pad_edge=False, header_style="bold", show_header=any(columns)
        )
        for index, name in enumerate(columns):
            # a list of names and values wraps its values, a table keeps its lines
            table.add_column(
                name, justify="right" if index and any(columns) else "left", no_wrap=index == 0 or any(columns),
                overflow="fold",
            )  # fmt: skip
        for row in rows:
            table.add_row(*(str(cell) for cell in row))
        console = self.console
        if console.is_terminal:
            console.print(table)
            return
        console.width = _NO_EDGE  # a file or pipe has no edge: nothing is cut or wrapped, nothing padded
        with console.capture() as captured:
            console.print(table)
        for line in captured.get().splitlines():
            console.print(line.rstrip(), markup=False)

    @contextmanager
    def progress(self, title: str, *, asks: bool = False) -> Iterator[Callable[[Step], None]]:
        """An observer for long work: a bar on a terminal, plain lines elsewhere; always on stderr.

        ``asks``: the operator is asked questions meanwhile; a bar would draw over the answers.
        """
        if asks or not sys.stderr.isatty():
            yield lambda step: print(_plain(title, step), file=sys.stderr, flush=True)
            return
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(title, total=None)

            def update(step: Step) -> None:
                bar.update(task, description=f"{title}: {step.message}", completed=step.done, total=step.total)

            yield update


def _plain(title: str, step: Step) -> str:
    left = f", {seconds_text(step.seconds_left)} left" if step.seconds_left is not None else ""
    return f"{title} {step.done}/{step.total}: {step.message}{left}"


class LengthParam(click.ParamType[float]):
    """A length with a unit; a bare number is centimetres. Value in millimetres."""

    name = "length"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse one command line value."""
        if isinstance(value, float):
            return value
        try:
            return length_mm(value, default_unit="cm")
        except InputError as error:
            self.fail(str(error), param, ctx)


class PitchParam(click.ParamType[float]):
    """Pitch of a sensor's pixels, with its unit. Value in millimetres."""

    name = "length"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse one command line value."""
        try:
            return value if isinstance(value, float) else pixel_pitch_mm(value)
        except InputError as error:
            self.fail(str(error), param, ctx)


LENGTH, PITCH = LengthParam(), PitchParam()


def command_options(function: Command) -> Command:
    """Accept the global options after the command's name too, and hand the command a :class:`Context`."""

    @click.option("-C", "directory", type=click.Path(path_type=Path), default=None, help="Project directory.")
    @click.option("-v", "--verbose", count=True, help="Say more; twice for debugging.")
    @click.option("--json", "as_json", is_flag=True, help="Machine output on stdout, all else on stderr.")
    @functools.wraps(function)
    def wrapper(*args: Any, directory: Path | None, verbose: int, as_json: bool, **kwargs: Any) -> Any:
        context = click.get_current_context().find_object(Context) or Context()
        if directory is not None:
            context.directory = directory
        context.verbose += verbose
        context.json = context.json or as_json
        _set_up_logging(context.verbose)
        return function(context, *args, **kwargs)

    return wrapper  # type: ignore[return-value]


def _set_up_logging(verbose: int) -> None:
    level = {0: logging.WARNING, 1: logging.INFO}.get(verbose, logging.DEBUG)
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", stream=sys.stderr, force=True)
    for name in ("workbench", "calibration", "rigs"):
        logging.getLogger(name).setLevel(level)
    if not verbose:  # what is wrong with a file is said by us, in one line
        logging.getLogger("tifffile").setLevel(logging.CRITICAL)


def run(group: click.Group, argv: Sequence[str] | None = None) -> int:
    """Run the command line; every expected error is one line and an exit code."""
    try:
        result = group.main(args=list(argv) if argv is not None else None, standalone_mode=False)
        return result if isinstance(result, int) else 0
    except click.exceptions.Exit as leave:
        return leave.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        return EXIT_INPUT
    except click.UsageError as error:
        hint = f" (see `{error.ctx.command_path} --help`)" if error.ctx else ""
        return _fail(f"{error.format_message()}{hint}", EXIT_INPUT)
    except (KeyboardInterrupt, click.Abort):
        return _fail("interrupted; `workbench resume` goes on with a calibration", EXIT_INTERRUPTED)
    except (InputError, CalibrationError, ConfigError, click.ClickException) as error:
        return _fail(error.format_message() if isinstance(error, click.ClickException) else str(error), EXIT_INPUT)
    except CheckFailedError as error:
        return _fail(str(error), EXIT_CHECK)
    except RigError as error:
        full = getattr(error.__cause__, "errno", None) in _FULL
        return _fail(str(error), EXIT_INPUT if full else EXIT_DEVICE)
    except (BrokenPipeError, SystemExit):  # rich and click end the process when stdout is closed
        return _reader_has_gone()
    except OSError as error:
        advice = _ADVICE.get(error.errno or 0)
        if advice is None:
            return _internal(error)
        where = error.filename2 or error.filename or "disk"
        return _fail(f"{where}: {(error.strerror or 'not accessible').lower()}; {advice}", EXIT_INPUT)
    except Exception as error:
        return _internal(error)


_FULL = {
    errno.ENOSPC: "free some space and run again",
    errno.EDQUOT: "free some space and run again",
    errno.EFBIG: "raise the limit on the size of files (`ulimit -f`), or name a disk that takes larger ones",
}
_ADVICE = {
    **_FULL,
    errno.EACCES: "change its permissions or name another place",
    errno.EPERM: "change its permissions or name another place",
    errno.EROFS: "name another place",
    errno.ENOENT: "check the path",
    errno.ENOTDIR: "a file stands where a directory is needed: name another place",
    errno.EEXIST: "a file stands where a directory is needed: name another place",
    errno.EISDIR: "name a file",
    errno.ENAMETOOLONG: "check the path",
}
"""Trouble of the file system that the operator can mend."""


def _reader_has_gone() -> int:
    """What `head` does to a pipe is no error; Python must not complain when it closes stdout at its end."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _fail(message: str, code: int) -> int:
    print(f"workbench: {' '.join(message.split())}", file=sys.stderr)
    return code


def _internal(error: Exception) -> int:
    traceback.print_exception(error, file=sys.stderr)
    return _fail(f"internal error, please report it: {type(error).__name__}: {error}", EXIT_INTERNAL)
