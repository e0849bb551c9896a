"""Textures for scenes, all generated: by name, for any size, the same for the same seed.

Values are 0 to 1 and mix an object's dark and light colours linearly. Sizes of details are in pixels of the texture.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from rigs.charts import chart as chart_picture
from rigs.simulated.sensor import FloatImage

_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)
_LETTERS = np.array(list("aabcdeeefghiijklmnoopqrsttuuvwxyzABDEGKMRSTW0123456789"))


def texture(name: str, shape: tuple[int, int], seed: int = 0) -> FloatImage:
    """Generate a texture.

    Parameters
    ----------
    name
        One of :data:`TEXTURES`.
    shape
        (height, width) in pixels.
    seed
        Same seed, same texture.

    Returns
    -------
    FloatImage
        float32 (height, width), 0 to 1.

    Raises
    ------
    ValueError
        There is no such texture; the message lists what there is.
    """
    if name not in TEXTURES:
        raise ValueError(f"no texture {name!r}; there are {', '.join(sorted(TEXTURES))}")
    made = TEXTURES[name](shape[0], shape[1], np.random.default_rng([seed, 0x7E]))
    return np.asarray(np.clip(made, 0.0, 1.0), np.float32)


def _chart(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Resolution chart: stars, bars, rings, checks, slanted edges; turned by the seed."""
    drawn = chart_picture(2 * width, 2 * height)
    small = cv2.resize(drawn, (width, height), interpolation=cv2.INTER_AREA)
    turned = small[:: int(generator.choice([-1, 1])), :: int(generator.choice([-1, 1]))]
    return np.asarray(turned / np.float32(255.0), np.float32)


