"""A bank with PSFs over the field, as the central bank that would have been measured at one place of the frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.bank import Bank

FloatArray = NDArray[np.float64]

_CENTRAL_ONLY = ("aperture", "field_radius_px", "chief_yx", "middle_yx", "place_yx")
_ROW_GAP = 0.5
"""Points are of one row where their rows are nearer than this part of the grid's mean pitch."""


def bank_at(bank: Bank, place_yx: tuple[float, float]) -> Bank:
    """The bank of one place in the frame, with a single set of PSFs.

    At each depth the four sets about the place are blended bilinearly, by where their points were imaged at that
    depth. Outside the grid the nearest edge counts: nothing is extrapolated. Sets whose points don't form a grid are
    not blended: the nearest is taken.

    Parameters
    ----------
    bank
        Any bank; one with a single set is returned as it is.
    place_yx
        Fraction of the half frame, like :attr:`calibration.bank.Bank.field_yx`.

    Returns
    -------
    Bank
        One set of PSFs. The lens keeps the central fit's focus and zero; its radii are those of the place.
    """
    count = len(bank.field_yx)
    if count == 1:
        return bank
    places = places_of(bank)
    weights = np.stack([_weights(places[:, d], place_yx) for d in range(bank.depths_mm.size)], axis=1)
    chief = np.asarray(bank.extras.get("chief_yx", np.zeros((count, bank.depths_mm.size, 2))), np.float64)
    psf, se = np.zeros(bank.psf.shape[1:]), np.zeros(bank.psf.shape[1:])
    main = weights.argmax(axis=0)
    for d, best in enumerate(main):
        for f in np.flatnonzero(weights[:, d] > 0):
            move = chief[best, d] - chief[f, d]
            psf[d] += weights[f, d] * _moved(bank.psf[f, d], move)
            se[d] += (weights[f, d] * _moved(bank.psf_se[f, d], move)) ** 2
    psf /= psf.sum(axis=(1, 2), keepdims=True)
    extras = {name: array for name, array in bank.extras.items() if name not in _CENTRAL_ONLY}
    extras["chief_yx"] = chief[main, np.arange(main.size)][np.newaxis]
    lens = bank.lens
    radii = bank.extras.get("field_radius_px")
    if radii is not None:
        mixed = (weights * np.asarray(radii, np.float64)).sum(axis=0)
        slope, intercept = np.polyfit(1.0 / bank.depths_mm, mixed, 1)
        lens = replace(lens, focus_mm=float(-slope / intercept), scale_px=float(intercept), radius_px=mixed)
    return replace(
        bank,
        psf=psf.astype(np.float32)[np.newaxis],
        psf_se=np.sqrt(se).astype(np.float32)[np.newaxis],
        field_yx=np.array([place_yx], np.float64),
        lens=lens,
        extras=extras,
    )


def places_of(bank: Bank) -> FloatArray:
    """Where each set's point was imaged at each depth, float64 (F, D, 2), as fractions of the half frame."""
    stored = bank.extras.get("place_yx")
    if stored is not None:
        return np.asarray(stored, np.float64)
    return np.repeat(bank.field_yx[:, np.newaxis], bank.depths_mm.size, axis=1)


def central_bank(bank: Bank) -> Bank:
    """The central set alone, as a bank of its own: what calibrating with one point would have given."""
    if len(bank.field_yx) == 1:
        return bank
    index = bank.central_index
    extras = {
        name: array[index : index + 1] if name in _CENTRAL_ONLY and name != "aperture" else array
        for name, array in bank.extras.items()
        if name != "place_yx"
    }
    manifest = dict(bank.manifest)
    aperture = dict(manifest.get("aperture", {}))
    of_places = {name: [aperture[name][index]] for name in ("core_px", "core_wings") if aperture.get(name)}
    if of_places:
        manifest["aperture"] = {**aperture, **of_places}
    return replace(
        bank,
        psf=bank.psf[index : index + 1],
        psf_se=bank.psf_se[index : index + 1],
        field_yx=bank.field_yx[index : index + 1],
        manifest=manifest,
        extras=extras,
    )


def region_place(mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Centroid (y, x) of a region as fractions of the half frame; mask is bool (H, W) with at least one pixel."""
    return (_middle(mask.sum(axis=1)), _middle(mask.sum(axis=0)))


def _middle(counts: NDArray[np.int_]) -> float:
    half = counts.size / 2.0
    return float((counts @ (np.arange(counts.size) + 0.5) / counts.sum() - half) / half)


def _weights(places: FloatArray, place_yx: tuple[float, float]) -> FloatArray:
    """Weight of each set, float64 (F,), sum 1."""
    weights = np.zeros(len(places))
    rows = _rows(places)
    if rows is None:
        weights[np.hypot(*(places - place_yx).T).argmin()] = 1.0
        return weights
    heights = places[rows, 0].mean(axis=1)
    for row, share in _between(heights, place_yx[0]):
        for column, part in _between(places[rows[row], 1], place_yx[1]):
            weights[rows[row][column]] += share * part
    return weights


def _rows(places: FloatArray) -> NDArray[np.intp] | None:
    """Indices of the grid's points by row and column, (rows, columns), or None where they don't form a grid."""
    order = np.argsort(places[:, 0])
    heights = places[order, 0]
    spread = np.ptp(places, axis=0).max() / max(np.sqrt(len(places)) - 1.0, 1.0)
    ends = np.flatnonzero(np.diff(heights) > _ROW_GAP * spread) + 1
    parts = np.split(order, ends)
    if len({part.size for part in parts}) != 1:
        return None
    return np.stack([part[np.argsort(places[part, 1])] for part in parts])


def _between(knots: FloatArray, value: float) -> list[tuple[int, float]]:
    """The two ascending knots about a value with their linear weights; the end's alone outside."""
    if value <= knots[0] or knots.size == 1:
        return [(0, 1.0)]
    if value >= knots[-1]:
        return [(knots.size - 1, 1.0)]
    upper = int(np.searchsorted(knots, value))
    share = float((value - knots[upper - 1]) / (knots[upper] - knots[upper - 1]))
    return [(upper - 1, 1.0 - share), (upper, share)]


def _moved(picture: NDArray[np.float32], by_yx: FloatArray) -> FloatArray:
    """Shifted by part of a pixel, so that the chief rays of blended sets coincide; linear: nothing becomes negative."""
    whole = picture.astype(np.float64)
    return whole if not by_yx.any() else np.asarray(ndimage.shift(whole, by_yx, order=1), np.float64)
