"""The depth map, textured with the all-focus image, seen in perspective.

Every depth is a plane parallel to the sensor, and the perspective image of a plane is a homography; so the scene is
drawn as warped layers from far to near (painter's algorithm), without a mesh. Across, the axes are image coordinates,
as in the photograph; in depth they are centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from workbench.display import exposure_gain, to_srgb8
from workbench.figures.pictures import as_rgb, depth_norm, outlines, reduced, reduced_depth
from workbench.figures.style import DEPTH_MAP, FAINT, MUTED, SMALL, WIDTH_IN, halo, new_figure, style
from workbench.measurement import Measurement

MAX_LAYERS = 48
_CANVAS_PX = 1400
_YAW, _PITCH = np.radians(-30.0), np.radians(19.0)
_EYE = 3.0
"""Distance of the eye from the middle of the box, in widths of the photograph: the smaller, the stronger the fall."""
_LENGTH = 1.6
"""Length of the depth axis, in widths of the photograph."""

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _View:
    """Projection of the box to canvas pixels; x, y in widths of the photograph from its middle, y down."""

    near_cm: float
    far_cm: float
    half_height: float
    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)

    def project(self, x: Points, y: Points, depth_cm: Points) -> Points:
        """Canvas coordinates (N, 2)."""
        z = ((depth_cm - self.near_cm) / (self.far_cm - self.near_cm) - 0.5) * _LENGTH
        turned_x = x * np.cos(_YAW) + z * np.sin(_YAW)
        turned_z = -x * np.sin(_YAW) + z * np.cos(_YAW)
        tilted_y = y * np.cos(_PITCH) - turned_z * np.sin(_PITCH)
        away = y * np.sin(_PITCH) + turned_z * np.cos(_PITCH) + _EYE
        flat = np.stack([turned_x / away, tilted_y / away], axis=-1) * _EYE
        return np.asarray(flat * self.scale + np.array(self.shift), np.float64)

    def floor(self, x: Points, depth_cm: Points) -> Points:
        """Canvas coordinates of points on the floor, which lies just below the photograph."""
        return self.project(x, np.full_like(x, self.half_height * 1.04), depth_cm)


def perspective(measurement: Measurement) -> Figure:
    """Show the all-focus image with each pixel at its measured depth, seen from the upper left.

    Pixels of unknown depth are left out. More than 48 different depths are drawn as 48 layers, even in inverse depth.
    """
    linear = reduced(measurement.all_focus, 900)
    shape = (linear.shape[0], linear.shape[1])
    texture = as_rgb(to_srgb8(linear, exposure_gain(reduced(measurement.image.planes, 900))))
    depth_cm = reduced_depth(measurement.depth_map_mm, shape) / 10
    layers = depth_layers(depth_cm)
    view, canvas_height = _fit_view(layers, shape)
    with style():
        figure = new_figure(WIDTH_IN, WIDTH_IN * canvas_height / _CANVAS_PX)
        axes = figure.subplots()
        _draw_box(axes, view, layers, shape)
        axes.imshow(_paint(layers, texture, view, canvas_height), extent=(0, _CANVAS_PX, canvas_height, 0), zorder=2,
                    interpolation="antialiased")  # fmt: skip
        axes.set_xlim(0, _CANVAS_PX)
        axes.set_ylim(canvas_height, 0)
        axes.set_axis_off()
    return figure


def depth_layers(depth_cm: NDArray[np.floating]) -> list[tuple[float, NDArray[np.bool_]]]:
    """Split a depth map (NaN = unknown) into depths and their masks, from far to near."""
    known = np.isfinite(depth_cm) & (depth_cm > 0)
    values = np.unique(depth_cm[known])
    if values.size <= MAX_LAYERS:
        return [(float(value), depth_cm == value) for value in values[::-1]]
    edges = np.linspace(1 / values[-1], 1 / values[0], MAX_LAYERS + 1)
    inverse = np.where(known, 1 / np.where(known, depth_cm, 1.0), np.nan)
    index = np.clip(np.searchsorted(edges, inverse, side="right") - 1, 0, MAX_LAYERS - 1)
    middles = 2 / (edges[:-1] + edges[1:])
    return [(float(middles[k]), mask) for k in range(MAX_LAYERS) if (mask := known & (index == k)).any()]


def _fit_view(layers: list[tuple[float, NDArray[np.bool_]]], shape: tuple[int, int]) -> tuple[_View, int]:
    depths = [depth for depth, _ in layers] or [100.0]
    near, far = min(depths), max(depths)
    room = max(0.06 * (far - near), 0.05 * far)
    half_height = shape[0] / shape[1] / 2
    plain = _View(near - room, far + room, half_height)
    x, y, z = (
        a.ravel() for a in np.meshgrid((-0.5, 0.5), (-half_height, half_height * 1.04), (near - room, far + room))
    )
    corners = plain.project(x, y, z)
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = np.array([110.0, 20.0])
    scale = float((_CANVAS_PX - 2 * margin[0]) / (high - low)[0])
    bottom = 60.0
    canvas_height = int(np.ceil((high - low)[1] * scale + margin[1] + bottom))
    shift = margin - low * scale
    return _View(near - room, far + room, half_height, scale, (float(shift[0]), float(shift[1]))), canvas_height


def _paint(
    layers: list[tuple[float, NDArray[np.bool_]]], texture: NDArray[np.uint8], view: _View, canvas_height: int
) -> NDArray[np.uint8]:
    height, width = texture.shape[:2]
    size = (_CANVAS_PX, canvas_height)
    colour: NDArray[np.float32] = np.zeros((canvas_height, _CANVAS_PX, 3), np.float32)
    cover: NDArray[np.float32] = np.zeros((canvas_height, _CANVAS_PX, 1), np.float32)
    norm = depth_norm(np.array([depth for depth, _ in layers]))
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    for depth, mask in layers:
        x, y = corners[:, 0] / width - 0.5, (corners[:, 1] - height / 2) / width
        target = view.project(x.astype(np.float64), y.astype(np.float64), np.full(4, depth))
        to_canvas = np.asarray(cv2.getPerspectiveTransform(corners, target.astype(np.float32)), np.float64)
        premultiplied = np.dstack([texture * mask[:, :, np.newaxis], mask.astype(np.uint8) * 255])
        warped = np.asarray(cv2.warpPerspective(premultiplied, to_canvas, size), np.float32) / np.float32(255)
        alpha = warped[:, :, 3:]
        colour = warped[:, :, :3] + colour * (1 - alpha)
        cover = alpha + cover * (1 - alpha)
        if len(layers) < MAX_LAYERS:
            _rim(colour, cover, mask, to_canvas, mpl.colormaps[DEPTH_MAP](norm(depth)))
    rgba = np.dstack([np.divide(colour, cover, out=np.ones_like(colour), where=cover > 1e-3), cover])
    return np.asarray(np.rint(rgba.clip(0, 1) * 255), np.uint8)


def _rim(
    colour: NDArray[np.float32], cover: NDArray[np.float32], mask: NDArray[np.bool_], to_canvas: Points,
    rgba: tuple[float, float, float, float],
) -> None:  # fmt: skip
    """Draw a layer's outline in the colour of its depth, so that layers stand apart."""
    for line in outlines(mask):
        points = cv2.perspectiveTransform(line.reshape(-1, 1, 2), to_canvas)
        fixed = np.rint(points * 16).astype(np.int32)
        cv2.polylines(colour, [fixed], True, rgba[:3], 2, cv2.LINE_AA, 4)
        plane = np.ascontiguousarray(cover[:, :, 0])
        cv2.polylines(plane, [fixed], True, 1.0, 2, cv2.LINE_AA, 4)
        cover[:, :, 0] = plane


