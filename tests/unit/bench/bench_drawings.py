"""Stand-ins for tests of the benchmark: outcomes, a lens whose PSF is a Gaussian, a bank, a method that reads grey."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank, LensFit
from calibration.image import LinearImage
from calibration.optics import signed_radius
from workbench.bench.scoring import Outcome
from workbench.depth.estimate import DepthEstimate

FOCUS_MM = 1600.0


def outcome(true_mm: float, depth_mm: float, **more: Any) -> Outcome:
    facts: dict[str, Any] = {
        "method": "m", "texture": "chart", "size": "128", "light": "normal", "interval_mm": (float("nan"),) * 2,
        "confidence": 1.0, "status": "ok", "seconds": 0.1,
    }  # fmt: skip
    return Outcome(true_mm=true_mm, depth_mm=depth_mm, **{**facts, **more})


@dataclass(frozen=True)
class GaussianLens:
    """A PSF whose standard deviation is half the blur radius, and a core."""

    scale_px: float = 8.0
    core_px: float = 0.7
    residual: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def radius_px(self, depth_mm: float) -> float:
        return self.scale_px * (1 - FOCUS_MM / depth_mm)

    def deviation_px(self, depth_mm: float) -> float:
        return float(np.hypot(self.core_px, self.radius_px(depth_mm) / 2))

    def psf_at(self, depth_mm: float, size: int | None = None) -> NDArray[np.float32]:
        half = (size or 41) // 2
        line = np.exp(-0.5 * (np.arange(-half, half + 1) / self.deviation_px(depth_mm)) ** 2)
        psf = np.outer(line, line)
        return np.asarray(psf / psf.sum(), np.float32)


def small_bank(recipe: str = "superpixel") -> Bank:
    """Four planes of Gaussian PSFs."""
    depths = np.array([1000.0, 1300.0, 1700.0, 2500.0])
    lens = GaussianLens()
    psf = np.stack([lens.psf_at(float(z), 21) for z in depths])[None]
    radii = signed_radius(depths, focus_mm=FOCUS_MM, scale=lens.scale_px)
    zeros = np.zeros(depths.size)
    fit = LensFit(FOCUS_MM, 1.0, lens.scale_px, 0.01, 0.0, 1.0, radii, zeros + 0.05, zeros)
    return Bank(depths, psf, np.zeros_like(psf), np.zeros((1, 2)), fit, recipe, 0.0086)


def grey_is_depth(image: LinearImage, bank: Bank, labels: NDArray[np.int32], _: object) -> dict[int, DepthEstimate]:
    """A method that can be judged by hand: the depth is the region's mean grey, 0.1 for each metre."""
    nan = float("nan")
    result = {}
    for label in np.unique(labels[labels > 0]):
        depth = 10_000.0 * float(image.luminance[labels == label].mean())
        result[int(label)] = DepthEstimate(
            depth, (depth - 20, depth + 20), 0.9, nan, 0.0, "ok", bank.depths_mm, np.full(4, 0.25), nan,
            int((labels == label).sum()),
        )  # fmt: skip
    return result
