"""A second point within the first one's light: what a search for separate points can't see.

A reflection or a double exposure lays a shifted copy over the point. One picture of the aperture, of the size that the
lens gives this depth, then explains the frame badly, and two such pictures explain it well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import least_squares

from calibration.errors import FitError
from calibration.lens_fit import MIN_DEPTHS, LensFit, fit_lens
from calibration.render import HALF_EXTENT, render
from calibration.spot_fit import Spot, SpotFit, fit_spot, soften
from calibration.template import TemplateFit, fit_spots

FloatArray = NDArray[np.float64]

LEAST_SHARE = 0.02
"""A copy with less of the light than this is not told from what no aperture's picture explains."""
LEAST_DISTANCE_PX = 2.5
"""A copy nearer than this is a shake, or an aberration."""
STANDS_OUT = 1.5
"""A depth is looked at where its misfit is so many times the median's."""
LOOKED_AT = 3
"""Depths that stand out most; no more of one bank are looked at, since each costs a second or so."""
ENOUGH = 12
"""Other depths that the aperture is taken from for the closer look."""
EXPLAINED = 0.5
"""Part of the residual power, against one picture of any size, that the copy must take away."""
WITHIN = 0.7
"""A copy nearer than this many radii may be an aberration of the lens, if neighbouring depths show it too."""
HINT = 0.25
"""The same with the aperture as fitted to all frames, the doubled one among them: then it is worth a closer look."""
_MOST_FIRST, _MOST_SECOND = 200, 4000


@dataclass(frozen=True, slots=True)
class Copy:
    """A second copy of a point: its part of the light, how far it lies from the first, what it explains."""

    share: float
    distance_px: float
    explained: float
    """Part of the residual power of a single picture that it takes away."""


@dataclass(frozen=True, slots=True)
class Doubled:
    """Which of a depth's repeats holds its point twice."""

    depth: int
    repeat: int
    copy: Copy


def find_doubled(
    spots: Sequence[Spot],
    repeats: Sequence[Sequence[Spot]],
    nominal_mm: FloatArray,
    fit: TemplateFit,
    lens: LensFit,
) -> Doubled | None:
    """The frame that holds its point twice, if one does; the clearest of several.

    Parameters
    ----------
    spots
        One per depth, the average of its repeats; zero outside the light's support.
    repeats
        The single frames of each depth, likewise.
    nominal_mm
        float64 (D,), nominal depths, mm.
    fit, lens
        Aperture and lens fitted to all of them, doubled ones included.

    Returns
    -------
    Doubled or None
        None also where there are too few depths to leave one out.
    """
    if len(spots) <= MIN_DEPTHS:
        return None
    found: list[Doubled] = []
    for i in _worth_a_look(spots, nominal_mm, fit, lens):
        rest = np.delete(np.arange(len(spots)), i)
        rest = rest[np.unique(np.linspace(0, rest.size - 1, min(rest.size, ENOUGH)).astype(int))]
        try:
            alone, lens_alone = _fit([spots[k] for k in rest], nominal_mm[rest], apply_zero=lens.zero_applied)
        except FitError:
            continue
        radius = lens_radius(lens_alone, nominal_mm[i])
        copies = [second_copy(spot, alone, radius) for spot in repeats[i]]
        clearest = int(np.argmax([c.share if _is_copy(c, EXPLAINED) else 0.0 for c in copies]))
        copy = copies[clearest]
        if _is_copy(copy, EXPLAINED) and not _runs_on(i, copy, spots, nominal_mm, alone, lens_alone):
            found.append(Doubled(i, clearest, copy))
    return max(found, key=lambda one: one.copy.share, default=None)


def _worth_a_look(spots: Sequence[Spot], nominal_mm: FloatArray, fit: TemplateFit, lens: LensFit) -> list[int]:
    """Depths that stand out, where two copies explain more already; and the largest, which the aperture is made of.

    A copy in the largest goes into the common aperture, so that it is the others that stand out.
    """
    misfit = np.array([s.misfit for s in fit.spots])
    order = np.argsort(-misfit)[:LOOKED_AT]
    out = [int(i) for i in order if misfit[i] > STANDS_OUT * float(np.median(misfit))]
    if not out:
        return []
    chosen = [i for i in out if _is_copy(second_copy(spots[i], fit, lens_radius(lens, nominal_mm[i])), HINT)]
    largest = int(np.argmax([abs(s.radius_px) for s in fit.spots]))
    return chosen if largest in chosen else [*chosen, largest]


def _runs_on(
    i: int, copy: Copy, spots: Sequence[Spot], nominal_mm: FloatArray, fit: TemplateFit, lens: LensFit
) -> bool:
    """Whether the copy is the lens's own: within the blurred aperture, and in the neighbouring depths as well.

    An aberration changes the inside of the blur smoothly with depth; a reflection or a double exposure doesn't.
    """
    if copy.distance_px > WITHIN * abs(lens_radius(lens, nominal_mm[i])):
        return False
    order = np.argsort(nominal_mm).tolist()
    place = order.index(i)
    return any(
        _is_copy(second_copy(spots[k], fit, lens_radius(lens, nominal_mm[k])), EXPLAINED)
        for k in order[max(0, place - 1) : place + 2]
        if k != i
    )


