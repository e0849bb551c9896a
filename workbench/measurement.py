"""The result of measuring one photograph, as values; files and JSON are made from it elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate


@dataclass(frozen=True)
class Measurement:
    """Depths of one photograph.

    Attributes
    ----------
    image
        The developed photograph.
    image_name
        The file as the operator named it.
    bank_ref, bank_id
        The bank as asked for (``active``, ``v2``) and its id.
    bank_quality
        Verdict on the bank: good, suspect, bad or unknown.
    method, options
        Estimator and everything that was chosen for it, as JSON values.
    labels
        int32 (H, W): region of each pixel, 0 = none.
    estimates
        Depth of each region by label.
    depth_map_mm
        float32 (H, W): NaN where unknown.
    all_focus
        float32 (H, W, C) linear: each region deconvolved with the PSF of its depth.
    files
        Files written, by role (depth_png, depth_tiff, all_focus, labels, report).
    """

    image: LinearImage
    image_name: str
    bank_ref: str
    bank_id: str
    method: str
    options: dict[str, Any]
    labels: NDArray[np.int32]
    estimates: dict[int, DepthEstimate]
    depth_map_mm: NDArray[np.float32]
    all_focus: NDArray[np.float32]
    bank_quality: str = "unknown"
    seconds: float = 0.0
    files: dict[str, Path] = field(default_factory=dict)

    def as_json(self, path_text: Any = str) -> dict[str, Any]:
        """The object that ``measure --json`` prints; ``path_text`` turns a path into text.

        Lengths are mm; an unknown number is NaN here (null in JSON).
        """
        return {
            "image": self.image_name,
            "bank": self.bank_id,
            "bank_quality": self.bank_quality,
            "method": self.method,
            "regions": [
                {
                    "id": label,
                    "depth_mm": _round(estimate.depth_mm),
                    "interval_mm": [_round(bound) for bound in estimate.interval_mm],
                    "confidence": _round(estimate.confidence, 4),
                    "mirror_mm": _round(estimate.mirror_mm),
                    "mirror_probability": _round(estimate.mirror_probability, 4),
                    "second_mm": _round(estimate.second_mm),
                    "pixels": estimate.pixels,
                    "status": estimate.status,
                    "reason": estimate.reason,
                }
                for label, estimate in sorted(self.estimates.items())
            ],
            "files": {role: path_text(path) for role, path in self.files.items()},
            "options": self.options,
        }


def _round(value: float, digits: int = 1) -> float:
    return round(float(value), digits)
