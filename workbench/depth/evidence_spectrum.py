"""How well a blur of each radius explains a region's power spectrum.

The periodogram I(f) of a blurred texture is Gamma distributed about ``S(f) g(f) k(f) + n`` where ``k`` is the blur's
squared transfer function smeared by the taper, ``n`` white noise, and ``S g`` the texture's own spectrum: ``S`` smooth
(piecewise linear in log-log, and with a gentle dependence on direction), ``g`` an unknown factor per frequency. The
factor is what keeps periodic, sparse and text-like textures from breaking the model: it is log-normal with a wide
second component and is integrated out, so that a spectral line, or a gap between lines, counts as a surprise of
bounded size, and what decides is where the blur's zeros leave nothing but noise. ``S`` and ``n`` are fitted anew for
every blur by Fisher scoring from the fit of the blur before, mostly two steps (:mod:`~workbench.depth.evidence_scan`).
Where the best blur leaves lines through the origin unexplained, the texture has straight edges, and all blurs are
fitted once more with a ridge of ``S`` along each of them (:mod:`~workbench.depth.evidence_ridges`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from workbench.depth.evidence_ridges import UNEXPLAINED, VISIBLE, ridge_directions, with_perpendiculars
from workbench.depth.evidence_scan import TextureFactor, likelihood_tables, noise_alone, scan_blurs

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]

EXPECTED_SLOPE, _SLOPE_SD = -2.4, 0.8
"""Expected slope of log power over log frequency, over all knots, and its spread; amplitudes of scenes fall as 1/f
(Field 1987)."""
_BEND_SD = 0.8
"""Expected change of that slope from knot to knot, times the knots' distance."""
_DIRECTION_SD = 0.8
_RIDGE_SD = 2.0
"""How steeply a ridge of power may fall off. Wood grain, planks and shelves hold nearly all of their power within a few
frequencies of a line through the origin."""
_LESS_PER_RIDGE = 0.28
"""Each ridge takes so much off the logarithm of the log-likelihood's weight. Of 20 things that were tried it foresees
best how far the radius is off, in standard errors by the likelihood's curvature (405 regions, seeds 77 and 78)."""
_LINES_GAIN = 10.0
"""Nats that ridges must gain on a blur that draws lines itself, and ridges at right angles to those that were found.
Of 32 regions that such a blur fits (of 942 by the simulated rig) 28 gain up to 7; of the other four two gross ones are
mended, one goes 2 cm farther off. Traced plaids that read wrong gain 47 and 55. Of 16 regions with lines of one
direction ten gain 13 to 70 by those at right angles, the others up to 3."""
_RIDGE_ROUNDS = 2
"""How often lines are sought in what is left unexplained."""
_ABOVE_NOISE = 1.5
"""Log power over the noise from which on a frequency tells of the texture by itself."""
_FEW_AVERAGES = 3.5
"""Below it the lowest tenth of a periodogram lies far under its mean."""
FIRST_CYCLE = 2.0
"""Frequencies with fewer cycles per window are left out: shading and the taper's main lobe."""


@dataclass(frozen=True)
class Band:
    """Which frequencies count, and what shapes log S may have there; all in cycles per pixel.

    Attributes
    ----------
    knots
        Log S is linear in log frequency between these.
    highest
        Higher frequencies are left out.
    ridge_width
        Of a ridge of power.
    roll_off
        Log S may fall, or rise, by ``(f / roll_off)^2`` times a coefficient of the order of 1: the texture's own
        softness. 0 for no such term.
    ridges_from
        Textures have ridges along and across their axis where one direction holds so much more of the gradients' power
        than the other, 0 to 1 (the structure tensor's coherence). 0 for all of them.
    more_ridges
        Whether ridges are sought in other directions, too.
    """

    knots: tuple[float, ...] = (0.02, 0.045, 0.09, 0.18, 0.36)
    highest: float = 0.5
    ridge_width: float = 0.012
    roll_off: float = 0.0
    ridges_from: float = 0.5
    more_ridges: bool = True

    @property
    def log_knots(self) -> FloatArray:
        """Natural logarithms of the knots, float64 (K,)."""
        return np.asarray(np.log(np.array(self.knots)), np.float64)


SUPERPIXELS = Band()
PHOTOSITES = Band((0.01, 0.0225, 0.045, 0.09, 0.18, 0.36), 0.36, 0.006, 0.25, ridges_from=0.0, more_ridges=False)
"""At half the pitch. The colour filters' carriers lie beyond it, and so does most of what the demosaicing kernel takes
away. Few textures keep falling as a power of frequency up to there: prints and paint have a finest detail."""


