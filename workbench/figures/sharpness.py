"""How sharpness assessment reached its depth: edge maps before and after denoising, histogram and threshold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from workbench.depth.estimate import DepthEstimate
from workbench.figures.style import (
    BLUE,
    FAINT,
    INK,
    INTENSITY_MAP,
    MUTED,
    ORANGE,
    SMALL,
    VERMILLION,
    WIDTH_IN,
    image_axes,
    new_figure,
    style,
)

Diagnostics = Mapping[str, NDArray[np.float64]]

MAPS = (
    ("x", "first difference, x"),
    ("y", "first difference, y"),
    ("xx", "second difference, x"),
    ("yy", "second difference, y"),
)
"""Names of the four edge maps in the diagnostics, and in words."""


def has_edge_maps(estimate: DepthEstimate) -> bool:
    """Whether the estimate kept what :func:`window_sums` and :func:`threshold` draw."""
    return all(f"{what}_{name}" in estimate.diagnostics for name, _ in MAPS for what in ("window", "sections"))


def window_sums(estimate: DepthEstimate) -> Figure:
    """Show the four window-sum maps at the chosen depth: as they are (above) and after denoising (below).

    Each column has one colour range, so that what denoising removed can be read off.
    """
    found = estimate.diagnostics
    height, width = found["window_x"].shape
    with style():
        figure = new_figure(WIDTH_IN, min(7.0, 0.75 + 2 * WIDTH_IN / 4 * height / width))
        grid = figure.subplots(2, 4, squeeze=False)
        for column, (name, words) in enumerate(MAPS):
            pair = found[f"window_{name}"] * 1e4, found[f"denoised_{name}"] * 1e4
            top = float(np.percentile(pair[0], 99.5)) or 1.0
            for row, picture in enumerate(pair):
                axes = grid[row, column]
                shown = axes.imshow(picture, cmap=INTENSITY_MAP, vmin=0.0, vmax=top)
                image_axes(axes)
            grid[0, column].set_title(words, fontsize=SMALL)
            grid[1, column].set_xlabel("x (px)", fontsize=SMALL)
            bar = figure.colorbar(shown, ax=grid[:, column], location="bottom", fraction=0.05, pad=0.02, aspect=18)
            bar.outline.set_linewidth(0.4)
            bar.ax.tick_params(labelsize=SMALL - 1, length=2)
            bar.set_label("share of the sum (10⁻⁴)", fontsize=SMALL)
        grid[0, 0].set_ylabel("window sum\ny (px)")
        grid[1, 0].set_ylabel("denoised\ny (px)")
    return figure


def threshold(estimate: DepthEstimate, name: str = "x") -> Figure:
    """Show histogram and cumulative distribution of one window-sum map, cut into sections, with its threshold.

    The threshold is the largest magnitude of the first section whose next section spans at least twice as much
    magnitude; what lies above is kept.
    """
    found = estimate.diagnostics
    counts, edges = found[f"histogram_{name}"], found[f"magnitude_{name}"] * 1e4
    ends, theta = found[f"sections_{name}"] * 1e4, float(found[f"threshold_{name}"][0]) * 1e4
    right = max(float(edges[-1]), 1e-12)
    with style():
        figure = new_figure(WIDTH_IN, 2.2)
        left_axes, right_axes = figure.subplots(1, 2)
        below = edges[:-1] + edges[1:] < 2 * theta
        left_axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=np.where(below, "#b8c0c8", BLUE), lw=0)
        if counts.max() > 0:
            left_axes.set_yscale("log")
            left_axes.set_ylim(0.7, counts.max() * 2)
        left_axes.set_ylabel("pixels")
        left_axes.set_title("histogram")
        _distribution(right_axes, counts, edges, ends)
        for axes in (left_axes, right_axes):
            axes.axvline(theta, color=VERMILLION, lw=1.1)
            axes.set_xlim(0, right)
            axes.set_xlabel("normalised window sum (10⁻⁴)")
        kept = float(counts[~below].sum() / max(1.0, counts.sum()))
        right_axes.annotate(
            f"threshold {theta:.3g}\n{100 * kept:.0f} % kept", (theta, 0.1), (5, 0), textcoords="offset points",
            color=VERMILLION, fontsize=SMALL,
        )  # fmt: skip
    return figure


def _distribution(axes: Axes, counts: NDArray[np.float64], edges: NDArray[np.float64], ends: Any) -> None:
    heights = np.linspace(0.0, 1.0, len(ends))
    for height, end in zip(heights, ends, strict=True):
        axes.plot([0, end], [height, height], color=FAINT, lw=0.6, zorder=0)
        axes.plot([end, end], [0, height], color=FAINT, lw=0.6, zorder=0)
    cumulative = np.concatenate([[0.0], np.cumsum(counts)]) / max(1.0, counts.sum())
    axes.plot(edges, cumulative, color=INK, lw=1.1)
    axes.plot(ends, heights, "o", ms=3, color=ORANGE, mec="white", mew=0.3, label="section ends")
    axes.set_ylim(0, 1.03)
    axes.set_ylabel("cumulative share of pixels")
    axes.set_title("cumulative distribution")
    axes.legend(loc="lower right")


def contributions(estimate: DepthEstimate) -> Figure:
    """Plot the score of each edge map against depth, before the size factor, and that factor."""
    scores, factor = estimate.diagnostics["scores"], estimate.diagnostics["lambda"]
    depth_cm = estimate.depths_mm / 10
    colours = (BLUE, ORANGE, VERMILLION, MUTED)
    with style():
        figure = new_figure(WIDTH_IN * 0.7, 2.2)
        axes = figure.subplots()
        for (_, words), row, colour, dash in zip(MAPS, scores, colours, ("-", "--", "-.", ":"), strict=True):
            top = float(row.max()) or 1.0
            axes.plot(depth_cm, row / top, color=colour, ls=dash, label=words)
        axes.plot(depth_cm, factor / (float(np.abs(factor).max()) or 1.0), color=INK, lw=0.8, label="size factor")
        axes.set_xlabel("depth (cm)")
        axes.set_ylabel("each / its largest")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