def _draw_box(axes: Axes, view: _View, layers: list[tuple[float, NDArray[np.bool_]]], shape: tuple[int, int]) -> None:
    ticks = [t for t in MaxNLocator(6).tick_values(view.near_cm, view.far_cm) if view.near_cm <= t <= view.far_cm]
    ends = np.array([-0.5, 0.5])
    for depth in (*ticks, view.near_cm, view.far_cm):
        axes.plot(*view.floor(ends, np.full(2, depth)).T, color=FAINT, lw=0.7, zorder=0)
    for x in np.linspace(-0.5, 0.5, 5):
        axes.plot(*view.floor(np.full(2, x), np.array([view.near_cm, view.far_cm])).T, color=FAINT, lw=0.7, zorder=0)
    norm = depth_norm(np.array([depth for depth, _ in layers]))
    for depth, mask in layers:  # where each layer stands
        columns = np.flatnonzero(mask.any(axis=0))
        foot = view.floor(np.array([columns[0], columns[-1] + 1]) / shape[1] - 0.5, np.full(2, depth))
        axes.plot(*foot.T, color=mpl.colormaps[DEPTH_MAP](norm(depth)), lw=2.2, zorder=1, solid_capstyle="butt",
                  path_effects=halo(2.8, MUTED))  # fmt: skip
    for tick in ticks:
        edge, label = view.floor(np.array([-0.5, -0.54]), np.full(2, tick))
        axes.plot([edge[0], label[0]], [edge[1], label[1]], color=MUTED, lw=0.7)
        axes.annotate(f"{tick:g}", label, (-2, -1), textcoords="offset points", fontsize=SMALL, ha="right", va="center")
    along = np.array([view.near_cm, view.far_cm])
    _edge_label(axes, "depth (cm)", view.floor(np.full(2, -0.5), along), away_pt=34)
    _edge_label(axes, "across the photograph", view.floor(ends, np.full(2, view.near_cm)), away_pt=9)


def _edge_label(axes: Axes, text: str, edge: Points, away_pt: float) -> None:
    """Write along an edge of the floor, ``away_pt`` points below it."""
    (x0, y0), (x1, y1) = edge
    slope = np.arctan2(-(y1 - y0), x1 - x0)
    slope = (slope + np.pi / 2) % np.pi - np.pi / 2
    below = (np.sin(slope) * away_pt, -np.cos(slope) * away_pt)
    axes.annotate(
        text, ((x0 + x1) / 2, (y0 + y1) / 2), below, textcoords="offset points", ha="center", va="center",
        rotation=float(np.degrees(slope)), rotation_mode="anchor", fontsize=SMALL + 1,
    )  # fmt: skip
