"""The second photograph of methods that need two: same camera and scene, another aperture, and that one's bank."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.errors import MismatchError
from calibration.image import LinearImage
from workbench.depth.screening import ScreeningOptions


@dataclass(frozen=True, slots=True)
class SecondViewOptions(ScreeningOptions):
    """What a method with two photographs needs besides.

    Attributes
    ----------
    second_image
        The scene through the second aperture, from the same place, focused at the same distance, developed like the
        first.
    second_bank
        Bank of the second aperture; its depths must cover those of the first.
    """

    second_image: LinearImage | None = None
    second_bank: Bank | None = None


def second_view(image: LinearImage, bank: Bank, options: SecondViewOptions, method: str) -> tuple[LinearImage, Bank]:
    """The second photograph and its bank, checked.

    Raises
    ------
    MismatchError
        One is missing, or doesn't belong to the first.
    """
    second, second_bank = options.second_image, options.second_bank
    if second is None or second_bank is None:
        missing = "second_image" if second is None else "second_bank"
        raise MismatchError(
            f"method {method} needs a second photograph through another aperture and that aperture's bank: "
            f"{missing} is missing; give --set second_image=FILE --set second_bank=REF"
        )
    if second.shape != image.shape:
        raise MismatchError(
            f"{second.info.path}: {second.shape[1]} x {second.shape[0]} pixels, the first photograph has "
            f"{image.shape[1]} x {image.shape[0]}; photograph both with the same camera"
        )
    pitches = bank.pixel_pitch_mm, second_bank.pixel_pitch_mm
    if pitches[0] and pitches[1] and abs(pitches[0] / pitches[1] - 1.0) > 0.01:
        raise MismatchError(
            f"second_bank: pixel pitch is {pitches[1] * 1000:.2f} um, the first bank's {pitches[0] * 1000:.2f} um; "
            "make both banks with the same camera"
        )
    return second, second_bank


def common_depths(bank: Bank, second: Bank) -> NDArray[np.intp]:
    """Indices of the second bank's planes nearest to the first bank's depths, (D,).

    Raises
    ------
    MismatchError
        A depth of the first bank lies further than half a step from any plane of the second.
    """
    inverse, other = 1.0 / bank.depths_mm, 1.0 / second.depths_mm
    nearest = np.abs(other[np.newaxis] - inverse[:, np.newaxis]).argmin(axis=1)
    off = np.abs(other[nearest] - inverse)
    worst = int(off.argmax())
    if off[worst] > 0.5 * float(np.abs(np.diff(inverse)).max()):
        raise MismatchError(
            f"second_bank: has no plane near {bank.depths_mm[worst] / 10:g} cm; make both banks at the same depths"
        )
    return np.asarray(nearest, np.intp)
