"""What all reports share: the page, figures in it, numbers as text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import jinja2
from matplotlib.figure import Figure

from workbench.figures.style import Format, to_data_uri

GLYPHS = {
    "ok": "●", "ambiguous": "▲", "saturated": "■", "no-texture": "✕", "good": "●", "suspect": "▲", "bad": "✕",
}  # fmt: skip
"""Sign of each status and verdict: tells them apart without colour."""
UNKNOWN = "–"

Facts = list[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Shown:
    """A figure in a page."""

    title: str
    caption: str
    source: str
    """A ``data:`` address."""
    shape: str = ""
    """CSS class: '' for the full width, ``narrow`` or ``small``."""


def render(template: str, **values: Any) -> str:
    """Fill a template of this package; everything is escaped, and a value that is missing is an error."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("workbench"), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template(template).render(software=metadata.version("depth-workbench"), **values)


def shown(title: str, caption: str, figure: Figure, form: Format = "svg", shape: str = "") -> Shown:
    """Render a figure for a page."""
    return Shown(title, caption, to_data_uri(figure, form), shape)


def fixed(value: float, digits: int, *, sign: bool = False) -> str:
    """Format with fixed digits, with a true minus sign; a dash for what is not a number."""
    if not math.isfinite(value):
        return UNKNOWN
    return f"{value:{'+' if sign else ''}.{digits}f}".replace("-", "−")


def cm(depth_mm: float | None, digits: int | None = None) -> str:
    """Format a depth in mm as cm: with fixed digits, or with four significant ones."""
    if depth_mm is None or not math.isfinite(depth_mm):
        return UNKNOWN
    return f"{depth_mm / 10:.4g}" if digits is None else f"{depth_mm / 10:.{digits}f}"


def pitch_text(pitch_mm: float | None) -> str:
    """Format a pixel pitch in µm."""
    return f"{pitch_mm * 1000:.3g} µm" if pitch_mm else UNKNOWN


def plain(value: Any) -> str:
    """Format any JSON value for reading."""
    if value is None or value == "" or value == [] or value == {}:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {plain(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(plain(item) for item in value)
    return str(value)


def plain_facts(values: Mapping[str, Any]) -> Facts:
    """Format a JSON object as pairs of name and value."""
    return [(str(name).replace("_", " "), plain(value)) for name, value in values.items()]