def lens_radius(lens: LensFit, nominal_mm: float) -> float:
    """Signed radius (px) that a fit gives a nominal depth."""
    return float(lens.sigma_px(np.array([nominal_mm + (lens.zero_mm if lens.zero_applied else 0.0)]))[0])


def second_copy(spot: Spot, fit: TemplateFit, radius_px: float) -> Copy:
    """Explain a spot by two pictures of the aperture of the given size, and compare with one of any size.

    All pairs of places on the pixel grid are tried (their best amplitudes follow from correlations); the best pair is
    refined to a fraction of a pixel.

    Parameters
    ----------
    spot
        Zero outside the light's support.
    fit
        The aperture's picture, preferably of other depths only.
    radius_px
        Signed radius that the lens gives this depth.
    """
    values = spot.values
    shape = (int(values.shape[0]), int(values.shape[1]))
    core = fit.core.of_dot(spot.extra_variance_px2)

    def picture(radius: float, y: float, x: float) -> FloatArray:
        return render(fit.template, HALF_EXTENT, shape, radius=radius, centre=(y, x), core=core)

    first, second = _best_pair(values, picture(radius_px, shape[0] // 2, shape[1] // 2))

    def amplitudes(places: FloatArray) -> tuple[FloatArray, FloatArray]:
        design = np.stack([picture(radius_px, *places[:2]).ravel(), picture(radius_px, *places[2:]).ravel()], axis=1)
        weights = np.maximum(np.linalg.lstsq(design, values.ravel(), rcond=None)[0], 0.0)
        return weights, values.ravel() - design @ weights

    places = least_squares(lambda p: amplitudes(p)[1], [*first, *second], diff_step=1e-3, max_nfev=12).x
    weights, left = amplitudes(places)
    single = _single_residual(spot, fit, radius_px, first if weights[0] >= weights[1] else second, picture)
    return Copy(
        share=float(weights.min() / max(weights.sum(), 1e-30)),
        distance_px=float(np.hypot(*(places[:2] - places[2:]))),
        explained=1.0 - float(left @ left) / max(single, 1e-30),
    )


def _is_copy(copy: Copy, least_explained: float) -> bool:
    return copy.share >= LEAST_SHARE and copy.distance_px >= LEAST_DISTANCE_PX and copy.explained >= least_explained


def _fit(spots: Sequence[Spot], nominal_mm: FloatArray, *, apply_zero: bool) -> tuple[TemplateFit, LensFit]:
    fit = fit_spots(spots, 1.0 / nominal_mm)
    radii = np.array([s.radius_px for s in fit.spots])
    errors = np.array([s.radius_se_px for s in fit.spots])
    return fit, fit_lens(nominal_mm, radii, errors, apply_zero=apply_zero)


def _best_pair(values: FloatArray, picture: FloatArray) -> tuple[tuple[int, int], tuple[int, int]]:
    """Places (row, column) of two copies of ``picture`` (drawn about the middle) that explain most of ``values``."""
    shape = values.shape
    size = [fft.next_fast_len(2 * n) for n in shape]
    turned = np.conj(fft.rfft2(picture, s=size))
    overlap = fft.irfft2(fft.rfft2(picture, s=size) * turned, s=size)  # of two copies, by distance
    matched = fft.irfft2(fft.rfft2(values, s=size) * turned, s=size)  # of data and copy, by shift from the middle
    middle = np.array(shape) // 2
    places = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 2)
    score = matched[tuple((places - middle).T)]
    usable = score > 0.02 * score.max()
    places, score = places[usable], score[usable]
    order = np.argsort(-score)
    strong = order[score[order] > 0.6 * score.max()]
    strong = strong[:: max(1, len(strong) // _MOST_FIRST)]
    every = order[:: max(1, len(order) // _MOST_SECOND)]
    power = float(overlap[0, 0])
    best, found = -np.inf, (strong[0], strong[0])
    for i in strong:
        step = places[every] - places[i]
        shared = overlap[tuple(step.T)]
        a, b = score[i], score[every]
        det = np.maximum(power**2 - shared**2, 1e-30)
        first, second = (power * a - shared * b) / det, (power * b - shared * a) / det
        good = (np.hypot(*step.T) >= LEAST_DISTANCE_PX) & (first > 0) & (second > 0)
        if not good.any():
            continue
        gain = np.where(good, first * a + second * b, -np.inf)
        k = int(gain.argmax())
        if gain[k] > best:
            best, found = float(gain[k]), (i, every[k])
    (y0, x0), (y1, x1) = places[found[0]].tolist(), places[found[1]].tolist()
    return (y0, x0), (y1, x1)


def _single_residual(
    spot: Spot, fit: TemplateFit, radius_px: float, start_yx: tuple[int, int], picture: Callable[..., FloatArray]
) -> float:
    """Residual power of one picture of whatever size suits best."""
    y, x = start_yx
    start = SpotFit(radius_px, 0.0, float(y), float(x), 0.0, float(spot.values.sum()), 1.0, 0.0)
    one = fit_spot(fit.template, soften(spot), start, fit.core)
    drawn = picture(one.radius_px, one.centre_y, one.centre_x)
    flux = float((spot.values * drawn).sum() / max(float((drawn * drawn).sum()), 1e-30))
    return float(((spot.values - flux * drawn) ** 2).sum())
