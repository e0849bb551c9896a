"""What the camera sees of the panel: its pattern at the carriage's depth, and the dim room around it.

Light 1 is the panel's full white. Ambient light is given as the light of a white sheet in the same room.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from rigs.charts import BUILT_IN
from rigs.errors import PanelError
from rigs.panel_patterns import drawing, outside, srgb_decoded
from rigs.protocols import Pattern
from rigs.simulated.blur import blur_through, reach_px, transmission_map
from rigs.simulated.coverage import FloatArray, box_overlap, polygon_coverage
from rigs.simulated.lens import Lens, Spot, point_image, transmission
from rigs.simulated.sensor import FloatImage, bayer, times_cell

_COARSE = 8
"""The panel's dim outline is drawn on pixels so many times coarser."""


@dataclass(frozen=True)
class PanelSurface:
    """The display.

    Attributes
    ----------
    width_px, height_px, pitch_mm
        Device pixels and their pitch.
    leak
        Light of a black pixel while the display is on, relative to white.
    reflectance
        Of the dark display.
    surroundings
        Reflectance of what is around it.
    """

    width_px: int = 1920
    height_px: int = 1200
    pitch_mm: float = 0.1
    leak: float = 1e-5
    reflectance: float = 0.02
    surroundings: float = 0.04


@dataclass(frozen=True)
class View:
    """Where the panel is, seen from the camera.

    Attributes
    ----------
    depth_mm
        Distance from the lens.
    x_mm, y_mm
        Its centre's offset from the optical axis, right and up.
    ambient
        Light of a white sheet in the room.
    """

    depth_mm: float
    x_mm: float = 0.0
    y_mm: float = 0.0
    ambient: float = 0.0005


def check_pattern(pattern: Pattern, surface: PanelSurface) -> None:
    """Refuse a pattern that the panel can't show.

    Raises
    ------
    PanelError
        A wrong colour, size, position or picture.
    """
    drawing(pattern)
    beyond = outside(pattern, surface.width_px, surface.height_px)
    if beyond is not None:
        raise PanelError(
            f"panel: a dot at ({beyond[0]:g}, {beyond[1]:g}) px doesn't lie wholly on the panel of "
            f"{surface.width_px} x {surface.height_px} px; move it towards the centre"
        )
    if pattern.kind == "picture":
        _picture(pattern, surface)


