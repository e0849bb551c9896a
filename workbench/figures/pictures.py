"""Pictures of a measurement: photograph and all-focus image, regions, depth map."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from workbench.display import exposure_gain, to_srgb8
from workbench.figures.style import (
    DEPTH_MAP,
    HATCH,
    INK,
    MUTED,
    REGION_COLOURS,
    SMALL,
    UNKNOWN,
    WIDTH_IN,
    halo,
    new_figure,
    style,
)
from workbench.measurement import Measurement

Picture = NDArray[np.uint8]

FIGURE_SIDE_PX = 1000
"""Pictures in figures are reduced to this many pixels along the longer side: what a printed column can show."""


def reduced(image: NDArray[np.float32], side: int = FIGURE_SIDE_PX) -> NDArray[np.float32]:
    """Reduce a linear image (H, W, C) by area averaging so that its longer side is at most ``side``; keeps 3 axes."""
    factor = max(image.shape[:2]) / side
    if factor > 1:
        size = (max(1, round(image.shape[1] / factor)), max(1, round(image.shape[0] / factor)))
        small = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.float32).reshape(size[1], size[0], -1)
    return image


def reduced_labels(labels: NDArray[np.int32], shape: tuple[int, int]) -> NDArray[np.int32]:
    """Bring labels (H, W) to another size by nearest neighbour."""
    if labels.shape == shape:
        return labels
    return np.asarray(cv2.resize(labels, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST), np.int32)


def reduced_depth(depth_mm: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Bring a depth map (H, W) to another size by nearest neighbour, so that no depth is made up; keeps NaN."""
    if depth_mm.shape == shape:
        return depth_mm
    return np.asarray(cv2.resize(depth_mm, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST), np.float32)


def as_rgb(picture: Picture) -> Picture:
    """Give (H, W, 1) or (H, W, 3) as three channels."""
    return np.asarray(np.broadcast_to(picture, (*picture.shape[:2], 3))) if picture.shape[2] == 1 else picture


