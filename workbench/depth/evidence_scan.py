"""The likelihood of a periodogram under each blur, its texture and noise fitted by Fisher scoring.

Its tables integrate the texture's unknown factor out; its loops are what the whole method's time goes into.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from workbench.compiled import compiled

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]

_LOW, _STEP, _CELLS = -12.0, 0.125, 256
"""The likelihood is tabulated over log(I/n) and log(S k/n)."""
_LEAST_LOG = -60.0
"""No single frequency may count more against a depth than this: the outlier floor."""
_AVERAGES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 18.0, 27.0, 40.0)
_WORSE, _MOST_HALVINGS = 0.1, 6
"""A scoring step that loses more than so much log-likelihood is halved, at most so often, then not taken."""
_UNSETTLED, _MOST_STEPS = 10.0, 20
"""Where the last step gained more than so much log-likelihood, two more are taken, up to so many in all."""
_FARTHER = 2.0
"""Long and plain steps take turns, the last one plain; a long one goes so many times as far. Textures scatter more than
the expected information foresees, plain steps are too short for them, and steps of two lengths settle faster than
steps of either (Young 1953)."""
_MOST_CHANGE = 2.0
"""No step changes a coefficient by more than this."""
_FAINTEST = 6.0
"""Log noise isn't sought farther below what was expected: beyond the tables' end everything would fit."""
_AT_ONCE = 512
"""Frequencies, as many as the processor's fastest cache holds."""


@dataclass(frozen=True, slots=True)
class TextureFactor:
    """Distribution of the unknown factor g per frequency: standard deviation of its logarithm, and of a second part."""

    spread: float = 0.5
    wide_share: float = 0.1
    wide_spread: float = 2.5


def likelihood_tables(averages: float, factor: TextureFactor) -> tuple[Float32, ...]:
    """What :func:`scan_blurs` looks up for an average of about so many periodograms.

    Returns
    -------
    table
        float32 (C, C), rows over log(I / n), columns over log(S k / n): log density of log I.
    info_ss, info_sn, info_nn
        float32 (C,): Fisher information on the two, over log(S k / n).
    """
    worth = min(_AVERAGES, key=lambda a: abs(np.log(a / max(averages, 1.0))))
    return _tables(worth, factor.spread, factor.wide_share, factor.wide_spread)


@lru_cache(maxsize=64)
def _tables(averages: float, spread: float, wide_share: float, wide_spread: float) -> tuple[Float32, ...]:
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
    tables = (table, *information)
    # subnormal numbers would cost a hundred times as much as zero, and say no more
    return tuple(np.ascontiguousarray(np.where(np.abs(t) < 1e-20, 0.0, t), np.float32) for t in tables)


def _normal(distance: FloatArray, spread: float) -> FloatArray:
    """Normal density on the grid, each column of unit sum."""
    weight = np.exp(-0.5 * (distance / spread) ** 2)
    return np.asarray(weight / weight.sum(axis=0), np.float64)


def noise_alone(log_power: Float32, table: Float32, independent_share: float) -> float:
    """Log-likelihood of a periodogram, its logarithm float32 (F,), without any texture."""
    column = table[:, 0].astype(np.float64)
    grid = _LOW + _STEP * np.arange(_CELLS)
    level = np.log(np.mean(np.exp(log_power.astype(np.float64))))
    trials = [float(np.interp(log_power - level - shift, grid, column).sum()) for shift in (-0.4, -0.2, 0.0, 0.2)]
    return independent_share * max(trials)


