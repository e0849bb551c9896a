"""Traces rays from the sensor through the aperture to the nearest surface.

Every photosite sends the same number of rays: from a point within the photosite (widened by the camera's spot)
through a point of the aperture, both from a scrambled Sobol sequence that is shifted anew for each photosite, by way
of the conjugate point on the plane in focus. There is no point-spread function, no convolution and no layer anywhere:
blur and occlusion come from which rays meet what.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, qmc

from workbench.compiled import compiled
from workbench.processors import each, usable_processors
from workbench.raytrace.world import Camera, Surface

Floats = NDArray[np.float64]
_QUANTILES = 1024
_BAND = 16


@dataclass(frozen=True, slots=True)
class Traced:
    """What the sensor receives.

    Attributes
    ----------
    light
        float32 (height, width): light on each photosite through its colour filter, 1 is a white surface.
    depth_mm, surface
        float32 and int16 (height / 2, width / 2), of the ray through the lens's centre: depth along the axis, and the
        index of the surface; infinity and -1 where there is nothing.
    """

    light: NDArray[np.float32]
    depth_mm: NDArray[np.float32]
    surface: NDArray[np.int16]


def trace(camera: Camera, surfaces: Sequence[Surface], *, rays: int, seed: int) -> Traced:
    """Photograph surfaces, without noise of the sensor.

    Parameters
    ----------
    camera
        Lens and sensor.
    surfaces
        What is there.
    rays
        Per photosite, a power of two.
    seed
        Of the rays.
    """
    shapes, texels = _packed(surfaces)
    generator = np.random.default_rng([seed, 0x7A])
    samples = qmc.Sobol(4, rng=generator).random(rays)
    quantiles, triangles = _spot_quantiles(camera), _triangles(camera)
    light = np.zeros((camera.height, camera.width), np.float32)
    shifts = generator.random((camera.height, camera.width, 4), np.float32)
    unit = camera.pitch_mm / camera.image_mm  # slope of a ray through the lens's centre, per photosite

    def band(top: int) -> None:
        rows = slice(top, min(top + _BAND, camera.height))
        _trace_rows(light[rows], shifts[rows], top, camera.height, camera.width, unit, camera.focus_mm, samples,
                    triangles, quantiles, shapes, texels)  # fmt: skip

    each(band, range(0, camera.height, _BAND), usable_processors())
    depth = np.full((camera.height // 2, camera.width // 2), np.inf, np.float32)
    surface = np.full(depth.shape, -1, np.int16)
    _look(depth, surface, camera.height, camera.width, unit, shapes, texels)
    return Traced(light, depth, surface)


def trace_point(camera: Camera, depth_mm: float, *, rays: int, seed: int) -> NDArray[np.float64]:
    """Light of a point at this depth, seen in the middle of the frame, per photosite; it sums to 1."""
    samples, triangles = qmc.Sobol(4, rng=np.random.default_rng([seed, 0x7B])).random(rays), _triangles(camera)
    spread = norm.ppf(np.clip(samples[:, 2:], 1e-9, 1 - 1e-9)) * (camera.spot_mm / camera.pitch_mm)
    # A ray from the point through A of the aperture meets the plane in focus at A (1 - focus / depth).
    across = _openings(np.ascontiguousarray(samples[:, :2]), triangles) * (1.0 - camera.focus_mm / depth_mm)
    site = across * camera.image_mm / camera.focus_mm / camera.pitch_mm + spread
    middle = camera.height / 2, camera.width / 2
    edges = [np.arange(n + 1) - middle[axis] for axis, n in enumerate((camera.height, camera.width))]
    counts, _, _ = np.histogram2d(site[:, 1], site[:, 0], bins=(edges[0], edges[1]))
    return np.asarray(counts / rays, np.float64)


def _spot_quantiles(camera: Camera) -> Floats:
    """Where in its photosite a ray begins, photosites from the corner: quantiles of a box blurred by the spot."""
    sigma = camera.spot_mm / camera.pitch_mm
    at = np.linspace(-0.5 - 5 * sigma, 0.5 + 5 * sigma, 4001)
    below = sum(sign * (x * norm.cdf(x / sigma) + sigma * norm.pdf(x / sigma))
                for sign, x in ((1, at + 0.5), (-1, at - 0.5)))  # fmt: skip
    return np.asarray(0.5 + np.interp(np.linspace(0, 1, _QUANTILES), below, at), np.float64)


def _triangles(camera: Camera) -> Floats:
    """The opening cut into triangles, ear by ear: (n, 7), the end of each one's share of the area, its corners, mm."""
    outline = np.array(camera.aperture_mm) * (1.0, -1.0)
    if _area(outline) < 0:
        outline = outline[::-1]
    left, found = list(range(len(outline))), []
    while len(left) > 3:
        for k in range(len(left)):
            corner = outline[[left[k - 1], left[k], left[(k + 1) % len(left)]]]
            others = [outline[i] for i in left if not (outline[i] == corner).all(axis=1).any()]
            if _area(corner) > 0 and not any(_inside(corner, point) for point in others):
                found.append(corner)
                left.pop(k)
                break
        else:
            raise ValueError("the aperture's outline crosses itself or encloses nothing")
    found.append(outline[left])
    shares = np.array([_area(corner) for corner in found])
    return np.column_stack([np.cumsum(shares) / shares.sum(), np.reshape(found, (-1, 6))])


