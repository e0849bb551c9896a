"""One look for all figures: sizes, type, colours that print and suit colour-blind readers, and the way to bytes."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patheffects import withStroke

WIDTH_IN = 7.2
"""Width of a full figure: the text width of an A4 page."""
DPI = 192
"""Twice the 96 dpi of a screen."""

SMALL, NORMAL, LARGE = 7.0, 8.0, 9.5
"""The font scale (pt): annotations, axes, headings."""

# Okabe and Ito 2008: distinguishable with any colour vision, and by lightness in print
BLUE, ORANGE, GREEN, VERMILLION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, YELLOW = "#56B4E9", "#CC79A7", "#F0E442"
INK, MUTED, FAINT = "#1b1f24", "#68707a", "#dfe3e8"
UNKNOWN = "#e7e9ec"
"""Fill of what has no depth; always with a hatch."""
HATCH = "////"
REGION_COLOURS = (BLUE, ORANGE, GREEN, VERMILLION, SKY, PURPLE, YELLOW)

DEPTH_MAP = "cividis_r"
"""Depth colours: near is light, far is dark; lightness alone carries the order, so it survives a grey printer."""
INTENSITY_MAP = "viridis"

_FONTS = ("Source Sans 3", "Helvetica Neue", "Helvetica", "Arial", "Liberation Sans", "DejaVu Sans")

Format = Literal["svg", "png", "jpeg"]


def _families() -> list[str]:
    known = {entry.name for entry in font_manager.fontManager.ttflist}
    return [name for name in _FONTS if name in known]


@contextmanager
def style() -> Iterator[None]:
    """Settings of all figures, for the time in which one is made; whatever the caller had set is restored."""
    with mpl.rc_context(
        {
            "font.family": _families(),
            "font.size": NORMAL,
            "axes.labelsize": NORMAL,
            "axes.titlesize": NORMAL,
            "axes.titleweight": "bold",
            "axes.titlelocation": "left",
            "axes.titlepad": 5.0,
            "axes.labelcolor": INK,
            "axes.edgecolor": MUTED,
            "axes.linewidth": 0.6,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": False,
            "axes.unicode_minus": True,
            "grid.color": FAINT,
            "grid.linewidth": 0.5,
            "text.color": INK,
            "xtick.color": MUTED,
            "ytick.color": MUTED,
            "xtick.labelcolor": INK,
            "ytick.labelcolor": INK,
            "xtick.labelsize": SMALL,
            "ytick.labelsize": SMALL,
            "xtick.major.width": 0.6,
            "ytick.major.width": 0.6,
            "xtick.major.size": 3.0,
            "ytick.major.size": 3.0,
            "legend.fontsize": SMALL,
            "legend.frameon": False,
            "lines.linewidth": 1.3,
            "lines.markersize": 4.0,
            "hatch.linewidth": 0.4,
            "hatch.color": "#a9b0b8",
            "figure.facecolor": "white",
            "savefig.facecolor": "white",
            "svg.fonttype": "path",
            "svg.hashsalt": "depth-workbench",
            "image.interpolation": "nearest",
        }
    ):
        yield


def new_figure(width_in: float, height_in: float) -> Figure:
    """Make an empty figure on a canvas of its own; constrained layout."""
    layout = ConstrainedLayoutEngine(w_pad=0.04, h_pad=0.04, wspace=0.03, hspace=0.05)
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def image_axes(axes: Axes) -> None:
    """Strip ticks from axes that show a picture, and keep a thin frame."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_linewidth(0.4)
        spine.set_color(MUTED)


def halo(width: float = 2.0, colour: str = "white") -> list[Any]:
    """Path effect that keeps text and lines readable on a picture."""
    return [withStroke(linewidth=width, foreground=colour)]


def scale_bar(axes: Axes, length_px: float, label: str, *, colour: str = "white", inset: float = 0.05) -> None:
    """Draw a horizontal bar of ``length_px`` data pixels in the lower left corner of an image, labelled above it."""
    x0, x1 = sorted(axes.get_xlim())
    y_low, y_high = axes.get_ylim()
    x = x0 + inset * (x1 - x0)
    y = y_low + inset * (y_high - y_low)
    other = "black" if colour == "white" else "white"
    axes.plot([x, x + length_px], [y, y], color=colour, lw=1.6, solid_capstyle="butt", path_effects=halo(2.6, other))
    text = axes.annotate(
        label, (x, y), (0, 2), textcoords="offset points", ha="left", va="bottom", linespacing=1.1,
        color=colour, fontsize=SMALL, path_effects=halo(1.5, other),
    )  # fmt: skip
    text.set_in_layout(False)


def nice_length(limit: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that doesn't exceed ``limit`` (> 0)."""
    power = 10.0 ** np.floor(np.log10(limit))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= limit * (1 + 1e-9)))


def to_bytes(figure: Figure, form: Format) -> bytes:
    """Render a figure: ``svg`` for drawings, ``jpeg`` for photographs, ``png`` for flat pictures.

    Carries no date, so that the same values give the same bytes.
    """
    buffer = io.BytesIO()
    with style():
        if form == "jpeg":
            figure.savefig(buffer, format="jpeg", dpi=DPI, pil_kwargs={"quality": 88, "subsampling": 0})
        elif form == "png":
            figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None}, pil_kwargs={"optimize": True})
        else:
            figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def to_data_uri(figure: Figure, form: Format) -> str:
    """Give the figure as a ``data:`` address, for a page that needs no other file."""
    kind = {"svg": "image/svg+xml", "png": "image/png", "jpeg": "image/jpeg"}[form]
    return f"data:{kind};base64,{base64.b64encode(to_bytes(figure, form)).decode('ascii')}"
