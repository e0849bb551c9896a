"""Figures of a PSF bank: the PSFs, their radii with the fitted lens, the quality of each depth."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.quality import LIMITS, Limit
from workbench.figures.style import (
    BLUE,
    FAINT,
    INK,
    MUTED,
    ORANGE,
    SMALL,
    VERMILLION,
    WIDTH_IN,
    image_axes,
    new_figure,
    nice_length,
    scale_bar,
    style,
)

FloatArray = NDArray[np.float64]

VERDICT_STYLE: Mapping[str, tuple[str, str, str]] = {
    "good": ("o", BLUE, "●"),
    "suspect": ("^", ORANGE, "▲"),
    "bad": ("X", VERMILLION, "✕"),
}
"""Marker, colour and sign of each verdict: shape tells them apart without colour."""

MAX_TILES = 40
_COLUMNS = 8
_INSET = 0.42
_INSET_BELOW = 0.16
"""PSFs smaller than this part of the tile are shown again, magnified, in its corner."""


def verdicts(bank: Bank) -> tuple[str, ...]:
    """Verdict of each depth, (D,): from the manifest's quality figures, or else from the lens fit's residuals."""
    depths = bank.manifest.get("quality", {}).get("depths", [])
    if len(depths) == bank.depths_mm.size:
        return tuple(str(entry["verdict"]) for entry in depths)
    suspect = bank.lens.suspect or (False,) * bank.depths_mm.size
    return tuple("suspect" if flag else "good" for flag in suspect)


def psf_montage(bank: Bank) -> Figure:
    """Show the central PSFs over depth at one common scale, each normalised to its own peak, with its depth.

    PSFs that the common scale makes too small to see are repeated, magnified, in a corner. Banks of more than 40
    depths show an even selection.
    """
    chosen = _even_selection(bank.depths_mm.size, MAX_TILES)
    half = _montage_half(bank)
    centre = bank.central.shape[1] // 2
    tiles = bank.central[:, centre - half : centre + half + 1, centre - half : centre + half + 1]
    rows = -(-len(chosen) // _COLUMNS)
    columns = min(_COLUMNS, len(chosen))
    words = verdicts(bank)
    with style():
        figure = new_figure(WIDTH_IN, 0.35 + rows * WIDTH_IN / _COLUMNS * 1.17)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes in grid.flat:
            axes.set_axis_off()
        for k, d in enumerate(chosen):
            axes = grid.flat[k]
            axes.set_axis_on()
            _psf_tile(axes, tiles[d], abs(float(bank.lens.sigma_px(bank.depths_mm[d : d + 1])[0])), half)
            _, colour, sign = VERDICT_STYLE[words[d]]
            marked = words[d] != "good"
            axes.set_title(
                f"{bank.depths_mm[d] / 10:.4g} cm" + (f" {sign}" if marked else ""), fontsize=SMALL, pad=2.5,
                color=INK, weight="bold" if marked else "normal",
            )  # fmt: skip
            if marked:
                axes.spines[:].set(color=colour, linewidth=1.6)
        bar = nice_length(0.6 * half)
        emptiest = int(np.argmin(np.abs(bank.lens.sigma_px(bank.depths_mm[chosen]))))
        scale_bar(grid.flat[emptiest], bar, _length_label(bar, bank.pixel_pitch_mm), colour="black")
        figure.supxlabel("depth from the reference plane (cm), columns and rows in pixels of the developed image",
                         fontsize=SMALL, color=MUTED)  # fmt: skip
    return figure


def _psf_tile(axes: Axes, tile: NDArray[np.float32], radius_px: float, half: int) -> None:
    peak = float(tile.max()) or 1.0
    axes.imshow(tile, cmap="Greys", vmin=0.0, vmax=peak)
    image_axes(axes)
    if radius_px < _INSET_BELOW * half:
        small = max(3, int(np.ceil(1.1 * radius_px)) + 1)
        factor = _INSET * half / small
        if factor < 2.0:
            return
        inset = axes.inset_axes((1 - _INSET, 1 - _INSET, _INSET, _INSET))
        inset.imshow(tile[half - small : half + small + 1, half - small : half + small + 1], cmap="Greys", vmin=0.0,
                     vmax=peak)  # fmt: skip
        image_axes(inset)
        inset.text(0.5, -0.04, f"{factor:.0f} times", transform=inset.transAxes, ha="center", va="top", color=MUTED,
                   fontsize=SMALL - 1.5)  # fmt: skip


def _montage_half(bank: Bank) -> int:
    widest = float(np.abs(bank.lens.sigma_px(bank.depths_mm)).max())
    return int(min(bank.central.shape[1] // 2, max(6, np.ceil(1.08 * widest + 2))))


def _even_selection(count: int, most: int) -> list[int]:
    if count <= most:
        return list(range(count))
    return sorted({round(i) for i in np.linspace(0, count - 1, most)})


def _length_label(length_px: float, pitch_mm: float | None) -> str:
    text = f"{length_px:g} px"
    return text if pitch_mm is None else f"{text}\n{length_px * pitch_mm * 1000:.0f} µm"


def aperture_picture(bank: Bank) -> Figure:
    """Show the aperture as the PSFs reveal it, oriented as the PSF beyond focus; axes in aperture radii.

    Raises
    ------
    KeyError
        The bank holds no ``aperture`` array.
    """
    picture = bank.extras["aperture"]
    radius_mm = bank.manifest.get("aperture", {}).get("radius_mm")
    factor, unit = (radius_mm, "mm") if radius_mm else (1.0, "aperture radii")
    edge = 1.25 * factor
    with style():
        figure = new_figure(WIDTH_IN / 3, WIDTH_IN / 3)
        axes = figure.subplots()
        open_level = float(np.median(picture[picture > 0.5 * np.percentile(picture, 99)]))
        axes.imshow(picture, cmap="Greys", vmin=0.0, vmax=1.3 * open_level, extent=(-edge, edge, -edge, edge))
        angle = np.linspace(0, 2 * np.pi, 200)
        axes.plot(factor * np.cos(angle), factor * np.sin(angle), color=MUTED, lw=0.7, ls=(0, (3, 3)))
        axes.plot(0, 0, "+", color=VERMILLION, ms=6, mew=1.0)
        axes.set_xlabel(f"x ({unit})")
        axes.set_ylabel(f"y ({unit})")
        axes.spines[:].set_visible(True)
    return figure


def field_montage(bank: Bank) -> Figure:
    """Show the most blurred PSF at each measured place of the frame, laid out as the frame is."""
    widest = int(np.abs(bank.lens.sigma_px(bank.depths_mm)).argmax())
    half = _montage_half(bank)
    centre = bank.psf.shape[-1] // 2
    window = slice(centre - half, centre + half + 1)
    ys, xs = bank.field_yx.T
    size = 0.9 / max(2.0, np.sqrt(len(xs)) + 0.5)
    with style():
        figure = new_figure(WIDTH_IN * 0.62, WIDTH_IN * 0.44)
        axes = figure.subplots()
        for place, (y, x) in enumerate(zip(ys, xs, strict=True)):
            tile = bank.psf[place, widest, window, window]
            axes.imshow(tile, cmap="Greys", vmin=0, extent=(x - size, x + size, y + size, y - size))
            axes.text(x, y + size, f"({x:+.2f}, {y:+.2f})", ha="center", va="top", fontsize=SMALL, color=MUTED)
        axes.set_xlim(min(-1.0, xs.min() - size), max(1.0, xs.max() + size))
        axes.set_ylim(max(1.0, ys.max() + 1.3 * size), min(-1.0, ys.min() - size))
        axes.set_xlabel("x (half frame widths)")
        axes.set_ylabel("y (half frame heights)")
        axes.set_title(f"PSF at {bank.depths_mm[widest] / 10:.4g} cm over the field")
        axes.set_aspect("auto")
    return figure


def radius_against_depth(bank: Bank) -> Figure:
    """Plot signed radius against depth with the fitted thin lens and one-sigma error bars; residuals below.

    Negative radii are nearer than focus, where the PSF is turned by 180 degrees. The upper edge carries the inverse
    depth in dioptres, in which the lens is a straight line.
    """
    lens = bank.lens
    depth_cm = bank.depths_mm / 10
    words = np.array(verdicts(bank))
    fine_mm = np.geomspace(bank.depths_mm[0] * 0.95, bank.depths_mm[-1] * 1.03, 400)
    with style():
        figure = new_figure(WIDTH_IN, 4.4)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.6, 1))
        upper.axhline(0, color=FAINT, lw=0.8, zorder=0)
        upper.plot(fine_mm / 10, lens.sigma_px(fine_mm), color=MUTED, lw=1.1, label="fitted thin lens", zorder=1)
        _by_verdict(upper, depth_cm, lens.radius_px, lens.radius_se_px, words, prefix="measured, ")
        upper.axvline(lens.focus_mm / 10, color=MUTED, lw=0.8, ls=(0, (4, 3)), zorder=0)
        upper.annotate(
            f"focus {lens.focus_mm / 10:.2f} ± {lens.focus_se_mm / 10:.2g} cm", (lens.focus_mm / 10, 0.06),
            (4, 0), xycoords=("data", "axes fraction"), textcoords="offset points", color=MUTED, fontsize=SMALL,
        )  # fmt: skip
        upper.set_ylabel("signed radius (px)")
        upper.legend(loc="lower right", bbox_to_anchor=(1.0, 0.12))
        if bank.pixel_pitch_mm is not None:
            pitch_um = bank.pixel_pitch_mm * 1000
            right = upper.secondary_yaxis("right", functions=(lambda px: px * pitch_um, lambda um: um / pitch_um))
            right.set_ylabel("on the sensor (µm)")
        top = upper.secondary_xaxis("top", functions=(_inverse_depth, _inverse_depth))
        top.set_xlabel("inverse depth (dioptres, 1/m)")
        top.set_xticks(_dioptre_ticks(bank.depths_mm))
        _residual_panel(lower, bank, words)
    return figure


def _residual_panel(axes: Axes, bank: Bank, words: NDArray[np.str_]) -> None:
    lens, depth_cm = bank.lens, bank.depths_mm / 10
    limit = LIMITS["residual_px"]
    axes.axhspan(-limit.suspect, limit.suspect, color="#f2f5f8", zorder=0)
    axes.axhline(0, color=MUTED, lw=1.1, zorder=1)
    _by_verdict(axes, depth_cm, lens.residual_px, lens.radius_se_px, words)
    reach = max(1.25 * float(np.abs(lens.residual_px).max()), 1.15 * limit.suspect)
    axes.set_ylim(-reach, reach)
    if reach > limit.bad:
        for sign in (-1, 1):
            axes.axhline(sign * limit.bad, color=VERMILLION, lw=0.8)
    middle = float(depth_cm.mean())
    for depth, residual, word in zip(depth_cm, lens.residual_px, words, strict=True):
        # next to a residual that dwarfs them others lie on the axis, where their labels would cover them
        if word != "good" and abs(residual) > 0.1 * reach:
            axes.annotate(
                f"{depth:.4g} cm", (depth, residual), (6 if depth < middle else -6, 0), textcoords="offset points",
                fontsize=SMALL, va="center", ha="left" if depth < middle else "right",
            )  # fmt: skip
    axes.set_ylabel("measured − fit (px)")
    axes.set_xlabel("depth (cm)")
    low = float(lens.residual_px[depth_cm > middle].sum()) < -limit.bad  # then the upper corner is the free one
    axes.text(
        0.995, 0.96 if low else 0.04, f"band: ±{limit.suspect:g} px, suspect beyond", transform=axes.transAxes,
        ha="right", va="top" if low else "bottom", fontsize=SMALL, color=MUTED,
    )  # fmt: skip


def _by_verdict(
    axes: Axes, x: FloatArray, y: FloatArray, error: FloatArray | None, words: NDArray[np.str_], prefix: str = ""
) -> None:
    for word, (marker, colour, _) in VERDICT_STYLE.items():
        chosen = (words == word) & np.isfinite(y)
        if not chosen.any():
            continue
        size = 4.0 if word == "good" else 6.5
        axes.errorbar(
            x[chosen], y[chosen], None if error is None else error[chosen], fmt=marker, ms=size, color=colour,
            mec="white" if word != "bad" else colour, mew=0.4, elinewidth=0.8, capsize=1.5, capthick=0.8,
            label=f"{prefix}{word}", zorder=3,
        )  # fmt: skip


def _inverse_depth(value: Any) -> Any:
    """Turn cm into dioptres and back; kept finite, because limits are tried while axes are set up."""
    return 100.0 / np.maximum(value, 1e-3)


def _dioptre_ticks(depths_mm: FloatArray) -> list[float]:
    """Round dioptres from far to near, none closer on the depth axis than a label is wide."""
    candidates = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)
    room = 0.07 * float(np.ptp(depths_mm))
    kept: list[float] = []
    for tick in candidates:
        depth = 1000.0 / tick
        if depths_mm[0] <= depth <= depths_mm[-1] and (not kept or 1000.0 / kept[-1] - depth > room):
            kept.append(tick)
    return kept


def quality_by_depth(bank: Bank) -> Figure:
    """Plot every quality figure that the manifest holds against depth, with the limits of suspect and bad.

    Raises
    ------
    ValueError
        The manifest holds no quality figure (a bank that was imported as bare arrays).
    """
    names, values = _quality_table(bank.manifest.get("quality", {}).get("depths", []))
    if not names:
        raise ValueError("the bank's manifest holds no quality figures")
    depth_cm = np.array([entry["depth_nominal_mm"] / 10 for entry in bank.manifest["quality"]["depths"]])
    columns = 3
    rows = -(-len(names) // columns)
    with style():
        figure = new_figure(WIDTH_IN, 0.3 + 1.32 * rows)
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True)
        for axes, name, row in zip(grid.flat, names, values, strict=False):
            _quality_panel(axes, name, depth_cm, row, LIMITS.get(name))
        for axes in list(grid.flat)[len(names) :]:
            axes.set_axis_off()
        for k in range(columns):
            last = max(r for r in range(rows) if r * columns + k < len(names) or r == 0)
            grid[last, k].set_xlabel("depth (cm)")
            grid[last, k].tick_params(labelbottom=True)
    return figure


def _quality_table(depths: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[FloatArray]]:
    names = list(dict.fromkeys(name for entry in depths for name in entry["figures"]))
    table = [np.array([_number(entry["figures"].get(name)) for entry in depths]) for name in names]
    kept = [k for k, row in enumerate(table) if np.isfinite(row).any()]
    return [names[k] for k in kept], [table[k] for k in kept]


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def verdict_of(value: float, limit: Limit | None) -> str:
    """Judge one figure by its limit; good where there is none."""
    if limit is None or not np.isfinite(value):
        return "good"
    sign = -1.0 if limit.low_is_bad else 1.0
    if sign * value > sign * limit.bad:
        return "bad"
    return "suspect" if sign * value > sign * limit.suspect else "good"


def _quality_panel(axes: Axes, name: str, depth_cm: FloatArray, values: FloatArray, limit: Limit | None) -> None:
    words = np.array([verdict_of(float(value), limit) for value in values])
    if limit is not None:  # a figure far on the good side (noise-free data) says no more than its limit's thousandfold
        values = np.clip(values, 1e-3 * limit.bad, 1e3 * limit.suspect) if limit.low_is_bad else values
    axes.plot(depth_cm, values, color=FAINT, lw=0.8, zorder=1)
    _by_verdict(axes, depth_cm, values, None, words)
    shown = values[np.isfinite(values)]
    low, high = float(shown.min()), float(shown.max())
    if limit is not None:
        low, high = min(low, limit.suspect), max(high, limit.suspect)
        axes.axhline(limit.suspect, color=ORANGE, lw=0.9, ls=(0, (5, 2)), zorder=0)
        if min(low, high) <= limit.bad <= max(low, high):
            axes.axhline(limit.bad, color=VERMILLION, lw=0.9, zorder=0)
    if limit is not None and limit.low_is_bad and low > 0 and high / low > 30:
        axes.set_yscale("log")
        axes.set_ylim(low / 1.6, high * 1.6)
        axes.yaxis.set_major_locator(LogLocator(numticks=5))
        axes.yaxis.set_minor_locator(NullLocator())
    else:
        margin = 0.12 * (high - low or 1.0)
        axes.set_ylim(min(low - margin, 0.0) if low >= 0 and low < 0.5 * high else low - margin, high + margin)
        axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_title(figure_name(name))
    axes.set_ylabel(_UNITS.get(name, "ratio"))


_UNITS = {
    "residual_px": "px",
    "residual_sigma": "standard errors",
    "background": "fraction of white",
    "saturation_margin": "fraction of white",
}


def figure_name(name: str) -> str:
    """Give a quality figure's name as words: ``residual_px`` -> ``residual``."""
    words = name.removesuffix("_px").replace("_", " ")
    known = {"residual sigma": "residual in standard errors", "flux snr": "flux SNR", "peak snr": "peak SNR"}
    return known.get(words, words)


def in_words(reason: str) -> str:
    """Replace names of quality figures (``residual_px``) in a sentence by words."""
    for name in sorted(LIMITS, key=len, reverse=True):
        reason = re.sub(rf"\b{name}\b", figure_name(name), reason)
    return reason