@compiled
def _opening(u: float, v: float, triangles: Floats) -> tuple[float, float]:
    """Point of the opening for a point of the unit square, evenly spread; y down."""
    k, before = 0, 0.0
    while k < triangles.shape[0] - 1 and u >= triangles[k, 0]:
        before = triangles[k, 0]
        k += 1
    root = np.sqrt((u - before) / (triangles[k, 0] - before))  # Osada et al. 2002, equation 1
    a, b, c = 1.0 - root, root * (1.0 - v), root * v
    return (
        a * triangles[k, 1] + b * triangles[k, 3] + c * triangles[k, 5],
        a * triangles[k, 2] + b * triangles[k, 4] + c * triangles[k, 6],
    )


@compiled
def _openings(unit: Floats, triangles: Floats) -> Floats:
    points = np.empty_like(unit)
    for n in range(unit.shape[0]):
        points[n, 0], points[n, 1] = _opening(unit[n, 0], unit[n, 1], triangles)
    return points


def _cross(first: Floats, second: Floats) -> Floats:
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0], np.float64)


def _area(outline: Floats) -> float:
    return float(_cross(outline, np.roll(outline, -1, axis=0)).sum() / 2)


def _inside(corner: Floats, point: Floats) -> bool:
    return all(_cross(corner[(k + 1) % 3] - corner[k], point - corner[k]) >= 0 for k in range(3))


def _packed(surfaces: Sequence[Surface]) -> tuple[Floats, NDArray[np.uint8]]:
    """Numbers of each surface in a row, and all pictures one after the other."""
    rows, start = [], 0
    for surface in surfaces:
        height, width = surface.picture.shape[:2]
        rows.append([*surface.corner, *surface.across, *surface.down, surface.round_mm, start, height, width])
        start += surface.picture.size
    return np.array(rows, np.float64), np.concatenate([surface.picture.ravel() for surface in surfaces])


