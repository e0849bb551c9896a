"""Which side of focus each cell of a piece speaks for, if any.

Mirror depths with the same blur must not stay one region. Nor must plaster, whose grain tells no side, and a thing at
its mirror depth: it would be lent that thing's side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_expit

from workbench.depth.evidence_expected import smeared_power
from workbench.depth.evidence_model import DepthModel, Learned
from workbench.depth.evidence_periodogram import pooled_periodogram
from workbench.depth.evidence_side import favour_by_window
from workbench.depth.evidence_spectrum import fit_spectra
from workbench.depth.evidence_windows import Window

FloatArray = NDArray[np.float64]

_LEAST_RADIUS_PX = 1.5
"""Nearer to focus than this the two sides are the same depth, all but."""
_SPECTRUM_WINDOWS = 9
_TELLING = 3.0
"""Log-odds of cells whose texture tells a side of focus are mostly larger than this."""
_SCATTER = 2.0
"""Standard deviation of cells' log-odds about what their texture tells. Both were chosen on ray-traced scenes."""


def side_odds_by_cell(
    plane: NDArray[np.float32],
    windows: Sequence[Window],
    pieces: NDArray[np.int32],
    likelihood: FloatArray,
    model: DepthModel,
    learned: Learned,
    *,
    least_cells: int,
    overlap: float,
) -> FloatArray:
    """Log-odds of the far side against the near one for each cell, at its piece's radius.

    Parameters
    ----------
    plane
        float32 (H, W).
    windows
        One about each cell.
    pieces
        int32 (cells,): pieces of one |radius|.
    likelihood
        float64 (cells, R): log-likelihood of each of the model's rows.
    model, learned
        The bank, made ready.
    least_cells
        Pieces with fewer than twice as many cells are left whole.
    overlap
        Share of what a window says that is the cell's own; neighbouring windows see much of the same pixels.

    Returns
    -------
    float64 (cells,)
        0 where a piece has one side only, or is too small or too near to focus to be split.
    """
    result = np.zeros(len(windows))
    everywhere = np.ones_like(plane)
    for piece in np.unique(pieces):
        cells = np.flatnonzero(pieces == piece)
        row = int(likelihood[cells].sum(axis=0).argmax())
        radius = abs(float(model.row_radius_px[row]))
        if cells.size < 2 * least_cells or radius < _LEAST_RADIUS_PX or not model.sides_in_reach[row].all():
            continue
        own = [windows[int(cell)] for cell in cells]
        pooled = pooled_periodogram(plane, own[:: -(-len(own) // _SPECTRUM_WINDOWS)], model.kernel_lags.shape[1] // 2)
        expected = smeared_power(model.kernel_lags[row : row + 1], pooled.taper_lags, pooled.power.shape[0])
        fit = fit_spectra(pooled.power, pooled.trusted, expected, independent_share=pooled.independent_share)
        psfs = [model.psf_at(sign * radius) for sign in (1.0, -1.0)]
        favour = favour_by_window(plane, everywhere, own, psfs, fit.texture(0))
        result[cells] = overlap * favour @ learned.favour_weights
    return result


def side_likelihoods(odds: FloatArray) -> FloatArray:
    """Log-probability of the far and of the near side, float64 (cells, 2), from the log-odds (cells,) between them."""
    return np.stack([log_expit(odds), log_expit(-odds)], axis=1)


def telling_likelihoods(odds: FloatArray) -> FloatArray:
    """Log-likelihood of three kinds of texture: that tells the far side, the near side, or none.

    With log-odds ``o``: ``-(max(0, 3 - o) / 2)^2 / 2`` for the far side, ``-(max(0, 3 + o) / 2)^2 / 2`` for the near
    one (any larger log-odds are as likely), ``-(o / 2)^2 / 2`` for none, each but for the same constant.

    Parameters
    ----------
    odds
        float64 (cells,): log-odds of the far side against the near one.

    Returns
    -------
    float64 (cells, 3), nats.
    """
    short = [np.maximum(_TELLING - sign * odds, 0.0) for sign in (1.0, -1.0)]
    return np.asarray(-0.5 * (np.stack([*short, odds], axis=1) / _SCATTER) ** 2)
