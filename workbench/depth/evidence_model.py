"""A bank made ready for measuring by evidence: autocorrelations on a fine grid of radii, and what was learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.pupil import PsfModel, PupilModel, psf_model
from workbench.depth.evidence_kernels import kernel_lags
from workbench.depth.evidence_scan import TextureFactor
from workbench.depth.evidence_side import SPARSENESS
from workbench.depth.options import require

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEARNED = "evidence_learned_6"
"""Name of :class:`Learned` among a bank's extras."""
NATIVE_FINER = 2
"""Photosites a superpixel is wide."""
_NEGATIVE_LIGHT = 1.5
"""Log-odds of a side per standard error that its light is less negative."""
_BEYOND_PX = 0.5
"""The grid of radii reaches so far beyond the bank's planes, so that a depth at their end has two sides."""
_FARTHEST = 0.98
_LEAST_NATIVE_ROWS = 6
_AROUND_PX = 3.0
"""Room (superpixels) that the largest finely drawn PSF needs beyond its radius: core, and what refining adds."""


@dataclass(frozen=True, slots=True)
class EvidenceOptions:
    """What may be chosen.

    Attributes
    ----------
    window_px, smallest_window_px
        Side of the windows; halved down to the smallest for regions that don't hold one.
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
    close_log_likelihood, close_ratio
        A blur whose radius differs by more than this ratio, and whose spectrum fits less than so much worse as the
        posterior weighs it, makes a region ambiguous whatever else speaks for the best one: a smooth texture in focus
        looks like a rough one behind a larger blur.
    varied_px, varied_log_likelihood
        A mixture of blurs whose radii lie so far to both sides, and which explains the spectrum so much better than any
        single blur, makes a region ambiguous: its surface is slanted, or it holds several depths. What it explains
        worse sets how far the likelihood is trusted about its modes, and the interval's width; that is set for 4 px.
    parts_log_likelihood
        So does what the region's parts lose, together, by sharing one blur: the one that suits them best, or the
        answer's.
    least_evidence
        Log-likelihood that texture must gain over noise alone.
    colour_gain
        Where a mixture of the colour channels shows so much more texture over noise (in power) than the luminance, it
        is measured instead.
    max_saturated
        Larger fractions of saturated pixels refuse the region.
    native_px
        Blurs of smaller radius (superpixels) are judged by the photosites themselves where the RAW file has details of
        that size; 0 for never.
    prior_power
        What depths are likely before anything is seen: as this power of z per step of 1/z. 1 takes every ratio of
        depths for equally likely (an octave nearer as much as one farther), 2 every depth, 0 every radius of blur.
    factor_spread, factor_wide_share, factor_wide_spread
        Distribution of the texture's factor per frequency (:class:`TextureFactor`).
    """

    window_px: int = 128
    smallest_window_px: int = 64
    least_weight: float = 0.3
    margin: float = 0.04
    margin_px: float = 24.0
    radius_step_px: float = 0.3
    side_windows: int = 9
    ambiguous_below: float = 0.95
    close_log_likelihood: float = 6.0
    close_ratio: float = 1.25
    varied_px: float = 4.0
    varied_log_likelihood: float = 8.0
    parts_log_likelihood: float = 10.0
    least_evidence: float = 12.0
    colour_gain: float = 1.6
    max_saturated: float = 0.1
    native_px: float = 4.5
    prior_power: float = 1.0
    factor_spread: float = 0.5
    factor_wide_share: float = 0.1
    factor_wide_spread: float = 2.5

    def __post_init__(self) -> None:
        require(
            self,
            smallest_window_px=16 <= self.smallest_window_px <= 1024,
            window_px=self.smallest_window_px <= self.window_px <= 1024 and self.window_px % 4 == 0,
            least_weight=0 < self.least_weight <= 1,
            margin=0 <= self.margin < 0.5,
            margin_px=self.margin_px >= 0,
            radius_step_px=0.05 <= self.radius_step_px <= 4,
            side_windows=self.side_windows >= 1,
            ambiguous_below=0 <= self.ambiguous_below <= 1,
            close_ratio=self.close_ratio >= 1,
            varied_px=self.varied_px > 0,
            colour_gain=self.colour_gain > 0,
            max_saturated=0 <= self.max_saturated <= 1,
            native_px=0 <= self.native_px <= 20,
            prior_power=0 <= self.prior_power <= 4,
            factor_spread=0 < self.factor_spread <= 5,
            factor_wide_share=0 <= self.factor_wide_share < 1,
            factor_wide_spread=0 < self.factor_wide_spread <= 10,
        )

    @property
    def factor(self) -> TextureFactor:
        """Distribution of the texture's factor per frequency."""
        return TextureFactor(self.factor_spread, self.factor_wide_share, self.factor_wide_spread)


