"""Merge neighbouring cells as long as what was seen in them is explained by one cause nearly as well as by one each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_CHANCE = 1.0
"""Log-likelihood that pieces of one cause lose by chance: all that lose less are equally compatible."""


def merge_cells(
    likelihood: FloatArray,
    colours: FloatArray,
    shape: tuple[int, int],
    within: NDArray[np.int32],
    tolerance: float,
    least_cells: int,
) -> NDArray[np.int32]:
    """Agglomerate neighbouring cells: the most compatible first, of equally compatible ones those of similar colours.

    Parameters
    ----------
    likelihood
        float64 (cells, n): log-likelihood of each cause, a radius of blur say, in each cell.
    colours
        float64 (cells, C), on a scale on which differences can be compared.
    shape
        Rows and columns of cells.
    within
        int32 (cells,): only cells of the same number merge.
    tolerance
        Log-likelihood that two pieces may lose by a common cause and still merge.
    least_cells
        A piece of fewer cells goes to the neighbour that suits it best, whatever it loses.

    Returns
    -------
    int32 (cells,)
        Piece of each cell, numbered from 1.
    """
    total = likelihood.shape[0]
    number = np.arange(total).reshape(shape)
    adjacent: dict[int, set[int]] = {index: set() for index in range(total)}
    for a, b in ((number[1:], number[:-1]), (number[:, 1:], number[:, :-1])):
        for i, j in zip(a.ravel().tolist(), b.ravel().tolist(), strict=True):
            if within[i] == within[j]:
                adjacent[i].add(j)
                adjacent[j].add(i)
    parent = np.arange(total)
    evidence, best, colour = likelihood.copy(), likelihood.max(axis=1), colours.copy()
    size = np.ones(total, int)

    def apart(first: int, second: int) -> tuple[float, float]:
        lost = float(best[first] + best[second] - (evidence[first] + evidence[second]).max())
        return max(lost, _CHANCE), float(np.abs(colour[first] - colour[second]).max())

    losses = {(i, j): apart(i, j) for i in adjacent for j in adjacent[i] if i < j}
    while losses:
        (keep, gone), (smallest, _) = min(losses.items(), key=lambda entry: entry[1])
        if smallest > tolerance:
            # what is too small to stand alone goes to the neighbour that suits it best
            small = {p: v for p, v in losses.items() if min(size[p[0]], size[p[1]]) < least_cells}
            if not small:
                break
            keep, gone = min(small, key=small.__getitem__)
        evidence[keep] += evidence[gone]
        best[keep] = evidence[keep].max()
        colour[keep] = (size[keep] * colour[keep] + size[gone] * colour[gone]) / (size[keep] + size[gone])
        size[keep] += size[gone]
        parent[parent == gone] = keep
        adjacent[keep] = (adjacent[keep] | adjacent.pop(gone)) - {keep, gone}
        losses = {pair: value for pair, value in losses.items() if keep not in pair and gone not in pair}
        for other in adjacent[keep]:
            adjacent[other] = (adjacent[other] - {gone}) | {keep}
            losses[min(keep, other), max(keep, other)] = apart(keep, other)
    return np.asarray(np.unique(parent, return_inverse=True)[1] + 1, np.int32)
