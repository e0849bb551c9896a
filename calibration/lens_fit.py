"""Fit the thin lens to all measured radii: focus distance, scale, stage zero, with standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.errors import DepthListError, FitError
from calibration.optics import signed_radius

FloatArray = NDArray[np.float64]

MIN_DEPTHS = 3
MIN_DEPTHS_FOR_ZERO = 5
"""With fewer depths the stage's zero is not fitted: three parameters would explain any four numbers."""

_RADIUS_FLOOR_PX = 0.01
"""Added to every standard error: pixels and templates are not perfect."""
_BAD_SIGMAS = 5.0


@dataclass(frozen=True, slots=True)
class LensFit:
    """Thin lens fitted to all PSFs of a bank. Radii are pixels of the developed image, lengths mm."""

    focus_mm: float
    focus_se_mm: float
    scale_px: float
    """Radius of the aperture's image for a point at infinity: A f / (focus - f) / pitch."""
    scale_se_px: float
    zero_mm: float
    """What is to be added to the nominal depths: depth = nominal + zero. NaN where it could not be fitted."""
    zero_se_mm: float
    radius_px: NDArray[np.float64]
    """(D,) signed radius measured on each PSF."""
    radius_se_px: NDArray[np.float64]
    residual_px: NDArray[np.float64]
    """(D,) measured minus fitted."""
    zero_applied: bool = True
    """Whether the bank's depths are nominal + zero (True), or the zero is only reported and focus and scale were
    fitted to the nominal depths (False)."""
    suspect: tuple[bool, ...] = field(default=())
    """(D,) radii that the lens doesn't explain: a wrong depth, a wrong frame, a moved camera."""

    def sigma_px(self, depth_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fitted signed radius (px) at any depth (mm, bank's reference)."""
        return signed_radius(np.asarray(depth_mm, np.float64), focus_mm=self.focus_mm, scale=self.scale_px)


def check_depths(depths_mm: Sequence[float], *, ordered: bool = False) -> FloatArray:
    """Check a list of nominal depths (mm) and return it as an array.

    Parameters
    ----------
    depths_mm
        Nominal depths, mm.
    ordered
        Whether the list stands for planes of a stack, where only ascending or descending order makes sense.

    Raises
    ------
    DepthListError
        Fewer than 3, duplicates, not positive, out of order, or numbers that can only be in another unit.
    """
    depths = np.asarray(depths_mm, np.float64)
    if depths.ndim != 1 or depths.size < MIN_DEPTHS:
        raise DepthListError(f"{depths.size} depths: a bank needs at least {MIN_DEPTHS} different ones")
    if not np.isfinite(depths).all() or depths.min() <= 0:
        raise DepthListError("depths must be positive numbers, measured from the camera")
    values, counts = np.unique(depths, return_counts=True)
    if counts.max() > 1:
        raise DepthListError(f"depth {values[counts.argmax()] / 10:g} cm is listed twice; give each depth once")
    steps = np.diff(depths)
    if ordered and not ((steps > 0).all() or (steps < 0).all()):
        i = int(np.flatnonzero(np.sign(steps) != np.sign(steps[0]))[0])
        first = "ascend" if steps[0] > 0 else "descend"
        raise DepthListError(
            f"depths are out of order: they {first} up to plane {i + 1} ({depths[i] / 10:g} cm), but "
            f"plane {i + 2} is at {depths[i + 1] / 10:g} cm; list them in the order of the planes, all ascending or "
            "all descending"
        )
    if values[-1] < 50.0:
        raise DepthListError(
            f"the farthest depth is {values[-1] / 10:g} cm; were these numbers metres? give centimetres"
        )
    if values[0] > 20_000.0:
        raise DepthListError(
            f"the nearest depth is {values[0] / 1000:g} m; were these numbers millimetres? give centimetres"
        )
    if values[-1] > 200.0 * values[0]:
        raise DepthListError(f"depths run from {values[0] / 10:g} to {values[-1] / 10:g} cm; do they mix units?")
    return depths


def fit_lens(nominal_mm: FloatArray, radius_px: FloatArray, radius_se_px: FloatArray, *, apply_zero: bool) -> LensFit:
    """Fit ``radius = scale (1 - focus / (nominal + zero))`` by robust weighted least squares.

    Weights are inverse variances (with a floor); outliers are held down by a Huber loss at 3 robust standard
    deviations, and reported. Standard errors are scaled by the residuals' robust spread.

    Parameters
    ----------
    nominal_mm, radius_px, radius_se_px
        float64 (D,), D >= 3: nominal depth, signed radius and its standard error.
    apply_zero
        True: depths become nominal + zero, focus is measured from that plane. False: focus and scale are fitted to
        the nominal depths as they are, and the zero is what a free fit would say.

    Raises
    ------
    FitError
        The radii don't follow a thin lens at all.
    DepthListError
        Fewer than 3 depths.
    """
    nominal_mm = check_depths(nominal_mm.tolist())
    fixed = _robust_fit(nominal_mm, radius_px, radius_se_px, free_zero=False)
    free = None
    if nominal_mm.size >= MIN_DEPTHS_FOR_ZERO:
        free = _robust_fit(nominal_mm, radius_px, radius_se_px, free_zero=True)
    chosen = free if apply_zero and free is not None else fixed
    spread = float(np.ptp(radius_px))
    if not chosen.focus_mm > 0 or not chosen.scale_px > 0 or chosen.typical_px > 0.05 * spread + 0.1:
        raise FitError(
            f"the radii don't follow a thin lens (typical residual {chosen.typical_px:.2f} px of {spread:.1f} px): "
            "check that depths and files belong together and that focus was not touched"
        )
    return LensFit(
        focus_mm=chosen.focus_mm,
        focus_se_mm=chosen.se[0],
        scale_px=chosen.scale_px,
        scale_se_px=chosen.se[1],
        zero_mm=free.zero_mm if free else float("nan"),
        zero_se_mm=free.se[2] if free else float("nan"),
        radius_px=radius_px,
        radius_se_px=radius_se_px,
        residual_px=chosen.residual_px,
        zero_applied=apply_zero and free is not None,
        suspect=tuple(bool(b) for b in chosen.bad),
    )


_WIDEST = 1.0 / (2 * 0.7)
"""Radius over focal length at f/0.7."""
_STATED_TIMES = 5.0
"""A mask is smaller than the stop that the frames state, not by so much."""


def aperture_radius_mm(lens: LensFit, *, focal_length_mm: float, pixel_pitch_mm: float) -> float:
    """Radius (mm) of the circle about the aperture: scale * pitch * (focus - f) / f (thin lens)."""
    return lens.scale_px * pixel_pitch_mm * (lens.focus_mm - focal_length_mm) / focal_length_mm


def check_aperture(radius_mm: float, *, focal_length_mm: float, f_number: float | None) -> None:
    """Refuse depths that make the aperture another lens's: they are in another unit, mostly.

    Focus, and with it the aperture that the blur asks for, grow in proportion to the depths.

    Raises
    ------
    DepthListError
        Wider than any lens of this focal length, or far from the f-number that the frames state.
    """
    stated = focal_length_mm / (2.0 * f_number) if f_number else None
    wide = radius_mm > _WIDEST * focal_length_mm or (stated is not None and radius_mm > _STATED_TIMES * stated)
    narrow = stated is not None and radius_mm < stated / _STATED_TIMES
    if wide or narrow:
        lens = f"{focal_length_mm:g} mm lens"
        fact = f"a {lens} at f/{f_number:g} has {stated:.2g} mm" if stated else f"no {lens} is so wide"
        other = "millimetres given as centimetres" if wide else "centimetres given as millimetres, or inches"
        raise DepthListError(
            f"with these depths the aperture would be {radius_mm:.2g} mm in radius, but {fact}; are they in another "
            f"unit ({other})?"
        )


@dataclass(frozen=True, slots=True)
class _Solution:
    focus_mm: float
    scale_px: float
    zero_mm: float
    se: tuple[float, float, float]
    residual_px: FloatArray
    typical_px: float
    bad: NDArray[np.bool_]


def _robust_fit(nominal: FloatArray, radius: FloatArray, se: FloatArray, *, free_zero: bool) -> _Solution:
    sigma = np.hypot(se, _RADIUS_FLOOR_PX)
    sigma = np.minimum(sigma, 10.0 * np.median(sigma))  # a single huge error must not free its point altogether
    # with u = 1/z: radius = scale - (scale focus) u, linear where the zero is held; a Theil-Sen line starts it
    u = 1.0 / nominal
    i, j = np.triu_indices(nominal.size, 1)
    slope = float(np.median((radius[i] - radius[j]) / (u[i] - u[j])))
    scale = float(np.median(radius - slope * u))
    if not scale > 0 or not slope < 0:
        raise FitError(
            "the points' radii don't grow from near to far as they must: check that depths and files belong together"
        )
    start = np.array([-slope / scale, scale, 0.0])[: 3 if free_zero else 2]
    units = np.array([start[0], start[1], 0.1 * nominal.min()])[: start.size]

    def residual(p: FloatArray, weight: FloatArray) -> FloatArray:
        zero = p[2] * units[2] if free_zero else 0.0
        model = p[1] * units[1] * (1.0 - p[0] * units[0] / (nominal + zero))
        return np.asarray((radius - model) * weight, np.float64)

    p = start / units
    weight = 1.0 / sigma
    solution = least_squares(residual, p, args=(weight,), loss="soft_l1", f_scale=3.0)
    for _ in range(3):  # the noise's true scale follows from the residuals
        plain = residual(solution.x, weight)
        spread = max(1.0, 1.4826 * float(np.median(np.abs(plain))))
        solution = least_squares(residual, solution.x, args=(weight,), loss="soft_l1", f_scale=2.0 * spread)
    plain = residual(solution.x, weight)
    bad = np.abs(plain) > _BAD_SIGMAS * spread
    dof = max(1, nominal.size - int(bad.sum()) - p.size)
    scatter = max(1.0, float((plain[~bad] ** 2).sum()) / dof)
    kept = solution.jac[~bad] if (~bad).sum() > p.size else solution.jac
    covariance = np.linalg.pinv(kept.T @ kept) * scatter
    errors = np.sqrt(np.diag(covariance)) * units
    values = solution.x * units
    return _Solution(
        focus_mm=float(values[0]),
        scale_px=float(values[1]),
        zero_mm=float(values[2]) if free_zero else 0.0,
        se=(float(errors[0]), float(errors[1]), float(errors[2]) if free_zero else float("nan")),
        residual_px=residual(solution.x, np.ones_like(nominal)),
        typical_px=float(np.median(np.abs(residual(solution.x, np.ones_like(nominal))))),
        bad=bad,
    )