@dataclass(frozen=True, slots=True)
class Learned:
    """What is learned from the bank (:mod:`workbench.depth.evidence_learn`); the defaults are sane for any.

    Attributes
    ----------
    spectral_weight
        Power that the spectrum's likelihood is raised to, beside that by the texture's ridges: textures are not quite
        as modelled.
    size_power
        Sparseness counts for the radius in proportion to this power of the number of pixels over 128 x 128.
    floor_px
        Standard error of the radius that no evidence undercuts.
    outlier
        Probability that the whole reasoning fails.
    side_weights
        Per filter family and order of the moment: log-odds of a side per standard error that it is sparser.
    mode_weights
        Per filter family: log-likelihood of a radius per unit of sparseness.
    """

    spectral_weight: float = 1.0
    size_power: float = 0.25
    floor_px: float = 0.015
    outlier: float = 0.003
    side_weights: tuple[float, ...] = (0.5, 0.2, 0.4, 0.1, 0.3, 0.2, 0.4, 0.1)
    mode_weights: tuple[float, ...] = (21.0, 7.0, 0.0, 35.0)

    @property
    def favour_weights(self) -> FloatArray:
        """Of all that two sides are compared by. The last one, of negative light, is not learned."""
        return np.array([*self.side_weights, _NEGATIVE_LIGHT])

    def as_array(self) -> FloatArray:
        """Plain numbers, for a bank's extras."""
        return np.array([self.spectral_weight, self.size_power, self.floor_px, self.outlier,
                         *self.side_weights, *self.mode_weights])  # fmt: skip

    @classmethod
    def from_array(cls, values: NDArray[np.floating]) -> Learned:
        """Inverse of :meth:`as_array`."""
        numbers, statistics = [float(v) for v in values], len(SPARSENESS)
        spectral_weight, size_power, floor_px, outlier = numbers[:4]
        weights = tuple(numbers[4 : 4 + statistics]), tuple(numbers[4 + statistics :])
        return cls(spectral_weight, size_power, floor_px, outlier, *weights)


