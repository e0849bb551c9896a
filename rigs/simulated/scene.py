"""Scenes of flat, possibly slanted, objects that hide each other, photographed through the simulated lens.

Objects are cut into layers of nearly one depth. From far to near, each layer's light and its coverage are blurred with
the point image of its depth, and the blurred light is laid over what lies behind in proportion to the blurred coverage:
what is seen past the edge of a near object is part of both (Hasinoff and Kutulakos, A layer-based restoration framework
for variable-aperture photography, ICCV 2007). The layers of one slanted object continue underneath the next nearer one,
so that no background shines through at the seams.

Places in the frame are fractions of its width and height, x right, y down, (0, 0) the top left corner: the same
scene fits every sensor. Depths are millimetres along the axis, from the lens.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigs.simulated.blur import blur_through, reach_px, transmission_map
from rigs.simulated.coverage import polygon_coverage
from rigs.simulated.lens import Lens
from rigs.simulated.perspective import in_perspective
from rigs.simulated.sensor import FloatImage, bayer
from rigs.simulated.textures import texture

Colour = tuple[float, float, float]
_SLICE_PX, _SLICE_MM = 0.4, 10.0
"""A slanted object is cut where the radius of the point image has changed by so much, or depth if that is farther."""
_SLANTED_TEXTURE_PX = 2048
_REACH_STEP = 128


@dataclass(frozen=True)
class SceneObject:
    """A flat object.

    Attributes
    ----------
    name
        For the table of objects.
    texture, seed
        See :mod:`rigs.simulated.textures`.
    outline
        Polygon (x, y) in fractions of the frame; may reach beyond it.
    depths_mm
        Depth at the top left, top right and bottom left corner of the outline's bounding box.
    enlarge
        Of slanted objects: size of the texture's pixels relative to the frame's at the nearest depth.
    dark, light
        Reflectance (red, green, blue) where the texture is 0 and where it is 1.
    """

    name: str
    texture: str
    outline: tuple[tuple[float, float], ...]
    depths_mm: tuple[float, float, float]
    seed: int = 0
    enlarge: float = 1.0
    dark: Colour = (0.05, 0.05, 0.05)
    light: Colour = (0.9, 0.9, 0.9)


@dataclass(frozen=True)
class Scene:
    """Objects in any order; the farthest should fill the frame."""

    name: str
    objects: tuple[SceneObject, ...]


@dataclass(frozen=True)
class SceneTruth:
    """What an ideal measurement would find, one value for each 2x2 cell of photosites.

    Attributes
    ----------
    depth_mm
        float32 (height // 2, width // 2); 0 where there is no object.
    object_id
        uint8, same shape: 1 is the first of ``names``; 0 where there is none.
    names
        Names of the objects.
    """

    depth_mm: NDArray[np.float32]
    object_id: NDArray[np.uint8]
    names: tuple[str, ...]


@dataclass(frozen=True)
class _InversePlane:
    """Inverse depth of a plane, affine in the frame's pixel coordinates: 1/z = base + by_x x + by_y y."""

    base: float
    by_x: float
    by_y: float

    @property
    def slope(self) -> float:
        return math.hypot(self.by_x, self.by_y)

    def at(self, x: NDArray[np.number], y: NDArray[np.number]) -> NDArray[np.float64]:
        return np.asarray((self.base + self.by_x * x) + self.by_y * y, np.float64)


def scene_light(
    scene: Scene,
    lens: Lens,
    frame_shape: tuple[int, int],
    pitch_mm: float,
    *,
    response: Colour = (1.0, 1.0, 1.0),
    illumination: float = 1.0,
) -> FloatImage:
    """Light on each photosite of a photograph of the scene.

    Parameters
    ----------
    scene, lens
        What is photographed, and through what.
    frame_shape, pitch_mm
        Photosites (height, width) and their pitch.
    response
        Sensitivity of red, green and blue photosites.
    illumination
        Light of a white sheet.

    Returns
    -------
    FloatImage
        float32 (height, width), RGGB.
    """
    out = np.zeros(frame_shape, np.float32)
    layers: list[tuple[float, int, tuple[float, float]]] = []
    for index, item in enumerate(scene.objects):
        layers += [(middle, index, band) for middle, band in _bands(item, lens, frame_shape, pitch_mm)]
    layers.sort(key=lambda layer: layer[0])
    last_use = {index: position for position, (_, index, _) in enumerate(layers)}
    drawn: dict[int, _Drawn] = {}
    for position, (inverse, index, band) in enumerate(layers):
        item = scene.objects[index]
        if index not in drawn:
            drawn[index] = _draw(item, lens, frame_shape, pitch_mm)
        _lay_over(out, drawn[index], item, 1.0 / inverse, band, lens, pitch_mm, response)
        if last_use[index] == position:
            del drawn[index]
    out *= np.float32(illumination)
    falloff = transmission_map(lens, pitch_mm, frame_shape)
    return out if falloff is None else out * falloff


def scene_truth(scene: Scene, frame_shape: tuple[int, int]) -> SceneTruth:
    """Depth and object in front, for each 2x2 cell of photosites."""
    cells = frame_shape[0] // 2, frame_shape[1] // 2
    nearest = np.zeros(cells)
    ids = np.zeros(cells, np.uint8)
    # Coordinates of a cell's middle in photosites, and the outline in cells.
    y, x = 2.0 * np.arange(cells[0])[:, None] + 1.0, 2.0 * np.arange(cells[1])[None, :] + 1.0
    for number, item in enumerate(scene.objects, start=1):
        loop = np.array(item.outline) * (frame_shape[1] / 2, frame_shape[0] / 2)
        inverse = _inverse_plane(item, frame_shape).at(x, y)
        in_front = (polygon_coverage([loop], cells) >= 0.5) & (inverse > nearest)
        nearest = np.where(in_front, inverse, nearest)
        ids[in_front] = number
    depth = np.divide(1.0, nearest, out=np.zeros(cells), where=nearest > 0).astype(np.float32)
    return SceneTruth(depth, ids, tuple(item.name for item in scene.objects))


@dataclass(frozen=True)
class _Drawn:
    """An object's sharp texture and coverage (H, W), with its first pixel's place in the frame."""

    grey: FloatImage
    coverage: FloatImage
    corner_yx: tuple[int, int]
    plane: _InversePlane


def _box(item: SceneObject) -> tuple[float, float, float, float]:
    xs, ys = zip(*item.outline, strict=True)
    return min(xs), min(ys), max(xs), max(ys)


def _inverse_plane(item: SceneObject, frame_shape: tuple[int, int]) -> _InversePlane:
    x0, y0, x1, y1 = _box(item)
    here, right, below = (1.0 / depth for depth in item.depths_mm)
    by_x = (right - here) / ((x1 - x0) * frame_shape[1])
    by_y = (below - here) / ((y1 - y0) * frame_shape[0])
    return _InversePlane(here - by_x * x0 * frame_shape[1] - by_y * y0 * frame_shape[0], by_x, by_y)


def _region(
    item: SceneObject, lens: Lens, frame_shape: tuple[int, int], pitch_mm: float
) -> tuple[int, int, int, int] | None:
    """Rows and columns (first, end) that an object takes in the frame and as far around as its blur reaches."""
    height, width = frame_shape
    x0, y0, x1, y1 = _box(item)
    top, bottom, left, right = (
        math.floor(y0 * height),
        math.ceil(y1 * height),
        math.floor(x0 * width),
        math.ceil(x1 * width),
    )
    plane = _inverse_plane(item, frame_shape)
    seen_x, seen_y = (min(max(left, 0), width), min(right, width)), (min(max(top, 0), height), min(bottom, height))
    depths = [1.0 / (plane.base + plane.by_x * x + plane.by_y * y) for x in seen_x for y in seen_y]
    reach = max(reach_px(lens, depth, pitch_mm) for depth in depths)
    if plane.slope:
        reach = math.ceil(1.2 * reach) + 2  # past the frame's border it may be nearer still
    # textures are drawn for this rectangle: through another aperture the same object must look the same
    reach = _REACH_STEP * math.ceil(reach / _REACH_STEP)
    top, bottom, left, right = (
        max(top, -reach),
        min(bottom, height + reach),
        max(left, -reach),
        min(right, width + reach),
    )
    return (top, bottom, left, right) if top < bottom and left < right else None


def _bands(
    item: SceneObject, lens: Lens, frame_shape: tuple[int, int], pitch_mm: float
) -> Iterator[tuple[float, tuple[float, float]]]:
    """Layers of an object: inverse depth of the middle, inverse depths of far and near border."""
    region = _region(item, lens, frame_shape, pitch_mm)
    if region is None:
        return
    plane = _inverse_plane(item, frame_shape)
    if plane.slope == 0.0:
        yield plane.base, (-math.inf, math.inf)
        return
    top, bottom, left, right = region
    corners = [plane.base + plane.by_x * x + plane.by_y * y for x in (left, right) for y in (top, bottom)]
    far, near = min(corners), max(corners)
    # The cone's section is affine in inverse depth.
    per_inverse = abs(lens.cone_section(1.0 / near) - lens.cone_section(1.0 / far)) / (near - far)
    step = _SLICE_PX * pitch_mm / (per_inverse * lens.pupil.radius_mm)
    start = far
    while start < near:
        end = min(start + max(step, _SLICE_MM * start**2), near)
        yield (start + end) / 2, (-math.inf if start == far else start, math.inf if end == near else end)
        start = end


def _draw(item: SceneObject, lens: Lens, frame_shape: tuple[int, int], pitch_mm: float) -> _Drawn:
    region = _region(item, lens, frame_shape, pitch_mm)
    assert region is not None
    top, bottom, left, right = region
    shape = bottom - top, right - left
    plane = _inverse_plane(item, frame_shape)
    loop = np.array(item.outline) * (frame_shape[1], frame_shape[0]) - (left, top)
    coverage = polygon_coverage([loop], shape).astype(np.float32)
    if plane.slope == 0.0:
        grey = texture(item.texture, shape, item.seed)
    else:
        grey = _slanted_texture(item, plane, region, frame_shape, lens.sensor_distance_mm / pitch_mm)
    return _Drawn(grey, coverage, (top, left), plane)


def _slanted_texture(
    item: SceneObject,
    plane: _InversePlane,
    region: tuple[int, int, int, int],
    frame_shape: tuple[int, int],
    distance_px: float,
) -> FloatImage:
    """Texture that lies in a slanted plane, in perspective.

    Its pixels are ``enlarge`` times as large as the frame's where the object is nearest.
    """
    top, bottom, left, right = region
    # 1 = z (base' + by_x dx + by_y dy) in units of the image distance gives the plane's normal.
    base = plane.base + plane.by_x * frame_shape[1] / 2 + plane.by_y * frame_shape[0] / 2
    normal = np.array([plane.by_x * distance_px, plane.by_y * distance_px, base])
    normal /= np.linalg.norm(normal)
    along = np.cross(normal, (0.0, 1.0, 0.0) if abs(normal[1]) < 0.9 else (0.0, 0.0, 1.0))
    along /= np.linalg.norm(along)
    across = np.cross(normal, along)
    corners = plane.at(np.array([left, right, left, right]), np.array([top, top, bottom, bottom]))
    texel_mm = item.enlarge / float(corners.max()) / distance_px

    def coordinates(rows: FloatImage, columns: FloatImage) -> tuple[FloatImage, FloatImage]:
        y, x = rows.astype(np.float64) + top, columns.astype(np.float64) + left
        depth = 1.0 / plane.at(x, y)
        dx, dy = (x - frame_shape[1] / 2) / distance_px, (y - frame_shape[0] / 2) / distance_px
        u, v = (
            (depth * (dx * axis[0] + dy * axis[1] + axis[2]) / texel_mm).astype(np.float32) for axis in (along, across)
        )
        return u, v

    image = texture(item.texture, (_SLANTED_TEXTURE_PX, _SLANTED_TEXTURE_PX), item.seed)
    return in_perspective(image, (bottom - top, right - left), coordinates)


def _lay_over(
    out: FloatImage,
    drawn: _Drawn,
    item: SceneObject,
    depth_mm: float,
    band: tuple[float, float],
    lens: Lens,
    pitch_mm: float,
    response: Colour,
) -> None:
    """Blur one layer and lay it over ``out`` (the frame so far)."""
    reach = reach_px(lens, depth_mm, pitch_mm)
    part = _layer_part(drawn, band, reach)
    if part is None:
        return
    grey, coverage, (top, left) = part
    light, cover = (np.pad(plane, reach) for plane in (grey * coverage, coverage))
    light, cover = blur_through(lens, depth_mm, pitch_mm, [light, cover], (top - reach, left - reach), _shape(out))
    top, left = top - reach, left - reach
    y0, y1 = max(0, top), min(out.shape[0], top + light.shape[0])
    x0, x1 = max(0, left), min(out.shape[1], left + light.shape[1])
    if y0 >= y1 or x0 >= x1:
        return
    cut = slice(y0 - top, y1 - top), slice(x0 - left, x1 - left)
    light, cover = light[cut], np.clip(cover[cut], 0.0, 1.0)
    target = out[y0:y1, x0:x1]
    dark_cell = bayer(np.array(item.dark) * np.array(response))
    more_cell = bayer((np.array(item.light) - np.array(item.dark)) * np.array(response))
    for y in (0, 1):
        for x in (0, 1):
            site = slice(y, None, 2), slice(x, None, 2)
            dark, more = (cell[(y + y0) % 2, (x + x0) % 2] for cell in (dark_cell, more_cell))
            target[site] += cover[site] * (dark - target[site]) + more * light[site]


def _layer_part(
    drawn: _Drawn, band: tuple[float, float], reach: int
) -> tuple[FloatImage, FloatImage, tuple[int, int]] | None:
    """Texture, coverage, corner of an object's part between two inverse depths, continued towards the viewer."""
    grey, coverage, (top, left), plane = drawn.grey, drawn.coverage, drawn.corner_yx, drawn.plane
    if plane.slope == 0.0:
        return grey, coverage, (top, left)
    far, near = band[0], band[1] + (2 * reach + 2) * plane.slope
    y, x = top + np.arange(grey.shape[0]) + 0.5, left + np.arange(grey.shape[1]) + 0.5
    by_row, by_column = plane.base + plane.by_y * y, plane.by_x * x
    ramp = plane.slope  # one pixel
    rows = np.flatnonzero((by_row + by_column.max() >= far - ramp) & (by_row + by_column.min() <= near + ramp))
    columns = np.flatnonzero((by_column + by_row.max() >= far - ramp) & (by_column + by_row.min() <= near + ramp))
    if not rows.size or not columns.size:
        return None
    cut = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    inverse = by_row[cut[0], None] + by_column[None, cut[1]]
    share = (inverse <= near) * np.clip((inverse - far) / ramp + 0.5, 0.0, 1.0)
    return grey[cut], coverage[cut] * share.astype(np.float32), (top + int(rows[0]), left + int(columns[0]))


def _shape(image: FloatImage) -> tuple[int, int]:
    return int(image.shape[0]), int(image.shape[1])
