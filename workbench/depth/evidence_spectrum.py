"""How well a blur of each radius explains a region's power spectrum.

The periodogram I(f) of a blurred texture is Gamma distributed about ``S(f) g(f) k(f) + n`` where ``k`` is the blur's
squared transfer function smeared by the taper, ``n`` white noise, and ``S g`` the texture's own spectrum: ``S`` smooth
(piecewise linear in log-log, and with a gentle dependence on direction), ``g`` an unknown factor per frequency. The
factor is what keeps periodic, sparse and text-like textures from breaking the model: it is log-normal with a wide
second component and is integrated out, so that a spectral line, or a gap between lines, counts as a surprise of
bounded size, and what decides is where the blur's zeros leave nothing but noise. ``S`` and ``n`` are fitted anew for
every blur by Fisher scoring, from the fit of the blur before: mostly two steps, one pass over the spectrum each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.special import gammaln

from workbench.depth.compiled import compiled

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]

_SLOPE, _SLOPE_SD = -2.4, 0.8
"""Expected fall of log power with log frequency, over all knots; amplitudes of scenes fall as 1/f (Field 1987)."""
_BEND_SD = 0.8
"""Expected change of that slope from knot to knot, times the knots' distance."""
_DIRECTION_SD = 0.8
_RIDGE_SD, _NO_RIDGE_SD = 2.0, 0.01
"""How steeply a ridge of power along the texture's axis, or across it, may fall off. Wood grain, planks and shelves
hold nearly all of their power within a few frequencies of a line through the origin."""
_COHERENT = 0.5
"""Coherence of the gradients' directions from which on there are ridges; charts, photographs and brick have less."""
_LOW, _STEP, _CELLS = -12.0, 0.125, 256
"""The likelihood is tabulated over log(I/n) and log(S k/n)."""
_ABOVE_NOISE = 1.5
"""Log power over the noise from which on a frequency tells of the texture by itself."""
_LEAST_LOG = -60.0
"""No single frequency may count more against a depth than this: the outlier floor."""
_WORSE, _MOST_HALVINGS = 0.1, 6
"""A scoring step that loses more than so much log-likelihood is halved, at most so often, then not taken."""
_UNSETTLED, _MOST_STEPS = 10.0, 20
"""Where the last step gained more than so much log-likelihood, two more are taken, up to so many in all."""
_SMEARED_AT_ONCE = 8
_AVERAGES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 18.0, 27.0, 40.0)
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
        Of a ridge of power along the texture's axis or across it.
    roll_off
        Log S may fall, or rise, by ``(f / roll_off)^2`` times a coefficient of the order of 1: the texture's own
        softness. 0 for no such term.
    """

    knots: tuple[float, ...] = (0.02, 0.045, 0.09, 0.18, 0.36)
    highest: float = 0.5
    ridge_width: float = 0.012
    roll_off: float = 0.0

    @property
    def log_knots(self) -> FloatArray:
        """Natural logarithms of the knots, float64 (K,)."""
        return np.asarray(np.log(np.array(self.knots)), np.float64)


SUPERPIXELS = Band()
PHOTOSITES = Band((0.01, 0.0225, 0.045, 0.09, 0.18, 0.36), 0.36, 0.006, 0.25)
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
    axis
        Direction (rad) in the frequency plane that holds most of the power; the basis has ridges along and across it.
    band
        Frequencies that were used.
    """

    log_likelihood: FloatArray
    null: float
    coefficients: FloatArray
    log_noise: FloatArray
    axis: float
    band: Band = SUPERPIXELS

    def texture(self, row: int) -> TextureSpectrum:
        """What was fitted for one blur."""
        return TextureSpectrum(self.coefficients[row], float(self.log_noise[row]), self.axis, self.band)


@dataclass(frozen=True, slots=True)
class TextureSpectrum:
    """Texture and noise fitted for one blur: log S on its basis, float64 (P,), log n, and the basis's axis (rad)."""

    coefficients: FloatArray
    log_noise: float
    axis: float
    band: Band = SUPERPIXELS

    def log_power(self, modulus: FloatArray, direction: FloatArray) -> FloatArray:
        """Log S at flattened frequencies, float64 (F,)."""
        return np.asarray(basis(modulus, direction, self.axis, self.band) @ self.coefficients)


