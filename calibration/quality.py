"""What makes a PSF or a bank good or bad, as named figures with thresholds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.lens_fit import LensFit
from calibration.psf import Stacked
from calibration.template import SpotFit

FloatArray = NDArray[np.float64]
Verdict = Literal["good", "suspect", "bad"]


@dataclass(frozen=True, slots=True)
class Limit:
    """Where a figure becomes suspect and where bad; ``low_is_bad`` gives the direction."""

    suspect: float
    bad: float
    low_is_bad: bool
    meaning: str


LIMITS: Mapping[str, Limit] = {
    "flux_snr": Limit(200.0, 50.0, True, "flux over its standard error"),
    "peak_snr": Limit(20.0, 8.0, True, "brightest pixel over its standard error"),
    "background": Limit(0.02, 0.1, False, "level of the surround after dark subtraction, fraction of white"),
    "background_tilt": Limit(0.2, 0.5, False, "change of the surround across the cut-out over the PSF's mean level"),
    "saturation_margin": Limit(0.05, 0.01, True, "1 minus the brightest channel"),
    "residual_px": Limit(0.15, 0.5, False, "absolute distance of the radius from the fitted lens"),
    "residual_sigma": Limit(5.0, 15.0, False, "the same over its standard error and the fit's spread"),
    "halo": Limit(0.15, 0.4, False, "share of the light outside the circle about the blurred aperture"),
    "asymmetry": Limit(0.05, 0.02, True, "distance of the PSF from itself turned by 180 degrees, 0 to 1"),
    "neighbour_change": Limit(
        0.6, 0.85, False, "distance to the nearer neighbouring depth's PSF, scaled to one size, 0 to 1"
    ),
    "model_misfit": Limit(0.15, 0.35, False, "what the common aperture does not explain, root of power"),
    "repeat_scatter": Limit(2.0, 5.0, False, "difference of repeats over what noise predicts"),
    "flux_spread": Limit(0.05, 0.2, False, "relative spread of the repeats' flux"),
}
"""Thresholds by figure. They are set from what each error does to a depth (METHOD: 0.1 px is 1.5 cm at 350 cm), with
room for a real lens; figures that don't apply (single frames, focus) are NaN and not judged."""


@dataclass(frozen=True, slots=True)
class PsfQuality:
    """Figures of one depth and what they amount to."""

    depth_nominal_mm: float
    figures: Mapping[str, float]
    verdict: Verdict
    reasons: tuple[str, ...]
    """Names of the figures behind a verdict other than good, worst first."""


