"""The PSF at any depth: one picture of the pupil, scaled in 1/z, fitted to all measured PSFs of a bank.

A thin lens images a point to a copy of its pupil whose signed radius is linear in 1/z (METHOD Eq. 1). With the pupil's
picture ``T``, a core for everything that doesn't scale (diffraction, aberration, the renderer's pixel filter)
and the chief ray's place, the PSF between and beyond the measured planes is integrated over pixels without sampling
error (:func:`calibration.template.render`). Where the measured PSFs don't follow that picture, because the pupil's
outline changes with depth (a lens that vignettes) or its edges ring, :class:`PsfInterpolator` blends the two measured
neighbours, each scaled to the radius in between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.errors import BankError, FitError
from calibration.lens_fit import LensFit
from calibration.template import HALF_EXTENT, Core, Spot, fit_spots, render

__all__ = [
    "BetweenPlanes",
    "PsfInterpolator",
    "PsfModel",
    "PupilModel",
    "between_planes",
    "fit_pupil",
    "psf_model",
    "pupil_of_bank",
]

FloatArray = NDArray[np.float64]

GOOD_RESIDUAL = 0.06
"""Where the pupil's median residual (root of residual power over the PSF's power, noise removed) is larger than this,
blending neighbours is asked whether it describes the bank better."""
_ENDS = 1e-9


class PsfModel(Protocol):
    """A PSF for every depth."""

    @property
    def residual(self) -> FloatArray:
        """float64 (D,): root of residual power over PSF power per measured depth, noise removed."""
        ...

    def radius_px(self, depth_mm: float) -> float:
        """Signed radius (px) of the pupil's image."""
        ...

    def psf_at(self, depth_mm: float, size: int | None = None) -> NDArray[np.float32]:
        """PSF at a depth, float32 (K, K), unit sum."""
        ...

    def side_px(self, depth_mm: float) -> int:
        """Side K that holds all of the PSF at a depth."""
        ...


