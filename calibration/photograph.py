"""A photograph of a scene, developed for the bank that will measure it."""

from __future__ import annotations

from pathlib import Path

from calibration.bank import Bank, check_fits
from calibration.image import LinearImage
from calibration.raw import develop


def develop_photograph(path: str | Path, bank: Bank) -> LinearImage:
    """Develop a photograph like a bank's frames, and keep its photosites.

    Raises
    ------
    FrameError
        The file can't be used.
    MismatchError
        It doesn't belong to the bank (:func:`calibration.bank.check_fits`).
    """
    image = develop(path, recipe="native" if bank.recipe == "native" else "superpixel", keep_mosaic=True)
    check_fits(bank, image)
    return image
