"""A region as it is seen at one pitch: its windows, its spectrum fitted for every blur, its restorations compared.

Superpixels serve for all blurs. Next to focus the aperture's shape lies in frequencies that they mix up or don't hold:
there the photosites are looked at themselves, where the RAW file has details of that size and the bank a model of the
pupil that can be drawn so fine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from calibration.image import LinearImage
from calibration.mosaic import grey_photosites, native_luminance_power
from workbench.depth.evidence_colour import chroma_over_luminance
from workbench.depth.evidence_expected import smeared_power
from workbench.depth.evidence_model import NATIVE_FINER, DepthModel, EvidenceOptions
from workbench.depth.evidence_periodogram import Pooled, pooled_periodogram
from workbench.depth.evidence_posterior import Refined
from workbench.depth.evidence_restoration import Patches, cut_patches
from workbench.depth.evidence_side import Comparison, compare
from workbench.depth.evidence_spectrum import PHOTOSITES, SpectralFit, TextureSpectrum, fit_spectra
from workbench.depth.evidence_windows import Window, clear_share, finer_windows, thinned
from workbench.depth.regions import bounding_box

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CONTEXT_PX = 48
"""What is kept of the picture around a region's box; restorations look so far beyond their windows."""
_SHAPELESS_PX = {1: 1.5, NATIVE_FINER: 1.0}
"""Radius (superpixels) below which the lens's own spot and the pixels hide the aperture's shape, and so the side, by
how fine the pixels are."""
_EDGE_TRUST = 0.35
"""What the comparison of the sides counts where all of the region lies within two radii of its edge."""
_REFINED_STEPS, _REFINED_FINER, _REFINED_FISHER_STEPS = 2, 3, 3
_MOST_CHROMA = 0.4
"""Of textures with three independent channels mixed into a grey one, depths next to focus were right up to 0.45 and in
focus, wherever they truly were, from 0.7 on; colour photographs have 0.02 to 0.6."""
_ANCHOR_ROWS = 3
_MOST_LIFTED = 10.0
"""Log-likelihood by which photosites may lift the best blur next to focus over superpixels' best one there."""
_NATIVE_FISHER_STEPS = 2
_MOST_NATIVE_WINDOWS, _NATIVE_SIDE_WINDOWS = 25, 5
"""Of a large region: one window of photosites costs as much as four of superpixels, and five that lie apart see more
than the nine overlapping ones of a small region."""


@dataclass(frozen=True, slots=True)
class View:
    """A region's pixels of one pitch.

    Attributes
    ----------
    plane
        float32 (h, w).
    soft, clear
        float32 (h, w): the region with a soft edge, 1 inside, and the distance (px) of its pixels from its edge.
    windows
        That cover it, heaviest first.
    pooled
        Their periodogram, free of what filling in the photosites' colours took away.
    fit
        Texture and noise for the model's rows: for superpixels all of them, for photosites the first ones.
    finer
        Pixels a superpixel is wide.
    is_light
        Whether the plane is never negative but for noise: a difference of colours may be.
    """

    plane: NDArray[np.float32]
    soft: NDArray[np.float32]
    clear: NDArray[np.float32]
    windows: list[Window]
    pooled: Pooled
    fit: SpectralFit
    finer: int = 1
    is_light: bool = True