def frequencies(size: int, band: Band = SUPERPIXELS) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """|f| and direction on the half plane (N, N // 2 + 1), and which of it is used (each frequency once)."""
    fy, fx = fft.fftfreq(size)[:, np.newaxis], fft.rfftfreq(size)[np.newaxis, :]
    modulus = np.hypot(fy, fx)
    used = (modulus * size >= FIRST_CYCLE) & (modulus <= band.highest) & ~((fx == 0) & (fy < 0))
    return modulus, np.arctan2(fy + 0 * fx, fx + 0 * fy), used


def basis(modulus: FloatArray, direction: FloatArray, axis: float, band: Band = SUPERPIXELS) -> FloatArray:
    """Basis of log S for flattened frequencies, float64 (F, P).

    Radial hats, gentle turns, the roll-off where the band has one, ridges along and across.
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
    away = (modulus * np.sin(direction - axis), modulus * np.cos(direction - axis))
    ridges = [-np.log1p((f / band.ridge_width) ** 2) for f in away]
    soft = [-((np.minimum(modulus, band.highest) / band.roll_off) ** 2)] if band.roll_off else []
    return np.concatenate([hats, np.stack(turns + soft + ridges, axis=1)], axis=1)


def _axis(power: FloatArray, modulus: FloatArray, direction: FloatArray) -> tuple[float, float]:
    """Direction (rad) of most of the gradients' power, and how far it prevails (0 to 1: the tensor's coherence).

    The structure tensor of Bigun and Granlund (1987), taken in the frequency plane.
    """
    weight = np.maximum(power - np.percentile(power, 25), 0.0) * modulus**2
    turn = complex((weight * np.exp(2j * direction)).sum())
    return 0.5 * float(np.angle(turn)), abs(turn) / max(float(weight.sum()), 1e-30)


def _prior(width: int, log_knots: FloatArray, ridge_sd: float) -> tuple[FloatArray, FloatArray]:
    """Precision and precision times mean of the Gaussian prior on the basis's coefficients."""
    knots = log_knots.size
    rows, values = [], []
    slope = np.zeros(width)
    slope[[0, knots - 1]] = np.array([-1.0, 1.0]) / (log_knots[-1] - log_knots[0]) / _SLOPE_SD
    rows.append(slope)
    values.append(_SLOPE / _SLOPE_SD)
    for j in range(1, knots - 1):
        bend = np.zeros(width)
        bend[j - 1 : j + 2] = np.array([1.0, -2.0, 1.0]) / _BEND_SD
        rows.append(bend)
        values.append(0.0)
    for j in range(knots, width):
        turn = np.zeros(width)
        turn[j] = 1.0 / (_DIRECTION_SD if j < width - 2 else ridge_sd)
        rows.append(turn)
        values.append(0.0)
    design, target = np.array(rows), np.array(values)
    return design.T @ design, design.T @ target


