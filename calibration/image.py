"""The developed image: what RAW files become, and the only form in which bank and scene meet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.mosaic import Mosaic

Recipe = Literal["superpixel", "native", "linear"]
"""``superpixel``: 2x2 CFA cells to one RGB pixel, no interpolation. ``native``: photosite pitch.
``linear``: the file was already a developed linear image (TIFF, NPY)."""


@dataclass(frozen=True, slots=True)
class FrameInfo:
    """What a file says about itself. Unknown values are None or ''."""

    path: str
    sha256: str
    make: str = ""
    model: str = ""
    raw_size: tuple[int, int] | None = None
    """Visible photosites (height, width); None for a linear image."""
    cfa: str = ""
    """Colour filter pattern of the top-left 2x2 cell, e.g. ``RGGB``."""
    exposure_s: float | None = None
    iso: float | None = None
    focal_length_mm: float | None = None
    f_number: float | None = None
    pixel_pitch_mm: float | None = None
    """Photosite pitch of the known camera, or as the file states it (FocalPlaneXResolution)."""
    dark: str = ""
    """How a dark frame was subtracted: ``pixelwise``, ``median level`` (dark of another size), or '' for none."""

    def with_dark(self, how: str) -> FrameInfo:
        """The same facts after a dark frame was subtracted in this way."""
        return replace(self, dark=how)


@dataclass(frozen=True, slots=True)
class LinearImage:
    """A linear image, fraction of white, black level removed (values slightly below 0 are noise, kept).

    Attributes
    ----------
    planes
        float32 (H, W, C); C = 3 (R, G, B) or 1.
    saturated
        bool (H, W): at least one contributing photosite is at or near white level.
    recipe
        How it was developed.
    pixel_pitch_mm
        Pitch of these pixels (superpixel: twice the photosite pitch); None if unknown.
    info
        Facts of the source file.
    mosaic
        The photosites that the superpixels were made of, where they were kept (:func:`calibration.raw.develop`).
    """

    planes: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    recipe: Recipe
    pixel_pitch_mm: float | None
    info: FrameInfo
    mosaic: Mosaic | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the developed image."""
        return int(self.planes.shape[0]), int(self.planes.shape[1])

    @property
    def luminance(self) -> NDArray[np.float32]:
        """float32 (H, W): (R + 2 G + B) / 4 for colour, the mean of the four photosites of a cell."""
        if self.planes.shape[2] == 1:
            return np.ascontiguousarray(self.planes[:, :, 0])
        r, g, b = (self.planes[:, :, i] for i in range(3))
        return np.asarray((r + 2.0 * g + b) * np.float32(0.25), dtype=np.float32)
