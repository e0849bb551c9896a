"""What a region's pixels say, before anything learned is applied: its spectrum fitted for every blur."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.image import LinearImage
from workbench.depth.evidence_expected import smeared_power
from workbench.depth.evidence_model import DepthModel, EvidenceOptions
from workbench.depth.evidence_periodogram import pooled_periodogram
from workbench.depth.evidence_spectrum import SpectralFit, fit_spectra, frequencies
from workbench.depth.evidence_uniform import Part, fit_parts, mixture_gain
from workbench.depth.evidence_view import View, joined_likelihood, view_photosites
from workbench.depth.evidence_windows import covered_pixels, place_windows, soft_mask, thinned

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RAMP_PX = 12.0
_MOST_WINDOWS = 100
"""Of a large region; averages of more are not trusted more."""
_NATIVE_WITHIN = 70.0
"""Photosites are looked at where superpixels leave a blur next to focus within so much log-likelihood of the best."""
_ENOUGH = 0.7
"""Full windows' worth of region below which smaller windows are tried."""
_RESOLVED = 0.25
"""Of a window's side: a blur of a larger radius spans more than half of the window, its zeros lie less than two
frequencies apart."""
_LOW_CYCLES = 6.0
_LEAST_LOW_SHARE, _MOST_LINE_SHARE = 0.25, 0.9
_LOW_SHARE_WITH_LINES, _LINES = 0.85, 0.48
"""A strict pattern by either share alone, or by both together: few lines hold nearly half of the power, and between
them low frequencies are empty."""


@dataclass(frozen=True, slots=True)
class Observation:
    """What a region's pixels say, before anything learned is applied."""

    view: View
    photosites: View | None
    likelihood: FloatArray
    """float64 (R,): log-likelihood of the spectrum for each of the model's rows, by both views."""
    pixels: float
    """Superpixels' worth of information: sum of the squared tapers' weights."""
    covered: int
    """Superpixels that lie in a window."""
    low_share: float
    """Share of the lowest frequencies that stand above the noise."""
    line_share: float
    """Part of the texture's power, relative to its smooth spectrum, in the strongest hundredth of the frequencies."""
    varied: float
    """Log-likelihood that a mixture of neighbouring blurs gains over the best single one."""
    parts: list[Part]
    """Its quarters by themselves; none where they are too small, or nobody asks."""


def observe(
    plane: NDArray[np.float32],
    mask: Mask,
    model: DepthModel,
    options: EvidenceOptions,
    with_photosites: LinearImage | None = None,
    *,
    is_light: bool = True,
    as_one: bool = False,
) -> Observation | None:
    """Pool the region's windows and fit every blur; None where no window fits.

    Photosites are looked at next to focus, where an image is given that has them. ``is_light``: see :class:`View`. With
    ``as_one`` nobody asks whether its quarters have the same blur.
    """
    margin = min(options.margin_px, options.margin * float(np.sqrt(mask.sum())))
    size = options.window_px
    soft, clear = soft_mask(mask, margin_px=margin, ramp_px=_RAMP_PX)
    while True:
        windows = place_windows(mask, soft, size, least_weight=options.least_weight)
        if sum(w.weight for w in windows) >= _ENOUGH:
            break
        size //= 2
        if size < options.smallest_window_px:
            return None
    chosen = thinned(windows, _MOST_WINDOWS)
    pooled = pooled_periodogram(plane, chosen, model.kernel_lags.shape[1] // 2)
    expected = smeared_power(model.kernel_lags, pooled.taper_lags, size)
    fit = fit_spectra(
        pooled.power, pooled.trusted, expected, independent_share=pooled.independent_share, factor=options.factor,
        unresolved=np.abs(model.row_radius_px) > _RESOLVED * size,
    )  # fmt: skip
    view, photosites = View(plane, soft, clear, chosen, pooled, fit, is_light=is_light), None
    if with_photosites is not None and with_photosites.mosaic is not None and _next_to_focus(fit.log_likelihood, model):
        photosites = view_photosites(with_photosites, mask, view, model, options)
    parts = list[Part]()
    if not as_one and size // 2 >= options.smallest_window_px:
        finer = place_windows(mask, soft, size // 2, least_weight=options.least_weight)
        parts = fit_parts(plane, finer, mask, model, options)
    pixels = sum(w.weight for w in windows) * size * size * 0.25  # half overlap both ways: each pixel counts fourfold
    return Observation(
        view,
        photosites,
        joined_likelihood(view, photosites),
        max(pixels, size * size * windows[0].weight),
        covered_pixels(mask, windows),
        _low_share(pooled.power, fit),
        _line_share(pooled.power, expected, fit),
        mixture_gain(pooled, expected, fit, model, options),
        parts,
    )


def _next_to_focus(likelihood: FloatArray, model: DepthModel) -> bool:
    if model.native is None:
        return False
    near = likelihood[: len(model.native.kernel_lags)]
    return bool(near.max() > likelihood.max() - _NATIVE_WITHIN)


def _low_share(power: FloatArray, fit: SpectralFit) -> float:
    """Of the frequencies up to a few cycles per window, the share with three times the noise's power.

    Every blur passes them, and every texture but a strict pattern has them: falling spectra reach highest there.
    """
    modulus, _, used = frequencies(power.shape[0])
    lowest = used & (modulus * power.shape[0] <= _LOW_CYCLES)
    noise = np.exp(float(fit.log_noise[int(fit.log_likelihood.argmax())]))
    return float((power[lowest] > 3.0 * noise).mean())


def _line_share(power: FloatArray, expected: NDArray[np.float32], fit: SpectralFit) -> float:
    modulus, direction, used = frequencies(power.shape[0])
    best = int(fit.log_likelihood.argmax())
    texture = np.exp(fit.texture(best).log_power(modulus[used], direction[used]))
    model = texture * np.maximum(expected[best][used], 0.0) + np.exp(float(fit.log_noise[best]))
    ratio = np.sort(power[used] / model)
    return float(ratio[-max(1, ratio.size // 100) :].sum() / max(float(ratio.sum()), 1e-30))


def is_strict_pattern(seen: Observation) -> bool:
    """Whether a region shows isolated spatial frequencies only: any blur explains them."""
    has_lines = seen.line_share > _LINES and seen.low_share < _LOW_SHARE_WITH_LINES
    return has_lines or seen.low_share < _LEAST_LOW_SHARE or seen.line_share > _MOST_LINE_SHARE