def smeared_power(kernel_lags: Float32, taper_lags: FloatArray, size: int) -> Float32:
    """Expected periodogram of white texture behind each blur.

    Parameters
    ----------
    kernel_lags
        float32 (D, 2 L + 1, 2 L + 1): autocorrelation of each PSF.
    taper_lags
        float64 (2 L + 1, 2 L + 1).
    size
        Window side N; lags beyond it fold over, as sampling the spectrum at N frequencies makes them.

    Returns
    -------
    float32 (D, N, N // 2 + 1).
    """
    longest = kernel_lags.shape[1] // 2
    reach = min(longest, size - 1)  # the taper has no longer lags
    part = slice(longest - reach, longest + reach + 1)
    taper = taper_lags[part, part].astype(np.float32)
    power = np.empty((kernel_lags.shape[0], size, size // 2 + 1), np.float32)
    # a few blurs at a time, as many as the processor's cache holds
    unfolded = np.zeros((_SMEARED_AT_ONCE, 2 * size, 2 * size), np.float32)
    middle = unfolded[:, size - reach : size + reach + 1, size - reach : size + reach + 1]
    for first in range(0, len(power), _SMEARED_AT_ONCE):
        count = min(_SMEARED_AT_ONCE, len(power) - first)
        np.multiply(kernel_lags[first : first + count, part, part], taper, out=middle[:count])
        rows = unfolded[:count, :size] + unfolded[:count, size:]
        power[first : first + count] = fft.rfft2(rows[:, :, :size] + rows[:, :, size:], axes=(1, 2)).real
    return power


def mixed_power(expected: Float32, radius_px: FloatArray, spread_px: float) -> Float32:
    """Expected periodogram where all blurs up to ``spread_px`` smaller or larger than one another occur side by side.

    Parameters
    ----------
    expected
        float32 (D, N, N // 2 + 1): :func:`smeared_power` of each blur.
    radius_px
        float64 (D,): their radii, evenly spaced; |radius| counts, so that blurs of both sides of focus may mix.
    spread_px
        Half the range of radii in a mixture.

    Returns
    -------
    float32 (M, N, N // 2 + 1)
        Mixtures about every third radius.
    """
    radius = np.abs(radius_px)
    step = float(np.median(np.abs(np.diff(radius))))
    order = np.argsort(radius)
    ascending = radius[order]
    middles = ascending[::3][ascending[::3] <= ascending[-1] - 0.5 * spread_px]
    offsets = np.arange(-spread_px, spread_px + 0.5 * step, step)
    # both sides of focus where rows are signed: the nearest row of that |radius| will do
    nearest = np.abs(np.abs(middles[:, np.newaxis] + offsets)[:, :, np.newaxis] - ascending).argmin(axis=2)
    share = np.zeros((middles.size, radius.size), np.float32)
    np.add.at(share, (np.arange(middles.size)[:, np.newaxis], order[nearest]), np.float32(1.0 / offsets.size))
    return np.asarray((share @ expected.reshape(radius.size, -1)).reshape(middles.size, *expected.shape[1:]))


@lru_cache(maxsize=64)
def _tables(averages: float, spread: float, wide_share: float, wide_spread: float) -> tuple[Float32, ...]:
    """Log density of log I, its slopes in log(S k) and log n, and the Fisher information, over the table's grid."""
    grid = _LOW + _STEP * np.arange(_CELLS)
    # the mean is n (1 + exp(b + log g)): one function of b + log g, averaged over log g by a matrix product
    tail = 4.0 * wide_spread
    shifted = np.arange(_LOW - tail, grid[-1] + tail, _STEP)
    excess = grid[:, np.newaxis] - np.logaddexp(shifted, 0.0)
    log_gamma = averages * (excess - np.exp(np.minimum(excess, 30.0)) + np.log(averages)) - gammaln(averages)
    distance = shifted[:, np.newaxis] - grid
    kernel = (1.0 - wide_share) * _normal(distance, spread) + wide_share * _normal(distance, wide_spread)
    table = np.log(np.exp(log_gamma) @ kernel + 1e-300)
    table = np.maximum(table, _LEAST_LOG)
    by_signal = np.gradient(table, _STEP, axis=1)
    by_noise = -np.gradient(table, _STEP, axis=0) - by_signal
    density = np.exp(table)
    density /= density.sum(axis=0, keepdims=True)
    information = [(density * a * b).sum(axis=0) for a, b in
                   ((by_signal, by_signal), (by_signal, by_noise), (by_noise, by_noise))]  # fmt: skip
    tables = (table, by_signal, by_noise, *information)
    # subnormal numbers would cost a hundred times as much as zero, and say no more
    return tuple(np.ascontiguousarray(np.where(np.abs(t) < 1e-20, 0.0, t), np.float32) for t in tables)


def _normal(distance: FloatArray, spread: float) -> FloatArray:
    """Normal density on the grid, each column of unit sum."""
    weight = np.exp(-0.5 * (distance / spread) ** 2)
    return np.asarray(weight / weight.sum(axis=0), np.float64)


@dataclass(frozen=True, slots=True)
class TextureFactor:
    """Distribution of the unknown factor g per frequency: standard deviation of its logarithm, and of a second part."""

    spread: float = 0.5
    wide_share: float = 0.1
    wide_spread: float = 2.5


def fit_spectra(
    power: FloatArray,
    averages: float,
    expected: Float32,
    *,
    correlation: float = 0.3,
    factor: TextureFactor | None = None,
    start: tuple[FloatArray, float] | None = None,
    steps: int = 2,
    band: Band = SUPERPIXELS,
) -> SpectralFit:
    """Fit texture and noise for every blur and say how well it explains the periodogram.

    Parameters
    ----------
    power
        float64 (N, N // 2 + 1): average periodogram.
    averages
        What the average is worth.
    expected
        float32 (D, N, N // 2 + 1): the blurs' smeared squared transfer functions, in an order in which neighbours are
        alike (each fit starts from the last).
    correlation
        Neighbouring frequencies of a tapered window are not independent; the log-likelihood is multiplied by this.
    factor
        The texture's factor per frequency.
    start
        Coefficients and log noise to start from; without them they are sought for the first blur.
    steps
        Fisher scoring steps for each blur.
    band
        Frequencies that count.
    """
    factor = factor or TextureFactor()
    size = power.shape[0]
    modulus, direction, used = frequencies(size, band)
    axis, coherence = _axis(power[used], modulus[used], direction[used])
    terms = basis(modulus[used], direction[used], axis, band)
    log_power = np.log(np.maximum(power[used], 1e-16)).astype(np.float32)
    log_expected = np.log(np.maximum(expected[:, used], 1e-9)).astype(np.float32)
    worth = min(_AVERAGES, key=lambda a: abs(np.log(a / max(averages, 1.0))))
    tables = _tables(worth, factor.spread, factor.wide_share, factor.wide_spread)
    # ridges where one direction prevails only: elsewhere they lead the few scoring steps astray
    precision, pull = _prior(terms.shape[1], band.log_knots, _RIDGE_SD if coherence > _COHERENT else _NO_RIDGE_SD)
    # the lowest tenth is noise, or less than texture: single periodograms scatter far below their mean
    noise = float(np.log(max(float(np.percentile(power[used], 10)), 1e-16) / (0.3 if worth < 4 else 1.0)))
    arguments = (np.ascontiguousarray(terms.T, np.float32), precision, pull)
    if start is None:
        # least squares where there is more than noise, and at the lowest frequencies in any case
        usable = (log_power > noise + _ABOVE_NOISE) | (modulus[used] < band.knots[1] * 1.4)
        seen, target = terms[usable], log_power[usable] - log_expected[0, usable]
        first = np.linalg.solve(precision + seen.T @ seen + 1e-6 * np.eye(len(pull)), pull + seen.T @ target)
        _, warm, warm_noise = _scan(
            log_power, log_expected[:1], *arguments, first, noise, noise, 12, correlation, *tables
        )
        start = warm[0], float(warm_noise[0])
    likelihood, coefficients, log_noise = _scan(
        log_power, log_expected, *arguments, *start, noise, steps, correlation, *tables
    )
    return SpectralFit(likelihood, _noise_alone(log_power, tables[0], correlation), coefficients, log_noise, axis, band)


def _noise_alone(log_power: Float32, table: Float32, correlation: float) -> float:
    column = table[:, 0].astype(np.float64)
    grid = _LOW + _STEP * np.arange(_CELLS)
    level = np.log(np.mean(np.exp(log_power.astype(np.float64))))
    trials = [float(np.interp(log_power - level - shift, grid, column).sum()) for shift in (-0.4, -0.2, 0.0, 0.2)]
    return correlation * max(trials)


@compiled
def _scan(
    log_power: Float32,
    log_expected: Float32,
    columns: Float32,
    precision: FloatArray,
    pull: FloatArray,
    start: FloatArray,
    start_noise: float,
    prior_noise: float,
    steps: int,
    correlation: float,
    table: Float32,
    by_signal: Float32,
    by_noise: Float32,
    info_ss: Float32,
    info_sn: Float32,
    info_nn: Float32,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    # Loops over frequencies are innermost and plain, one array at a time: so they become vector instructions.
    blurs, count = log_expected.shape
    p = columns.shape[0]
    cells = table.shape[0]
    likelihood, coefficients, noises = np.zeros(blurs), np.zeros((blurs, p)), np.zeros(blurs)
    theta, log_noise = start.copy(), start_noise
    gradient, hessian, towards = np.zeros(p + 1), np.zeros((p + 1, p + 1)), np.zeros(p)
    signal, slope, slope_noise = np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
    ss, sn, nn = np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
    weighted = np.zeros(count, np.float32)
    kept, kept_noise = theta.copy(), log_noise
    for d in range(blurs):
        taken, wanted, halved, best = 0, steps, 0, -np.inf
        while True:
            signal[:] = log_expected[d]
            for j in range(p):
                factor = np.float32(theta[j])
                column = columns[j]
                for f in range(count):
                    signal[f] += factor * column[f]
            total = 0.0
            for f in range(count):
                y = min(max((log_power[f] - log_noise - _LOW) / _STEP, 0.0), cells - 1.001)
                x = min(max((signal[f] - log_noise - _LOW) / _STEP, 0.0), cells - 1.001)
                y0, x0 = int(y), int(x)
                y -= y0
                x -= x0
                w00, w01, w10, w11 = (1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x
                total += (
                    w00 * table[y0, x0] + w01 * table[y0, x0 + 1]
                    + w10 * table[y0 + 1, x0] + w11 * table[y0 + 1, x0 + 1]
                )  # fmt: skip
                if taken < wanted:
                    slope[f] = (
                        w00 * by_signal[y0, x0] + w01 * by_signal[y0, x0 + 1]
                        + w10 * by_signal[y0 + 1, x0] + w11 * by_signal[y0 + 1, x0 + 1]
                    )  # fmt: skip
                    slope_noise[f] = (
                        w00 * by_noise[y0, x0] + w01 * by_noise[y0, x0 + 1]
                        + w10 * by_noise[y0 + 1, x0] + w11 * by_noise[y0 + 1, x0 + 1]
                    )  # fmt: skip
                    ss[f], sn[f], nn[f] = info_ss[x0], info_sn[x0], info_nn[x0]
            total *= correlation
            for j in range(p):
                left = pull[j]
                for k in range(p):
                    left -= precision[j, k] * theta[k]
                towards[j] = left
                total += 0.5 * theta[j] * (pull[j] + left)
            total -= 0.25 * (log_noise - prior_noise) ** 2
            if total < best - _WORSE:  # the last step went too far
                halved += 1
                if halved > _MOST_HALVINGS:
                    theta[:], log_noise, total = kept, kept_noise, best
                    break
                theta[:] = 0.5 * (theta + kept)
                log_noise = 0.5 * (log_noise + kept_noise)
                continue
            if taken == wanted:
                if total - best < _UNSETTLED or wanted >= _MOST_STEPS:
                    break
                wanted += 2
                continue
            kept[:], kept_noise, best = theta, log_noise, total
            for j in range(p):
                column = columns[j]
                gradient[j] = _dot(slope, column)
                hessian[p, j] = _dot(sn, column)
                for f in range(count):
                    weighted[f] = ss[f] * column[f]
                for k in range(j + 1):
                    hessian[j, k] = _dot(weighted, columns[k])
            gradient[p] = slope_noise.sum()
            hessian[p, p] = nn.sum()
            gradient *= correlation
            hessian *= correlation
            gradient[:p] += towards
            gradient[p] -= 0.5 * (log_noise - prior_noise)
            hessian[p, p] += 0.5
            for j in range(p):
                for k in range(j + 1):
                    hessian[j, k] += precision[j, k]
            for j in range(p + 1):
                hessian[j, j] = 1.02 * hessian[j, j] + 1e-3
            _solve(hessian, gradient)
            shorter = min(1.0, 2.0 / max(float(np.abs(gradient).max()), 1e-9))
            theta += shorter * gradient[:p]
            log_noise += shorter * float(gradient[p])
            taken, halved = taken + 1, 0
        likelihood[d], noises[d] = total, log_noise
        coefficients[d] = theta
    return likelihood, coefficients, noises


@compiled
def _dot(first: Float32, second: Float32) -> float:
    total = np.float32(0.0)
    for f in range(first.shape[0]):
        total += first[f] * second[f]
    return float(total)


@compiled
def _solve(lower: FloatArray, vector: FloatArray) -> None:
    """Solve a positive definite system in place (Cholesky); only the lower triangle is read."""
    n = vector.shape[0]
    for i in range(n):
        for j in range(i + 1):
            left = lower[i, j]
            for k in range(j):
                left -= lower[i, k] * lower[j, k]
            if i == j:
                lower[i, i] = np.sqrt(max(left, 1e-12))
            else:
                lower[i, j] = left / lower[j, j]
    for i in range(n):
        for k in range(i):
            vector[i] -= lower[i, k] * vector[k]
        vector[i] /= lower[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            vector[i] -= lower[k, i] * vector[k]
        vector[i] /= lower[i, i]
