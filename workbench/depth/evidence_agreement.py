"""The part of a found region whose windows agree on one blur.

A strip of sharp ground along a coat's foot outweighs the coat in the pooled spectrum, however narrow it is. Window by
window each has a voice of bounded strength: the blur that suits most of them is the region's, and those that deny it
see something else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from workbench.depth.evidence_model import DepthModel, EvidenceOptions
from workbench.depth.evidence_uniform import FOCUS_TRUST, PARTS_ROWS, claims_focus, fit_part, same_blur
from workbench.depth.evidence_view import View
from workbench.depth.evidence_windows import Window, place_windows, thinned
from workbench.depth.regions import bounding_box

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_WINDOWS, _MOST_WINDOWS = 20, 200
_LOUDEST, _DENIES = 4.0, 3.0
"""Nats by which a window may speak against a blur at most, and from which on it denies it."""
_LEAST_PART = 0.5


@dataclass(frozen=True, slots=True)
class Agreement:
    """What most windows of a region agree on.

    Attributes
    ----------
    radius_px
        |radius| of the blur that suits most of them.
    part
        bool (H, W): the region's pixels that lie nearer to a window that can have it than to one that can't, as far as
        they hang together: what a rim of strangers cuts off may be one, too.
    """

    radius_px: float
    part: Mask

    def suits(self, radius_px: float) -> bool:
        """Whether a blur of this |radius| is the one that most windows agree on."""
        return bool(same_blur(np.array([radius_px]), self.radius_px)[0])


def agreement(view: View, mask: Mask, model: DepthModel, options: EvidenceOptions) -> Agreement | None:
    """Ask a region's windows one by one which blur they can have.

    Parameters
    ----------
    view
        The region's superpixels.
    mask
        bool (H, W): the same.
    model, options
        Radii of the blurs; size of the smallest windows, the least evidence of texture with which one has a voice.

    Returns
    -------
    Agreement or None
        None where no window denies what suits the others, where less than half of the region is left, and where windows
        are too few to speak of most.
    """
    windows = thinned(
        place_windows(mask, view.soft, options.smallest_window_px, least_weight=options.least_weight), _MOST_WINDOWS
    )
    if len(windows) < _LEAST_WINDOWS:
        return None
    radius = np.abs(model.row_radius_px[PARTS_ROWS])
    lost = np.stack([_lost(view.plane, window, model, options) for window in windows])
    # a window may have any blur that differs too little from one that it likes
    bearable = np.stack([lost[:, same_blur(radius, centre)].min(axis=1) for centre in radius], axis=1)
    voice = np.array([window.weight for window in windows])
    voice *= np.where(claims_focus(radius[lost.argmin(axis=1)]), FOCUS_TRUST, 1.0)
    best = int((voice @ np.minimum(bearable, _LOUDEST)).argmin())
    denies = bearable[:, best] > _DENIES
    if denies.all() or not denies.any():
        return None
    part = _largest(mask & _nearest(windows, ~denies, mask))
    return Agreement(float(radius[best]), part) if part.sum() >= _LEAST_PART * mask.sum() else None


def _lost(plane: NDArray[np.float32], window: Window, model: DepthModel, options: EvidenceOptions) -> FloatArray:
    """Nats that each of some blurs loses to a window's best one, float64 (R,); none of them where it shows nothing."""
    fit = fit_part(plane, [window], model, options).fit
    best = float(fit.log_likelihood.max())
    if best - fit.null < options.least_evidence:
        return np.zeros(fit.log_likelihood.size)
    return fit.likelihood_weight * (best - fit.log_likelihood)


def _nearest(windows: list[Window], chosen: Mask, mask: Mask) -> Mask:
    """Pixels of a region that are nearest to the middle of a chosen window, of what of it the region holds."""
    box = rows, columns = bounding_box(mask)
    middles = np.array([_middle(window) for window in windows]).round().astype(int)
    y = np.clip(middles[:, 0] - rows.start, 0, rows.stop - rows.start - 1)
    x = np.clip(middles[:, 1] - columns.start, 0, columns.stop - columns.start - 1)
    is_chosen, elsewhere = np.zeros((2, rows.stop - rows.start, columns.stop - columns.start), np.bool_)
    elsewhere[:] = True
    elsewhere[y, x] = False
    is_chosen[y[chosen], x[chosen]] = True
    nearest = ndimage.distance_transform_edt(elsewhere, return_distances=False, return_indices=True)
    result = np.zeros(mask.shape, np.bool_)
    result[box] = is_chosen[tuple(nearest)]
    return result


def _largest(mask: Mask) -> Mask:
    """The largest connected part."""
    parts, count = ndimage.label(mask)
    return mask if count < 2 else np.asarray(parts == np.bincount(parts[mask]).argmax())


def _middle(window: Window) -> tuple[float, float]:
    """Row and column of the centre of a window's squared taper."""
    energy = window.taper.astype(np.float64) ** 2
    place = np.arange(energy.shape[0])
    total = energy.sum()
    return (
        window.row + float(energy.sum(axis=1) @ place / total),
        window.column + float(energy.sum(axis=0) @ place / total),
    )
