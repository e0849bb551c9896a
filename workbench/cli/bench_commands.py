"""The group ``bench`` with all its commands."""

from workbench.cli import bench_field, bench_raytrace
from workbench.cli.bench import bench

__all__ = ["bench", "bench_field", "bench_raytrace"]
