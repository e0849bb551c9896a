"""Image of an aperture's picture: scaled, shifted, blurred by a Gaussian core, integrated over pixels, exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

FloatArray = NDArray[np.float64]

HALF_EXTENT = 1.25
"""An aperture's picture reaches this many radii to each side; room for a first guess that is off."""

_TAIL = 7.0
"""Standard deviations from an edge beyond which the core's blur changes nothing."""
_LEAST_RADIUS = 1e-2
_LEAST_CORE = 1e-3


def share_matrix(
    n_pixels: int, n_cells: int, half_extent: float, *, centre: float, radius: float, core: float
) -> FloatArray:
    """Share of each template cell in each pixel along one axis, float64 (n_pixels, n_cells).

    Cell j spans [u_j, u_j + du] radii, mapped to centre + radius * u; pixel i spans [i - 1/2, i + 1/2]. With
    H(t) = t Phi(t / core) + core phi(t / core), the second integral of the Gaussian, the share is the mixed second
    difference of H over both pairs of edges, divided by the cell's width.
    """
    t, edges, sign = _edge_distances(n_pixels, n_cells, half_extent, centre=centre, radius=radius)
    integral = np.maximum(t, 0.0)
    if core > _LEAST_CORE:
        near = np.abs(t) < _TAIL * core
        s = np.abs(t[near]) / core
        integral[near] += core * (_density(s) - s * ndtr(-s))  # H is max(t, 0) and this even function of t
    return np.asarray(-sign / (edges[1] - edges[0]) * _mixed_difference(integral), np.float64)


def share_slopes(
    n_pixels: int, n_cells: int, half_extent: float, *, centre: float, radius: float, core: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """:func:`share_matrix` and its derivatives by centre, radius and the core's variance, each (n_pixels, n_cells).

    From H' = Phi and dH / d(core^2) = phi / (2 core); the cells' width scales with the radius.
    """
    t, edges, sign = _edge_distances(n_pixels, n_cells, half_extent, centre=centre, radius=radius)
    core = max(core, _LEAST_CORE)
    integral, step, bell = np.maximum(t, 0.0), (t > 0).astype(np.float64), np.zeros_like(t)
    near = np.abs(t) < _TAIL * core
    s = t[near] / core
    density, below = _density(s), ndtr(s)
    integral[near] = core * (s * below + density)
    step[near] = below
    bell[near] = density / (2.0 * core)
    size, width = abs(edges[0]) / half_extent, edges[1] - edges[0]
    share = -sign / width * _mixed_difference(integral)
    by_centre = _mixed_difference(step) / width
    by_radius = _mixed_difference(step * (edges / size)[np.newaxis, :]) / width - sign * share / size
    by_variance = -sign / width * _mixed_difference(bell)
    return share, by_centre, by_radius, by_variance


def _edge_distances(
    n_pixels: int, n_cells: int, half_extent: float, *, centre: float, radius: float
) -> tuple[FloatArray, FloatArray, float]:
    sign = 1.0 if radius >= 0 else -1.0
    edges = np.linspace(-half_extent, half_extent, n_cells + 1) * max(abs(radius), _LEAST_RADIUS)
    pixels = sign * (np.arange(n_pixels + 1) - 0.5 - centre)
    return pixels[:, np.newaxis] - edges[np.newaxis, :], edges, sign


def _density(s: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * s * s) / np.sqrt(2 * np.pi), np.float64)


def _mixed_difference(values: FloatArray) -> FloatArray:
    rows = values[1:] - values[:-1]
    return np.asarray(rows[:, 1:] - rows[:, :-1], np.float64)


def render(
    template: FloatArray,
    half_extent: float,
    shape: tuple[int, int],
    *,
    radius: float,
    centre: tuple[float, float],
    core: float,
) -> FloatArray:
    """Image of unit flux of the aperture on a grid of ``shape`` pixels; see :func:`share_matrix`."""
    n = template.shape[0]
    ay = share_matrix(shape[0], n, half_extent, centre=centre[0], radius=radius, core=core)
    ax = share_matrix(shape[1], n, half_extent, centre=centre[1], radius=radius, core=core)
    return ay @ template @ ax.T


def render_slopes(
    template: FloatArray,
    half_extent: float,
    shape: tuple[int, int],
    *,
    radius: float,
    centre: tuple[float, float],
    core: float,
) -> tuple[FloatArray, FloatArray]:
    """:func:`render` and its derivatives (4, h, w) by radius, centre's row, centre's column and the core's variance."""
    n = template.shape[0]
    y, y_centre, y_radius, y_variance = share_slopes(
        shape[0], n, half_extent, centre=centre[0], radius=radius, core=core
    )
    x, x_centre, x_radius, x_variance = share_slopes(
        shape[1], n, half_extent, centre=centre[1], radius=radius, core=core
    )
    across = template @ np.concatenate([x, x_centre, x_radius, x_variance]).T
    plain, by_centre, by_radius, by_variance = np.split(across, 4, axis=1)
    slopes = np.stack(
        [y_radius @ plain + y @ by_radius, y_centre @ plain, y @ by_centre, y_variance @ plain + y @ by_variance]
    )
    return y @ plain, slopes
