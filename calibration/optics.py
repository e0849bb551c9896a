"""Thin lens: signed blur radius against depth, its inverse, the mirror depth.

The signed radius of the aperture's image is linear in inverse depth (thin lens; METHOD Eq. 1)::

    sigma(z) = scale * (1 - focus / z),     scale = A f / (focus - f)

negative nearer than focus (the PSF is turned by 180 degrees), positive beyond. ``scale`` is the radius at
infinity, in whatever unit the caller uses (mm on the sensor, or pixels of the developed image).
"""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@overload
def signed_radius(depth_mm: float, *, focus_mm: float, scale: float) -> float: ...
@overload
def signed_radius(depth_mm: FloatArray, *, focus_mm: float, scale: float) -> FloatArray: ...
def signed_radius(depth_mm: float | FloatArray, *, focus_mm: float, scale: float) -> float | FloatArray:
    """Signed radius of the aperture's image, in the unit of ``scale``; negative nearer than focus."""
    return scale * (1.0 - focus_mm / depth_mm)


@overload
def depth_from_radius(radius: float, *, focus_mm: float, scale: float) -> float: ...
@overload
def depth_from_radius(radius: FloatArray, *, focus_mm: float, scale: float) -> FloatArray: ...
def depth_from_radius(radius: float | FloatArray, *, focus_mm: float, scale: float) -> float | FloatArray:
    """Inverse of :func:`signed_radius`; infinite or negative where ``radius >= scale`` (beyond infinity)."""
    with np.errstate(divide="ignore"):
        result = focus_mm / (1.0 - np.asarray(radius, dtype=np.float64) / scale)
    return float(result) if np.ndim(radius) == 0 else np.asarray(result, dtype=np.float64)


def mirror_depth(depth_mm: float, *, focus_mm: float) -> float:
    """Depth (mm) on the other side of focus with the same |sigma|: 1/z' = 2/focus - 1/z; inf if there is none."""
    inverse = 2.0 / focus_mm - 1.0 / depth_mm
    return 1.0 / inverse if inverse > 0 else float("inf")


def image_distance_mm(*, focal_length_mm: float, focus_mm: float) -> float:
    """Distance (mm) from lens to sensor when focused at ``focus_mm``: f focus / (focus - f)."""
    return focal_length_mm * focus_mm / (focus_mm - focal_length_mm)
