"""Textures to learn from: generated, of every kind that photographs hold, never stored.

Edges, lines, corners and regular patterns of many sizes and contrasts; none of them comes from a picture. They serve to
weigh the estimator's clues against each other (:mod:`workbench.depth.evidence_learn`), not as test images.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

Float32 = NDArray[np.float32]
Generator = np.random.Generator

_FINER = 2
"""Drawn this many times finer and averaged, so that edges are not aligned to pixels."""


def random_texture(side: int, generator: Generator, finer: int = 1) -> Float32:
    """One texture of random kind, size, direction and contrast, values about 0 to 1.

    float32 (finer * side, finer * side): ``finer``, 1 or 2, of its samples make a pixel's side.
    """
    kind = KINDS[int(generator.integers(len(KINDS)))]
    drawn = kind(side * _FINER, generator)
    if generator.random() < 0.5:
        turn = cv2.getRotationMatrix2D((side, side), float(generator.uniform(0, 360)), 1.0)
        shape = (side * _FINER, side * _FINER)
        drawn = np.asarray(cv2.warpAffine(drawn, turn, shape, borderMode=cv2.BORDER_REFLECT_101), np.float32)
    samples = finer * side
    texture = cv2.resize(drawn, (samples, samples), interpolation=cv2.INTER_AREA)
    texture = texture - float(texture.mean())
    contrast = float(np.exp(generator.uniform(np.log(0.02), np.log(0.35))))
    spread = float(texture.std())
    shading = _grain(samples, generator, 2.0) * generator.uniform(0.0, 0.05)
    grain = _grain(samples, generator, float(generator.uniform(0.3, 1.2))) * contrast * generator.uniform(0.0, 0.15)
    return np.asarray(0.45 + texture * (contrast / max(spread, 1e-6)) + grain + shading, np.float32)


def blurred_texture(side: int, psf: Float32, generator: Generator, finer: int = 1) -> Float32:
    """A :func:`random_texture` blurred by a PSF and summed in pixels, float32 (side, side); no noise.

    The PSF, float32 (K, K), K odd, is sampled ``finer`` times, 1 or 2, as densely as the pixels.
    """
    half, inner = psf.shape[0] // 2, finer * side
    texture = random_texture(side + 2 * -(-half // finer), generator, finer)
    size = fft.next_fast_len(texture.shape[0] + 2 * half, real=True)
    blurred = fft.irfft2(fft.rfft2(texture, s=(size, size)) * fft.rfft2(psf, s=(size, size)), s=(size, size))
    light = np.asarray(blurred[2 * half : 2 * half + inner, 2 * half : 2 * half + inner], np.float32)
    return np.asarray(cv2.resize(light, (side, side), interpolation=cv2.INTER_AREA), np.float32)


def _grain(side: int, generator: Generator, fall: float) -> Float32:
    modulus = np.hypot(fft.fftfreq(side)[:, np.newaxis], fft.rfftfreq(side)[np.newaxis, :])
    spectrum = fft.rfft2(generator.standard_normal((side, side))) / np.maximum(modulus, 0.5 / side) ** fall
    spectrum[0, 0] = 0.0
    noise = fft.irfft2(spectrum, s=(side, side))
    return np.asarray(noise / noise.std(), np.float32)


def _leaves(side: int, generator: Generator) -> Float32:
    """Opaque discs of a power law of sizes: occlusion, as in Lee, Mumford and Huang 2001."""
    canvas = np.full((side, side), 0.5, np.float32)
    smallest = float(generator.uniform(4, 16))
    count = int(min(2.5 * side * side / (8.0 * smallest**2), 3000)) + 30
    for radius, x, y, grey in zip(
        np.minimum(smallest * generator.random(count) ** -0.5, side / 4),
        generator.uniform(0, side, count), generator.uniform(0, side, count), generator.random(count), strict=True,
    ):  # fmt: skip
        cv2.circle(canvas, (int(x), int(y)), int(radius), float(grey), -1)
    return canvas


def _polygons(side: int, generator: Generator) -> Float32:
    """Overlapping triangles and quadrangles: straight edges, sharp corners."""
    canvas = np.full((side, side), 0.5, np.float32)
    size = float(generator.uniform(12, 80))
    for _ in range(int(4 * side * side / size**2) + 10):
        corners = generator.uniform(0, side, 2) + size * generator.standard_normal((int(generator.integers(3, 5)), 2))
        cv2.fillPoly(canvas, [np.rint(corners).astype(np.int32)], float(generator.random()))
    return canvas


def _strokes(side: int, generator: Generator) -> Float32:
    """Rows of small glyphs made of a few strokes: the look of print, dense or sparse, small or large."""
    canvas = np.ones((side, side), np.float32)
    height = float(np.exp(generator.uniform(np.log(12), np.log(110))))
    thick = max(1, round(height * generator.uniform(0.07, 0.2)))
    filled = generator.uniform(0.4, 1.0)
    for y in np.arange(-height * generator.random(), side, height * generator.uniform(1.3, 2.2)):
        for x in np.arange(-height * generator.random(), side, height * generator.uniform(0.7, 0.9)):
            if generator.random() > filled:
                continue
            for _ in range(int(generator.integers(2, 5))):
                ends = generator.choice([0.0, 0.5, 1.0], (2, 2)) * height * (0.6, 1.0) + (x, y)
                (x0, y0), (x1, y1) = np.rint(ends).astype(int).tolist()
                if generator.random() < 0.7:
                    cv2.line(canvas, (x0, y0), (x1, y1), 0.0, thick)
                else:
                    cv2.ellipse(canvas, (x0, y0), (int(height / 4), int(height / 3)), 0, 0, 300, 0.0, thick)
    return canvas if generator.random() < 0.7 else np.asarray(1.0 - canvas, np.float32)


def _tiles(side: int, generator: Generator) -> Float32:
    """Bricks, tiles and planks: periodic joints, tones that vary from piece to piece."""
    height = float(np.exp(generator.uniform(np.log(12), np.log(70))))
    width, joint = height * generator.uniform(1.0, 4.0), height * generator.uniform(0.05, 0.25)
    y, x = np.mgrid[0:side, 0:side].astype(np.float64)
    y += generator.uniform(0, height)
    course = np.floor(y / height)
    x += generator.uniform(0, width) + (course % 2) * width * generator.choice([0.0, 0.5])
    tones = generator.uniform(0.0, 1.0, 4096)[(course * 61 + np.floor(x / width) * 17).astype(np.int64) % 4096]
    piece = 0.5 + generator.uniform(0.0, 0.6) * (tones - 0.5)
    gap = (y % height < joint) | (x % width < joint)
    return np.asarray(np.where(gap, generator.choice([0.0, 1.0]), piece), np.float32)


def _cells(side: int, generator: Generator) -> Float32:
    """Pebbles, leather, foam: cells about random points, darker towards their borders."""
    seeds = np.ones((side, side), np.uint8)
    count = int(side * side / np.exp(generator.uniform(np.log(80), np.log(1500)))) + 4
    seeds[generator.integers(0, side, count), generator.integers(0, side, count)] = 0
    distance, label = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    tones = generator.uniform(0.3, 1.0, int(label.max()) + 1).astype(np.float32)
    depth = np.float32(generator.uniform(0.3, 1.0) / max(float(np.percentile(distance, 98)), 1.0))
    return np.asarray(tones[label] * (1.0 - depth * distance), np.float32)


def _fibres(side: int, generator: Generator) -> Float32:
    """Wood, grass, cloth: thin bright lines with a common direction."""
    canvas = np.zeros((side, side), np.float32)
    length, lean = float(generator.uniform(20, 160)), float(generator.uniform(0.02, 0.6))
    for _ in range(int(side * side / length / generator.uniform(2, 20)) + 20):
        x, y = generator.uniform(0, side, 2)
        angle = lean * generator.standard_normal()
        dx, dy = length * np.sin(angle) / 2, length * np.cos(angle) / 2
        cv2.line(canvas, (int(x - dx), int(y - dy)), (int(x + dx), int(y + dy)), float(generator.random()),
                 int(generator.integers(1, 4)))  # fmt: skip
    return canvas


def _relief(side: int, generator: Generator) -> Float32:
    """Plaster, clouds, marble: noise of a power law, bent so that it has ridges or plateaus."""
    noise = _grain(side, generator, float(generator.uniform(0.8, 1.8)))
    form = int(generator.integers(4))
    if form == 0:
        return np.asarray(np.abs(noise), np.float32)
    if form == 1:
        return np.asarray(np.tanh(4.0 * noise), np.float32)
    if form == 2:
        return np.asarray(np.exp(0.7 * noise), np.float32)
    return noise


KINDS: tuple[Callable[[int, Generator], Float32], ...] = (
    _leaves, _leaves, _polygons, _strokes, _strokes, _tiles, _cells, _fibres, _relief,
)  # fmt: skip