def panel_light(
    pattern: Pattern,
    surface: PanelSurface,
    view: View,
    lens: Lens,
    frame_shape: tuple[int, int],
    pitch_mm: float,
    response: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> FloatImage:
    """Light on each photosite (see :func:`rigs.simulated.sensor.expose`) of a frame that shows the panel.

    Returns
    -------
    FloatImage
        float32 (height, width), RGGB.
    """
    response_cell = bayer(response)
    light = times_cell(_background(surface, view, lens, frame_shape, pitch_mm), response_cell)
    colour = np.array(_linear_colour(pattern)) * np.array(response)
    if pattern.kind in ("dot", "grid"):
        points = pattern.points_px if pattern.kind == "grid" else ((pattern.x_px, pattern.y_px),)
        for x_px, y_px in points:
            _add_dot(light, (x_px, y_px), pattern.size_px, bayer(colour), surface, view, lens, pitch_mm)
    elif pattern.kind == "picture":
        picture = _picture(pattern, surface)
        if picture.ndim == 2:
            light += times_cell(
                _shown(picture, surface, view, lens, frame_shape, pitch_mm),
                bayer(pattern.brightness * np.array(response)),
            )
        else:
            for channel in range(3):
                weights = np.zeros(3)
                weights[channel] = pattern.brightness * response[channel]
                shown = _shown(picture[:, :, channel], surface, view, lens, frame_shape, pitch_mm)
                light += times_cell(shown, bayer(weights))
    elif pattern.kind in ("white", "crosshair"):
        flat = np.ones((surface.height_px, surface.width_px), np.float32)
        if pattern.kind == "crosshair":
            flat[:] = 0.0
            cy, cx = surface.height_px // 2, surface.width_px // 2
            half = max(1, math.floor(pattern.size_px + 0.5)) / 2
            flat[math.ceil(cy - half) : math.ceil(cy + half)] = 1.0
            flat[:, math.ceil(cx - half) : math.ceil(cx + half)] = 1.0
        light += times_cell(_shown(flat, surface, view, lens, frame_shape, pitch_mm), bayer(colour))
    return light


def _linear_colour(pattern: Pattern) -> tuple[float, float, float]:
    values = np.array([int(pattern.colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    r, g, b = srgb_decoded(values) * pattern.brightness
    return float(r), float(g), float(b)


def _add_dot(
    light: FloatImage,
    position_px: tuple[float, float],
    size_px: float,
    cell: FloatImage,
    surface: PanelSurface,
    view: View,
    lens: Lens,
    pitch_mm: float,
) -> None:
    magnification = lens.magnification(view.depth_mm)
    x_mm = (view.x_mm + position_px[0] * surface.pitch_mm) * magnification
    y_mm = (view.y_mm - position_px[1] * surface.pitch_mm) * magnification
    height, width = light.shape
    row, column = height / 2 - y_mm / pitch_mm, width / 2 + x_mm / pitch_mm
    spot = Spot("disc" if size_px > 1 else "square", max(size_px, 1.0) * surface.pitch_mm * magnification)
    centre = math.floor(row), math.floor(column)
    image = point_image(
        lens, view.depth_mm, pitch_mm, field_mm=(x_mm, y_mm),
        offset_px=(row - centre[0] - 0.5, column - centre[1] - 0.5), spot=spot,
    )  # fmt: skip
    flux = spot.area_mm2 / pitch_mm**2 * transmission(lens, (x_mm, y_mm))
    half = image.shape[0] // 2
    top, left = centre[0] - half, centre[1] - half
    y0, y1 = max(0, top), min(height, top + image.shape[0])
    x0, x1 = max(0, left), min(width, left + image.shape[1])
    if y0 < y1 and x0 < x1:
        part = (flux * image[y0 - top : y1 - top, x0 - left : x1 - left]).astype(np.float32)
        light[y0:y1, x0:x1] += times_cell(part, cell, (y0, x0))


def _edges_px(
    surface: PanelSurface, view: View, lens: Lens, frame_shape: tuple[int, int], pitch_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Rows and columns in the frame of the borders of the panel's pixels (height_px + 1), (width_px + 1)."""
    scale = lens.magnification(view.depth_mm) / pitch_mm
    rows = frame_shape[0] / 2 - view.y_mm * scale
    columns = frame_shape[1] / 2 + view.x_mm * scale
    step = surface.pitch_mm * scale
    down = rows + step * (np.arange(surface.height_px + 1) - surface.height_px / 2)
    across = columns + step * (np.arange(surface.width_px + 1) - surface.width_px / 2)
    return np.asarray(down, np.float64), np.asarray(across, np.float64)


def _background(
    surface: PanelSurface, view: View, lens: Lens, frame_shape: tuple[int, int], pitch_mm: float
) -> FloatImage:
    """Blurred light of the black panel and of what is around it."""
    around = np.float32(view.ambient * surface.surroundings)
    panel = np.float32(surface.leak + view.ambient * surface.reflectance)
    rows, columns = _edges_px(surface, view, lens, frame_shape, pitch_mm)
    kernel = point_image(lens, view.depth_mm, _COARSE * pitch_mm).astype(np.float32)
    margin = kernel.shape[0] // 2
    height, width = (math.ceil(n / _COARSE) + 2 * margin for n in frame_shape)
    y0, y1, x0, x1 = (float(v) / _COARSE + margin for v in (rows[0], rows[-1], columns[0], columns[-1]))
    covered = polygon_coverage([np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])], (height, width))
    blurred = cv2.filter2D(covered.astype(np.float32), -1, kernel[::-1, ::-1], borderType=cv2.BORDER_REPLICATE)
    inner = blurred[margin : height - margin, margin : width - margin]
    full = cv2.resize(inner, (inner.shape[1] * _COARSE, inner.shape[0] * _COARSE), interpolation=cv2.INTER_LINEAR)
    light = around + (panel - around) * full[: frame_shape[0], : frame_shape[1]]
    falloff = transmission_map(lens, pitch_mm, frame_shape)
    return np.asarray(light if falloff is None else light * falloff, np.float32)


def _shown(
    picture: FloatImage, surface: PanelSurface, view: View, lens: Lens, frame_shape: tuple[int, int], pitch_mm: float
) -> FloatImage:
    """Blurred image of a picture (height_px, width_px) that fills the panel; by exact areas from panel to frame."""
    margin = reach_px(lens, view.depth_mm, pitch_mm)
    rows, columns = _edges_px(surface, view, lens, frame_shape, pitch_mm)
    height, width = frame_shape
    down = box_overlap(rows + margin, height + 2 * margin).astype(np.float32)
    across = box_overlap(columns + margin, width + 2 * margin).astype(np.float32)
    sharp = np.ascontiguousarray(down @ picture @ across.T, np.float32)
    (blurred,) = blur_through(lens, view.depth_mm, pitch_mm, [sharp], (-margin, -margin), frame_shape)
    light = blurred[margin : margin + height, margin : margin + width]
    falloff = transmission_map(lens, pitch_mm, frame_shape)
    return np.asarray(light if falloff is None else light * falloff, np.float32)


def _picture(pattern: Pattern, surface: PanelSurface) -> FloatImage:
    """Linear light of the panel's pixels: (height_px, width_px), or (..., 3) for a coloured file, not yet dimmed."""
    size = surface.width_px, surface.height_px
    draw = BUILT_IN.get(pattern.picture)
    if draw is not None:
        return srgb_decoded(draw(*size) / 255.0).astype(np.float32)
    pixels = cv2.imread(pattern.picture, cv2.IMREAD_COLOR) if pattern.picture else None
    if pixels is None:
        raise PanelError(
            f"panel: picture {pattern.picture!r} is no image file; built-in pictures are {', '.join(sorted(BUILT_IN))}"
        )
    shrink = min(1.0, size[0] / pixels.shape[1], size[1] / pixels.shape[0])
    if shrink < 1.0:
        pixels = cv2.resize(pixels, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    canvas = np.zeros((surface.height_px, surface.width_px, 3), np.float32)
    top, left = (surface.height_px - pixels.shape[0]) // 2, (surface.width_px - pixels.shape[1]) // 2
    linear = srgb_decoded(np.asarray(pixels[:, :, ::-1] / 255.0, np.float64))
    canvas[top : top + pixels.shape[0], left : left + pixels.shape[1]] = linear
    return canvas
