"""Figures of an accuracy run: errors against depth, rates by texture, and how near the physical limit is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from calibration.optics import mirror_depth
from workbench.bench.scoring import Outcome, grouped
from workbench.bench.tables import BANDS_MM, band_name
from workbench.figures.style import (
    BLUE,
    FAINT,
    INK,
    MUTED,
    ORANGE,
    REGION_COLOURS,
    SMALL,
    VERMILLION,
    WIDTH_IN,
    new_figure,
    style,
)

_TICKS_CM = (60, 80, 100, 130, 160, 200, 250, 350)
_COLUMNS = 3
_COLOURS = (*REGION_COLOURS, MUTED)
"""Of methods, in the order of the tables."""
_BAR_IN, _BARS_IN = 0.16, 0.8
"""Height of one method's bar, and most of all bars of a texture."""


def measured_against_true(outcomes: Sequence[Outcome], focus_mm: float) -> Figure:
    """Every answer, one panel per method, on axes linear in 1/z: the diagonal is right, the dashed line the mirror."""
    methods = list(dict.fromkeys(o.method for o in outcomes))
    columns = min(_COLUMNS, len(methods))
    rows = -(-len(methods) // columns)
    with style():
        figure = new_figure(WIDTH_IN if columns > 1 else WIDTH_IN * 0.6, 0.5 + 2.5 * rows)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, method in zip(grid.flat, methods, strict=False):
            _scatter(axes, [o for o in outcomes if o.method == method], focus_mm)
            axes.set_title(method)
        for axes in list(grid.flat)[len(methods) :]:
            axes.set_axis_off()
        handles, names = grid.flat[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=4)
    return figure


def _scatter(axes: Axes, outcomes: Sequence[Outcome], focus_mm: float) -> None:
    ends = np.array([550.0, 3900.0])
    axes.plot(1000 / ends, 1000 / ends, color=MUTED, lw=0.8, zorder=1, label="right")
    line = np.linspace(1 / ends[1], 1 / ends[0], 200)
    mirrors = np.array([mirror_depth(1 / u, focus_mm=focus_mm) for u in line])
    seen = np.isfinite(mirrors) & (mirrors < ends[1])
    axes.plot(1000 * line[seen], 1000 / mirrors[seen], color=MUTED, lw=0.8, ls="--", zorder=1, label="mirror depth")
    answered = [o for o in outcomes if o.answered]
    for marked, marker, colour, label in ((False, "o", BLUE, "given"), (True, "^", ORANGE, "called ambiguous")):
        chosen = [o for o in answered if (o.status == "ambiguous") == marked]
        axes.plot(
            [1000 / o.true_mm for o in chosen], [1000 / o.depth_mm for o in chosen], marker, color=colour, ms=2.5,
            alpha=0.55, mew=0, label=label,
        )  # fmt: skip
    ticks = [100.0 / cm for cm in _TICKS_CM]
    for axis, label in ((axes.xaxis, "true depth, cm"), (axes.yaxis, "measured, cm")):
        axis.set_major_locator(FixedLocator(ticks))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 / value:.0f}"))
        axis.set_label_text(label)
    axes.tick_params(axis="x", rotation=60)
    axes.set_xlim(1000 / ends[1], 1000 / ends[0])
    axes.set_ylim(1000 / ends[1], 1000 / ends[0])
    axes.invert_xaxis()  # near on the left
    axes.invert_yaxis()
    axes.set_aspect("equal")


def rates_by_texture(outcomes: Sequence[Outcome], focus_mm: float) -> Figure:
    """Exact and gross answers of each texture class, as bars for each method."""
    groups = grouped(outcomes, lambda o: (o.method, o.texture), focus_mm)
    methods = list(dict.fromkeys(key[0] for key in groups))
    textures = list(dict.fromkeys(key[1] for key in groups))
    height = 0.8 / len(methods)
    with style():
        figure = new_figure(WIDTH_IN, 1.0 + len(textures) * min(_BAR_IN * max(2, len(methods)), _BARS_IN))
        panels = figure.subplots(1, 2, sharey=True)
        for axes, what in zip(panels, ("exact", "gross"), strict=True):
            for k, method in enumerate(methods):
                shares = [100 * getattr(groups[method, t], what) if (method, t) in groups else np.nan for t in textures]
                places = np.arange(len(textures)) + (k - (len(methods) - 1) / 2) * height
                axes.barh(places, shares, height * 0.9, color=_COLOURS[k % len(_COLOURS)], label=method)
            axes.set_yticks(range(len(textures)), textures)
            axes.set_xlim(0, 100)
            axes.set_title({"exact": "exact, % of answers", "gross": "off by more than 40 cm, % of regions"}[what])
            axes.grid(True, axis="x")
            axes.set_axisbelow(True)
        panels[0].set_ylim(len(textures) - 0.5, -0.5)
        handles, names = panels[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=min(5, len(names)))
    return figure


def error_and_bound(outcomes: Sequence[Outcome], focus_mm: float) -> Figure:
    """RMS error of the fine answers by depth band and size, over the Cramer-Rao bound of the same ones."""
    sizes = list(dict.fromkeys(o.size for o in outcomes))
    methods = list(dict.fromkeys(o.method for o in outcomes))
    bands = [band_name(low) for low, _ in BANDS_MM]
    groups = grouped(outcomes, lambda o: (o.size, o.method, band_name(o.true_mm)), focus_mm)
    with style():
        figure = new_figure(WIDTH_IN, 2.6)
        for axes, size in zip(figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0], sizes, strict=True):
            for k, method in enumerate(methods):
                found = [groups.get((size, method, band)) for band in bands]
                colour = _COLOURS[k % len(_COLOURS)]
                axes.plot([f.fine_rms_cm if f else np.nan for f in found], "o-", color=colour, label=method)
                bounds = [f.bound_cm if f else np.nan for f in found]
                if k == 0 and np.isfinite(bounds).any():
                    axes.plot(bounds, "v:", color=INK, ms=3, label=f"bound (regions of {method})")
            axes.set_yscale("log")
            axes.set_title(size)
            axes.set_xticks(range(len(bands)), [_short(band) for band in bands], rotation=60)
            axes.axhline(5.0, color=VERMILLION, lw=0.6, ls="--")
            axes.annotate("5 cm", (0, 5.0), (0, 1), textcoords="offset points", fontsize=SMALL, color=VERMILLION)
            axes.grid(True, axis="y", color=FAINT)
        axes = figure.axes[0]
        axes.set_ylabel("RMS error, cm")
        handles, names = axes.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=min(5, len(names)))
    return figure


def _short(band: str) -> str:
    return band.replace("nearer than ", "< ").replace("beyond ", "> ").replace(" to ", "–").replace(" cm", "")
