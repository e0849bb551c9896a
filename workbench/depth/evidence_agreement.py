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
from workbench.depth.evidence_uniform import PARTS_ROWS, fit_part, focus_trust, same_blur
from workbench.depth.evidence_view import View
from workbench.depth.evidence_windows import Window, place_windows, thinned
from workbench.depth.regions import bounding_box

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_WINDOWS, _MOST_WINDOWS = 20, 200
"""Windows that show a texture; fewer have no majority."""
_LOUDEST, _DENIES = 4.0, 3.0
"""Nats by which a window may speak against a blur at most, and from which on it denies it."""
_MOST = 0.7
"""Share of these windows that agree, and of the region that is left, at least: what is more is no strip of something
else but another thing. All were chosen on 45 uneven regions of traced scenes (seeds 1000 to 7000)."""


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
        bool (H, W): the region, saturated pixels and all.
    model, options
        Radii of the blurs; size of the smallest windows, the least evidence of texture with which one has a voice.

    Returns
    -------
    Agreement or None
        None where no window denies what suits the others, where too many do, and where too few show a texture.
    """
    windows = place_windows(mask, view.soft, options.smallest_window_px, least_weight=options.least_weight)
    asked = [(window, _lost(view.plane, window, model, options)) for window in thinned(windows, _MOST_WINDOWS)]
    heard = [(window, lost) for window, lost in asked if lost is not None]
    if len(heard) < _LEAST_WINDOWS:
        return None
    weight = np.array([window.weight for window, _ in heard])
    radius = np.abs(model.row_radius_px[PARTS_ROWS])
    best, denies = most_agreed(np.stack([lost for _, lost in heard]), weight, radius)
    if not denies.any() or weight[~denies].sum() < _MOST * weight.sum():
        return None
    part = _largest(mask & _nearest([window for window, _ in heard], ~denies, mask))
    return Agreement(float(radius[best]), part) if part.sum() >= _MOST * mask.sum() else None


def most_agreed(lost: FloatArray, weight: FloatArray, radius_px: FloatArray) -> tuple[int, Mask]:
    """The blur that suits most windows, and which of them deny it.

    Parameters
    ----------
    lost
        float64 (W, R): nats that each blur loses in each window to the one that suits it best.
    weight
        float64 (W,): of the windows.
    radius_px
        float64 (R,): |radii| of the blurs. A window may have any blur that differs too little from one that it likes.

    Returns
    -------
    int, bool (W,)
    """
    bearable = np.stack([lost[:, same_blur(radius_px, centre)].min(axis=1) for centre in radius_px], axis=1)
    voice = weight * focus_trust(radius_px[lost.argmin(axis=1)])
    cost, own_cost = (voice @ np.minimum(nats, _LOUDEST) for nats in (bearable, lost))
    equal = np.flatnonzero(cost <= cost.min() + 1e-9 * voice.sum())  # all that differ too little from the best
    best = int(equal[own_cost[equal].argmin()])
    return best, np.asarray(bearable[:, best] > _DENIES)


def _lost(plane: NDArray[np.float32], window: Window, model: DepthModel, options: EvidenceOptions) -> FloatArray | None:
    """Nats that each of some blurs loses to a window's best one, float64 (R,); None where it shows no texture."""
    fit = fit_part(plane, [window], model, options).fit
    best = float(fit.log_likelihood.max())
    if best - fit.null < options.least_evidence:
        return None
    return fit.likelihood_weight * (best - fit.log_likelihood)


def _nearest(windows: list[Window], chosen: Mask, mask: Mask) -> Mask:
    """Pixels of a region that are nearest to the middle of a chosen window, of what of it the region holds."""
    box = rows, columns = bounding_box(mask)
    middles = np.array([_middle(window) for window in windows]).round().astype(int)
    y = np.clip(middles[:, 0] - rows.start, 0, rows.stop - rows.start - 1)
    x = np.clip(middles[:, 1] - columns.start, 0, columns.stop - columns.start - 1)
    is_chosen = np.zeros((rows.stop - rows.start, columns.stop - columns.start), np.bool_)
    elsewhere = np.ones_like(is_chosen)
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