def _text(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Page of printed words."""
    page = np.full((height, width), 255, np.uint8)
    y = 0
    while y < height + 30:
        size = float(generator.uniform(0.45, 1.0))
        font = int(generator.choice(_FONTS))
        y += int(40 * size)
        x = int(generator.uniform(5, 60))
        while x < width:
            word = "".join(generator.choice(_LETTERS, int(generator.integers(2, 10))))
            (length, _), _ = cv2.getTextSize(word, font, size, 1)
            cv2.putText(page, word, (x, y), font, size, 0, 1 if size < 0.8 else 2, cv2.LINE_AA)
            x += length + int(18 * size)
        if generator.random() < 0.08:
            y += int(30 * size)
    return np.asarray(page / 255.0, np.float32)


def _leaves(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Dead leaves under uneven light, like a photograph: ellipses, radii after r**-3, each with its own shading."""
    smallest, largest = 2.5, max(12.0, min(height, width) / 5)
    density = 0.5 * (smallest**-2 - largest**-2)
    mean_area = math.pi * math.log(largest / smallest) / density
    count = min(200_000, math.ceil(2.5 * height * width / mean_area))
    canvas = np.full((height, width), 128, np.uint8)
    radii = (smallest**-2 - generator.random(count) * (smallest**-2 - largest**-2)) ** -0.5
    centres = generator.random((count, 2)) * (width, height)
    greys, squeeze, turns = generator.random(count), generator.uniform(0.4, 1.0, count), generator.random(count) * 180
    for radius, (x, y), grey, flat, turn in zip(radii, centres, greys, squeeze, turns, strict=True):
        # Positions and axes carry four binary digits below the pixel.
        centre, axes = (int(16 * x), int(16 * y)), (int(16 * radius), int(16 * radius * flat))
        cv2.ellipse(canvas, centre, axes, float(turn), 0, 360, 20 + int(220 * grey), -1, cv2.LINE_AA, 4)
    light = _filtered_noise(height, width, generator, lambda f: np.exp(-((f * max(height, width) / 3) ** 2)))
    grain = _filtered_noise(height, width, generator, lambda f: 1.0 / np.maximum(f, 0.02))
    return np.asarray(canvas / 255.0 * (0.75 + 0.12 * light) + 0.02 * grain, np.float32)


def _noise(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Gaussian noise whose amplitude falls with frequency as f**-1.1."""
    noise = _filtered_noise(height, width, generator, lambda f: np.maximum(f, 0.004) ** -1.1)
    return np.asarray(0.5 + 0.18 * noise, np.float32)


def _gravel(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Pebbles: cells about random points, darker towards their borders."""
    seeds = np.ones((height, width), np.uint8)
    count = max(4, height * width // 120)
    seeds[generator.integers(0, height, count), generator.integers(0, width, count)] = 0
    distance, label = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    grey = generator.uniform(0.25, 1.0, int(label.max()) + 1).astype(np.float32)
    return np.asarray(grey[label] * np.clip(1.1 - 0.09 * distance, 0.1, 1.0), np.float32)


def _grass(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Thin blades in several directions, the brightest in front."""
    result = np.zeros((height, width), np.float32)
    for _ in range(5):
        sparse = (generator.random((height, width), np.float32) > 0.997).astype(np.float32)
        sparse *= generator.random((height, width), np.float32)
        angle, length = generator.uniform(-0.6, 0.6), 21
        kernel = np.zeros((length, length), np.uint8)
        dx, dy = length / 2 * math.sin(angle), length / 2 * math.cos(angle)
        middle = length // 2
        ends = [(int(middle + s * dx), int(middle + s * dy)) for s in (-1, 1)]
        cv2.line(kernel, ends[0], ends[1], 255, 1, cv2.LINE_AA)
        blades = cv2.filter2D(sparse, -1, kernel.astype(np.float32) / 255.0)
        result = np.maximum(result, np.minimum(blades, 1.0))
    return result


def _brick(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Brick wall in running bond, from afar."""
    return _bond(height, width, generator, (22, 62, 4), grain=0.02)


def _masonry(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Rough brick wall in running bond, from nearer by."""
    return _bond(height, width, generator, (64, 180, 10), grain=0.07)


def _bond(
    height: int, width: int, generator: np.random.Generator, pixels: tuple[int, int, int], *, grain: float
) -> FloatImage:
    """Bricks of (height, width) with a joint of so many pixels."""
    tall, wide, joint = pixels
    y, x = np.arange(height)[:, None], np.arange(width)[None, :]
    row = y // tall
    shifted = x + (row % 2) * (wide // 2) + int(generator.integers(0, wide))
    column = shifted // wide
    tone = generator.uniform(0.55, 0.85, (int(row.max()) + 1, int(column.max()) + 1))
    wall = tone[row, column]
    wall = np.where((y % tall < joint) | (shifted % wide < joint), 0.15, wall).astype(np.float32)
    rough = _filtered_noise(height, width, generator, lambda f: 1.0 / np.maximum(f, 0.02))
    return np.asarray(cv2.GaussianBlur(wall, (0, 0), 0.6) + grain * rough, np.float32)


def _weave(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Plain weave: threads that pass over and under each other, strictly periodic."""
    period = 9.0
    y = (np.arange(height)[:, None] + generator.uniform(0, period)) / period
    x = (np.arange(width)[None, :] + generator.uniform(0, period)) / period
    warp, weft = np.abs(np.sin(math.pi * x)), np.abs(np.sin(math.pi * y))
    over = (np.floor(x) + np.floor(y)) % 2 == 0
    return np.asarray(np.where(over, 0.35 + 0.6 * warp, 0.1 + 0.5 * weft), np.float32)


def _faint(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Photograph-like texture of 6 % of the contrast."""
    return np.asarray(0.5 + 0.06 * (_leaves(height, width, generator) - 0.5), np.float32)


def _letters(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """A few large letters on a plain ground."""
    sign = np.full((height, width), 235, np.uint8)
    size = min(height, width) / 90
    thickness = max(2, round(2.5 * size))
    step = int(34 * size)
    for y in range(int(30 * size), height + step, int(38 * size)):
        for x in range(int(generator.uniform(4, 20) * size / 2), width, step):
            letter = str(generator.choice(_LETTERS)).upper()
            cv2.putText(sign, letter, (x, y), cv2.FONT_HERSHEY_DUPLEX, size, 20, thickness, cv2.LINE_AA)
    return np.asarray(sign / 255.0, np.float32)


def _blank(height: int, width: int, generator: np.random.Generator) -> FloatImage:
    """Nothing to see: one level, chosen by the seed."""
    return np.full((height, width), generator.uniform(0.4, 0.6), np.float32)


def _filtered_noise(
    height: int,
    width: int,
    generator: np.random.Generator,
    gain: Callable[[NDArray[np.float32]], NDArray[np.floating]],
) -> FloatImage:
    """Gaussian noise with an amplitude spectrum ``gain(f)``, f in cycles per pixel; mean 0, standard deviation 1."""
    size = fft.next_fast_len(height, real=True), fft.next_fast_len(width, real=True)
    transform = fft.rfft2(generator.standard_normal(size, np.float32))
    fy = fft.fftfreq(size[0]).astype(np.float32)[:, None]
    fx = fft.rfftfreq(size[1]).astype(np.float32)[None, :]
    transform *= gain(np.hypot(fy, fx))
    transform[0, 0] = 0.0
    noise = fft.irfft2(transform, s=size)[:height, :width]
    return np.asarray((noise - noise.mean()) / noise.std(), np.float32)


TEXTURES: dict[str, Callable[[int, int, np.random.Generator], FloatImage]] = {
    "chart": _chart, "text": _text, "leaves": _leaves, "noise": _noise, "gravel": _gravel, "grass": _grass,
    "brick": _brick, "weave": _weave, "faint": _faint, "letters": _letters, "blank": _blank,
    "masonry": _masonry,
}  # fmt: skip
"""Textures by name: (height, width, generator) -> float32 (height, width)."""
