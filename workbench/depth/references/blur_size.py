"""From the width of a blur to depth, for methods that know blur only as a Gaussian's standard deviation.

The bank tells how wide its PSFs are at each depth; their second moment follows ``s**2 = core**2 + (share sigma)**2``
with sigma the thin lens's signed radius. Its inverse turns a measured standard deviation into |sigma|, and the lens
into depth.

A width has no sign. The papers assume that everything lies beyond the focal plane, and so do these methods wherever
the bank reaches that far; the depth on the near side with the same blur is reported as mirror, equally probable. A blur
that is larger than anything beyond focus can only come from the near side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.optics import depth_from_radius
from workbench.depth.estimate import DepthEstimate, Status
from workbench.depth.screening import Region, ScreeningOptions

FloatArray = NDArray[np.float64]

_REACH = 1.1
"""A blur that is larger by this factor than the bank's largest on one side still counts as the bank's last depth."""


@dataclass(frozen=True, slots=True)
class BlurScale:
    """Standard deviation (px) of the bank's PSFs along an axis, mean of both axes, against the lens's radius (px).

    Attributes
    ----------
    core_px
        In focus.
    share
        Of the radius, far out of focus.
    """

    core_px: float
    share: float

    def std_px(self, radius_px: FloatArray) -> FloatArray:
        """Standard deviation of blur at radii of either sign."""
        return np.asarray(np.hypot(self.core_px, self.share * radius_px), np.float64)

    def radius_px(self, std_px: float) -> float:
        """|sigma| of a standard deviation; 0 where it is sharper than focus."""
        return float(np.sqrt(max(std_px**2 - self.core_px**2, 0.0)) / self.share)


def blur_scale(bank: Bank) -> BlurScale:
    """Fit :class:`BlurScale` to the second moments of a bank's central PSFs."""
    variance = np.array(
        [_variance(psf, abs(radius)) for psf, radius in zip(bank.central, bank.lens.radius_px, strict=True)]
    )
    weight = 1.0 / variance
    design = np.stack([np.ones_like(variance), bank.lens.radius_px**2], axis=1)
    core, share = np.linalg.lstsq(design * weight[:, np.newaxis], variance * weight, rcond=None)[0]
    return BlurScale(float(np.sqrt(max(core, 0.0))), float(np.sqrt(max(share, 1e-6))))


def _variance(psf: NDArray[np.float32], radius_px: float) -> float:
    """Second central moment along an axis, mean of both, within a disc that holds the aperture's image.

    The disc keeps the noise of far pixels out, which a second moment would weigh most.
    """
    half = psf.shape[0] // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    light = np.where(np.hypot(y, x) <= 1.4 * radius_px + 4.0, np.maximum(psf, 0.0), 0.0).astype(np.float64)
    light /= light.sum()
    centre_y, centre_x = float((light * y).sum()), float((light * x).sum())
    return 0.5 * float((light * ((y - centre_y) ** 2 + (x - centre_x) ** 2)).sum())


def estimate_from_blur(
    bank: Bank,
    region: Region,
    options: ScreeningOptions,
    scale: BlurScale,
    std_px: float,
    spread_px: float,
    diagnostics: Mapping[str, FloatArray],
) -> DepthEstimate:
    """Depth of a region whose blur is known.

    Parameters
    ----------
    bank, region, options
        What is measured.
    scale
        Of this bank.
    std_px
        Standard deviation of the region's blur.
    spread_px
        How far single edges or bands scatter about it; the width of the curve that is reported.
    diagnostics
        Further arrays.
    """
    radius = scale.radius_px(std_px)
    far, near = _sides(bank, radius)
    known = np.isfinite(far) or np.isfinite(near)
    if not known:
        far = float(bank.depths_mm[int(np.argmax(np.abs(bank.lens.sigma_px(bank.depths_mm))))])
    depth, mirror = (far, near) if np.isfinite(far) else (near, float("nan"))
    status: Status = "ok"
    reason = ""
    if not known:
        status, reason = "ambiguous", f"a blur of {radius:.1f} px in radius is more than any depth of the bank has"
    elif np.isfinite(mirror):
        status, reason = (
            "ambiguous",
            f"{mirror / 10:.1f} cm has the same blur; this method can't tell the side of focus",
        )
    if region.saturated > options.max_saturated:
        status, reason = "saturated", f"{100 * region.saturated:.0f} % of the inner pixels are saturated"
    radii = np.abs(bank.lens.sigma_px(bank.depths_mm))
    width = max(spread_px / scale.share, 0.5 * float(np.median(np.abs(np.diff(radii)))) if radii.size > 1 else 1.0)
    curve = np.exp(-0.5 * ((radii - radius) / width) ** 2)
    nan = float("nan")
    return DepthEstimate(
        depth_mm=depth,
        interval_mm=(nan, nan),
        confidence=nan,
        mirror_mm=mirror,
        mirror_probability=0.5 if np.isfinite(mirror) else nan,
        status=status,
        depths_mm=bank.depths_mm,
        score=curve / max(float(curve.max()), 1e-300),
        second_mm=mirror,
        pixels=region.pixels,
        reason=reason,
        diagnostics={"blur_std_px": np.array([std_px]), "radius_px": np.array([radius]), **diagnostics},
    )


def _sides(bank: Bank, radius: float) -> tuple[float, float]:
    """Depths beyond and nearer than focus with this blur, NaN where the bank doesn't reach."""
    first, last = float(bank.depths_mm[0]), float(bank.depths_mm[-1])
    focus, scale = bank.lens.focus_mm, bank.lens.scale_px
    far = near = float("nan")
    if last > focus and radius <= _REACH * float(bank.lens.sigma_px(bank.depths_mm)[-1]):
        beyond = depth_from_radius(radius, focus_mm=focus, scale=scale) if radius < scale else last
        far = min(beyond, last)
    if first < focus and radius <= _REACH * -float(bank.lens.sigma_px(bank.depths_mm)[0]):
        near = max(depth_from_radius(-radius, focus_mm=focus, scale=scale), first)
    return far, near
