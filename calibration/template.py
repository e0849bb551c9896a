"""Radius, sign and chief ray of every measured point by one common picture of the aperture.

Every point's image is the same aperture, scaled by the signed radius, shifted to where the chief ray lands, blurred by
a small core and integrated over pixels::

    image = flux * Ay(radius, cy, core) @ T @ Ax(radius, cx, core)^T

``T`` is the aperture on a grid in units of its own radius; ``Ay`` and ``Ax`` hold, exactly, the share of each grid
cell that falls into each pixel row or column (a box scaled, blurred by a Gaussian and integrated over a box: both
separate in y and x). ``T`` and the radii are found in turns: radii, shifts and flux by Gauss-Newton, ``T`` by the
Richardson-Lucy iteration over all images together, which deconvolves pixels and core. The result needs no knowledge
of the aperture's shape, and holds where a PSF is hardly wider than its core.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import FitError
from calibration.pupil_outline import circumscribed
from calibration.render import HALF_EXTENT, render, share_matrix

__all__ = ["HALF_EXTENT", "Spot", "SpotFit", "TemplateFit", "fit_spots", "render", "share_matrix"]

FloatArray = NDArray[np.float64]

MODEL_ERROR = 0.02
"""Error of the common aperture's picture, as a fraction of a spot's plateau."""

MIN_CORE_PX = 0.05
CORE_FROM_PX = 3.0
"""The common core is taken from spots larger than this, and smaller than 0.6 of the largest: in the smallest it can't
be told from the radius, in the largest not from the picture's own sharpness."""


@dataclass(frozen=True, slots=True)
class Spot:
    """One measured image: values (h, w), their standard errors, and what blurs it besides the common core."""

    values: FloatArray
    se: FloatArray
    extra_variance_px2: float = 0.0
    """Variance per axis of the dot's own image (px^2)."""


@dataclass(frozen=True, slots=True)
class SpotFit:
    """Where the chief ray lands in a spot (row, column in its array), and its signed radius, with standard errors."""

    radius_px: float
    radius_se_px: float
    centre_y: float
    centre_x: float
    centre_se_px: float
    flux: float
    chi2: float
    """Sum of squared residuals in standard errors, per degree of freedom."""
    misfit: float
    """Root of residual power over signal power: what the common aperture doesn't explain, noise included."""
    sign_evidence: float
    """chi2 total of the opposite sign minus that of this one, over chi2 per degree of freedom; small: undecided."""


@dataclass(frozen=True, slots=True)
class TemplateFit:
    """Common aperture and the fits of all spots (in their order).

    Attributes
    ----------
    template
        float64 (N, N), sums to 1, oriented as the PSF beyond focus; covers +-``half_extent`` radii.
    half_extent
        Half side of the template in radii.
    core_px
        Standard deviation of the common Gaussian core, besides the pixel's own box.
    spots
        Fits per spot.
    """

    template: FloatArray
    half_extent: float
    core_px: float
    spots: tuple[SpotFit, ...]


