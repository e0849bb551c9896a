"""Ready scenes by name."""

from __future__ import annotations

import math
import re

import numpy as np

from rigs.errors import ConfigError
from rigs.simulated.scene import Colour, Scene, SceneObject
from rigs.simulated.textures import TEXTURES

_WALL_MM, _FRONT_MM = 3500.0, 800.0
_TABLE_TOP, _TABLE_BOTTOM = 0.60, 1.0
_DRAWN_TEXTURES = ("chart", "text", "leaves", "gravel", "grass", "brick", "letters", "masonry")


def rectangle(x0: float, y0: float, x1: float, y1: float) -> tuple[tuple[float, float], ...]:
    """Outline of an upright rectangle."""
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def plane_scene(
    texture_name: str,
    depth_mm: float,
    *,
    seed: int = 0,
    depth_right_mm: float | None = None,
    dark: Colour = (0.05, 0.05, 0.05),
    light: Colour = (0.9, 0.9, 0.9),
) -> Scene:
    """One textured plane that fills the frame.

    Parameters
    ----------
    texture_name, seed
        See :mod:`rigs.simulated.textures`.
    depth_mm
        Its depth; at the left border of the frame if it is slanted.
    depth_right_mm
        Depth at the right border; None: the same.
    dark, light
        Reflectance of the texture's 0 and 1.
    """
    right = depth_mm if depth_right_mm is None else depth_right_mm
    # It goes on beyond the frame, whatever the frame's size; a slanted one until its inverse depth halves or doubles.
    left, slope = 1 / depth_mm, 1 / right - 1 / depth_mm
    edge = 20.0 if slope == 0 else min(20.0, 0.5 * min(left, 1 / right) / abs(slope))
    left_end, right_end = (
        (depth_mm, depth_mm) if slope == 0 else (1 / (left - edge * slope), 1 / (1 / right + edge * slope))
    )
    outline, depths = rectangle(-edge, -20.0, 1 + edge, 21.0), (left_end, right_end, left_end)
    item = SceneObject(texture_name, texture_name, outline, depths, seed, dark=dark, light=light)
    return Scene(f"plane {texture_name} {depth_mm:g} mm", (item,))


def four_objects(seed: int = 0) -> Scene:
    """Four objects at 100, 160, 250 and 320 cm on a table that runs to a wall at 350 cm."""

    def standing(
        name: str, texture_name: str, depth_mm: float, x: tuple[float, float], top: float, dark: Colour, light: Colour
    ) -> SceneObject:
        outline = rectangle(x[0], top, x[1], _table_row(depth_mm))
        return SceneObject(name, texture_name, outline, (depth_mm,) * 3, seed + int(depth_mm), dark=dark, light=light)

    wall = SceneObject(
        "wall", "masonry", rectangle(-0.2, -0.2, 1.2, _TABLE_TOP + 0.02), (_WALL_MM,) * 3, seed + 1, 1.0,
        (0.55, 0.52, 0.45), (0.50, 0.20, 0.14),
    )  # fmt: skip
    below = 1.12
    bottom_mm = _table_depth(below)
    table = SceneObject(
        "table", "gravel", rectangle(-0.2, _TABLE_TOP, 1.2, below), (_WALL_MM, _WALL_MM, bottom_mm), seed + 2, 1.5,
        (0.16, 0.13, 0.10), (0.62, 0.55, 0.44),
    )  # fmt: skip
    return Scene(
        "four-objects",
        (
            wall, table,
            standing("poster", "chart", 3200.0, (0.70, 0.97), 0.10, (0.03, 0.05, 0.12), (0.80, 0.85, 0.95)),
            standing("box", "leaves", 2500.0, (0.47, 0.74), 0.24, (0.03, 0.08, 0.03), (0.60, 0.90, 0.50)),
            standing("book", "text", 1600.0, (0.26, 0.50), 0.32, (0.04, 0.04, 0.05), (0.92, 0.90, 0.84)),
            standing("cushion", "noise", 1000.0, (0.03, 0.29), 0.28, (0.10, 0.05, 0.25), (0.95, 0.75, 0.30)),
        ),
    )  # fmt: skip


def drawn_objects(seed: int = 0) -> Scene:
    """Four upright objects before a wall, overlapping, all drawn at random: places, depths, textures and colours.

    Depths are uniform in 1/z from 75 to 270 cm, the wall stands at 280 to 340 cm.
    """
    generator = np.random.default_rng([seed, 0x5C])

    def item(name: str, texture_name: str, outline: tuple[tuple[float, float], ...], depth_mm: float) -> SceneObject:
        dark, light = (tuple(generator.uniform(low, high, 3)) for low, high in ((0.03, 0.25), (0.5, 0.95)))
        number = int(generator.integers(2**31))
        return SceneObject(name, texture_name, outline, (depth_mm,) * 3, number, 1.0, dark, light)

    wall = str(generator.choice(("masonry", "leaves", "brick")))
    objects = [item("wall", wall, rectangle(-0.2, -0.2, 1.2, 1.2), float(generator.uniform(2800.0, 3400.0)))]
    inverse = np.sort(generator.uniform(1 / 2700.0, 1 / 750.0, 4))  # farthest first
    for number, column in enumerate(generator.permutation(4)):
        wide, high = generator.uniform(0.24, 0.34), generator.uniform(0.28, 0.42)
        x, y = 0.24 * column + generator.uniform(-0.02, 0.03), generator.uniform(0.05, 0.66 - high)
        outline = rectangle(x, y, x + wide, y + high)
        texture_name = str(generator.choice(_DRAWN_TEXTURES))
        objects.append(item(f"{texture_name} {number + 1}", texture_name, outline, float(1 / inverse[number])))
    return Scene(f"drawn {seed}", tuple(objects))


def scene_by_name(name: str, seed: int = 0) -> Scene:
    """Scene from its name in a configuration: ``four-objects``, ``drawn-objects``, or a plane (``plane:chart:200cm``).

    Raises
    ------
    ConfigError
        There is no such scene, texture or depth; the message says what there is.
    """
    if name == "four-objects":
        return four_objects(seed)
    if name == "drawn-objects":
        return drawn_objects(seed)
    match = re.fullmatch(r"plane:([a-z]+):([0-9]+(?:\.[0-9]+)?)cm", name)
    if not match:
        raise ConfigError(
            f"simulation.scene: no scene {name!r}; write four-objects, drawn-objects, or a plane: plane:chart:200cm"
        )
    if match[1] not in TEXTURES:
        raise ConfigError(
            f"simulation.scene: no texture {match[1]!r} in {name!r}; there are {', '.join(sorted(TEXTURES))}"
        )
    depth_mm = 10.0 * float(match[2])
    if not 200.0 <= depth_mm < math.inf:
        raise ConfigError(f"simulation.scene: {name!r} is too near for the lens; place the plane at 20cm or farther")
    return plane_scene(match[1], depth_mm, seed=seed)


def _table_row(depth_mm: float) -> float:
    """Row (fraction of the frame) in which the table has this depth: affine in inverse depth."""
    share = (1 / depth_mm - 1 / _WALL_MM) / (1 / _FRONT_MM - 1 / _WALL_MM)
    return _TABLE_TOP + share * (_TABLE_BOTTOM - _TABLE_TOP)


def _table_depth(row: float) -> float:
    share = (row - _TABLE_TOP) / (_TABLE_BOTTOM - _TABLE_TOP)
    return 1.0 / (1 / _WALL_MM + share * (1 / _FRONT_MM - 1 / _WALL_MM))
