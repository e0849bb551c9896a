"""bench field: off axis, a bank over the field against its central set."""

from __future__ import annotations

from dataclasses import asdict

import click
import numpy as np

from workbench.banks import open_bank
from workbench.bench.bench_banks import rig_settings
from workbench.bench.cases import TEXTURES, Case
from workbench.bench.field import compare_over_field
from workbench.bench.scoring import Figures, summarise
from workbench.bench.tables import figures_table
from workbench.cli.bench import bench
from workbench.cli.common import Context, command_options
from workbench.depth.methods import DEFAULT_METHOD, METHODS, needs_second_view
from workbench.errors import InputError


@bench.command("field")
@click.option("--bank", "bank_ref", default="active", show_default=True, help="Bank with PSFs over the field.")
@click.option("--cases", "count", type=click.IntRange(1, 1000), default=20, show_default=True, help="Photographs.")
@click.option("--region", type=click.IntRange(48, 256), default=160, show_default=True, help="Side of the regions, px.")
@click.option("--method", type=click.Choice([name for name in METHODS if not needs_second_view(name)]),
              default=DEFAULT_METHOD, show_default=True, help="Estimator.")  # fmt: skip
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Of textures and depths.")
@command_options
def field(context: Context, bank_ref: str, count: int, region: int, method: str, seed: int) -> None:
    """Compare a bank over the field with its central set, on regions towards the corners of the frame."""
    project = context.project()
    found, entry = open_bank(project, bank_ref)
    if len(found.field_yx) == 1:
        raise InputError(f"bench field: bank v{entry.version} has one set of PSFs; calibrate with --field 3x3 first")
    rig = rig_settings(project.config())
    generator = np.random.default_rng([seed, 0xF1])
    near, far = found.depths_mm[0], found.depths_mm[-1]
    cases = [
        Case(TEXTURES[i % len(TEXTURES)], float(1 / generator.uniform(1 / far, 1 / near)), False, seed + i)
        for i in range(count)
    ]
    with context.progress("measuring off axis") as observer:
        outcomes = compare_over_field(found, rig, cases, method=method, side_px=region, observer=observer)
    groups: dict[tuple[str, ...], Figures] = {
        (name, f"{region} px"): summarise([o for o in outcomes if o.method == name], found.lens.focus_mm)
        for name in dict.fromkeys(o.method for o in outcomes)
    }
    table = figures_table(
        f"Off axis, {method}, coma {rig.coma:g}, vignetting {rig.vignetting:g}", "region", groups
    )  # fmt: skip
    context.table(table.columns, table.rows, title=table.title)
    context.emit({"bank": found.id, "figures": {key[0]: asdict(figures) for key, figures in groups.items()}})
