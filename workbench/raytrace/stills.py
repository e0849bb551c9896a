"""Still lifes: things at known depths, drawn at random, for the camera that traces rays."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from workbench.raytrace.drawings import Rgb, draw
from workbench.raytrace.world import Camera, Picture, Surface, upright

Generator = np.random.Generator

THINGS = ("page", "poster", "foliage", "pebbles", "planks", "plaid", "coat", "card", "books", "terrazzo", "meadow")
PLANES = ("page", "poster", "foliage", "pebbles", "planks", "plaid", "books", "terrazzo", "meadow", "masonry")
"""What single planes show: all that has texture everywhere."""
_WALLS = ("masonry", "plaster", "foliage", "books", "planks")
_GROUNDS = ("planks", "plaid", "meadow", "pebbles", "terrazzo")
_NEAREST_MM, _FARTHEST_MM = 720.0, 2750.0
_WALL_MM = (2850.0, 3450.0)
_TURNED = 0.2
_LARGEST_TEXTURE = 3200


def plane(camera: Camera, kind: str, depth_mm: float, seed: int) -> list[Surface]:
    """One picture that fills the frame."""
    generator = np.random.default_rng([seed, 0x91])
    size = _frame_at(camera, depth_mm, 1.3)
    return [upright(kind, _picture(camera, kind, size, depth_mm, generator), (0.0, 0.0, depth_mm), size)]


def still_life(camera: Camera, seed: int) -> list[Surface]:
    """Three to five things before a wall, most of them on a table or on the ground.

    Depths of the things are uniform in 1/z from 72 to 275 cm, the wall stands at 285 to 345 cm. Things overlap, are
    cut out of boards (rectangles, ellipses, blobs) or wound around a cylinder; one board in five is turned by up to 10
    degrees.

    Parameters
    ----------
    camera
        Whose frame they shall fill.
    seed
        Same seed, same still life.

    Returns
    -------
    list of Surface
        Named after what they show, things with a number; ground and wall last.
    """
    generator = np.random.default_rng([seed, 0x90])
    count = int(generator.integers(3, 6))
    inverse = np.sort(generator.uniform(1 / _FARTHEST_MM, 1 / _NEAREST_MM, count))[::-1]  # nearest first
    wall_mm = float(generator.uniform(*_WALL_MM))
    has_ground = generator.random() < 0.7
    half_high = 0.5 * camera.height * camera.pitch_mm / camera.image_mm  # slope of the frame's lower edge
    ground_mm = half_high * float(generator.uniform(700.0, 900.0))
    columns = generator.permutation(count)
    surfaces = []
    for number, (one, column) in enumerate(zip(inverse, columns, strict=True), start=1):
        depth = float(1 / one)
        view = camera.width_at_mm(depth)
        kind = str(generator.choice(THINGS))
        wide = view * float(generator.uniform(0.95, 1.45)) / (count + 0.5)
        tall = wide * float(generator.uniform(0.7, 1.6))
        x = view * ((column + 0.5) / count - 0.5) + view * float(generator.uniform(-0.04, 0.04))
        tall = min(tall, 1.3 * half_high * depth)
        y = ground_mm - tall / 2 if has_ground else float(generator.uniform(-0.4, 0.4)) * half_high * depth
        surfaces.append(_thing(camera, f"{kind} {number}", kind, (x, y, depth), (wide, tall), generator))
    if has_ground:
        surfaces.append(_ground(camera, ground_mm, wall_mm, generator))
    size = _frame_at(camera, wall_mm, 1.4)
    picture = _picture(camera, str(generator.choice(_WALLS)), size, wall_mm, generator)
    return [*surfaces, upright("wall", picture, (0.0, 0.0, wall_mm), size)]


def _frame_at(camera: Camera, depth_mm: float, larger: float) -> tuple[float, float]:
    """Width and height (mm) of so many times the field of view at a depth."""
    wide = larger * camera.width_at_mm(depth_mm)
    return wide, wide * camera.height / camera.width


def _thing(
    camera: Camera, name: str, kind: str, centre: tuple[float, float, float], size: tuple[float, float],
    generator: Generator,
) -> Surface:  # fmt: skip
    picture = _picture(camera, kind, size, centre[2], generator)
    form = str(generator.choice(("board", "board", "ellipse", "blob", "cylinder")))
    if form == "cylinder":
        radius = min(size[0] / 2, 60.0)
        flat = upright(name, picture, centre, (2 * radius, size[1]))
        return Surface(name, picture, flat.corner, flat.across, flat.down, radius)
    if form != "board":
        picture[..., 3] = _ellipse(picture.shape[:2]) if form == "ellipse" else _blob(picture.shape[:2], generator)
    flat = upright(name, picture, centre, size)
    if generator.random() >= _TURNED:
        return flat
    turn = np.radians(generator.uniform(-10.0, 10.0))
    across = (size[0] * float(np.cos(turn)), 0.0, size[0] * float(np.sin(turn)))
    corner = (centre[0] - across[0] / 2, flat.corner[1], centre[2] - across[2] / 2)
    return Surface(name, picture, corner, across, flat.down)


def _ground(camera: Camera, ground_mm: float, wall_mm: float, generator: Generator) -> Surface:
    """Level, from before the frame's lower edge to the wall; the picture's lower edge is near."""
    near = 600.0
    wide = 1.2 * camera.width_at_mm(wall_mm)
    texel = 1.5 * camera.photosite_at_mm(1400.0)
    shape = (2 * _LARGEST_TEXTURE, min(int(wide / texel), _LARGEST_TEXTURE))  # fine enough where it is near
    picture = _opaque(draw(str(generator.choice(_GROUNDS)), *shape, generator), generator)
    return Surface("ground", picture, (-wide / 2, ground_mm, wall_mm), (wide, 0.0, 0.0), (0.0, 0.0, near - wall_mm))


def _picture(camera: Camera, kind: str, size_mm: tuple[float, float], depth_mm: float, generator: Generator) -> Picture:
    """Texels of 0.8 to 2 photosites, larger ones where the picture would hold too many."""
    texel = camera.photosite_at_mm(depth_mm) * float(generator.uniform(0.8, 2.0))
    wide, tall = (min(max(int(length / texel), 64), _LARGEST_TEXTURE) for length in size_mm)
    return _opaque(draw(kind, tall, wide, generator), generator)


def _opaque(drawn: Rgb, generator: Generator) -> Picture:
    """With an outline that is everywhere, in a light of its own."""
    lit = np.clip(drawn * generator.uniform(0.6, 1.0), 0, 255).astype(np.uint8)
    return np.dstack([lit, np.full(lit.shape[:2], 255, np.uint8)])


def _ellipse(shape: tuple[int, int]) -> NDArray[np.uint8]:
    mask = np.zeros(shape, np.uint8)
    cv2.ellipse(mask, (shape[1] // 2, shape[0] // 2), (shape[1] // 2 - 1, shape[0] // 2 - 1), 0, 0, 360, 255, -1)
    return mask


def _blob(shape: tuple[int, int], generator: Generator) -> NDArray[np.uint8]:
    """A closed curve whose radius wavers."""
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    radius = 1.0 + sum(
        generator.uniform(0, 0.25 / k) * np.cos(k * angle + generator.uniform(0, 2 * np.pi)) for k in range(2, 6)
    )
    radius /= np.abs(radius).max()
    points = (1.0 + np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None]) * (shape[1] / 2, shape[0] / 2)
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [points.astype(np.int32)], 255)
    return mask
