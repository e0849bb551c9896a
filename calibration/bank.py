"""The bank: an immutable, content-addressed set of point-spread functions (arrays and manifest).

Draft of the value types; see Bank.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.optics import signed_radius


@dataclass(frozen=True, slots=True)
class LensFit:
    """Thin lens fitted to all PSFs of a bank. Radii are pixels of the developed image, lengths mm."""

    focus_mm: float
    focus_se_mm: float
    scale_px: float
    """Radius of the aperture's image for a point at infinity: A f / (focus - f) / pitch."""
    scale_se_px: float
    zero_mm: float
    """What was to be added to the nominal depths: depth = nominal + zero."""
    zero_se_mm: float
    radius_px: NDArray[np.float64]
    """(D,) signed radius measured on each PSF."""
    radius_se_px: NDArray[np.float64]
    residual_px: NDArray[np.float64]
    """(D,) measured minus fitted."""

    def sigma_px(self, depth_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fitted signed radius (px) at any depth (mm, bank's reference)."""
        return signed_radius(np.asarray(depth_mm, np.float64), focus_mm=self.focus_mm, scale=self.scale_px)


@dataclass(frozen=True)
class Bank:
    """PSFs of one camera, lens and focus setting, over depth (and, where measured, over the field).

    Attributes
    ----------
    depths_mm
        float64 (D,), ascending, measured from the reference plane of the lens fit.
    psf
        float32 (F, D, K, K), non-negative up to noise, unit sum; K odd; the chief ray is the centre pixel.
    psf_se
        float32 (F, D, K, K), standard error per pixel.
    field_yx
        float64 (F, 2): where in the frame each set was measured, as a fraction of the half frame
        ((0, 0) = centre, (-1, -1) = top left corner). F = 1 for a central bank.
    lens
        Thin lens fitted to the central set.
    recipe, pixel_pitch_mm
        Recipe and pitch (mm) of the developed image.
    manifest
        Everything else: provenance, quality, camera, see docs/reference.
    """

    depths_mm: NDArray[np.float64]
    psf: NDArray[np.float32]
    psf_se: NDArray[np.float32]
    field_yx: NDArray[np.float64]
    lens: LensFit
    recipe: str
    pixel_pitch_mm: float
    manifest: dict[str, Any] = field(default_factory=dict)

    @property
    def central(self) -> NDArray[np.float32]:
        """float32 (D, K, K): the set nearest to the centre of the frame."""
        return np.asarray(self.psf[int(np.argmin(np.hypot(*self.field_yx.T)))])
