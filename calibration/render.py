"""Image of an aperture's picture: scaled, shifted, blurred by a Gaussian core, integrated over pixels, exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

FloatArray = NDArray[np.float64]

HALF_EXTENT = 1.25
"""An aperture's picture reaches this many radii to each side; room for a first guess that is off."""


def share_matrix(
    n_pixels: int, n_cells: int, half_extent: float, *, centre: float, radius: float, core: float
) -> FloatArray:
    """Share of each template cell in each pixel along one axis, float64 (n_pixels, n_cells).

    Cell j spans [u_j, u_j + du] radii, mapped to centre + radius * u; pixel i spans [i - 1/2, i + 1/2]. With
    H(t) = t Phi(t / core) + core phi(t / core), the second integral of the Gaussian, the share is the mixed second
    difference of H over both pairs of edges, divided by the cell's width.
    """
    sign = 1.0 if radius >= 0 else -1.0
    size = max(abs(radius), 1e-2)
    edges = np.linspace(-half_extent, half_extent, n_cells + 1) * size
    pixels = np.arange(n_pixels + 1) - 0.5 - centre
    t = sign * pixels[:, np.newaxis] - edges[np.newaxis, :]
    if core > 1e-3:
        integral = t * ndtr(t / core) + core / np.sqrt(2 * np.pi) * np.exp(-0.5 * (t / core) ** 2)
    else:
        integral = np.maximum(t, 0.0)
    second = np.diff(np.diff(integral, axis=0), axis=1)
    return np.asarray(-sign * second / (edges[1] - edges[0]), np.float64)


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
