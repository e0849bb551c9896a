"""Pictures that the panel brings along: a resolution chart, and dead leaves.

Both are drawn for the panel's own size, pixel for pixel, and are the same at every call.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

GreyImage = NDArray[np.uint8]
_BLACK, _WHITE = 0, 255


def chart(width_px: int, height_px: int) -> GreyImage:
    """Resolution chart: tiles of stars, bars, checks, slanted edges, rings and text-like strokes, edge to edge.

    Every tile has strong detail at several scales and directions, so that a depth can be read anywhere on it.

    Returns
    -------
    GreyImage
        (height_px, width_px), black and white.
    """
    side = max(16, min(width_px, height_px) // 5)
    tiles = (_star, _bars, _strokes, _checks, _rings, _slanted)
    columns, rows = math.ceil(width_px / side), math.ceil(height_px / side)
    canvas = np.empty((rows * side, columns * side), dtype=np.uint8)
    for row in range(rows):
        for column in range(columns):
            # A stride of two a row keeps equal tiles from touching.
            tile = tiles[(column + 2 * row) % len(tiles)](side, row * columns + column)
            canvas[row * side : (row + 1) * side, column * side : (column + 1) * side] = tile
    top, left = (rows * side - height_px) // 2, (columns * side - width_px) // 2
    return canvas[top : top + height_px, left : left + width_px].copy()


def leaves(width_px: int, height_px: int) -> GreyImage:
    """Dead leaves: opaque discs of random grey whose radii follow r**-3, nearest last.

    Their spectrum falls like that of natural scenes (Lee, Mumford and Huang, Int. J. Computer Vision 41, 2001).

    Returns
    -------
    GreyImage
        (height_px, width_px), grey values uniform in linear steps of the screen's value.
    """
    generator = np.random.default_rng(20010101)
    shorter = min(width_px, height_px)
    smallest, largest = max(1.5, shorter / 300), max(3.0, shorter / 5)
    canvas = np.full((height_px, width_px), 128, dtype=np.uint8)
    density = 0.5 * (smallest**-2 - largest**-2)
    mean_area = math.pi * math.log(largest / smallest) / density
    # Covered three times over, less than 5 % of the ground is left to see.
    count = min(60_000, math.ceil(3.0 * width_px * height_px / mean_area))
    uniform = generator.random((count, 4))
    radii = (smallest**-2 - uniform[:, 0] * (smallest**-2 - largest**-2)) ** -0.5
    for radius, u, v, grey in zip(radii, uniform[:, 1], uniform[:, 2], uniform[:, 3], strict=True):
        x, y = u * width_px, v * height_px
        x0, x1 = max(0, int(x - radius)), min(width_px, int(x + radius) + 2)
        y0, y1 = max(0, int(y - radius)), min(height_px, int(y + radius) + 2)
        rows, columns = np.ogrid[y0:y1, x0:x1]
        inside = (columns - x) ** 2 + (rows - y) ** 2 <= radius**2
        canvas[y0:y1, x0:x1][inside] = int(255 * grey)
    return canvas


BUILT_IN: dict[str, Callable[[int, int], GreyImage]] = {"chart": chart, "leaves": leaves}
"""Built-in pictures by name: (width_px, height_px) -> grey image of that size."""


def _centred(side: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    axis = np.arange(side, dtype=np.float64) - (side - 1) / 2
    return axis[None, :], axis[:, None]


def _two_tone(white: NDArray[np.bool_]) -> GreyImage:
    return np.where(white, _WHITE, _BLACK).astype(np.uint8)


def _star(side: int, number: int) -> GreyImage:
    x, y = _centred(side)
    spokes = np.sin((20 + 8 * (number % 3)) * np.arctan2(y, x)) > 0
    return _two_tone(spokes & (np.hypot(x, y) < 0.47 * side))


def _bars(side: int, number: int) -> GreyImage:
    """Groups of bars, each with a shorter period, upright beside lying."""
    canvas = np.zeros((side, side), dtype=np.uint8)
    groups, half = 5, side // 2
    for group in range(groups):
        top, bottom = side * group // groups, side * (group + 1) // groups
        period = max(2, round(side / (3.5 * 1.7**group)))
        line = np.where(np.arange(side) % period < period / 2, _WHITE, _BLACK).astype(np.uint8)
        canvas[top:bottom, :half] = line[None, :half]
        canvas[top:bottom, half:] = line[: bottom - top, None]
    return canvas if number % 2 == 0 else canvas.T


def _checks(side: int, number: int) -> GreyImage:
    """Checks that halve in size from quarter to quarter."""
    canvas = np.empty((side, side), dtype=np.uint8)
    half = side // 2
    for quarter, (row, column) in enumerate(((0, 0), (0, 1), (1, 1), (1, 0))):
        cell = max(1, side // (6 * 2 ** ((quarter + number) % 4)))
        index = np.arange(side) // cell
        block = _two_tone((index[:, None] + index[None, :]) % 2 == 0)
        rows, columns = slice(row * half, side if row else half), slice(column * half, side if column else half)
        canvas[rows, columns] = block[rows, columns]
    return canvas


def _rings(side: int, number: int) -> GreyImage:
    """Zone plate: finer towards its rim, by default down to two pixels a half-period."""
    x, y = _centred(side)
    squared = x**2 + y**2
    return _two_tone((np.cos(np.pi * squared / (2.2 * side)) > 0) ^ bool(number % 2))


def _slanted(side: int, number: int) -> GreyImage:
    """Nested squares, turned by a few degrees: edges that cross the pixel grid at every phase."""
    x, y = _centred(side)
    angle = math.radians(6 + 9 * (number % 4))
    u, v = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
    distance = np.maximum(np.abs(u), np.abs(v)) / side
    return _two_tone(np.floor(9 * distance) % 2 == 0)


def _strokes(side: int, number: int) -> GreyImage:
    """Lines of text-like glyphs on white, the lines smaller towards the bottom."""
    generator = np.random.default_rng(1000 + number)
    canvas = np.full((side, side), _WHITE, dtype=np.uint8)
    top, cell = side // 16, max(1, side // 28)
    while top + 5 * cell < side - cell:
        left = cell
        while left + 3 * cell < side - cell:
            if generator.random() > 0.15:
                glyph = np.kron(generator.random((5, 3)) < 0.6, np.ones((cell, cell), dtype=bool))
                canvas[top : top + 5 * cell, left : left + 3 * cell][glyph] = _BLACK
            left += 4 * cell
        top += 7 * cell
        cell = max(1, round(cell * 0.75))
    return canvas