@dataclass(frozen=True, slots=True)
class NativeModel:
    """PSFs at the photosites' pitch for the blurs next to focus.

    Attributes
    ----------
    psfs
        PSF at any depth, on photosites.
    kernel_lags
        float32 (n, 2 L + 1, 2 L + 1): :func:`~workbench.depth.evidence_kernels.kernel_lags` of the first n rows of the
        :class:`DepthModel`.
    """

    psfs: PupilModel
    kernel_lags: NDArray[np.float32]


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
    planes_px
        Signed radii of the bank's first and last plane; the grid reaches somewhat farther.
    row_of
        intp (G,): row of ``kernel_lags`` for each signed radius.
    row_radius_px
        float64 (R,): |radius| of each row, or the signed one where the sides are not mirror images.
    row_sigma_px
        float64 (R,): signed radius whose PSF made the row.
    kernel_lags
        float32 (R, 2 L + 1, 2 L + 1): :func:`~workbench.depth.evidence_kernels.kernel_lags` of the rows' PSFs.
    sigma_se_px
        float64 (G,): standard error of the radius from the lens fit.
    """

    psfs: PsfModel
    sigma_px: FloatArray
    depths_mm: FloatArray
    planes_px: tuple[float, float]
    row_of: NDArray[np.intp]
    row_radius_px: FloatArray
    row_sigma_px: FloatArray
    kernel_lags: NDArray[np.float32]
    sigma_se_px: FloatArray
    psf_error: float
    """Standard error of the PSFs relative to their values, taken for white."""
    native: NativeModel | None
    """None where PSFs can't be drawn finer than they were measured, or blurs next to focus are out of reach."""

    @property
    def sides_in_reach(self) -> Mask:
        """bool (R, 2): whether the grid holds each row's |radius| on the far side, and on the near side."""
        radius = np.abs(self.row_radius_px)
        return np.stack([radius <= self.sigma_px[-1], radius <= -self.sigma_px[0]], axis=1)

    @property
    def farthest_px(self) -> float:
        """Radius beyond which there is no far side, just short of the radius at infinity."""
        return _farthest_px(self.psfs)

    def depth_mm(self, sigma_px: float) -> float:
        """Depth of a signed radius."""
        return float(_depths_of(self.psfs, np.float64(sigma_px)))

    def depth_within_mm(self, sigma_px: FloatArray | float) -> FloatArray:
        """Depths of signed radii, those beyond the bank's planes put on them; float64 like ``sigma_px``."""
        return _depths_of(self.psfs, np.clip(sigma_px, *self.planes_px))

    def psf_at(self, sigma_px: float, finer: int = 1) -> NDArray[np.float32]:
        """PSF of a signed radius, float32 (K, K); ``finer`` is the number of pixels a superpixel is wide."""
        psfs, lags = self._at_pitch(finer)
        return psfs.psf_at(self.depth_mm(sigma_px), (lags.shape[1] + 1) // 2)

    def lags_at(self, sigma_px: FloatArray, finer: int = 1) -> NDArray[np.float32]:
        """Autocorrelations like ``kernel_lags`` for any signed radii, float32 (n, 2 L + 1, 2 L + 1)."""
        psfs, lags = self._at_pitch(finer)
        return kernel_lags(psfs, _depths_of(self.psfs, sigma_px), (lags.shape[1] + 1) // 2, self.psf_error)

    def _at_pitch(self, finer: int) -> tuple[PsfModel, NDArray[np.float32]]:
        if finer == 1:
            return self.psfs, self.kernel_lags
        assert self.native is not None
        return self.native.psfs, self.native.kernel_lags


def prepare(bank: Bank, options: EvidenceOptions, field_index: int | None = None) -> DepthModel:
    """Compute what a bank's blurs leave of a texture, on a fine grid of radii.

    The grid reaches half a pixel of radius beyond the bank's planes, so that a depth at their end has two sides.
    """
    psfs = psf_model(bank, field_index)
    nearest, farthest = psfs.radius_px(float(bank.depths_mm[0])), psfs.radius_px(float(bank.depths_mm[-1]))
    step = options.radius_step_px
    low, high = int(np.floor((nearest - _BEYOND_PX) / step)), int(np.ceil((farthest + _BEYOND_PX) / step))
    index = np.arange(low, high + 1)
    sigma = np.asarray((index + 0.5) * step, np.float64)
    if isinstance(psfs, PupilModel):  # the near side is the far side turned over: one row for both
        row_of = np.where(index < 0, -1 - index, index)
        row_of -= row_of.min()
        # the side that reaches farther gives the rows' PSFs
        rows = sigma[index >= 0] if high >= -1 - low else sigma[index < 0][::-1]
        radius = np.abs(rows)
    else:
        row_of, rows, radius = index - low, sigma, sigma
    depths = _depths_of(psfs, np.minimum(sigma, _farthest_px(psfs)))
    size = (int(bank.psf.shape[2]) + 4) | 1
    error = float(np.clip(np.nanmedian(psfs.residual), 0.01, 0.2))
    lags = kernel_lags(psfs, _depths_of(psfs, rows), size, error)
    lens = bank.lens
    se = np.hypot(lens.scale_se_px * (1.0 - lens.focus_mm / depths), lens.scale_px * lens.focus_se_mm / depths)
    native = None
    if isinstance(psfs, PupilModel) and bank.recipe == "superpixel":
        native = _prepare_native(psfs, _depths_of(psfs, rows[radius < options.native_px]), options.native_px, error)
    return DepthModel(psfs, sigma, depths, (nearest, farthest), row_of, radius, rows, lags, se, error, native)


def _prepare_native(psfs: PupilModel, depths_mm: FloatArray, reach_px: float, error: float) -> NativeModel | None:
    if depths_mm.size < _LEAST_NATIVE_ROWS:
        return None
    finer = psfs.finer(NATIVE_FINER)
    size = int(np.ceil(2 * NATIVE_FINER * (reach_px + _AROUND_PX)))
    return NativeModel(finer, kernel_lags(finer, depths_mm, size | 1, error))


def _farthest_px(psfs: PsfModel) -> float:
    return _FARTHEST * psfs.radius_px(1e12)


def _depths_of(psfs: PsfModel, sigma_px: FloatArray | np.float64) -> FloatArray:
    """Depths (mm) of signed radii, which are linear in 1/z."""
    far, near = psfs.radius_px(1e12), psfs.radius_px(1.0)
    return np.asarray((near - far) / (sigma_px - far), np.float64)


def learned_of(bank: Bank) -> Learned:
    """What the bank holds of :class:`Learned`, or its defaults."""
    stored = bank.extras.get(LEARNED)
    return Learned() if stored is None else Learned.from_array(stored)