@dataclass(frozen=True, slots=True)
class Quality:
    """Figures of a bank: per depth, and overall."""

    depths: tuple[PsfQuality, ...]
    figures: Mapping[str, float]
    verdict: Verdict
    reasons: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a manifest; NaN becomes None."""
        return {
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "figures": _plain(self.figures),
            "depths": [
                {
                    "depth_nominal_mm": q.depth_nominal_mm,
                    "verdict": q.verdict,
                    "reasons": list(q.reasons),
                    "figures": _plain(q.figures),
                }
                for q in self.depths
            ],
        }


def judge(
    *,
    nominal_mm: FloatArray,
    lens: LensFit,
    spots: Sequence[SpotFit],
    stacks: Sequence[Stacked],
    psf: FloatArray,
    psf_se: FloatArray,
    core_px: float,
) -> Quality:
    """Compute all figures of one set of PSFs (D, K, K) and judge them by :data:`LIMITS`."""
    per_depth = []
    error = np.hypot(lens.radius_se_px, 0.01)
    typical = max(1.0, 1.4826 * float(np.median(np.abs(lens.residual_px) / error)))
    for d, (spot, stacked) in enumerate(zip(spots, stacks, strict=True)):
        point = stacked.point
        brightest = np.unravel_index(int(psf[d].argmax()), psf[d].shape)
        mean_level = point.flux / max(1, int(point.support.sum()))
        rows, columns = np.ogrid[: point.values.shape[0], : point.values.shape[1]]
        beyond = np.hypot(rows - spot.centre_y, columns - spot.centre_x) > abs(spot.radius_px) + 3.5 * core_px + 1.5
        at_focus = abs(spot.radius_px) < 2.0
        figures = {
            "flux_snr": point.flux_snr,
            "peak_snr": _ratio(float(psf[d].max()), float(psf_se[d][brightest])),
            "background": abs(point.background),
            "background_tilt": point.background_tilt / mean_level,
            "saturation_margin": 1.0 - point.peak,
            "residual_px": abs(float(lens.residual_px[d])),
            "residual_sigma": abs(float(lens.residual_px[d])) / (float(error[d]) * typical),
            "halo": float(point.values[point.support & beyond].sum()) / point.flux,
            "asymmetry": float("nan") if at_focus else asymmetry(psf[d]),
            "neighbour_change": _neighbour_change(psf, lens.radius_px, d),
            "model_misfit": float("nan") if at_focus else spot.misfit,
            "repeat_scatter": stacked.scatter,
            "flux_spread": stacked.flux_spread,
        }
        verdict, reasons = _verdict(figures)
        per_depth.append(PsfQuality(float(nominal_mm[d]), figures, verdict, reasons))
    bank_figures = {
        "depths": float(len(per_depth)),
        "residual_rms_px": float(np.sqrt(np.mean(lens.residual_px**2))),
        "residual_max_px": float(np.abs(lens.residual_px).max()),
        "focus_relative_se": lens.focus_se_mm / lens.focus_mm,
        "zero_se_mm": lens.zero_se_mm,
        "bad_depths": float(sum(q.verdict == "bad" for q in per_depth)),
        "suspect_depths": float(sum(q.verdict == "suspect" for q in per_depth)),
    }
    named = tuple(f"{q.depth_nominal_mm / 10:g} cm: {', '.join(q.reasons)}" for q in per_depth if q.verdict != "good")
    overall: Verdict = "good"
    if bank_figures["bad_depths"] > 0 or bank_figures["focus_relative_se"] > 0.01:
        overall = "bad"
    elif bank_figures["suspect_depths"] > 0:
        overall = "suspect"
    if bank_figures["focus_relative_se"] > 0.01:
        named = ("focus distance uncertain by more than 1 %", *named)
    return Quality(tuple(per_depth), bank_figures, overall, named)


def _ratio(value: float, error: float) -> float:
    """Signal to noise; NaN where one pixel holds everything, whose share has no error."""
    return value / error if error > 0 else float("nan")


def asymmetry(psf: FloatArray) -> float:
    """Half the L1 distance of a unit-sum PSF from itself turned by 180 degrees, at the best relative shift; 0 to 1.

    Side of focus can only be told where this is clearly above zero: the two sides' PSFs are each other's rotation.
    """
    turned = psf[::-1, ::-1]
    size = [2 * n for n in psf.shape]
    correlation = np.fft.irfft2(np.fft.rfft2(psf, s=size) * np.conj(np.fft.rfft2(turned, s=size)), s=size)
    peak = np.unravel_index(int(correlation.argmax()), correlation.shape)
    moved = np.zeros_like(psf)
    h, w = psf.shape
    dy, dx = (int(p) - s if p > n else int(p) for p, s, n in zip(peak, size, psf.shape, strict=True))
    ys, xs = slice(max(0, dy), min(h, h + dy)), slice(max(0, dx), min(w, w + dx))
    moved[ys, xs] = turned[slice(max(0, -dy), min(h, h - dy)), slice(max(0, -dx), min(w, w - dx))]
    return float(0.5 * np.abs(psf - moved).sum())


def psf_distance(a: FloatArray, b: FloatArray) -> float:
    """Half the L1 distance of two unit-sum PSFs on one grid: 0 equal, 1 disjoint."""
    return float(0.5 * np.abs(a - b).sum())


def _neighbour_change(psf: FloatArray, radius: FloatArray, index: int) -> float:
    """Distance to the neighbour nearest in radius on the same side, after scaling that to this radius."""
    size = radius[index]
    others = [k for k in (index - 1, index + 1) if 0 <= k < len(radius) and radius[k] * size > 0]
    if abs(size) < 3.0 or not others:
        return float("nan")
    nearest = min(others, key=lambda k: abs(radius[k] - size))
    if abs(radius[nearest]) < 3.0:
        return float("nan")
    scaled = _magnify(psf[nearest], float(size / radius[nearest]))
    return psf_distance(psf[index], scaled)


def _magnify(psf: FloatArray, factor: float) -> FloatArray:
    half = psf.shape[0] // 2
    result = ndimage.affine_transform(psf, np.eye(2) / factor, offset=half * (1 - 1 / factor), order=1)
    return np.asarray(result / max(float(result.sum()), 1e-30), np.float64)


def _verdict(figures: Mapping[str, float]) -> tuple[Verdict, tuple[str, ...]]:
    bad, suspect = [], []
    for name, value in figures.items():
        limit = LIMITS[name]
        if not np.isfinite(value):
            continue
        sign = -1.0 if limit.low_is_bad else 1.0
        if sign * value > sign * limit.bad:
            bad.append(name)
        elif sign * value > sign * limit.suspect:
            suspect.append(name)
    if bad:
        return "bad", (*bad, *suspect)
    return ("suspect", tuple(suspect)) if suspect else ("good", ())


def _plain(figures: Mapping[str, float]) -> dict[str, float | None]:
    return {name: (float(value) if np.isfinite(value) else None) for name, value in figures.items()}