def photograph_and_all_focus(measurement: Measurement) -> Figure:
    """Show the photograph and, beside it, every region deconvolved with the PSF of its depth; same exposure."""
    photograph = reduced(measurement.image.planes, FIGURE_SIDE_PX * 2 // 3)
    sharp = reduced(measurement.all_focus, FIGURE_SIDE_PX * 2 // 3)
    gain = exposure_gain(photograph)
    with style():
        figure = new_figure(WIDTH_IN, _height(photograph, WIDTH_IN / 2) + 0.45)
        pair = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, linear, title in zip(pair, (photograph, sharp), ("photograph", "all in focus"), strict=True):
            _show(axes, as_rgb(to_srgb8(linear, gain)), measurement.image.shape)
            axes.set_title(title)
            axes.set_xlabel("x (px)")
        pair[0].set_ylabel("y (px)")
    return figure


def segmentation(measurement: Measurement) -> Figure:
    """Show the regions as numbered outlines over the photograph; regions without a depth are hatched."""
    photograph = reduced(measurement.image.planes)
    shape = (photograph.shape[0], photograph.shape[1])
    labels = reduced_labels(measurement.labels, shape)
    grey = to_srgb8(photograph.mean(axis=2)).astype(np.float32) / 255
    base = np.repeat((0.35 + 0.65 * grey)[:, :, np.newaxis], 3, axis=2)
    numbers = sorted(measurement.estimates)
    for k, number in enumerate(numbers):
        colour = np.array([int(REGION_COLOURS[k % len(REGION_COLOURS)][i : i + 2], 16) / 255 for i in (1, 3, 5)])
        mask = labels == number
        base[mask] = 0.72 * base[mask] + 0.28 * colour
    with style():
        figure = new_figure(WIDTH_IN * 0.72, _height(photograph, WIDTH_IN * 0.72) + 0.35)
        axes = figure.subplots()
        _show(axes, (base * 255).astype(np.uint8), measurement.image.shape)
        scale = measurement.image.shape[1] / shape[1]
        unknown = [n for n in numbers if not math.isfinite(measurement.estimates[n].depth_mm)]
        _hatch(axes, np.isin(labels, unknown), scale)
        for number in numbers:
            _outline(axes, labels == number, scale)
        for number in numbers:
            _badge(axes, labels == number, str(number), scale)
        _image_labels(axes)
        if unknown:
            _unknown_key(axes, "no depth")
    return figure


def depth_map(measurement: Measurement) -> Figure:
    """Show the depth map with a colour bar in cm; unknown depth is grey and hatched.

    Regions carry their depth, ambiguous ones with a question mark.
    """
    height, width = measurement.depth_map_mm.shape
    factor = max(1.0, max(height, width) / FIGURE_SIDE_PX)
    shape = (max(1, round(height / factor)), max(1, round(width / factor)))
    depth_cm = reduced_depth(measurement.depth_map_mm, shape) / 10
    labels = reduced_labels(measurement.labels, shape)
    known = np.isfinite(depth_cm)
    norm = depth_norm(depth_cm[known])
    with style():
        figure = new_figure(WIDTH_IN * 0.8, WIDTH_IN * 0.8 * 0.85 * shape[0] / shape[1] + 0.35)
        axes = figure.subplots()
        axes.set_facecolor(UNKNOWN)
        picture = axes.imshow(np.ma.masked_invalid(depth_cm), cmap=DEPTH_MAP, norm=norm,
                              extent=(0, width, height, 0))  # fmt: skip
        if known.any():
            bar = figure.colorbar(picture, ax=axes, fraction=0.046, pad=0.02)
            bar.set_label("depth (cm)")
            bar.ax.invert_yaxis()
            bar.outline.set_linewidth(0.4)
        scale = width / shape[1]
        _hatch(axes, ~known, scale)
        for number, estimate in sorted(measurement.estimates.items()):
            mask = labels == number
            _outline(axes, mask, scale, colour="white", width=0.6)
            if math.isfinite(estimate.depth_mm):
                doubt = "?" if estimate.status == "ambiguous" else ""
                _depth_label(axes, mask, f"{estimate.depth_mm / 10:.0f}{doubt}", scale)
        _image_labels(axes)
        for spine in axes.spines.values():
            spine.set_visible(True)
        if not known.all():
            _unknown_key(axes, "unknown")
    return figure


def depth_norm(depth_cm: NDArray[np.floating]) -> Normalize:
    """Colour range over the known depths, at least 10 % wide about its middle, so that one depth is no artefact."""
    if depth_cm.size == 0:
        return Normalize(0.0, 1.0)
    low, high = float(depth_cm.min()), float(depth_cm.max())
    least = 0.05 * (low + high) / 2
    if high - low < 2 * least:
        low, high = (low + high) / 2 - least, (low + high) / 2 + least
    return Normalize(low, high)


def inner_point(mask: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Find the point of a mask that lies farthest from its edge: x, y and that distance, pixels of the mask."""
    padded = np.pad(mask.astype(np.uint8), 1)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 3)
    y, x = np.unravel_index(int(distance.argmax()), distance.shape)
    return float(x) - 0.5, float(y) - 0.5, float(distance.max())


def outlines(mask: NDArray[np.bool_]) -> Sequence[NDArray[np.float64]]:
    """Closed outlines of a mask, each (N, 2) as x, y in pixels of the mask (pixel edges at whole numbers)."""
    # enlarging puts the contour on pixel edges rather than through pixel centres
    twice = cv2.resize(np.pad(mask.astype(np.uint8), 1), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    found, _ = cv2.findContours(twice, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    return [(np.vstack([c[:, 0], c[:1, 0]]).astype(np.float64) + 0.5) / 2 - 1 for c in found if len(c) > 2]


def _height(image: NDArray[np.float32], width_in: float) -> float:
    return width_in * float(image.shape[0]) / float(image.shape[1])


def _show(axes: Axes, picture: Picture, full_shape: tuple[int, int]) -> None:
    axes.imshow(picture, extent=(0, full_shape[1], full_shape[0], 0), interpolation="antialiased")
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_linewidth(0.4)


def _image_labels(axes: Axes) -> None:
    axes.set_xlabel("x (px of the developed image)")
    axes.set_ylabel("y (px)")


def _outline(axes: Axes, mask: NDArray[np.bool_], scale: float, *, colour: str = INK, width: float = 1.0) -> None:
    other = "white" if colour == INK else INK
    for line in outlines(mask):
        axes.plot(*(line.T * scale), color=colour, lw=width, path_effects=halo(width + 1.2, other),
                  solid_joinstyle="round")  # fmt: skip


def _hatch(axes: Axes, mask: NDArray[np.bool_], scale: float) -> None:
    if not mask.any():
        return
    height, width = mask.shape
    axes.contourf(
        (np.arange(width) + 0.5) * scale, (np.arange(height) + 0.5) * scale, mask.astype(np.float64),
        levels=(0.5, 1.5), colors="none", hatches=[HATCH],
    )  # fmt: skip


def _unknown_key(axes: Axes, text: str) -> None:
    axes.legend(
        handles=[Patch(facecolor=UNKNOWN, edgecolor=MUTED, hatch=HATCH, lw=0.4, label=text)],
        loc="upper left", bbox_to_anchor=(0.0, -0.06), handlelength=1.6, borderpad=0,
    )  # fmt: skip


def _badge(axes: Axes, mask: NDArray[np.bool_], text: str, scale: float) -> None:
    if not mask.any():
        return
    x, y, _ = inner_point(mask)
    axes.text(
        x * scale, y * scale, text, ha="center", va="center", fontsize=SMALL, weight="bold", color=INK,
        bbox={"boxstyle": "circle,pad=0.25", "fc": "white", "ec": INK, "lw": 0.6},
    )  # fmt: skip


def _depth_label(axes: Axes, mask: NDArray[np.bool_], depth_cm: str, scale: float) -> None:
    if not mask.any():
        return
    x, y, radius = inner_point(mask)
    if radius < 0.018 * mask.shape[1]:  # no room: the number would hide more than it tells
        return
    axes.text(x * scale, y * scale, depth_cm, ha="center", va="center", fontsize=SMALL, weight="bold",
              color="white", path_effects=halo(1.8, INK))  # fmt: skip
