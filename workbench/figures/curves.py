"""What a region says about its depth: score or posterior curves, intervals, differences from a known truth."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray

from workbench.depth.estimate import DepthEstimate
from workbench.figures.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    SKY,
    SMALL,
    VERMILLION,
    WIDTH_IN,
    halo,
    new_figure,
    style,
)

FloatArray = NDArray[np.float64]

STATUS_STYLE: Mapping[str, tuple[str, str]] = {
    "ok": ("o", BLUE),
    "ambiguous": ("^", ORANGE),
    "saturated": ("s", VERMILLION),
    "no-texture": ("X", MUTED),
}
"""Marker and colour of each status: shape tells them apart without colour."""

_LOG_FLOOR = 1e-6
"""Probabilities below this part of the peak are not drawn: nobody can act on them."""


def is_posterior(estimate: DepthEstimate) -> bool:
    """Whether the curve is probability mass (sums to 1) rather than a score (largest value 1)."""
    score = estimate.score
    return bool(score.size > 1 and np.isfinite(score).all() and score.min() >= 0 and abs(score.sum() - 1) < 1e-3)


def score_curves(estimates: Mapping[int, DepthEstimate]) -> Figure:
    """Plot the curve that decided, one panel per region, with peak, 95 % interval, second best and mirror depth.

    Posteriors are drawn relative to their peak on a logarithmic axis, since a rival of a hundredth is worth seeing;
    scores on a linear one. A region without a depth shows the reason.
    """
    numbers = sorted(estimates)
    columns = min(3, max(1, len(numbers)))
    rows = max(1, -(-len(numbers) // columns))
    lowest = _lowest_score(estimates)
    with style():
        figure = new_figure(WIDTH_IN, 0.5 + 1.55 * rows)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, number in zip(grid.flat, numbers, strict=False):
            _curve_panel(axes, number, estimates[number], lowest)
        for k, axes in enumerate(grid.flat):
            if k >= len(numbers):
                axes.set_axis_off()
            elif k + columns >= len(numbers):
                axes.set_xlabel("depth (cm)")
        for row in grid:
            estimate = estimates.get(numbers[list(grid[:, 0]).index(row[0]) * columns]) if numbers else None
            row[0].set_ylabel("probability / peak" if estimate is None or is_posterior(estimate) else "score / best")
        figure.legend(handles=_curve_key(), loc="outside lower center", ncols=5, handlelength=1.8)
    return figure


def _lowest_score(estimates: Mapping[int, DepthEstimate]) -> float:
    """Lower end of the common score axis: panels must share it, or a flat curve would look like a peak."""
    lows = [
        float(np.nanmin(e.score)) / float(np.nanmax(e.score))
        for e in estimates.values()
        if math.isfinite(e.depth_mm) and not is_posterior(e) and np.nanmax(e.score) > 0
    ]
    return min(lows, default=0.0) - 0.05


def _curve_panel(axes: Axes, number: int, estimate: DepthEstimate, lowest: float) -> None:
    depth_cm = estimate.depths_mm / 10
    top = float(np.nanmax(estimate.score)) if estimate.score.size and np.isfinite(estimate.score).any() else 0.0
    refused = not math.isfinite(estimate.depth_mm)
    axes.set_title(
        f"region {number}: no depth" if refused else f"region {number}: {estimate.depth_mm / 10:.1f} cm",
        color=MUTED if refused else INK,
    )
    if depth_cm.size:
        margin = 0.02 * float(np.ptp(depth_cm))
        axes.set_xlim(depth_cm.min() - margin, depth_cm.max() + margin)
    if estimate.status != "ok":
        axes.set_title(estimate.status, loc="right", color=MUTED, fontsize=SMALL)
    if top > 0:
        _draw_curve(axes, estimate, depth_cm, estimate.score / top, lowest, faint=refused)
    else:
        axes.set_yticks([])
    if refused:
        axes.text(0.5, 0.55, _wrapped(estimate.reason or estimate.status, 30), transform=axes.transAxes, ha="center",
                  va="center", fontsize=SMALL, color=INK,
                  bbox={"fc": "white", "ec": FAINT, "lw": 0.6})  # fmt: skip
        return
    low, high = estimate.interval_mm
    if math.isfinite(low) and math.isfinite(high):
        axes.axvspan(low / 10, high / 10, color=SKY, alpha=0.28, lw=0, zorder=0)
    axes.axvline(estimate.depth_mm / 10, color=BLUE, lw=0.9, zorder=1)
    _mark(axes, estimate, estimate.depth_mm, "o", BLUE)
    if _in_reach(estimate, estimate.second_mm):
        _mark(axes, estimate, estimate.second_mm, "D", ORANGE)
    if _in_reach(estimate, estimate.mirror_mm):
        axes.axvline(estimate.mirror_mm / 10, color=GREEN, lw=1.0, ls=(0, (2, 2)), zorder=1)
        if math.isfinite(estimate.mirror_probability):
            _mirror_note(axes, estimate)


def _mirror_note(axes: Axes, estimate: DepthEstimate) -> None:
    left, right = axes.get_xlim()
    mirror = estimate.mirror_mm / 10
    to_left = mirror < estimate.depth_mm / 10 and mirror - left > 0.2 * (right - left)
    to_left = to_left or right - mirror < 0.2 * (right - left)
    axes.annotate(
        f"P {_probability(estimate.mirror_probability)}", (mirror, 0.97 if is_posterior(estimate) else 0.05),
        (-2 if to_left else 2, 0), xycoords=("data", "axes fraction"), textcoords="offset points",
        ha="right" if to_left else "left", va="top" if is_posterior(estimate) else "bottom", fontsize=SMALL - 1,
        color=GREEN, path_effects=halo(1.5),
    )  # fmt: skip


def _in_reach(estimate: DepthEstimate, depth_mm: float) -> bool:
    """Whether a depth is a number within the depths that were looked at."""
    return bool(estimate.depths_mm.size and estimate.depths_mm.min() <= depth_mm <= estimate.depths_mm.max())


def _draw_curve(
    axes: Axes, estimate: DepthEstimate, depth_cm: FloatArray, curve: FloatArray, lowest: float, *, faint: bool
) -> None:
    colour = MUTED if faint else INK
    if is_posterior(estimate):
        axes.set_yscale("log")
        axes.set_ylim(_LOG_FLOOR, 3.0)
        axes.yaxis.set_major_locator(LogLocator(numticks=4))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.plot(depth_cm, np.maximum(curve, _LOG_FLOOR), color=colour, lw=1.0, zorder=2)
    else:
        axes.plot(depth_cm, curve, color=colour, lw=0.9, marker=".", ms=2.5, zorder=2)
        axes.set_ylim(lowest, 1.0 + 0.08 * (1.0 - lowest))


def _mark(axes: Axes, estimate: DepthEstimate, depth_mm: float, marker: str, colour: str) -> None:
    order = np.argsort(estimate.depths_mm)
    top = float(np.nanmax(estimate.score))
    height = float(np.interp(depth_mm, estimate.depths_mm[order], estimate.score[order])) / top
    if is_posterior(estimate):
        height = max(height, _LOG_FLOOR)
    axes.plot(depth_mm / 10, height, marker, color=colour, mec="white", mew=0.6, ms=5.5, zorder=4, clip_on=False)


def _curve_key() -> list[Line2D | Patch]:
    return [
        Line2D([], [], color=BLUE, marker="o", ms=5, mec="white", lw=0.9, label="chosen depth"),
        Patch(color=SKY, alpha=0.28, lw=0, label="95 % interval"),
        Line2D([], [], color=ORANGE, marker="D", ms=5, mec="white", lw=0, label="second best"),
        Line2D([], [], color=GREEN, lw=1.0, ls=(0, (2, 2)), label="mirror depth, its probability P"),
    ]


def depths_with_intervals(estimates: Mapping[int, DepthEstimate], true_mm: Mapping[int, float] | None = None) -> Figure:
    """Plot depth and 95 % interval of each region on one axis, with mirror depths and, where known, the truth."""
    numbers = [n for n in sorted(estimates) if math.isfinite(estimates[n].depth_mm)]
    rows = np.arange(len(numbers))
    with style():
        figure = new_figure(WIDTH_IN, 0.75 + 0.2 * max(2, len(numbers)))
        axes = figure.subplots()
        axes.grid(axis="x")
        axes.set_axisbelow(True)
        for row, number in zip(rows, numbers, strict=True):
            _interval_row(axes, float(row), estimates[number], None if true_mm is None else true_mm.get(number))
        axes.set_yticks(rows, [str(number) for number in numbers])
        axes.set_ylim(len(numbers) - 0.4, -0.6)
        axes.set_ylabel("region")
        axes.set_xlabel("depth (cm)")
        used = [status for status in STATUS_STYLE if any(estimates[n].status == status for n in numbers)]
        axes.legend(handles=_interval_key(used, true_mm is not None), loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _interval_row(axes: Axes, row: float, estimate: DepthEstimate, true_mm: float | None) -> None:
    marker, colour = STATUS_STYLE[estimate.status]
    low, high = estimate.interval_mm
    if math.isfinite(low) and math.isfinite(high):
        axes.plot([low / 10, high / 10], [row, row], color=colour, lw=2.6, alpha=0.55, solid_capstyle="butt")
    if _in_reach(estimate, estimate.mirror_mm):
        axes.plot(estimate.mirror_mm / 10, row, marker="o", ms=4, mfc="none", mec=GREEN, mew=0.9, ls="")
    if true_mm is not None and math.isfinite(true_mm):
        axes.plot(true_mm / 10, row, marker="|", ms=10, mec=INK, mew=1.4, ls="", zorder=2)
    axes.plot(estimate.depth_mm / 10, row, marker=marker, ms=5, color=colour, mec="white", mew=0.5, ls="", zorder=3)


def _interval_key(statuses: Sequence[str], with_truth: bool) -> list[Line2D]:
    key = [
        Line2D([], [], color=STATUS_STYLE[s][1], marker=STATUS_STYLE[s][0], ms=5, mec="white", lw=2.6, label=s)
        for s in statuses
    ]
    key.append(Line2D([], [], marker="o", ms=4, mfc="none", mec=GREEN, ls="", label="mirror depth"))
    if with_truth:
        key.append(Line2D([], [], marker="|", ms=9, mec=INK, mew=1.4, ls="", label="true depth"))
    return key


def depth_difference(estimates: Mapping[int, DepthEstimate], true_mm: Mapping[int, float]) -> Figure:
    """Plot measured minus true depth against the true depth, with the 95 % interval of each region."""
    numbers = [n for n in sorted(estimates) if n in true_mm and math.isfinite(estimates[n].depth_mm)]
    with style():
        figure = new_figure(WIDTH_IN * 0.62, 2.3)
        axes = figure.subplots()
        axes.axhline(0, color=MUTED, lw=0.9, zorder=0)
        for number in numbers:
            estimate, truth = estimates[number], true_mm[number] / 10
            marker, colour = STATUS_STYLE[estimate.status]
            low, high = (bound / 10 - truth for bound in estimate.interval_mm)
            if math.isfinite(low) and math.isfinite(high):
                axes.plot([truth, truth], [low, high], color=colour, lw=1.4, alpha=0.6)
            error = estimate.depth_mm / 10 - truth
            axes.plot(truth, error, marker, color=colour, ms=5.5, mec="white", mew=0.5)
            axes.annotate(str(number), (truth, error), (5, 3), textcoords="offset points", fontsize=SMALL)
        axes.set_xlabel("true depth (cm)")
        axes.set_ylabel("measured − true (cm)")
    return figure


def _probability(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}" if value < 0.01 else f"{value:.2f}"


def _wrapped(text: str, width: int) -> str:
    return "\n".join(textwrap.wrap(text, width)[:4])