@compiled
def _meet(
    shapes: Floats, texels: NDArray[np.uint8], ax: float, ay: float, dx: float, dy: float
) -> tuple[int, float, float, float, float]:
    """Nearest surface of the ray (ax, ay, 0) + z (dx, dy, 1): index, z, column and row in its picture, brightness."""
    nearest, depth, column, row, shade = -1, np.inf, 0.0, 0.0, 1.0
    for k in range(shapes.shape[0]):
        ox, oy, oz = shapes[k, 0], shapes[k, 1], shapes[k, 2]
        ux, uy, uz = shapes[k, 3], shapes[k, 4], shapes[k, 5]
        vx, vy, vz = shapes[k, 6], shapes[k, 7], shapes[k, 8]
        radius, start, height, width = shapes[k, 9], int(shapes[k, 10]), int(shapes[k, 11]), int(shapes[k, 12])
        bright = 1.0
        if radius == 0.0:
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            slope = dx * nx + dy * ny + nz
            if slope == 0.0:
                continue
            z = ((ox - ax) * nx + (oy - ay) * ny + oz * nz) / slope
            if not 0.0 < z < depth:
                continue
            px, py, pz = ax + z * dx - ox, ay + z * dy - oy, z - oz
            s = (px * ux + py * uy + pz * uz) / (ux * ux + uy * uy + uz * uz)
            t = (px * vx + py * vy + pz * vz) / (vx * vx + vy * vy + vz * vz)
        else:
            cx, cz = ox + 0.5 * ux, oz + radius
            # (ax + z dx - cx)^2 + (z - cz)^2 = radius^2, the nearer root
            a = dx * dx + 1.0
            b = dx * (ax - cx) - cz
            root = b * b - a * ((ax - cx) ** 2 + cz * cz - radius * radius)
            if root <= 0.0:
                continue
            z = (-b - np.sqrt(root)) / a
            if not 0.0 < z < depth:
                continue
            sine = (ax + z * dx - cx) / radius
            s = 0.5 + np.arcsin(min(1.0, max(-1.0, sine))) / np.pi
            t = (ay + z * dy - oy) / vy
            bright = 0.35 + 0.65 * (cz - z) / radius
        if not (0.0 <= s < 1.0 and 0.0 <= t < 1.0):
            continue
        x, y = s * width, t * height
        if texels[start + 4 * (int(y) * width + int(x)) + 3] < 128:
            continue
        nearest, depth, column, row, shade = k, z, x, y, bright
    return nearest, depth, column, row, shade


@compiled
def _trace_rows(
    light: NDArray[np.float32], shifts: NDArray[np.float32], top: int, height: int, width: int, unit: float,
    focus: float, samples: Floats, triangles: Floats, quantiles: Floats, shapes: Floats, texels: NDArray[np.uint8],
) -> None:  # fmt: skip
    rays, last = samples.shape[0], quantiles.shape[0] - 1
    for i in range(light.shape[0]):
        for j in range(light.shape[1]):
            colour = (i + top) % 2 + j % 2
            total = 0.0
            for n in range(rays):
                jx = (samples[n, 2] + shifts[i, j, 2]) % 1.0 * last
                jy = (samples[n, 3] + shifts[i, j, 3]) % 1.0 * last
                kx, ky = int(jx), int(jy)
                sx = quantiles[kx] + (jx - kx) * (quantiles[min(kx + 1, last)] - quantiles[kx])
                sy = quantiles[ky] + (jy - ky) * (quantiles[min(ky + 1, last)] - quantiles[ky])
                u, v = (samples[n, 0] + shifts[i, j, 0]) % 1.0, (samples[n, 1] + shifts[i, j, 1]) % 1.0
                ax, ay = _opening(u, v, triangles)
                dx = (j + sx - 0.5 * width) * unit - ax / focus
                dy = (i + top + sy - 0.5 * height) * unit - ay / focus
                k, _, x, y, shade = _meet(shapes, texels, ax, ay, dx, dy)
                if k < 0:
                    continue
                start, tall, wide = int(shapes[k, 10]), int(shapes[k, 11]), int(shapes[k, 12])
                # Bilinear between texels' centres.
                x = min(max(x - 0.5, 0.0), wide - 1.001)
                y = min(max(y - 0.5, 0.0), tall - 1.001)
                c, r = int(x), int(y)
                fx, fy = x - c, y - r
                first = start + 4 * (r * wide + c) + colour
                second = first + 4 * wide
                total += shade * (
                    (1 - fy) * ((1 - fx) * texels[first] + fx * texels[first + 4])
                    + fy * ((1 - fx) * texels[second] + fx * texels[second + 4])
                )
            light[i, j] = total / (255.0 * rays)


@compiled
def _look(
    depth: NDArray[np.float32], surface: NDArray[np.int16], height: int, width: int, unit: float, shapes: Floats,
    texels: NDArray[np.uint8],
) -> None:  # fmt: skip
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            dx, dy = (2 * j + 1 - 0.5 * width) * unit, (2 * i + 1 - 0.5 * height) * unit
            k, z, _, _, _ = _meet(shapes, texels, 0.0, 0.0, dx, dy)
            if k >= 0:
                depth[i, j], surface[i, j] = z, k
