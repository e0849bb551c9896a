"""Image of an aperture's picture: scaled, shifted, blurred by a core, integrated over pixels, exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
WINGS_WIDTH = 4.0
"""How many times as wide as the core's middle its wings are."""


@dataclass(frozen=True, slots=True)
class Core:
    """What blurs every point alike, however far: a Gaussian, and wings, a share of the light in a wider one.

    Diffraction spreads light farther than any Gaussian does. Without wings a picture of the aperture puts that light
    into a halo of its own, which grows with it: radii of large images come out other than those of small ones. Rows and
    columns are blurred one after the other, so that the image stays a product of two matrices.

    Attributes
    ----------
    sigma_px
        Standard deviation of the Gaussian, besides the pixel's own box.
    wings
        Share of the light, per axis, in a Gaussian :data:`WINGS_WIDTH` times as wide.
    dot_variance_px2
        Variance per axis of the dot's own image, which widens both.
    """

    sigma_px: float
    wings: float = 0.0
    dot_variance_px2: float = 0.0

    @property
    def sigmas_px(self) -> tuple[float, float]:
        """Standard deviations of its Gaussian and of its wings, the dot's included."""
        dot = float(np.sqrt(self.dot_variance_px2))
        return float(np.hypot(self.sigma_px, dot)), float(np.hypot(WINGS_WIDTH * self.sigma_px, dot))

    @property
    def parts(self) -> tuple[tuple[float, float], ...]:
        """(share, standard deviation) of each of its Gaussians; one without wings."""
        middle, wide = self.sigmas_px
        return ((1.0 - self.wings, middle), (self.wings, wide)) if self.wings > 0.0 else ((1.0, middle),)

    @property
    def reach_px(self) -> float:
        """Distance beyond which next to no light lies: less than 2e-4 per axis."""
        return max(6.0 * self.parts[0][1], 3.5 * self.parts[-1][1])

    def of_dot(self, variance_px2: float) -> Core:
        """The same, widened by a dot of this variance per axis."""
        return replace(self, dot_variance_px2=variance_px2)

    def finer(self, factor: int) -> Core:
        """The same on pixels ``factor`` times as fine."""
        return replace(self, sigma_px=self.sigma_px * factor, dot_variance_px2=self.dot_variance_px2 * factor**2)


def share_matrix(
    n_pixels: int, n_cells: int, half_extent: float, *, centre: float, radius: float, core: Core
) -> FloatArray:
    """Share of each template cell in each pixel along one axis, float64 (n_pixels, n_cells).

    Cell j spans [u_j, u_j + du] radii, mapped to centre + radius * u; pixel i spans [i - 1/2, i + 1/2]. With
    H(t) = t Phi(t / sigma) + sigma phi(t / sigma), the second integral of a Gaussian, the share is the mixed second
    difference of H over both pairs of edges, divided by the cell's width; the core's H is that of its Gaussians
    together.
    """
    t, edges, sign = _edge_distances(n_pixels, n_cells, half_extent, centre=centre, radius=radius)
    integral = np.maximum(t, 0.0)
    for share, sigma in core.parts:
        if sigma > _LEAST_CORE:
            near = np.abs(t) < _TAIL * sigma
            s = np.abs(t[near]) / sigma
            # H is max(t, 0) and this even function of t
            integral[near] += share * sigma * (_density(s) - s * ndtr(-s))
    return np.asarray(-sign / (edges[1] - edges[0]) * _mixed_difference(integral), np.float64)


def share_slopes(
    n_pixels: int, n_cells: int, half_extent: float, *, centre: float, radius: float, core: Core
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """:func:`share_matrix` and its derivatives by centre, radius, the core's variance and its wings' share.

    Each float64 (n_pixels, n_cells). From H' = Phi and dH / d(sigma^2) = phi / (2 sigma); the cells' width scales with
    the radius, the wings with the core.
    """
    t, edges, sign = _edge_distances(n_pixels, n_cells, half_extent, centre=centre, radius=radius)
    narrow, wings = (_integrals(t, max(sigma, _LEAST_CORE)) for sigma in core.sigmas_px)
    integral, step = ((1.0 - core.wings) * a + core.wings * b for a, b in zip(narrow[:2], wings[:2], strict=True))
    bell = (1.0 - core.wings) * narrow[2] + core.wings * WINGS_WIDTH**2 * wings[2]
    size, width = abs(edges[0]) / half_extent, edges[1] - edges[0]
    share = -sign / width * _mixed_difference(integral)
    by_centre = _mixed_difference(step) / width
    by_radius = _mixed_difference(step * (edges / size)[np.newaxis, :]) / width - sign * share / size
    by_variance = -sign / width * _mixed_difference(bell)
    by_wings = -sign / width * _mixed_difference(wings[0] - narrow[0])
    return share, by_centre, by_radius, by_variance, by_wings


def _integrals(t: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """H of a Gaussian at t, and its derivatives by t and by the variance."""
    integral, step, bell = np.maximum(t, 0.0), (t > 0).astype(np.float64), np.zeros_like(t)
    near = np.abs(t) < _TAIL * sigma
    s = t[near] / sigma
    density, below = _density(s), ndtr(s)
    integral[near] = sigma * (s * below + density)
    step[near] = below
    bell[near] = density / (2.0 * sigma)
    return integral, step, bell


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
    core: Core,
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
    core: Core,
) -> tuple[FloatArray, FloatArray]:
    """:func:`render` and its derivatives (5, h, w) by radius, row, column, the core's variance and its wings' share."""
    n = template.shape[0]
    rows, columns = (
        share_slopes(size, n, half_extent, centre=place, radius=radius, core=core)
        for size, place in zip(shape, centre, strict=True)
    )
    y, y_centre, y_radius, y_variance, y_wings = rows
    across = template @ np.concatenate(columns).T
    plain, by_centre, by_radius, by_variance, by_wings = np.split(across, 5, axis=1)
    slopes = [
        y_radius @ plain + y @ by_radius,
        y_centre @ plain,
        y @ by_centre,
        y_variance @ plain + y @ by_variance,
        y_wings @ plain + y @ by_wings,
    ]
    return y @ plain, np.stack(slopes)
