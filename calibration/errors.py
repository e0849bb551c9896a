"""Expected errors of calibration: bad files, bad frames, banks that do not fit. One line each, with the way out."""

from __future__ import annotations


class CalibrationError(Exception):
    """Base of every expected error of this package (the operator's input, not our bug)."""


class FrameError(CalibrationError):
    """A RAW or image file is missing, broken, empty, or decodes to nothing usable."""


class PointError(CalibrationError):
    """A frame shows no usable point. ``reason`` is one of missing, faint, saturated, clipped, doubled."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class DepthListError(CalibrationError):
    """The list of depths can't be right: duplicates, out of order, wrong unit, too few."""


class FitError(CalibrationError):
    """The lens fit failed or explains nothing."""


class BankError(CalibrationError):
    """A bank is missing, damaged or malformed."""


class MismatchError(CalibrationError):
    """A bank and a scene don't belong together (recipe, pixel pitch, size, CFA, optics)."""
