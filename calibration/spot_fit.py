"""Signed radius and chief ray of one point's image, given the aperture's picture and the common core.

Levenberg-Marquardt with exact slopes on (radius, row, column) and, where asked for, the core's variance and its
wings; the flux is eliminated. Only a window about the aperture's image is looked at: the stray light that spreads far
beyond it says nothing about radius and place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.render import HALF_EXTENT, Core, render, render_slopes

FloatArray = NDArray[np.float64]

MODEL_ERROR = 0.02
"""Error of the common aperture's picture, as a fraction of a spot's plateau."""
MIN_CORE_PX = 0.05
_MOST_WINGS = 0.3
"""Share of the light beyond which wings would be the core."""

_WINDOW_MARGIN_PX = 8.0
_SMALL_STEP_PX = 2e-4
"""Steps smaller than this (px, px^2 for the core's variance, a share for its wings) end the iteration."""


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


def soften(spot: Spot) -> Spot:
    """Add the model's own error to the noise: a cell's edge is never known to the last photon.

    Without it the dark surround, with its small noise, would outvote the image by orders of magnitude.
    """
    plateau = float(np.percentile(spot.values[spot.values > 0.1 * spot.values.max()], 75))
    return replace(spot, se=np.hypot(spot.se, MODEL_ERROR * plateau))


def window_of(spot: Spot, fit: SpotFit) -> tuple[slice, slice]:
    """Rows and columns of a spot that the aperture's picture can reach, with a margin for a first guess that is off."""
    reach = HALF_EXTENT * abs(fit.radius_px) + _WINDOW_MARGIN_PX + 3.0 * float(np.sqrt(spot.extra_variance_px2))
    rows, columns = (
        slice(max(0, int(centre - reach)), min(size, int(centre + reach) + 2))
        for centre, size in zip((fit.centre_y, fit.centre_x), spot.values.shape, strict=True)
    )
    return rows, columns


def fit_spot(template: FloatArray, spot: Spot, start: SpotFit, core: Core, *, iterations: int = 12) -> SpotFit:
    """Fit radius and chief ray from where ``start`` is; standard errors are scaled by the misfit."""
    return _fit(template, spot, start, core, window_of(spot, start), iterations=iterations)[0]


def fit_either_sign(template: FloatArray, spot: Spot, start: SpotFit, core: Core, *, iterations: int = 12) -> SpotFit:
    """:func:`fit_spot` from ``start`` and from its mirror image; the better one."""
    window = window_of(spot, start)
    first = _fit(template, spot, start, core, window, iterations=iterations)[0]
    # the other sign starts where its centroid agrees
    n = template.shape[0]
    u = (np.arange(n) + 0.5) * 2 * HALF_EXTENT / n - HALF_EXTENT
    lean_y, lean_x = float(template.sum(axis=1) @ u), float(template.sum(axis=0) @ u)
    flipped = replace(
        first,
        radius_px=-first.radius_px,
        centre_y=first.centre_y + 2 * first.radius_px * lean_y,
        centre_x=first.centre_x + 2 * first.radius_px * lean_x,
    )
    second = _fit(template, spot, flipped, core, window, iterations=iterations)[0]
    return second if second.chi2 < first.chi2 else first


def fit_core(template: FloatArray, spot: Spot, start: SpotFit, core: Core, *, wings: bool) -> tuple[float, float]:
    """What suits one spot best as the core's wings, or as its variance (px^2), and the standard error of that.

    Radius and place are fitted with it; the variance with the wings, too, while the wings stay what they are if the
    variance is asked for. Held at the radii of the last turn instead, a core would take many turns to move, since a
    wider one and a smaller radius look alike.
    """
    values, errors = _fit(template, spot, start, core, window_of(spot, start), of_core=2 if wings else 1)[1]
    return float(values[int(wings)]), float(errors[int(wings)])


def _fit(
    template: FloatArray,
    whole: Spot,
    start: SpotFit,
    core: Core,
    window: tuple[slice, slice],
    *,
    of_core: int = 0,
    iterations: int = 12,
) -> tuple[SpotFit, tuple[FloatArray, FloatArray]]:
    values, weight = whole.values[window], 1.0 / whole.se[window]
    shape = (int(values.shape[0]), int(values.shape[1]))
    corner = np.array([0.0, window[0].start, window[1].start, 0.0, 0.0])
    free = 3 + of_core
    least = np.array([-np.inf, -np.inf, -np.inf, MIN_CORE_PX**2, 0.0])
    most = np.array([np.inf, np.inf, np.inf, np.inf, _MOST_WINGS])
    weighted = values * weight

    def core_of(p: FloatArray) -> Core:
        return Core(float(np.sqrt(p[3])), float(p[4])).of_dot(whole.extra_variance_px2)

    def profile(model: FloatArray) -> tuple[float, float]:
        scaled = model * weight
        flux = float((scaled * weighted).sum() / max(float((scaled * scaled).sum()), 1e-300))
        return flux, float(((weighted - flux * scaled) ** 2).sum())

    p = np.array([start.radius_px, start.centre_y, start.centre_x, core.sigma_px**2, core.wings]) - corner
    damping, cost, flux = 1e-3, np.inf, start.flux
    model = np.zeros(shape)
    hessian = np.eye(free + 1)
    for _ in range(iterations):
        model, slopes = render_slopes(
            template, HALF_EXTENT, shape, radius=float(p[0]), centre=(float(p[1]), float(p[2])), core=core_of(p)
        )
        flux, cost = profile(model)
        jacobian = (np.concatenate([flux * slopes[:free], model[np.newaxis]]) * weight).reshape(free + 1, -1)
        hessian = jacobian @ jacobian.T
        gradient = jacobian @ (weighted - flux * model * weight).ravel()
        moved = 0.0
        for _ in range(6):
            damped = hessian + damping * np.diag(np.diag(hessian) + 1e-12)
            limit = 0.5 * max(abs(p[0]), 2.0)
            change = np.zeros(5)
            change[:free] = np.clip(np.linalg.lstsq(damped, gradient, rcond=None)[0][:free], -limit, limit)
            trial = np.clip(p + change, least, most)
            step = float(np.abs(trial - p).max())
            if step < _SMALL_STEP_PX:
                break
            trial_model = render(
                template, HALF_EXTENT, shape,
                radius=float(trial[0]), centre=(float(trial[1]), float(trial[2])), core=core_of(trial),
            )  # fmt: skip
            trial_flux, trial_cost = profile(trial_model)
            if trial_cost < cost:
                moved = step if cost - trial_cost > 1e-5 * cost else 0.0
                p, model, flux, cost = trial, trial_model, trial_flux, trial_cost
                damping = max(damping * 0.2, 1e-7)
                break
            damping *= 10.0
        if moved == 0.0:
            break
    chi2 = cost / max(1, values.size - free - 1)
    errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(hessian)) * max(chi2, 1.0), 0.0))
    # at focus the image doesn't depend on the radius to first order
    radius_se = float(errors[0]) if 1e-4 < errors[0] < 1.0 else 1.0
    p = p + corner
    residual = float(((values - flux * model) ** 2).sum())
    fit = SpotFit(
        radius_px=float(p[0]),
        radius_se_px=radius_se,
        centre_y=float(p[1]),
        centre_x=float(p[2]),
        centre_se_px=float(max(errors[1], errors[2])),
        flux=flux,
        chi2=chi2,
        misfit=float(np.sqrt(residual / (values**2).sum())),
    )
    core_se = np.full(2, np.inf)
    core_se[:of_core] = np.where(errors[3:free] > 0, errors[3:free], np.inf)
    return fit, (p[3:], core_se)
