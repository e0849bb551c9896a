"""What is drawn on surfaces: pictures of everyday things, in colour, made from random numbers.

Sizes of details are given in texels; one texel is about what one photosite sees where the surface stands.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Rgb = NDArray[np.uint8]
Generator = np.random.Generator
_ALPHABET = list("aaabcdeeeefghiiiklmnnooprrssttuvwyzABCDEFGHKLMNPRSTW0123456789.,-")


def draw(kind: str, height: int, width: int, generator: Generator) -> Rgb:
    """Draw one of :data:`DRAWINGS`: uint8 (height, width, 3), linear in light."""
    return np.ascontiguousarray(DRAWINGS[kind](height, width, generator))


def _colour(generator: Generator, low: float, high: float) -> tuple[int, int, int]:
    r, g, b = (int(value) for value in generator.uniform(low, high, 3))
    return r, g, b


def _plain(height: int, width: int, colour: tuple[int, int, int]) -> Rgb:
    return np.full((height, width, 3), colour, np.uint8)


def _clouds(height: int, width: int, generator: Generator, cell: float) -> NDArray[np.float32]:
    """Smooth noise of several octaves, the coarsest with cells of so many texels; standard deviation 1."""
    total = np.zeros((height, width), np.float32)
    strength = 1.0
    while cell >= 1.0:
        shape = int(height / cell) + 3, int(width / cell) + 3
        coarse = generator.standard_normal(shape).astype(np.float32)
        fine = cv2.resize(coarse, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
        total += strength * fine[:height, :width]
        cell, strength = cell / 2, strength * 0.6
    return np.asarray(total / total.std(), np.float32)


def _shaded(picture: Rgb, light: NDArray[np.floating]) -> Rgb:
    return np.clip(picture * light[..., None], 0, 255).astype(np.uint8)


def _write(page: Rgb, generator: Generator, box: tuple[int, int, int, int], size: float, ink: tuple[int, int, int],
           font: int) -> None:  # fmt: skip
    """Lines of words of a size (OpenCV's scale) within x, y, width, height."""
    x0, y0, wide, tall = box
    thick = max(1, round(1.6 * size))
    y = y0 + int(26 * size)
    while y < y0 + tall:
        x = x0
        while True:
            word = "".join(generator.choice(_ALPHABET, int(generator.integers(2, 10))))
            (length, _), _ = cv2.getTextSize(word, font, size, thick)
            if x + length > x0 + wide:
                break
            cv2.putText(page, word, (x, y), font, size, ink, thick, cv2.LINE_AA)
            x += length + int(14 * size)
        y += int(38 * size)


def _page(height: int, width: int, generator: Generator) -> Rgb:
    page = _plain(height, width, _colour(generator, 190, 240))
    ink = _colour(generator, 5, 40)
    edge, columns = width // 14, int(generator.integers(1, 3))
    _write(page, generator, (edge, edge, width - 2 * edge, int(0.12 * height)), 1.7, ink, cv2.FONT_HERSHEY_DUPLEX)
    column = (width - edge) // columns
    size = float(generator.uniform(0.7, 1.3))
    for number in range(columns):
        box = (edge + number * column, edge + int(0.16 * height), column - edge, int(0.84 * height) - 2 * edge)
        _write(page, generator, box, size, ink, cv2.FONT_HERSHEY_COMPLEX)
    return page


def _poster(height: int, width: int, generator: Generator) -> Rgb:
    poster = _plain(height, width, _colour(generator, 40, 220))
    for _ in range(90):
        colour, side = _colour(generator, 5, 245), generator.uniform(0.03, 0.25) * min(height, width)
        x, y = generator.uniform(0, width), generator.uniform(0, height)
        corners = np.array([x, y]) + side * generator.uniform(-1, 1, (int(generator.integers(3, 7)), 2))
        if generator.random() < 0.5:
            cv2.circle(poster, (int(x), int(y)), int(side / 2), colour, -1, cv2.LINE_AA)
        else:
            cv2.fillPoly(poster, [corners.astype(np.int32)], colour, cv2.LINE_AA)
    ink = _colour(generator, 0, 255)
    box = (width // 12, int(0.1 * height), width * 5 // 6, int(0.18 * height))
    _write(poster, generator, box, 3.0, ink, cv2.FONT_HERSHEY_TRIPLEX)
    return poster


def _foliage(height: int, width: int, generator: Generator) -> Rgb:
    """Leaves that hide each other, with veins; sizes fall as a power law (dead leaves, Lee et al. 2001)."""
    canvas = _plain(height, width, (10, 25, 8))
    hue = generator.uniform(0.2, 1.0, 3)
    for _ in range(height * width // 300):
        long = min(7.0 * (1.0 - generator.random()) ** -0.5, 80.0)
        x, y, turn = int(generator.uniform(0, width)), int(generator.uniform(0, height)), generator.uniform(0, 180)
        green = generator.uniform(40, 200)
        colour = tuple(int(v) for v in np.clip(green * hue * generator.uniform(0.7, 1.2, 3), 0, 255))
        cv2.ellipse(canvas, (x, y), (int(long), int(0.45 * long)), turn, 0, 360, colour, -1, cv2.LINE_AA)
        along = long * np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
        vein = tuple(int(0.6 * v) for v in colour)
        start, stop = (int(x - along[0]), int(y - along[1])), (int(x + along[0]), int(y + along[1]))
        cv2.line(canvas, start, stop, vein, 1, cv2.LINE_AA)
    return canvas


def _meadow(height: int, width: int, generator: Generator) -> Rgb:
    canvas = _plain(height, width, (14, 26, 9))
    for _ in range(height * width // 90):
        x, y, long = generator.uniform(0, width), generator.uniform(0, height * 1.1), generator.uniform(15, 60)
        lean = generator.normal(0, 0.35)
        green = generator.uniform(50, 190)
        colour = (int(green * generator.uniform(0.4, 0.9)), int(green), int(0.3 * green))
        start, stop = (int(x), int(y)), (int(x + long * np.sin(lean)), int(y - long * np.cos(lean)))
        cv2.line(canvas, start, stop, colour, int(generator.integers(1, 3)), cv2.LINE_AA)
    return canvas


def _pebbles(height: int, width: int, generator: Generator) -> Rgb:
    canvas = _plain(height, width, (22, 20, 18))
    for _ in range(height * width // 220):
        radius = float(np.clip(generator.lognormal(2.2, 0.5), 3, 40))
        centre = int(generator.uniform(0, width)), int(generator.uniform(0, height))
        base, turn = generator.uniform(60, 210) * generator.uniform(0.85, 1.0, 3), generator.uniform(0, 180)
        flat = generator.uniform(0.6, 1.0)
        for share in (1.0, 0.7, 0.4):  # lighter towards the upper left
            moved = (int(centre[0] - 0.25 * (1 - share) * radius), int(centre[1] - 0.35 * (1 - share) * radius))
            colour = tuple(int(v) for v in np.clip(base * (1.25 - 0.45 * share), 0, 255))
            axes = (max(1, int(share * radius)), max(1, int(share * flat * radius)))
            cv2.ellipse(canvas, moved, axes, turn, 0, 360, colour, -1, cv2.LINE_AA)
    return _shaded(canvas, 1.0 + 0.06 * _clouds(height, width, generator, 4.0))


def _planks(height: int, width: int, generator: Generator) -> Rgb:
    wood = np.zeros((height, width, 3), np.float32)
    base = np.array([150.0, 105.0, 65.0]) * generator.uniform(0.6, 1.2)
    top = 0
    while top < height:
        tall = int(generator.uniform(60, 130))
        stretched = cv2.resize(_clouds(tall, width // 12 + 2, generator, 16.0), (width, tall))
        y = np.arange(tall, dtype=np.float32)[:, None]
        rings = np.sin(0.25 * y + 3.0 * stretched)
        part = 1.0 + 0.14 * rings + 0.08 * stretched + generator.normal(0, 0.12)
        part[:3] *= 0.35
        rows = min(tall, height - top)
        wood[top : top + rows] = (base * part[..., None])[:rows]
        top += tall
    return _shaded(np.clip(wood, 0, 255).astype(np.uint8), 1.0 + 0.04 * _clouds(height, width, generator, 2.0))


def _masonry(height: int, width: int, generator: Generator) -> Rgb:
    tall, wide, joint = int(generator.uniform(45, 90)), int(generator.uniform(130, 230)), int(generator.uniform(5, 11))
    wall = _plain(height, width, _colour(generator, 110, 160))
    base = np.array([165.0, 80.0, 60.0]) * generator.uniform(0.7, 1.2)
    for row in range(-1, height // tall + 1):
        for column in range(-1, width // wide + 2):
            left, top = int((column - 0.5 * (row % 2)) * wide), row * tall
            wobble = generator.integers(-2, 3, 4)
            colour = tuple(int(v) for v in np.clip(base * generator.normal(1.0, 0.13), 0, 255))
            start = (left + int(wobble[0]), top + int(wobble[1]))
            stop = (left + wide - joint + int(wobble[2]), top + tall - joint + int(wobble[3]))
            cv2.rectangle(wall, start, stop, colour, -1)
    return _shaded(wall, 1.0 + 0.10 * _clouds(height, width, generator, 24.0))


def _plaster(height: int, width: int, generator: Generator) -> Rgb:
    wall = _plain(height, width, _colour(generator, 120, 210))
    return _shaded(wall, 1.0 + 0.05 * _clouds(height, width, generator, 32.0))


def _plaid(height: int, width: int, generator: Generator) -> Rgb:
    cloth = np.zeros((height, width, 3), np.float32)
    for axis, length in ((0, height), (1, width)):
        line, at = np.zeros((length, 3), np.float32), 0
        while at < length:
            stripe = int(generator.uniform(4, 50))
            line[at : at + stripe] = _colour(generator, 10, 120)
            at += stripe
        cloth += line[:, None] if axis == 0 else line[None, :]
    threads = generator.standard_normal((height, width)).astype(np.float32)
    return _shaded(cloth.astype(np.uint8), 1.0 + 0.1 * cv2.GaussianBlur(threads, (0, 0), 0.8) * 3)


def _coat(height: int, width: int, generator: Generator) -> Rgb:
    """Dark cloth in folds."""
    cloth = _plain(height, width, _colour(generator, 12, 45))
    folds = cv2.resize(_clouds(height // 6 + 2, width, generator, 60.0), (width, height))
    return _shaded(cloth, np.clip(1.0 + 0.45 * folds + 0.10 * _clouds(height, width, generator, 3.0), 0.1, 3.0))


def _card(height: int, width: int, generator: Generator) -> Rgb:
    """A coloured card with a few large letters."""
    card = _plain(height, width, _colour(generator, 20, 235))
    size = min(height, width) / 110
    for number, letter in enumerate(generator.choice([c for c in _ALPHABET if c.isalpha()], 3)):
        where = int(width * (0.05 + 0.31 * number)), int(height * generator.uniform(0.45, 0.85))
        cv2.putText(card, str(letter).upper(), where, cv2.FONT_HERSHEY_DUPLEX, size, _colour(generator, 0, 250),
                    max(2, int(3 * size)), cv2.LINE_AA)  # fmt: skip
    return card


def _books(height: int, width: int, generator: Generator) -> Rgb:
    shelf, left = _plain(height, width, (15, 12, 10)), 0
    while left < width:
        wide, top = int(generator.uniform(28, 90)), int(generator.uniform(0, 0.15) * height)
        spine = np.ascontiguousarray(np.rot90(_plain(height - top, wide - 3, _colour(generator, 15, 220))))
        ink = _colour(generator, 0, 255)
        _write(spine, generator, (int(0.1 * height), wide // 6, int(0.7 * height), wide // 2), wide / 55, ink,
               cv2.FONT_HERSHEY_SIMPLEX)  # fmt: skip
        upright = np.rot90(spine, -1)
        room = min(wide - 3, width - left)
        shelf[top:, left : left + room] = upright[:, :room]
        left += wide
    return shelf


def _speckles(height: int, width: int, generator: Generator) -> Rgb:
    """Terrazzo: splinters of stone in cement."""
    floor = _plain(height, width, _colour(generator, 130, 200))
    for _ in range(height * width // 260):
        centre = generator.uniform((0, 0), (width, height))
        corners = centre + generator.lognormal(1.6, 0.5) * generator.uniform(-1, 1, (5, 2))
        hull = cv2.convexHull(corners.astype(np.float32)).astype(np.int32)
        cv2.fillConvexPoly(floor, hull, _colour(generator, 20, 230), cv2.LINE_AA)
    return floor


DRAWINGS: dict[str, Callable[[int, int, Generator], Rgb]] = {
    "page": _page, "poster": _poster, "foliage": _foliage, "meadow": _meadow, "pebbles": _pebbles, "planks": _planks,
    "masonry": _masonry, "plaster": _plaster, "plaid": _plaid, "coat": _coat, "card": _card, "books": _books,
    "terrazzo": _speckles,
}  # fmt: skip
