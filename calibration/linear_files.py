"""Arrays on disk that are already linear: TIFF and NPY."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from calibration.errors import FrameError

LINEAR_SUFFIXES = (".tif", ".tiff", ".npy")
_LARGEST = 1e12
"""Times white: no image holds so much, and sums of its squares would overflow."""


def is_linear_file(path: Path) -> bool:
    """Whether :func:`read_linear` reads this kind of file (by its suffix)."""
    return path.suffix.lower() in LINEAR_SUFFIXES


def read_linear(path: Path, *, white: float | None = None) -> NDArray[np.float32]:
    """Read a linear image as float32 (H, W, C), C = 1 or 3, in fractions of white.

    Parameters
    ----------
    path
        ``.npy``, ``.tif`` or ``.tiff`` with shape (H, W), (H, W, 1), (H, W, 3) or (3, H, W); an alpha channel is
        refused, since nothing says what it means.
    white
        Value that counts as 1. Default: 1 for floating point, the largest value of the type for integers.

    Raises
    ------
    FrameError
        Unreadable, of another shape or type, or with values that are not finite, or larger than any image has.
    """
    array = _load(path)
    if array.dtype.kind not in "uif":
        raise FrameError(f"{path}: holds {array.dtype} values; save real numbers (float32 or uint16)")
    array = _as_hwc(path, array)
    if white is None:
        white = 1.0 if array.dtype.kind == "f" else float(np.iinfo(array.dtype).max)
    planes = np.asarray(array, dtype=np.float32) / np.float32(white)
    if not np.isfinite(planes).all():
        raise FrameError(f"{path}: contains NaN or infinite pixels; save a complete image")
    if (largest := float(np.abs(planes).max())) > _LARGEST:
        raise FrameError(f"{path}: holds {largest:.0e} times white, as marks of missing pixels do; fill them in")
    return np.ascontiguousarray(planes)


def _load(path: Path) -> NDArray[Any]:
    try:
        if path.suffix.lower() == ".npy":
            return np.asarray(np.load(path, allow_pickle=False))
        return np.asarray(tifffile.imread(path))
    except Exception as error:  # the readers raise whatever their parsers meet in broken bytes
        kind = "NPY" if path.suffix.lower() == ".npy" else "TIFF"
        raise FrameError(f"{path}: can't be read as {kind} (truncated or another format?): {_line(error)}") from error


def _as_hwc(path: Path, array: NDArray[Any]) -> NDArray[Any]:
    if array.size == 0:
        raise FrameError(f"{path}: holds no image; save it again")
    if array.ndim == 2:
        return array[:, :, np.newaxis]
    if array.ndim == 3 and array.shape[2] in (1, 3):
        return array
    if array.ndim == 3 and array.shape[0] in (1, 3):
        return np.moveaxis(array, 0, 2)
    raise FrameError(f"{path}: has shape {array.shape}; expected (H, W) or (H, W, 3)")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
