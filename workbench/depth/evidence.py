"""Depth by evidence: the posterior over signed blur radius from a region's spectrum and its sparseness.

1. The region is covered with tapered windows; their periodograms are pooled (:mod:`~workbench.depth.evidence_windows`).
2. For every |radius| on a fine grid, texture and noise are fitted and the likelihood of the spectrum is taken
   (:mod:`~workbench.depth.evidence_spectrum`). It can't tell the side of focus.
3. Near the likelihood's modes, restorations with both sides' PSFs are compared (:mod:`~workbench.depth.evidence_side`).
4. Both join in one posterior over the signed radius, which is linear in 1/depth. It is tempered and widened by what was
   learned from the bank, by the lens fit's standard errors, and by a share for what no model foresees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.interpolate import CubicSpline
from scipy.special import expit

from calibration.bank import Bank
from calibration.image import LinearImage
from calibration.pupil import PsfModel, PupilModel, psf_model
from workbench.depth.estimate import DepthEstimate, Status
from workbench.depth.evidence_side import FAMILIES, sparseness
from workbench.depth.evidence_spectrum import SpectralFit, TextureFactor, fit_spectra, smeared_power
from workbench.depth.evidence_windows import Window, place_windows, pooled_periodogram

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class EvidenceOptions:
    """What may be chosen.

    Attributes
    ----------
    windows
        Sides of windows to try, largest first.
    least_weight
        A window is used if the region leaves it this share of a full taper's energy.
    margin
        Strip along the region's edge that is kept out, as a fraction of the root of its area ...
    margin_px
        ... but at most this many pixels.
    radius_step_px
        Step of the grid of radii.
    side_windows
        Windows that are deconvolved, at most.
    ambiguous_below
        With less probability than this in the best mode a region is ambiguous.
    least_evidence
        Log-likelihood that texture must gain over noise alone.
    max_saturated
        Larger fractions of saturated pixels refuse the region.
    texture
        Distribution of the texture's factor per frequency.
    """

    windows: tuple[int, ...] = (128, 64)
    least_weight: float = 0.3
    margin: float = 0.04
    margin_px: float = 24.0
    radius_step_px: float = 0.3
    side_windows: int = 9
    ambiguous_below: float = 0.95
    least_evidence: float = 12.0
    max_saturated: float = 0.1
    texture: TextureFactor = TextureFactor()


@dataclass(frozen=True, slots=True)
class Learned:
    """What is learned from the bank; the defaults are sane for any.

    Attributes
    ----------
    temperature
        Factor on the spectral log-likelihood.
    side_weights
        Log-odds per unit of each family's feature at 128 x 128 pixels.
    side_power
        The log-odds grow with the number of pixels to this power.
    floor_px
        Standard error of the radius that no evidence undercuts.
    outlier
        Probability that the whole spectral reasoning fails.
    """

    temperature: float = 0.6
    side_weights: tuple[float, ...] = (25.0, 10.0, 10.0, 5.0, 5.0, 5.0)
    side_power: float = 0.4
    floor_px: float = 0.03
    outlier: float = 0.003


@dataclass(frozen=True, slots=True)
class DepthModel:
    """A bank made ready for measuring.

    Attributes
    ----------
    psfs
        PSF at any depth.
    sigma_px
        float64 (G,): ascending grid of signed radii.
    depths_mm
        float64 (G,): their depths.
    row_of
        intp (G,): row of ``kernel_lags`` for each signed radius.
    row_radius_px
        float64 (R,): |radius| of each row, or the signed one where the sides are not mirror images.
    kernel_lags
        float32 (R, 2 L + 1, 2 L + 1): autocorrelations of the PSFs, their error included.
    sigma_se_px
        float64 (G,): standard error of the radius from the lens fit.
    """

    psfs: PsfModel
    sigma_px: FloatArray
    depths_mm: FloatArray
    row_of: NDArray[np.intp]
    row_radius_px: FloatArray
    kernel_lags: NDArray[np.float32]
    sigma_se_px: FloatArray

    def depth_mm(self, sigma_px: float) -> float:
        """Depth of a signed radius."""
        far, near = self.psfs.radius_px(1e12), self.psfs.radius_px(1.0)
        return (near - far) / (sigma_px - far)


def prepare(bank: Bank, options: EvidenceOptions, field_index: int | None = None) -> DepthModel:
    """Compute the autocorrelations of a bank's PSFs on a fine grid of radii.

    The grid reaches half a pixel of radius beyond the bank's planes, so that a depth at their end has two sides.
    """
    psfs = psf_model(bank, field_index)
    nearest, farthest = psfs.radius_px(float(bank.depths_mm[0])), psfs.radius_px(float(bank.depths_mm[-1]))
    step = options.radius_step_px
    low, high = int(np.floor((nearest - 0.5) / step)), int(np.ceil((farthest + 0.5) / step))
    index = np.arange(low, high + 1)
    sigma = (index + 0.5) * step
    symmetric = isinstance(psfs, PupilModel)
    key = np.where(index < 0, -1 - index, index) if symmetric else index
    rows, row_of = np.unique(key, return_inverse=True)
    if symmetric:
        # the sharper of both ends gives the row's PSF; near side exists for all radii in most set-ups
        row_sigma = np.array([sigma[np.flatnonzero(key == r)[0]] for r in rows])
    else:
        row_sigma = sigma
    model = DepthModel(psfs, sigma, np.zeros(0), row_of, np.abs(row_sigma) if symmetric else row_sigma,
                       np.zeros((0, 0, 0), np.float32), np.zeros(0))  # fmt: skip
    size = int(bank.psf.shape[2]) + 4
    error = float(np.clip(np.nanmedian(psfs.residual), 0.01, 0.2))
    lags = np.stack([_autocorrelation(psfs.psf_at(model.depth_mm(float(s)), size), error) for s in row_sigma])
    depths = np.array([model.depth_mm(float(s)) for s in sigma])
    lens = bank.lens
    se = np.hypot(lens.scale_se_px * (1.0 - lens.focus_mm / depths), lens.scale_px * lens.focus_se_mm / depths)
    return DepthModel(psfs, sigma, depths, row_of, model.row_radius_px, lags, se)


def _autocorrelation(psf: NDArray[np.float32], error: float) -> NDArray[np.float32]:
    k = psf.shape[0]
    size = fft.next_fast_len(2 * k, real=True)
    lags = fft.irfft2(np.abs(fft.rfft2(psf.astype(np.float64), s=(size, size))) ** 2, s=(size, size))
    index = np.arange(-(k - 1), k) % size
    lags = lags[np.ix_(index, index)]
    lags[k - 1, k - 1] *= 1.0 + error**2  # the PSF's own error, white for want of better knowledge
    return np.asarray(lags, np.float32)


def estimate_evidence(
    image: LinearImage, bank: Bank, labels: NDArray[np.int32], options: EvidenceOptions | None = None
) -> dict[int, DepthEstimate]:
    """Depth of each region of an image.

    Parameters
    ----------
    image
        Developed like the bank.
    bank
        PSFs and lens fit.
    labels
        int32 (H, W): region of each pixel, 0 = none.
    options
        Defaults as described there.

    Returns
    -------
    dict
        :class:`DepthEstimate` by label; its ``score`` is the posterior's probability per grid depth.
    """
    options = options or EvidenceOptions()
    model, learned = prepare(bank, options), learned_of(bank)
    plane = image.luminance
    return {
        int(label): measure_region(plane, image.saturated, labels == label, model, learned, options)
        for label in np.unique(labels[labels > 0])
    }


def learned_of(bank: Bank) -> Learned:
    """What the bank holds of :class:`Learned`, or its defaults."""
    stored = bank.extras.get("evidence_learned")
    if stored is None or len(stored) != 4 + len(FAMILIES):
        return Learned()
    return Learned(
        temperature=float(stored[0]),
        side_power=float(stored[1]),
        floor_px=float(stored[2]),
        outlier=float(stored[3]),
        side_weights=tuple(float(w) for w in stored[4:]),
    )


@dataclass(frozen=True, slots=True)
class Observation:
    """What a region's pixels say, before anything learned is applied."""

    windows: list[Window]
    fit: SpectralFit
    pixels: float
    """Pixels' worth of information: sum of the squared tapers' weights."""


