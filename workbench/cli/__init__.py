"""The command line: parse, call, print. The contract is docs/reference/command-line.md."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from workbench import __version__
from workbench.cli import rig
from workbench.cli.common import Context, run


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="workbench")
@click.option("-C", "directory", type=click.Path(path_type=Path), default=Path(), help="Project directory.")
@click.option("-v", "--verbose", count=True, help="Say more; twice for debugging.")
@click.option("--json", "as_json", is_flag=True, help="Machine output on stdout, all else on stderr.")
@click.pass_context
def workbench(ctx: click.Context, directory: Path, verbose: int, as_json: bool) -> None:
    """Absolute depth from one photograph: calibrate a coded-aperture camera, measure scenes."""
    ctx.obj = Context(directory, verbose, as_json)


for command in (rig.init, rig.plan):
    workbench.add_command(command)


def main() -> None:
    """Entry point of the console script."""
    sys.exit(run(workbench))