@compiled
def scan_blurs(
    log_power: Float32,
    log_expected: Float32,
    columns: Float32,
    precision: FloatArray,
    pull: FloatArray,
    start: FloatArray,
    start_noise: float,
    prior_noise: float,
    steps: int,
    independent_share: float,
    table: Float32,
    info_ss: Float32,
    info_sn: Float32,
    info_nn: Float32,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit texture and noise for one blur after another.

    Parameters
    ----------
    log_power
        float32 (F,): log of the periodogram.
    log_expected
        float32 (D, F): log of what each blur makes of white texture.
    columns
        float32 (P, F): basis of log S.
    precision, pull
        float64 (P, P) and (P,): the prior's precision, and that times its mean.
    start, start_noise
        float64 (P,) coefficients and log noise from where the first blur's fit sets out; the next one's from its end.
    prior_noise
        Log noise expected beforehand.
    steps
        Fisher scoring steps for each blur; more where they haven't settled.
    independent_share
        The sum over the frequencies is multiplied by this.
    table, info_ss, info_sn, info_nn
        :func:`likelihood_tables`.

    Returns
    -------
    log_likelihood, coefficients, log_noise
        float64 (D,), (D, P) and (D,).
    """
    blurs = log_expected.shape[0]
    p = columns.shape[0]
    likelihood, coefficients, noises = np.zeros(blurs), np.zeros((blurs, p)), np.zeros(blurs)
    theta, log_noise = start.copy(), start_noise
    gradient, hessian, towards = np.zeros(p + 1), np.zeros((p + 1, p + 1)), np.zeros(p)
    flat = table.ravel()
    work = np.zeros((5, _AT_ONCE), np.float32)
    kept, kept_noise = theta.copy(), log_noise
    for d in range(blurs):
        taken, wanted, halved, best = 0, steps, 0, -np.inf
        while True:
            total = independent_share * _terms(
                log_power, log_expected[d], columns, theta, log_noise, taken < wanted,
                flat, info_ss, info_sn, info_nn, gradient, hessian, work,
            )  # fmt: skip
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
            gradient *= independent_share
            gradient[:p] += towards
            gradient[p] -= 0.5 * (log_noise - prior_noise)
            hessian *= independent_share
            hessian[p, p] += 0.5
            for j in range(p):
                for k in range(j + 1):
                    hessian[j, k] += precision[j, k]
            for j in range(p + 1):
                hessian[j, j] = 1.02 * hessian[j, j] + 1e-3
            _solve(hessian, gradient)
            stride = min(
                1.0 if (wanted - taken) % 2 else _FARTHER, _MOST_CHANGE / max(float(np.abs(gradient).max()), 1e-9)
            )
            theta += stride * gradient[:p]
            log_noise = max(log_noise + stride * float(gradient[p]), prior_noise - _FAINTEST)
            taken, halved = taken + 1, 0
        likelihood[d], noises[d] = total, log_noise
        coefficients[d] = theta
    return likelihood, coefficients, noises


@compiled
def _terms(
    log_power: Float32,
    log_expected: Float32,
    columns: Float32,
    theta: FloatArray,
    log_noise: float,
    derivatives: bool,
    table: Float32,
    info_ss: Float32,
    info_sn: Float32,
    info_nn: Float32,
    gradient: FloatArray,
    hessian: FloatArray,
    work: Float32,
) -> float:
    # Log-likelihood of all frequencies; if derivatives are wanted, its gradient and the information's lower triangle.
    # As many frequencies at a time as the processor's fastest cache holds, innermost loops plain, one array at a time
    # and in single precision: so they become vector instructions.
    p, count = columns.shape
    cells = np.int32(_CELLS)
    nought, half, last = np.float32(0.0), np.float32(0.5), np.float32(_CELLS - 1.001)
    finer, lowest = np.float32(1.0 / _STEP), np.float32(log_noise + _LOW)
    gradient[:] = 0.0
    hessian[:] = 0.0
    total = 0.0
    for first in range(0, count, _AT_ONCE):
        beyond = min(first + _AT_ONCE, count)
        many = beyond - first
        x, slope, ss, sn, weighted = work[0, :many], work[1, :many], work[2, :many], work[3, :many], work[4, :many]
        x[:] = log_expected[first:beyond]
        for j in range(p):
            factor, column = np.float32(theta[j]), columns[j, first:beyond]
            for f in range(many):
                x[f] += factor * column[f]
        power, by_noise = log_power[first:beyond], nought
        for f in range(many):
            height, place = (power[f] - lowest) * finer, (x[f] - lowest) * finer
            # by comparisons, which let NaN fall to 0: min and max would pass it on, as an index out of bounds
            height, place = height if height > nought else nought, place if place > nought else nought
            height, place = height if height < last else last, place if place < last else last
            x[f] = place
            y0, x0 = np.int32(height), np.int32(place)
            up, right = height - np.float32(y0), place - np.float32(x0)
            cell = y0 * cells + x0
            corner, beside, above, across = table[cell], table[cell + 1], table[cell + cells], table[cell + cells + 1]
            lower, upper = corner + right * (beside - corner), above + right * (across - above)
            total += lower + up * (upper - lower)
            slope[f] = ((beside - corner) + up * (across - above - beside + corner)) * finer
            by_noise -= (upper - lower) * finer + slope[f]
        if not derivatives:
            continue
        gradient[p] += by_noise
        noise_information = nought
        for f in range(many):  # the nearest entry will do: only the way to the maximum depends on it
            x0 = np.int32(x[f] + half)
            ss[f], sn[f] = info_ss[x0], info_sn[x0]
            noise_information += info_nn[x0]
        hessian[p, p] += noise_information
        for j in range(p):
            column = columns[j, first:beyond]
            gradient[j] += _dot(slope, column)
            hessian[p, j] += _dot(sn, column)
            for f in range(many):
                weighted[f] = ss[f] * column[f]
            for k in range(j + 1):
                hessian[j, k] += _dot(weighted, columns[k, first:beyond])
    return total


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