def observe(plane: NDArray[np.float32], mask: Mask, model: DepthModel, options: EvidenceOptions) -> Observation | None:
    """Pool the region's windows and fit every blur; None where no window fits."""
    margin = min(options.margin_px, options.margin * float(np.sqrt(mask.sum())))
    for size in options.windows:
        windows = place_windows(mask, size, margin_px=margin, ramp_px=12.0, least_weight=options.least_weight)
        if sum(w.weight for w in windows) >= 0.7:
            break
    else:
        return None
    pooled = pooled_periodogram(plane, windows, model.kernel_lags.shape[1] // 2)
    expected = smeared_power(model.kernel_lags, pooled.taper_lags, size)
    averages = max(1.0, 0.7 * pooled.averages)
    fit = fit_spectra(pooled.power, averages, expected, factor=options.texture)
    pixels = sum(w.weight for w in windows) * size * size * 0.25  # half overlap both ways: each pixel counts fourfold
    return Observation(windows, fit, max(pixels, size * size * windows[0].weight))


def side_features(
    plane: NDArray[np.float32], seen: Observation, row: int, model: DepthModel, options: EvidenceOptions
) -> FloatArray:
    """How much sparser the far side's restoration is than the near side's, per filter family; float64 (F,)."""
    radius = abs(float(model.row_radius_px[row]))
    size = int((model.kernel_lags.shape[1] + 1) // 2)
    psfs = []
    for sign in (1.0, -1.0):
        if sign * radius < model.psfs.radius_px(1e12) * 0.98:
            psfs.append(model.psfs.psf_at(model.depth_mm(sign * radius), size))
        else:
            psfs.append(psfs[0][::-1, ::-1] if psfs else model.psfs.psf_at(model.depth_mm(-radius), size)[::-1, ::-1])
    chosen = seen.windows[:: max(1, len(seen.windows) // options.side_windows)][: options.side_windows]
    far, near = sparseness(plane, chosen, psfs, seen.fit.coefficients[row], float(seen.fit.log_noise[row]))
    return np.asarray(near - far, np.float64)


def measure_region(
    plane: NDArray[np.float32],
    saturated: Mask,
    mask: Mask,
    model: DepthModel,
    learned: Learned,
    options: EvidenceOptions,
) -> DepthEstimate:
    """Depth of one region; see :func:`estimate_evidence`."""
    pixels = int(mask.sum())
    clipped = float((saturated & mask).sum()) / max(pixels, 1)
    if clipped > options.max_saturated:
        return _refused(model, "saturated", pixels, f"{clipped:.0%} of its pixels are saturated; expose less")
    usable = mask & ~saturated if clipped > 0.002 else mask
    seen = observe(plane, usable, model, options)
    if seen is None:
        return _refused(model, "no-texture", pixels, f"too small or too thin for a window of {options.windows[-1]} px")
    gain = float(seen.fit.log_likelihood.max()) - seen.fit.null
    if gain < options.least_evidence:
        return _refused(model, "no-texture", pixels, "no texture above the noise")
    return _conclude(plane, seen, model, learned, options)


def _refused(model: DepthModel, status: Status, pixels: int, reason: str) -> DepthEstimate:
    nan = float("nan")
    flat = np.full(model.depths_mm.size, 1.0 / model.depths_mm.size)
    return DepthEstimate(nan, (nan, nan), 0.0, nan, nan, status, model.depths_mm, flat, nan, pixels, reason)


def _conclude(
    plane: NDArray[np.float32], seen: Observation, model: DepthModel, learned: Learned, options: EvidenceOptions
) -> DepthEstimate:
    log_rows = learned.temperature * seen.fit.log_likelihood
    odds = np.zeros(log_rows.size)
    modes = _modes(log_rows)
    scale = (seen.pixels / 16384.0) ** learned.side_power
    features = {row: side_features(plane, seen, row, model, options) for row in modes}
    for row in range(log_rows.size):
        nearest = min(modes, key=lambda m: abs(m - row))
        odds[row] = scale * float(features[nearest] @ np.array(learned.side_weights))
    fine, log_post = _signed_posterior(log_rows, odds, model)
    return summarise(fine, log_post, seen, model, learned, options)


def _modes(log_rows: FloatArray, depth: float = 12.0, most: int = 3) -> list[int]:
    """Rows of the highest local maxima that are within ``depth`` of the best."""
    padded = np.concatenate([[-np.inf], log_rows, [-np.inf]])
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    peaks = peaks[log_rows[peaks] > log_rows.max() - depth]
    return [int(p) for p in peaks[np.argsort(-log_rows[peaks])][:most]]


_FINER = 8


def _signed_posterior(log_rows: FloatArray, odds: FloatArray, model: DepthModel) -> tuple[FloatArray, FloatArray]:
    """Unnormalised log posterior over a finer grid of signed radii."""
    sigma = model.sigma_px
    log_side = np.where(sigma > 0, 1.0, -1.0) * odds[model.row_of]
    mirrored = np.bincount(model.row_of, minlength=odds.size)[model.row_of] > 1
    # twice the side's probability: no gain and no loss where the restorations don't differ
    bonus = np.where(mirrored, np.log(2.0 * expit(log_side) + 1e-12), 0.0)
    fine = np.linspace(sigma[0], sigma[-1], (sigma.size - 1) * _FINER + 1)
    magnitude = CubicSpline(sigma, log_rows[model.row_of])(fine)
    nearest = np.clip(np.rint((fine - sigma[0]) / (sigma[1] - sigma[0])).astype(int), 0, sigma.size - 1)
    return fine, magnitude + bonus[nearest]


def summarise(
    sigma: FloatArray,
    log_post: FloatArray,
    seen: Observation,
    model: DepthModel,
    learned: Learned,
    options: EvidenceOptions,
) -> DepthEstimate:
    """Depth, interval, mirror and status from a log posterior over signed radii (float64 (G,), even steps)."""
    step = float(sigma[1] - sigma[0])
    density = np.exp(log_post - log_post.max())
    density /= density.sum()
    best = int(density.argmax())
    se = float(np.hypot(learned.floor_px, np.interp(sigma[best], model.sigma_px, model.sigma_se_px)))
    reach = int(np.ceil(4 * se / step))
    blur = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / se) ** 2)
    density = np.convolve(density, blur / blur.sum(), mode="same")
    density = (1.0 - learned.outlier) * density / density.sum() + learned.outlier / density.size
    modes = _split(density, step)
    masses = [float(density[a:b].sum()) for a, b in modes]
    order = np.argsort(masses)[::-1]
    first, last = modes[int(order[0])]
    share = density[first:last] / density[first:last].sum()
    centre = float((share * sigma[first:last]).sum())
    depth = model.depth_mm(centre)
    low, high = _hull(density, 0.95)
    interval = tuple(sorted(model.depth_mm(float(np.clip(s, sigma[0], sigma[-1])))
                            for s in (sigma[low] - step / 2, sigma[high] + step / 2)))  # fmt: skip
    mirror, mirror_probability = float("nan"), 0.0
    if abs(centre) > 2 * se and sigma[0] <= -centre <= sigma[-1]:
        mirror = model.depth_mm(-centre)
        around = np.abs(sigma + centre) < max(6 * se, 1.0)
        around &= np.sign(sigma) == -np.sign(centre)
        mirror_probability = float(density[around].sum())
    second = model.depth_mm(float(sigma[modes[int(order[1])][0] + int(density[slice(*modes[int(order[1])])].argmax())])) \
        if len(modes) > 1 and masses[int(order[1])] > 1e-4 else float("nan")  # fmt: skip
    mass = masses[int(order[0])]
    status: Status = "ok" if mass >= options.ambiguous_below else "ambiguous"
    reason = ""
    if status == "ambiguous":
        other = mirror if mirror_probability > 0.5 * (1.0 - mass) else second
        reason = f"{1 - mass:.0%} probability of another depth, most likely {other / 10:.0f} cm"
    coarse = np.zeros(model.sigma_px.size)
    np.add.at(coarse, np.clip(np.rint((sigma - sigma[0]) / (step * _FINER)).astype(int), 0, coarse.size - 1), density)
    return DepthEstimate(
        depth_mm=depth,
        interval_mm=(float(interval[0]), float(interval[1])),
        confidence=mass * 0.95,
        mirror_mm=mirror,
        mirror_probability=mirror_probability,
        status=status,
        depths_mm=model.depths_mm,
        score=coarse / coarse.sum(),
        second_mm=second,
        pixels=int(seen.pixels),
        reason=reason,
        diagnostics={
            "radius_px": model.row_radius_px,
            "log_likelihood": seen.fit.log_likelihood,
            "null": np.array([seen.fit.null]),
        },
    )


def _split(density: FloatArray, step: float, gap_px: float = 1.0) -> list[tuple[int, int]]:
    """Cut the density at its deep valleys into modes [first, last)."""
    floor = max(1e-3 * float(density.max()), 2.0 * float(np.median(density)))
    above = np.flatnonzero(density > min(floor, 0.5 * float(density.max())))
    breaks = np.flatnonzero(np.diff(above) > gap_px / step)
    starts, ends = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [above.size - 1]])
    return [(int(above[s]), int(above[e]) + 1) for s, e in zip(starts, ends, strict=True)]


def _hull(density: FloatArray, mass: float) -> tuple[int, int]:
    """First and last index of the highest-density set of this mass."""
    order = np.argsort(-density)
    count = int(np.searchsorted(np.cumsum(density[order]), mass * density.sum())) + 1
    chosen = order[:count]
    return int(chosen.min()), int(chosen.max())