def fit_spots(spots: Sequence[Spot], inverse_depth: FloatArray, *, rounds: int = 5) -> TemplateFit:
    """Fit the common aperture and every spot's signed radius and chief ray.

    Parameters
    ----------
    spots
        At least three, at different depths.
    inverse_depth
        float64 (D,), nominal 1/depth: used for the first guess of the signs only (the blur's size has one minimum over
        depth), and to say which side is far.
    rounds
        Turns between aperture and radii; three suffice for sharp images.

    Raises
    ------
    FitError
        The spots are all alike, so that nothing scales.
    """
    radii, centres = _first_guess(spots, inverse_depth)
    spots = [_soften(spot) for spot in spots]
    biggest = int(np.argmax(np.abs(radii)))
    size = abs(radii[biggest])
    if size < 2.5:
        raise FitError("every point is in focus (blur radius below 2.5 px): spread the depths, or focus elsewhere")
    n_cells = int(np.clip(np.ceil(2 * HALF_EXTENT * size / 0.7), 40, 160))
    core = MIN_CORE_PX
    template = _start_template(spots[biggest], n_cells, radii[biggest], centres[biggest])
    fits = [
        SpotFit(float(r), 0.0, float(c[0]), float(c[1]), 0.0, float(s.values.sum()), 1.0, 0.0, 0.0)
        for s, r, c in zip(spots, radii, centres, strict=True)
    ]
    builders = np.argsort(np.abs(radii))[::-1][: max(3, min(10, len(spots) // 2))]
    for turn in range(rounds):
        template = _refine_template(
            template, [(spots[i], fits[i]) for i in builders], core, 12 if turn < rounds - 1 else 25
        )
        core = _fit_core(
            template,
            [(s, f) for s, f in zip(spots, fits, strict=True) if CORE_FROM_PX < abs(f.radius_px) < 0.6 * size],
            core,
        )
        fits = [
            _fit_spot(template, spot, fit, core, both_signs=turn >= 1) for spot, fit in zip(spots, fits, strict=True)
        ]
    template, fits = _to_gauge(template, fits)
    return TemplateFit(template, HALF_EXTENT, core, tuple(fits))


def _soften(spot: Spot) -> Spot:
    """Add the model's own error to the noise: a cell's edge is never known to the last photon.

    Without it the dark surround, with its small noise, would outvote the image by orders of magnitude.
    """
    plateau = float(np.percentile(spot.values[spot.values > 0.1 * spot.values.max()], 75))
    return replace(spot, se=np.hypot(spot.se, MODEL_ERROR * plateau))


def _moments(spot: Spot) -> tuple[FloatArray, float]:
    weight = np.where(spot.values > 3.0 * spot.se, spot.values, 0.0)
    total = weight.sum()
    yy, xx = np.mgrid[0 : weight.shape[0], 0 : weight.shape[1]]
    cy, cx = float((weight * yy).sum() / total), float((weight * xx).sum() / total)
    spread = float((weight * ((yy - cy) ** 2 + (xx - cx) ** 2)).sum() / total) - 1.0 / 6.0 - 2 * spot.extra_variance_px2
    return np.array([cy, cx]), float(np.sqrt(max(spread, 1e-4)))


def _first_guess(spots: Sequence[Spot], inverse_depth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Signed radii and chief rays from moments: |radius| falls to the focus and rises again, linear in 1/depth."""
    moments = [_moments(s) for s in spots]
    centroids = np.stack([m[0] for m in moments])
    spread = np.array([m[1] for m in moments])
    order = np.argsort(inverse_depth)  # far first: positive, then negative
    best, signs = np.inf, np.ones(len(spots))
    for near in range(len(spots) + 1):
        trial = np.ones(len(spots))
        trial[order[len(spots) - near :]] = -1.0
        line = np.polyfit(inverse_depth, trial * spread, 1)
        if line[0] >= 0:
            continue
        cost = float(np.abs(np.polyval(line, inverse_depth) - trial * spread).sum())
        if cost < best:
            best, signs = cost, trial
    if not np.isfinite(best):
        raise FitError("the points' blur does not change with depth: check that depths and files belong together")
    # rms radius of the biggest image -> its circumscribed circle
    biggest = int(np.argmax(spread))
    bright = spots[biggest].values > 0.5 * np.percentile(spots[biggest].values[spots[biggest].values > 0], 95)
    rows, columns = np.flatnonzero(bright.any(axis=1)), np.flatnonzero(bright.any(axis=0))
    middle = np.array([(rows[0] + rows[-1]) / 2.0, (columns[0] + columns[-1]) / 2.0])
    yy, xx = np.nonzero(bright)
    outer = float(np.hypot(yy - middle[0], xx - middle[1]).max()) + 0.5
    ratio = outer / spread[biggest]
    lean = signs[biggest] * (centroids[biggest] - middle) / spread[biggest]  # centroid of the aperture, in rms radii
    radii = signs * spread * ratio
    centres = centroids - (signs * spread)[:, np.newaxis] * lean
    return radii, centres


def _start_template(spot: Spot, n_cells: int, radius: float, centre: FloatArray) -> FloatArray:
    ay = share_matrix(spot.values.shape[0], n_cells, HALF_EXTENT, centre=centre[0], radius=radius, core=0.3)
    ax = share_matrix(spot.values.shape[1], n_cells, HALF_EXTENT, centre=centre[1], radius=radius, core=0.3)
    start = ay.T @ np.maximum(spot.values, 0.0) @ ax
    start += 1e-3 * start.max()
    return np.asarray(start / start.sum(), np.float64)


def _refine_template(
    template: FloatArray, pairs: Sequence[tuple[Spot, SpotFit]], core: float, iterations: int
) -> FloatArray:
    """Richardson-Lucy over several images: T <- T * sum A'(y / A T) / sum A' 1, images weighed by their size."""
    n = template.shape[0]
    axes = []
    for spot, fit in pairs:
        width = float(np.sqrt(core**2 + spot.extra_variance_px2))
        shape = spot.values.shape
        ay = share_matrix(shape[0], n, HALF_EXTENT, centre=fit.centre_y, radius=fit.radius_px, core=width)
        ax = share_matrix(shape[1], n, HALF_EXTENT, centre=fit.centre_x, radius=fit.radius_px, core=width)
        weight = fit.radius_px**2
        axes.append((ay, ax, np.maximum(spot.values, 0.0) / fit.flux, weight))
    norm = sum(w * np.outer(ay.sum(axis=0), ax.sum(axis=0)) for ay, ax, _, w in axes)
    norm = np.maximum(norm, 1e-3 * np.max(norm))
    for _ in range(iterations):
        gain = np.zeros_like(template)
        for ay, ax, data, weight in axes:
            model = ay @ template @ ax.T
            floor = 1e-4 * model.max()
            gain += weight * (ay.T @ ((data + floor) / (model + floor)) @ ax)
        template = template * gain / norm
    return np.asarray(template / template.sum(), np.float64)


def _to_gauge(template: FloatArray, fits: list[SpotFit]) -> tuple[FloatArray, list[SpotFit]]:
    """Make the circle about the aperture's outline the unit circle: resample the template, carry the fits along."""
    cy, cx, radius = circumscribed(template)
    n = template.shape[0]
    cell = 2 * HALF_EXTENT / n
    oy, ox = ((cy + 0.5) * cell - HALF_EXTENT, (cx + 0.5) * cell - HALF_EXTENT)
    size = radius * cell
    moved = [
        replace(
            f,
            radius_px=f.radius_px * size,
            radius_se_px=f.radius_se_px * size,
            centre_y=f.centre_y + f.radius_px * oy,
            centre_x=f.centre_x + f.radius_px * ox,
        )
        for f in fits
    ]
    # cells as pixels: the same exact resampling, in units of the new cells
    resampled = _resample(template, (oy, ox), size)
    return resampled, moved


def _resample(template: FloatArray, origin: tuple[float, float], size: float) -> FloatArray:
    n = template.shape[0]
    per_radius = n / (2 * HALF_EXTENT)
    matrices = []
    for offset in origin:
        centre = (n - 1) / 2.0 - offset / size * per_radius
        matrices.append(share_matrix(n, n, HALF_EXTENT, centre=centre, radius=per_radius / size, core=0.0))
    result = matrices[0] @ template @ matrices[1].T
    return np.asarray(result / result.sum(), np.float64)


def _fit_core(template: FloatArray, pairs: Sequence[tuple[Spot, SpotFit]], core: float) -> float:
    """Common core: fitted to each spot together with its radius and place, and averaged by its precision.

    Held at the radii of the last turn instead, it would take many turns to move, since a wider core and a smaller
    radius look alike.
    """
    if not pairs:
        return core
    found = [
        _gauss_newton(template, spot, (fit.radius_px, fit.centre_y, fit.centre_x), core, free_core=True)[1]
        for spot, fit in pairs
    ]
    variance = np.array([v for v, _ in found])
    weight = 1.0 / np.array([se for _, se in found]) ** 2
    order = np.argsort(variance)  # weighted median: a few spots with a problem of their own must not decide
    share = np.cumsum(weight[order]) / weight.sum()
    median = float(np.interp(0.5, share - 0.5 * weight[order] / weight.sum(), variance[order]))
    return float(np.sqrt(max(median, MIN_CORE_PX**2)))


def _profile(spot: Spot, model: FloatArray) -> tuple[float, float]:
    """Best flux and chi2 for a model of unit flux."""
    weight = 1.0 / spot.se**2
    flux = float((weight * model * spot.values).sum() / max(float((weight * model * model).sum()), 1e-300))
    return flux, float((weight * (spot.values - flux * model) ** 2).sum())


def _fit_spot(template: FloatArray, spot: Spot, start: SpotFit, core: float, *, both_signs: bool) -> SpotFit:
    first, _ = _gauss_newton(template, spot, (start.radius_px, start.centre_y, start.centre_x), core)
    if not both_signs:
        return first
    # the other sign starts where its centroid agrees
    flipped_y, flipped_x = _mirror_centre(template, first)
    second, _ = _gauss_newton(template, spot, (-first.radius_px, flipped_y, flipped_x), core)
    dof = max(1, spot.values.size - 4)
    if second.chi2 < first.chi2:
        first, second = second, first
    if np.sign(second.radius_px) == np.sign(first.radius_px):
        return replace(first, sign_evidence=0.0)
    return replace(first, sign_evidence=(second.chi2 - first.chi2) * dof / max(first.chi2, 1.0))


def _mirror_centre(template: FloatArray, fit: SpotFit) -> tuple[float, float]:
    n = template.shape[0]
    u = (np.arange(n) + 0.5) * 2 * HALF_EXTENT / n - HALF_EXTENT
    lean_y, lean_x = float(template.sum(axis=1) @ u), float(template.sum(axis=0) @ u)
    return fit.centre_y + 2 * fit.radius_px * lean_y, fit.centre_x + 2 * fit.radius_px * lean_x


def _gauss_newton(
    template: FloatArray,
    spot: Spot,
    start: tuple[float, float, float],
    core: float,
    *,
    free_core: bool = False,
    iterations: int = 12,
) -> tuple[SpotFit, tuple[float, float]]:
    """Levenberg-Marquardt on (radius, cy, cx) and, if free, the core's variance; the flux is eliminated.

    Returns the fit, with standard errors scaled by the misfit, and the core's variance with its standard error (px^2).
    """
    shape = (int(spot.values.shape[0]), int(spot.values.shape[1]))
    free = 4 if free_core else 3
    least = np.array([-np.inf, -np.inf, -np.inf, MIN_CORE_PX**2])

    def model_of(p: FloatArray) -> FloatArray:
        width = float(np.sqrt(p[3] + spot.extra_variance_px2))
        return render(template, HALF_EXTENT, shape, radius=float(p[0]), centre=(float(p[1]), float(p[2])), core=width)

    p = np.array([*start, core**2], np.float64)
    model = model_of(p)
    flux, cost = _profile(spot, model)
    damping = 1e-3
    hessian = np.eye(free + 1)
    for _ in range(iterations):
        columns = []
        for k in range(free):
            step = np.zeros(4)
            step[k] = 1e-2
            low = np.maximum(p - step, least)
            columns.append(flux * (model_of(p + step) - model_of(low)) / (p + step - low)[k])
        jacobian = np.stack([(c / spot.se).ravel() for c in (*columns, model)], axis=1)
        residual = ((spot.values - flux * model) / spot.se).ravel()
        hessian = jacobian.T @ jacobian
        gradient = jacobian.T @ residual
        gained, largest = 0.0, 0.0
        for _ in range(6):
            damped = hessian + damping * np.diag(np.diag(hessian) + 1e-12)
            limit = 0.5 * max(abs(p[0]), 2.0)
            change = np.zeros(4)
            change[:free] = np.clip(np.linalg.lstsq(damped, gradient, rcond=None)[0][:free], -limit, limit)
            trial = np.maximum(p + change, least)
            trial_model = model_of(trial)
            trial_flux, trial_cost = _profile(spot, trial_model)
            if trial_cost < cost:
                gained, largest = cost - trial_cost, float(np.abs(trial - p).max())
                p, model, flux, cost = trial, trial_model, trial_flux, trial_cost
                damping = max(damping * 0.2, 1e-7)
                break
            damping *= 10.0
        if gained < 1e-4 * cost and largest < 1e-4:
            break
    chi2 = cost / max(1, spot.values.size - free - 1)
    errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(hessian)) * max(chi2, 1.0), 0.0))
    # at focus the image doesn't depend on the radius to first order
    radius_se = float(errors[0]) if 1e-4 < errors[0] < 1.0 else 1.0
    fit = SpotFit(
        radius_px=float(p[0]),
        radius_se_px=radius_se,
        centre_y=float(p[1]),
        centre_x=float(p[2]),
        centre_se_px=float(max(errors[1], errors[2])),
        flux=flux,
        chi2=chi2,
        misfit=float(np.sqrt(((spot.values - flux * model) ** 2).sum() / (spot.values**2).sum())),
        sign_evidence=0.0,
    )
    return fit, (float(p[3]), float(errors[3]) if free_core and errors[3] > 0 else np.inf)