@dataclass(frozen=True, slots=True)
class PupilModel:
    """Pupil, lens line, core and chief ray of one set of PSFs.

    Attributes
    ----------
    template
        float64 (N, N), sums to 1: the pupil within +-``half_extent`` radii, oriented as the PSF beyond focus.
    half_extent
        Half side of the template in radii.
    radius_line
        (intercept, slope): radius in px is intercept + slope / depth_mm.
    core
        What blurs every point alike besides the pixel's box.
    chief_line
        float64 (2, 2): (intercept, slope) over 1/depth of the chief ray's row and column relative to the centre pixel.
    size
        Default side K of a PSF.
    depths_mm, residual
        float64 (D,): the depths it was fitted to and what is left there (see :class:`PsfModel`).
    """

    template: FloatArray
    half_extent: float
    radius_line: tuple[float, float]
    core: Core
    chief_line: FloatArray
    size: int
    depths_mm: FloatArray = field(default_factory=lambda: np.zeros(0))
    residual: FloatArray = field(default_factory=lambda: np.zeros(0))

    def radius_px(self, depth_mm: float) -> float:
        """Signed radius (px) of the pupil's image at a depth; negative nearer than focus."""
        return self.radius_line[0] + self.radius_line[1] / depth_mm

    def chief_yx(self, depth_mm: float) -> tuple[float, float]:
        """Row and column of the chief ray relative to the centre pixel."""
        place = self.chief_line[:, 0] + self.chief_line[:, 1] / depth_mm
        return float(place[0]), float(place[1])

    def psf_at(self, depth_mm: float, size: int | None = None) -> NDArray[np.float32]:
        """PSF at any depth (mm), float32 (K, K) of unit sum, integrated over pixels; K is made odd."""
        return self.psf_about(self.chief_yx(depth_mm), depth_mm, size)

    def psf_about(self, chief_yx: Sequence[float], depth_mm: float, size: int | None = None) -> NDArray[np.float32]:
        """The same with its chief ray's (row, column), in px relative to the centre pixel, elsewhere."""
        k = (size or self.size) | 1
        dy, dx = chief_yx
        picture = render(
            self.template,
            self.half_extent,
            (k, k),
            radius=self.radius_px(depth_mm),
            centre=(k // 2 + dy, k // 2 + dx),
            core=self.core,
        )
        return np.asarray(picture / max(float(picture.sum()), 1e-12), np.float32)

    def side_px(self, depth_mm: float) -> int:
        """Odd side K that holds all of the PSF at a depth: its picture, its core and its chief ray's place."""
        reach = self.half_extent * abs(self.radius_px(depth_mm)) + self.core.reach_px
        return 2 * int(np.ceil(reach + max(map(abs, self.chief_yx(depth_mm))) + 0.5)) + 1

    def finer(self, factor: int) -> PupilModel:
        """The same on pixels ``factor`` times as fine: what a bank of superpixels says of single photosites."""
        line = self.radius_line[0] * factor, self.radius_line[1] * factor
        return replace(
            self, radius_line=line, core=self.core.finer(factor), chief_line=self.chief_line * factor,
            size=self.size * factor,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class PsfInterpolator:
    """Blend of the two measured neighbours in 1/z, each scaled about its chief ray to the radius in between.

    Attributes
    ----------
    depths_mm
        float64 (D,), ascending.
    psf
        float32 (D, K, K).
    radius_line
        As in :class:`PupilModel`.
    chief_yx
        float64 (D, 2): chief ray relative to the centre pixel.
    residual
        float64 (D,): leave-one-out error of the blend.
    """

    depths_mm: FloatArray
    psf: NDArray[np.float32]
    radius_line: tuple[float, float]
    chief_yx: FloatArray
    residual: FloatArray = field(default_factory=lambda: np.zeros(0))

    def radius_px(self, depth_mm: float) -> float:
        """Signed radius (px) of the pupil's image at a depth; negative nearer than focus."""
        return self.radius_line[0] + self.radius_line[1] / depth_mm

    def psf_at(self, depth_mm: float, size: int | None = None) -> NDArray[np.float32]:
        """PSF at any depth (mm), float32 (K, K) of unit sum; beyond the ends the last plane is scaled."""
        place = np.sum([share * self.chief_yx[index] for index, share in self._shares(depth_mm)], axis=0)
        return self.psf_about(place, depth_mm, size)

    def psf_about(self, chief_yx: Sequence[float], depth_mm: float, size: int | None = None) -> NDArray[np.float32]:
        """The same with its chief ray's (row, column), in px relative to the centre pixel, elsewhere."""
        k = (size or self.psf.shape[1]) | 1
        radius = self.radius_px(depth_mm)
        parts = [share * self._scaled(index, radius, k, chief_yx) for index, share in self._shares(depth_mm)]
        blend = np.maximum(np.sum(parts, axis=0), 0.0)
        return np.asarray(blend / max(float(blend.sum()), 1e-12), np.float32)

    def side_px(self, depth_mm: float) -> int:  # noqa: ARG002 - measured PSFs are all of one size
        """Side K that holds all of the PSF at a depth: that of the measured ones, and what scaling adds."""
        return int(self.psf.shape[1]) + 4

    def _shares(self, depth_mm: float) -> list[tuple[int, float]]:
        """The measured neighbours of a depth, and what each counts for."""
        right = int(np.clip(np.searchsorted(self.depths_mm, depth_mm), 1, len(self.depths_mm) - 1))
        u = 1.0 / self.depths_mm[[right - 1, right]]
        share = float(np.clip((u[0] - 1.0 / depth_mm) / (u[0] - u[1]), 0.0, 1.0))
        return [(index, weight) for index, weight in ((right - 1, 1.0 - share), (right, share)) if weight > _ENDS]

    def _scaled(self, index: int, radius: float, size: int, chief_yx: Sequence[float]) -> FloatArray:
        there = self.radius_px(float(self.depths_mm[index]))
        # close to focus the core, which doesn't scale, is most of the PSF; a side never turns into the other
        is_scaled = there * radius > 0 and min(abs(there), abs(radius)) > 1.0
        scale = float(np.clip(radius / there, 0.5, 2.0)) if is_scaled else 1.0
        old, half = self.psf.shape[1] // 2, size // 2
        fine = 3  # sub-pixels a side: area average of the scaled picture
        grid = (np.arange(size * fine) - (size * fine - 1) / 2.0) / fine
        y, x = ((grid - new) / scale + old + own for new, own in zip(chief_yx, self.chief_yx[index], strict=True))
        rows, columns = np.meshgrid(y, x, indexing="ij")
        picture = cv2.remap(
            self.psf[index], columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR, borderValue=0
        )
        binned = picture.reshape(2 * half + 1, fine, 2 * half + 1, fine).mean(axis=(1, 3))
        return np.asarray(binned / max(float(binned.sum()), 1e-12), np.float64)


def fit_pupil(
    depths_mm: FloatArray, psf: NDArray[np.float32], psf_se: NDArray[np.float32], lens: LensFit
) -> PupilModel:
    """Fit one pupil, core and lens line to a set of measured PSFs.

    Parameters
    ----------
    depths_mm
        float64 (D,), D >= 3.
    psf, psf_se
        float32 (D, K, K): PSFs of unit sum and their standard errors (0 where nothing was measured).
    lens
        The lens fit of the set: its line gives the radius between the planes.

    Returns
    -------
    PupilModel
        With its residual per depth.

    Raises
    ------
    FitError
        The PSFs are all alike.
    """
    floor = np.maximum(psf_se.max(axis=(1, 2)), 1e-9)
    spots = [
        Spot(np.asarray(p, np.float64), np.where(s > 0, s, f).astype(np.float64))
        for p, s, f in zip(psf, psf_se, floor, strict=True)
    ]
    fit = fit_spots(spots, 1.0 / np.asarray(depths_mm, np.float64))
    half = psf.shape[1] // 2
    chief = np.array([(s.centre_y - half, s.centre_x - half) for s in fit.spots])
    model = _assemble(fit.template, fit.core, np.asarray(depths_mm, np.float64), chief, lens, psf.shape[1])
    # the picture's unit is the circle about its own outline, the lens fit's may be another
    found, expected = np.array([s.radius_px for s in fit.spots]), lens.sigma_px(model.depths_mm)
    unit = float(found @ expected / (expected @ expected))
    model = replace(model, radius_line=(model.radius_line[0] * unit, model.radius_line[1] * unit))
    return replace(model, residual=_residual(model, chief, psf, psf_se))


def pupil_of_bank(bank: Bank, field_index: int | None = None) -> PupilModel:
    """The pupil model of one field position of a bank (default: its centre).

    The picture of the aperture and the chief rays that were found when the bank was made are used where the bank
    holds them; otherwise they are fitted again.
    """
    index = bank.central_index if field_index is None else field_index
    psf, se = bank.psf[index], bank.psf_se[index]
    lens = _lens_of(bank, index)
    core = _core_of(bank.manifest, index) if index == bank.central_index else None
    # off axis the lens barrel trims the pupil: its own picture
    if core is None or "aperture" not in bank.extras or "chief_yx" not in bank.extras:
        return fit_pupil(bank.depths_mm, psf, se, lens)
    template = np.asarray(bank.extras["aperture"], np.float64)
    chief = np.asarray(bank.extras["chief_yx"][index], np.float64)
    model = _assemble(template, core, bank.depths_mm, chief, lens, psf.shape[1])
    return replace(model, residual=_residual(model, chief, psf, se))


def psf_model(bank: Bank, field_index: int | None = None) -> PsfModel:
    """The best model of a bank's PSFs: the pupil where it fits, else interpolation between the planes."""
    index = bank.central_index if field_index is None else field_index
    try:
        pupil = pupil_of_bank(bank, index)
    except FitError:
        return interpolator_of_bank(bank, index)
    misfit = float(np.median(pupil.residual))
    if misfit <= GOOD_RESIDUAL:
        return pupil
    blend = interpolator_of_bank(bank, index)
    return pupil if misfit <= float(np.median(blend.residual)) else blend


@dataclass(frozen=True, slots=True)
class BetweenPlanes:
    """Where PSFs between a bank's planes come from.

    Attributes
    ----------
    source
        ``pupil``, a picture of the aperture scaled in 1/z; ``interpolation`` of neighbours where that doesn't fit.
    residual
        Median over the planes of the root of residual power over PSF power, noise removed: of the pupil against the
        measured PSFs, of interpolation against each plane left out.
    """

    source: Literal["pupil", "interpolation"]
    residual: float


def between_planes(bank: Bank) -> BetweenPlanes | None:
    """What :func:`psf_model` uses for a bank's centre; None for one of fewer than three planes, which can't tell."""
    if bank.depths_mm.size < 3:
        return None
    model = psf_model(bank)
    source: Literal["pupil", "interpolation"] = "pupil" if isinstance(model, PupilModel) else "interpolation"
    return BetweenPlanes(source, float(np.nanmedian(model.residual)))


def interpolator_of_bank(bank: Bank, field_index: int) -> PsfInterpolator:
    """Interpolation between the measured planes of one field position, with its leave-one-out error."""
    chief = bank.extras.get("chief_yx")
    places = np.zeros((bank.depths_mm.size, 2)) if chief is None else np.asarray(chief[field_index], np.float64)
    line = _radius_line(bank.depths_mm, _lens_of(bank, field_index))
    whole = PsfInterpolator(bank.depths_mm, bank.psf[field_index], line, places)
    residual = np.full(bank.depths_mm.size, np.nan)
    for i in range(1, bank.depths_mm.size - 1):
        rest = np.delete(np.arange(bank.depths_mm.size), i)
        partial = PsfInterpolator(bank.depths_mm[rest], bank.psf[field_index][rest], line, places[rest])
        predicted = partial.psf_about(places[i], float(bank.depths_mm[i]))
        residual[i] = _misfit(predicted, bank.psf[field_index][i], bank.psf_se[field_index][i])
    residual[[0, -1]] = residual[[1, -2]]
    return replace(whole, residual=residual)


def _core_of(manifest: Mapping[str, Any], index: int) -> Core | None:
    """The core of a field position, from a bank's manifest; None where it doesn't say. Older ones know of no wings."""
    aperture = manifest.get("aperture", {})
    if not aperture.get("core_px"):
        return None
    wings = float(aperture["core_wings"][index]) if aperture.get("core_wings") else 0.0
    if not 0.0 <= wings < 1.0:
        raise BankError(f"bank: its manifest gives {wings:g} of the light to the core's wings; calibrate again")
    return Core(float(aperture["core_px"][index]), wings)


def _lens_of(bank: Bank, index: int) -> LensFit:
    radii = bank.extras.get("field_radius_px")
    if index == bank.central_index or radii is None:
        return bank.lens
    slope, intercept = np.polyfit(1.0 / bank.depths_mm, np.asarray(radii[index], np.float64), 1)
    return replace(bank.lens, focus_mm=float(-slope / intercept), scale_px=float(intercept))


def _radius_line(depths_mm: FloatArray, lens: LensFit) -> tuple[float, float]:
    slope, intercept = np.polyfit(1.0 / depths_mm, lens.sigma_px(depths_mm), 1)
    return float(intercept), float(slope)


def _assemble(
    template: FloatArray, core: Core, depths_mm: FloatArray, chief_yx: FloatArray, lens: LensFit, size: int
) -> PupilModel:
    # robust lines: the chief ray moves in proportion to 1/z where the stage isn't quite parallel to the axis
    u = 1.0 / depths_mm
    lines = []
    for k in (0, 1):
        keep = np.ones(u.size, np.bool_)
        for _ in range(3):
            slope, intercept = np.polyfit(u[keep], chief_yx[keep, k], 1)
            left = np.abs(chief_yx[:, k] - intercept - slope * u)
            keep = left <= max(3.0 * float(np.median(left)), 1e-6)
            if keep.sum() < 3:
                break
        lines.append((float(intercept), float(slope)))
    return PupilModel(
        template=template,
        half_extent=HALF_EXTENT,
        radius_line=_radius_line(depths_mm, lens),
        core=core,
        chief_line=np.array(lines),
        size=size,
        depths_mm=depths_mm,
    )


def _residual(
    model: PupilModel, chief_yx: FloatArray, psf: NDArray[np.float32], psf_se: NDArray[np.float32]
) -> FloatArray:
    """What the model leaves of each measured PSF, drawn where that was found: a stage's sway is no error of the PSF."""
    measured = zip(chief_yx, model.depths_mm, psf, psf_se, strict=True)
    return np.array([_misfit(model.psf_about(place, float(z)), p, s) for place, z, p, s in measured])


def _misfit(predicted: NDArray[np.float32], psf: NDArray[np.float32], se: NDArray[np.float32]) -> float:
    power = float(((predicted - psf) ** 2).sum()) - float((se**2).sum())
    return float(np.sqrt(max(power, 0.0) / max(float((psf**2).sum()), 1e-30)))
