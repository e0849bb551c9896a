"""The command line: parse, call, print. The contract is docs/reference/command-line.md."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import click

from workbench import __version__
from workbench.cli.common import Context, run

COMMANDS = {
    "init": "workbench.cli.rig:init",
    "doctor": "workbench.cli.doctor:doctor",
    "align": "workbench.cli.align:align",
    "plan": "workbench.cli.rig:plan",
    "calibrate": "workbench.cli.rig:calibrate",
    "resume": "workbench.cli.rig:resume",
    "measure": "workbench.cli.measure:measure",
    "capture": "workbench.cli.measure:capture",
    "bank": "workbench.cli.banks:bank",
    "demo": "workbench.cli.demo:demo",
    "bench": "workbench.cli.bench_commands:bench",
}


class LazyGroup(click.Group):
    """Imports a command's module only when it is used: `--version` must not wait for numerics."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """In the order in which a newcomer needs them."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import the module that holds a command."""
        if cmd_name not in COMMANDS:
            return None
        module, attribute = COMMANDS[cmd_name].split(":")
        command = getattr(importlib.import_module(module), attribute)
        assert isinstance(command, click.Command)
        return command


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="workbench")
@click.option("-C", "directory", type=click.Path(path_type=Path), default=Path(), help="Project directory.")
@click.option("-v", "--verbose", count=True, help="Say more; twice for debugging.")
@click.option("--json", "as_json", is_flag=True, help="Machine output on stdout, all else on stderr.")
@click.pass_context
def workbench(ctx: click.Context, directory: Path, verbose: int, as_json: bool) -> None:
    """Absolute depth from one photograph: calibrate a coded-aperture camera, measure scenes."""
    ctx.obj = Context(directory, verbose, as_json)


def main() -> None:
    """Entry point of the console script."""
    sys.exit(run(workbench))