def view_photosites(
    image: LinearImage, mask: Mask, superpixels: View, model: DepthModel, options: EvidenceOptions
) -> View | None:
    """A region's photosites, its spectrum fitted for the blurs next to focus.

    Parameters
    ----------
    image
        The photograph, its photosites kept.
    mask
        bool (H, W): usable superpixels of the region.
    superpixels
        The region as they show it; the same windows are looked at, of large regions a part.
    model, options
        The bank made ready; its ``native`` part.

    Returns
    -------
    View or None
        Grey light is assumed: red and blue are weighed so that the region's mean is grey. None where a channel is dark,
        and where colours change so much that the filters' carriers, with what they modulate, would pass for detail.
    """
    assert model.native is not None
    assert image.mosaic is not None
    box = rows, columns = bounding_box(mask, _CONTEXT_PX)
    if chroma_over_luminance(image.planes[box], mask[box]) > _MOST_CHROMA:
        return None
    plane = grey_photosites(image.mosaic.part(rows, columns), mask[box])
    if plane is None:
        return None
    soft, clear = _enlarged(superpixels.soft[box]), _enlarged(superpixels.clear[box])
    chosen = thinned(superpixels.windows, _MOST_NATIVE_WINDOWS)
    windows = finer_windows(chosen, soft, NATIVE_FINER, (rows.start, columns.start))
    lags = model.native.kernel_lags
    seen = pooled_periodogram(plane, windows, lags.shape[1] // 2)
    size = seen.power.shape[0]
    kept = native_luminance_power(fft.fftfreq(size)[:, np.newaxis], fft.rfftfreq(size)[np.newaxis, :])
    pooled = replace(seen, power=seen.power / np.maximum(kept, 1e-3))
    expected = smeared_power(lags, pooled.taper_lags, size)
    fit = fit_spectra(pooled.power, pooled.trusted, expected, independent_share=pooled.independent_share,
                      factor=options.factor, steps=_NATIVE_FISHER_STEPS, band=PHOTOSITES)  # fmt: skip
    return View(plane, soft, NATIVE_FINER * clear, windows, pooled, fit, NATIVE_FINER)


def _enlarged(values: NDArray[np.float32]) -> NDArray[np.float32]:
    shape = NATIVE_FINER * values.shape[1], NATIVE_FINER * values.shape[0]
    return np.asarray(cv2.resize(values, shape, interpolation=cv2.INTER_LINEAR), np.float32)


def joined_likelihood(superpixels: View, photosites: View | None) -> FloatArray:
    """Log-likelihood of every row, float64 (R,): that of superpixels, its shape next to focus by photosites.

    The two are of different data and differ by a constant, which is taken from the last rows that both have; but where
    the blur is larger than all of these, both fit badly there, and photosites could lift a blur next to focus over the
    true one. So they lift the best one by little over what superpixels say.
    """
    likelihood = superpixels.fit.log_likelihood
    if photosites is None:
        return likelihood
    joined = likelihood.copy()
    joined[: photosites.fit.log_likelihood.size] = photosites.fit.log_likelihood + _offset(superpixels, photosites)
    return joined


def view_of(superpixels: View, photosites: View | None, row: int) -> View:
    """Photosites for the rows that they were fitted for, superpixels for the others."""
    return photosites if photosites is not None and row < photosites.fit.log_likelihood.size else superpixels


def _offset(superpixels: View, photosites: View) -> float:
    rows = photosites.fit.log_likelihood.size
    coarse, fine = superpixels.fit.log_likelihood[:rows], photosites.fit.log_likelihood
    return float(min((coarse - fine)[-_ANCHOR_ROWS:].mean(), coarse.max() - fine.max() + _MOST_LIFTED))


def refine(
    superpixels: View, photosites: View | None, row: int, model: DepthModel, options: EvidenceOptions
) -> Refined:
    """Likelihood about one row on a fine grid, each blur fitted to convergence.

    A large, rich region tells radii apart that differ by far less than the rows do, and few steps from row to row
    follow such a narrow ridge too slowly.
    """
    view = view_of(superpixels, photosites, row)
    offset = 0.0 if view is superpixels else _offset(superpixels, view)
    reach = _REFINED_STEPS * options.radius_step_px
    offsets = np.linspace(-reach, reach, 2 * _REFINED_STEPS * _REFINED_FINER * view.finer + 1)
    radius = model.row_radius_px[row] + offsets
    if model.row_radius_px.min() >= 0:
        radius = radius[radius > 0]
        sigma = radius * np.sign(model.row_sigma_px[row])
    else:
        sigma = radius
    pooled = view.pooled
    expected = smeared_power(model.lags_at(sigma, view.finer), pooled.taper_lags, pooled.power.shape[0])
    fit = fit_spectra(pooled.power, pooled.trusted, expected, independent_share=pooled.independent_share,
                      factor=options.factor, start=view.fit.texture(row),
                      steps=_REFINED_FISHER_STEPS, band=view.fit.band)  # fmt: skip
    return Refined(radius, fit.log_likelihood + offset)


def compare_sides(
    superpixels: View, photosites: View | None, rows: Sequence[int], model: DepthModel, options: EvidenceOptions
) -> list[Comparison]:
    """How sparse the far and the near side's restorations are at some rows' radii.

    How sparse and how negative they are is read from superpixels at every row, so that rows can be compared; how much
    one side is favoured, from photosites next to focus. A single row has none to be compared with.
    """
    views = {row: view_of(superpixels, photosites, row) for row in rows}
    near = {}
    if photosites is not None:
        near = _compare(photosites, [row for row, view in views.items() if view is photosites], model, options)
    if len(rows) == len(near) == 1:
        return list(near.values())
    clues = _compare(superpixels, rows, model, options)
    return [replace(near.get(row, clue), sparse=clue.sparse, negative=clue.negative) for row, clue in clues.items()]


def _compare(view: View, rows: Sequence[int], model: DepthModel, options: EvidenceOptions) -> dict[int, Comparison]:
    if not rows:
        return {}
    good = [w for w in view.windows if w.weight >= 0.6 * view.windows[0].weight]
    most = options.side_windows
    if view.finer > 1 and len(good) > most:
        most = min(most, _NATIVE_SIDE_WINDOWS)
    windows = thinned(good, most)
    patches = cut_patches(view.plane, view.soft, windows)
    return {
        row: compare_windows(view, windows, patches, abs(float(model.row_radius_px[row])), view.fit.texture(row), model)
        for row in rows
    }


def compare_windows(
    view: View,
    windows: Sequence[Window],
    patches: Patches,
    radius_px: float,
    texture: TextureSpectrum,
    model: DepthModel,
) -> Comparison:
    """How sparse the far and the near side's restorations of some windows are, for one |radius| (superpixels).

    ``patches`` are the windows cut out of the view.
    """
    psfs: list[NDArray[np.float32]] = []
    for sign in (1.0, -1.0):
        if sign * radius_px < model.farthest_px:
            psfs.append(model.psf_at(sign * radius_px, view.finer))
        else:
            psfs.append((psfs[0] if psfs else model.psf_at(-radius_px, view.finer))[::-1, ::-1])
    clue = compare(patches, windows, psfs, texture, is_light=view.is_light)
    # next to focus the lens's own spot hides the aperture's shape, and with it the side
    shown = -np.expm1(-((radius_px / _SHAPELESS_PX[view.finer]) ** 2))
    # near the edge a restoration lacks what the blur carried out of the region
    trust = min(1.0, _EDGE_TRUST + clear_share(view.clear, windows, 2.0 * radius_px * view.finer))
    return replace(clue, favour=shown * trust * clue.favour, halves=shown * trust * clue.halves)