@dataclass(frozen=True, slots=True)
class SpectralFit:
    """Result over D blurs.

    Attributes
    ----------
    log_likelihood
        float64 (D,), with S and n at their best for each blur (and the priors' penalty).
    null
        The same for noise alone.
    coefficients
        float64 (D, P): log S on its basis.
    log_noise
        float64 (D,): log n.
    ridges
        Directions (rad) in the frequency plane along which the basis has ridges.
    band
        Frequencies that were used.
    """

    log_likelihood: FloatArray
    null: float
    coefficients: FloatArray
    log_noise: FloatArray
    ridges: tuple[float, ...]
    band: Band = SUPERPIXELS

    @property
    def likelihood_weight(self) -> float:
        """Power that the likelihood is raised to: a texture with ridges scatters more about S than one without.

        All fits of a region are weighed by that of its superpixels, so that their levels compare.
        """
        return float(np.exp(-_LESS_PER_RIDGE * len(self.ridges)))

    def texture(self, row: int) -> TextureSpectrum:
        """What was fitted for one blur."""
        return TextureSpectrum(self.coefficients[row], float(self.log_noise[row]), self.ridges, self.band)


@dataclass(frozen=True, slots=True)
class TextureSpectrum:
    """Texture and noise fitted for one blur: log S on its basis, float64 (P,), log n, and the basis's ridges (rad)."""

    coefficients: FloatArray
    log_noise: float
    ridges: tuple[float, ...]
    band: Band = SUPERPIXELS

    def log_power(self, modulus: FloatArray, direction: FloatArray) -> FloatArray:
        """Log S at flattened frequencies, float64 (F,)."""
        return np.asarray(basis(modulus, direction, self.ridges, self.band) @ self.coefficients)


@lru_cache(maxsize=16)
def frequencies(size: int, band: Band = SUPERPIXELS) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """|f| and direction on the half plane (N, N // 2 + 1), and which of it is used (each frequency once); read-only."""
    fy, fx = fft.fftfreq(size)[:, np.newaxis], fft.rfftfreq(size)[np.newaxis, :]
    modulus = np.hypot(fy, fx)
    used = (modulus * size >= FIRST_CYCLE) & (modulus <= band.highest) & ~((fx == 0) & (fy < 0))
    direction = np.arctan2(fy + 0 * fx, fx + 0 * fy)
    for shared in (modulus, direction, used):
        shared.setflags(write=False)
    return modulus, direction, used


def basis(modulus: FloatArray, direction: FloatArray, ridges: Sequence[float], band: Band = SUPERPIXELS) -> FloatArray:
    """Basis of log S for flattened frequencies, float64 (F, P).

    Radial hats, gentle turns, the roll-off where the band has one, ridges.
    """
    knots = band.log_knots
    u = np.log(np.maximum(modulus, 1e-4))
    cell = np.clip(np.searchsorted(knots, u) - 1, 0, knots.size - 2)
    share = (u - knots[cell]) / (knots[cell + 1] - knots[cell])  # beyond 0..1 outside: extrapolates
    hats = np.zeros((u.size, knots.size))
    hats[np.arange(u.size), cell] = 1.0 - share
    hats[np.arange(u.size), cell + 1] = share
    fine = np.clip((u - knots[0]) / (knots[-1] - knots[0]), 0.0, 1.0)
    c2, s2 = np.cos(2 * direction), np.sin(2 * direction)
    turns = [c2 * (1 - fine), c2 * fine, s2 * (1 - fine), s2 * fine, np.cos(4 * direction), np.sin(4 * direction)]
    lines = [-np.log1p((modulus * np.sin(direction - ridge) / band.ridge_width) ** 2) for ridge in ridges]
    soft = [-((np.minimum(modulus, band.highest) / band.roll_off) ** 2)] if band.roll_off else []
    return np.concatenate([hats, np.stack(turns + soft + lines, axis=1)], axis=1)


def _axis(power: FloatArray, modulus: FloatArray, direction: FloatArray) -> tuple[float, float]:
    """Direction (rad) of most of the gradients' power, and its coherence: the structure tensor's (Bigun and Granlund
    1987)."""
    weight = np.maximum(power - np.percentile(power, 25), 0.0) * modulus**2
    turn = (weight * np.exp(2j * direction)).sum()
    return 0.5 * float(np.angle(turn)), float(np.abs(turn) / max(float(weight.sum()), 1e-30))


def _prior(width: int, log_knots: FloatArray, ridges: int) -> tuple[FloatArray, FloatArray]:
    """Precision and precision times mean of the Gaussian prior on the basis's coefficients."""
    knots = log_knots.size
    rows, values = [], []
    slope = np.zeros(width)
    slope[[0, knots - 1]] = np.array([-1.0, 1.0]) / (log_knots[-1] - log_knots[0]) / _SLOPE_SD
    rows.append(slope)
    values.append(EXPECTED_SLOPE / _SLOPE_SD)
    for j in range(1, knots - 1):
        bend = np.zeros(width)
        bend[j - 1 : j + 2] = np.array([1.0, -2.0, 1.0]) / _BEND_SD
        rows.append(bend)
        values.append(0.0)
    for j in range(knots, width):
        turn = np.zeros(width)
        turn[j] = 1.0 / (_DIRECTION_SD if j < width - ridges else _RIDGE_SD)
        rows.append(turn)
        values.append(0.0)
    design, target = np.array(rows), np.array(values)
    return design.T @ design, design.T @ target


def fit_spectra(
    power: FloatArray,
    averages: float,
    expected: Float32,
    *,
    independent_share: float,
    factor: TextureFactor | None = None,
    start: TextureSpectrum | None = None,
    ridges: tuple[float, ...] | None = None,
    steps: int = 2,
    band: Band = SUPERPIXELS,
    unresolved: NDArray[np.bool_] | None = None,
) -> SpectralFit:
    """Fit texture and noise for every blur and say how well it explains the periodogram.

    Where ridges are found, and none at right angles to the highest one, such a one is tried, too.

    Parameters
    ----------
    power
        float64 (N, N // 2 + 1): average periodogram.
    averages
        What the average is worth.
    expected
        float32 (D, N, N // 2 + 1): the blurs' smeared squared transfer functions, in an order in which neighbours are
        alike (each fit starts from the last).
    independent_share
        Neighbouring frequencies of a tapered window are not independent: the sum over them is multiplied by this.
    factor
        The texture's factor per frequency.
    start
        Texture and noise to start from, whose ridges are kept; without it they are sought for the first blur.
    ridges
        Directions (rad) of the texture's ridges, where they are known: fits that are compared must have the same.
    steps
        Fisher scoring steps for each blur.
    band
        Frequencies that count.
    unresolved
        bool (D,): blurs whose zeros are finer than the window tells apart. Where one of them fits best, it may do so by
        the lines that it draws: ridges along the texture's lines, and at right angles, are tried against it.
    """
    modulus, direction, used = frequencies(power.shape[0], band)
    f, turn = modulus[used], direction[used]
    log_power = np.log(np.maximum(power[used], 1e-16)).astype(np.float32)
    log_expected = np.log(np.maximum(expected[:, used], 1e-9)).astype(np.float32)
    tables = likelihood_tables(averages, factor or TextureFactor())
    # the lowest tenth is noise, or less than texture
    tenth = max(float(np.percentile(power[used], 10)), 1e-16)
    noise = float(np.log(tenth / (0.3 if averages < _FEW_AVERAGES else 1.0)))

    def scan(ridges: tuple[float, ...]) -> tuple[SpectralFit, FloatArray]:
        terms = basis(f, turn, ridges, band)
        precision, pull = _prior(terms.shape[1], band.log_knots, len(ridges))
        arguments = (np.ascontiguousarray(terms.T, np.float32), precision, pull)
        if start is None:
            # least squares where there is more than noise, and at the lowest frequencies in any case
            usable = (log_power > noise + _ABOVE_NOISE) | (f < band.knots[1] * 1.4)
            seen, target = terms[usable], log_power[usable] - log_expected[0, usable]
            first = np.linalg.solve(precision + seen.T @ seen + 1e-6 * np.eye(len(pull)), pull + seen.T @ target)
            _, warm, warm_noise = scan_blurs(
                log_power, log_expected[:1], *arguments, first, noise, noise, 12, independent_share, *tables
            )
            begin = warm[0], float(warm_noise[0])
        else:
            begin = start.coefficients, start.log_noise
        likelihood, coefficients, log_noise = scan_blurs(
            log_power, log_expected, *arguments, *begin, noise, steps, independent_share, *tables
        )
        null = noise_alone(log_power, tables[0], independent_share)
        fit = SpectralFit(likelihood, null, coefficients, log_noise, ridges, band)
        return fit, terms @ coefficients[int(likelihood.argmax())]

    if start is not None:
        return scan(start.ridges)[0]
    if ridges is not None:
        return scan(ridges)[0]
    axis, coherence = _axis(power[used], f, turn)
    fit, texture = scan((axis, axis + np.pi / 2) if coherence >= band.ridges_from else ())
    for _ in range(_RIDGE_ROUNDS if band.more_ridges else 0):
        row = int(fit.log_likelihood.argmax())
        level, left = np.zeros((2, *power.shape))
        level[used] = log_power
        left[used] = log_power - np.logaddexp(texture + log_expected[row], fit.log_noise[row])
        more = _more_ridges(level, left, fit.ridges)
        if not more:
            break
        fit, texture = scan((*fit.ridges, *more))
    row = int(fit.log_likelihood.argmax())
    if unresolved is not None and unresolved[row] and not fit.ridges:
        level, drawn = np.zeros((2, *power.shape))
        level[used], drawn[used] = log_power, log_expected[row]
        lines = ridge_directions(level, (), VISIBLE) or ridge_directions(drawn, (), VISIBLE)[:1]
        tried = with_perpendiculars(lines)
    else:
        tried = with_perpendiculars(fit.ridges, first=1)
    if len(tried) > len(fit.ridges):
        lined = scan(tried)[0]
        if lined.log_likelihood.max() > fit.log_likelihood[row] + _LINES_GAIN:
            return lined
    return fit


def _more_ridges(level: FloatArray, left: FloatArray, known: tuple[float, ...]) -> tuple[float, ...]:
    """Ridges along lines that the best blur leaves unexplained, if there are any, and then along all that are seen.

    ``level`` log power, ``left`` what is left of it, float64 (N, N // 2 + 1). Lines that a right blur explains are the
    aperture's own edges, and no ridges of the texture.
    """
    more = ridge_directions(left, known, UNEXPLAINED)
    return (*more, *ridge_directions(level, (*known, *more), VISIBLE)) if more else ()
