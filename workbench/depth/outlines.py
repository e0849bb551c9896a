"""Where two regions meet, and how the brightness runs across: the data that occlusion is judged by.

Regions that were found follow the picture's outlines only roughly: along strips of half-shadow, along a grid. So the
two regions that meet at a point are those that lie some way to both sides, whatever lies in between, and the place of
the step in brightness is left open.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.image import LinearImage

FloatArray = NDArray[np.float64]
Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]
Value = TypeVar("Value", bound=np.generic)

_SPACING_PX = 3
"""Between points along an outline."""
_ALONG_PX = 3
"""A profile is the mean over so many pixels to both sides, along the outline."""
_SMOOTHED_PX, _PATCH_PX = 2.0, 6
"""An outline's direction is that of the regions smoothed so much; the patch that it is read from."""
_BEYOND_PX = 10, 20
"""Distances from a point between which a region has to lie alone."""
_AT_ONCE = 20000
"""Points whose directions are read at once: each takes a kilobyte or two."""
_PURE = 0.9
"""Share of what is looked at that belongs to the region."""
_STRIP_PX, _STRIP_SHARE = 6.0, 0.35
"""About an outline what belongs to neither doesn't matter, up to so many pixels or such a part of the profile."""
_CELL_PX, _PER_CELL = 12, 5
"""A strip between two regions has two borders: of so large a square no more points are kept than one outline has."""
_MOST_POINTS, _LEAST_POINTS = 400, 8
"""Of an outline: more are thinned, fewer say nothing."""
_CLIPPED = 0.01
"""Share of saturated pixels that spoils a profile: a clipped edge is a skewed one."""
_FAR_OUT, _STIFFNESS = 0.6, 1e-3
"""Of a profile: from which part of its length on a colour is that of the region. And a share of the colours' variance
that is there in every direction, so that none counts without end."""


@dataclass(frozen=True, slots=True)
class Outline:
    """Where two regions meet.

    Attributes
    ----------
    first, second
        Their labels, the smaller one first.
    yx
        float64 (n, 2): points, pixels.
    normal_yx
        float64 (n, 2): unit vectors into the first region.
    """

    first: int
    second: int
    yx: FloatArray
    normal_yx: FloatArray


@dataclass(frozen=True, slots=True)
class Profiles:
    """Brightness across an outline.

    Attributes
    ----------
    values
        float64 (n, 2 L + 1): one row per point, one value per pixel from L px within the second region to L px within
        the first, in the mixture of colours that differs most between them.
    angle
        float64 (n,): direction of the first region, radians from the image's x towards its y.
    """

    values: FloatArray
    angle: FloatArray


def find_outlines(labels: Labels) -> list[Outline]:
    """All places where two regions meet.

    Parameters
    ----------
    labels
        int32 (H, W): region of each pixel, 0 = none. Regions with pixels of none between them don't meet.

    Returns
    -------
    list of Outline
        By their labels.
    """
    yx, normal = _directed(labels, *_borders(labels))
    steps = np.arange(_BEYOND_PX[0], _BEYOND_PX[1] + 1)
    (ahead, clear_ahead), (behind, clear_behind) = (
        _majority(_looked_up(labels, yx[:, np.newaxis] + side * normal[:, np.newaxis] * steps[:, np.newaxis]))
        for side in (1.0, -1.0)
    )
    good = clear_ahead & clear_behind & (ahead != behind) & (np.minimum(ahead, behind) > 0)
    turned = np.where(ahead > behind, -1.0, 1.0)[:, np.newaxis]
    pairs = np.sort(np.stack([ahead, behind], axis=1), axis=1)
    found = []
    for first, second in np.unique(pairs[good], axis=0):
        of_pair = np.flatnonzero(good & (pairs == (first, second)).all(axis=1))
        apart = np.sort(np.unique((yx[of_pair] // _SPACING_PX).astype(int), axis=0, return_index=True)[1])
        chosen = of_pair[apart[_thinned(yx[of_pair[apart]])]]
        found.append(Outline(int(first), int(second), yx[chosen], (turned * normal)[chosen]))
    return found


def read_profiles(image: LinearImage, labels: Labels, outline: Outline, reach_px: int) -> Profiles | None:
    """Brightness across an outline.

    Parameters
    ----------
    image
        Linear light; points with saturated pixels so near are left out.
    labels
        int32 (H, W), as the outline was found in.
    outline
        See :func:`find_outlines`.
    reach_px
        L, how far to both sides.

    Returns
    -------
    Profiles or None
        Of the points that have both regions to themselves so far; None where there are few.
    """
    room = reach_px + _ALONG_PX + 2
    within = ((outline.yx > room) & (outline.yx < np.array(labels.shape) - 1 - room)).all(axis=1)
    points = np.flatnonzero(within)
    if points.size > _MOST_POINTS:
        points = points[np.linspace(0, points.size - 1, _MOST_POINTS).astype(int)]
    across, along = np.arange(-reach_px, reach_px + 1.0), np.arange(-_ALONG_PX, _ALONG_PX + 1.0)
    normal = outline.normal_yx[points]
    tangent = np.stack([normal[:, 1], -normal[:, 0]], axis=1)
    samples = (
        outline.yx[points, np.newaxis, np.newaxis]
        + normal[:, np.newaxis, np.newaxis] * across[:, np.newaxis, np.newaxis]
        + tangent[:, np.newaxis, np.newaxis] * along[:, np.newaxis]
    )
    seen, beyond = _looked_up(labels, samples), max(_STRIP_PX, _STRIP_SHARE * reach_px)
    pure = (seen[:, across > beyond] == outline.first).mean(axis=(1, 2)) > _PURE
    pure &= (seen[:, across < -beyond] == outline.second).mean(axis=(1, 2)) > _PURE
    pure &= _looked_up(image.saturated, samples).mean(axis=(1, 2)) <= _CLIPPED
    if pure.sum() < _LEAST_POINTS:
        return None
    colours = _interpolated(image.planes, samples[pure]).mean(axis=2)
    far = np.abs(across) > _FAR_OUT * reach_px
    mixture = _discriminant(colours[:, far & (across > 0)], colours[:, far & (across < 0)])
    return Profiles(colours @ mixture, np.arctan2(normal[pure, 0], normal[pure, 1]))


def _borders(labels: Labels) -> tuple[FloatArray, Labels]:
    """Points between neighbouring pixels of different regions, float64 (n, 2), and their labels, int32 (n, 2)."""
    points, sides = [], []
    for down, right in ((0, 1), (1, 0)):
        here, there = labels[: labels.shape[0] - down, : labels.shape[1] - right], labels[down:, right:]
        yx = np.argwhere((here != there) & (here > 0) & (there > 0))
        thin = np.unique(
            np.column_stack([yx // _SPACING_PX, here[tuple(yx.T)], there[tuple(yx.T)]]), axis=0, return_index=True
        )[1]
        yx = yx[np.sort(thin)]
        points.append(yx + np.array([down, right]) / 2)
        sides.append(np.stack([here[tuple(yx.T)], there[tuple(yx.T)]], axis=1))
    return np.concatenate(points), np.concatenate(sides)


def _directed(labels: Labels, yx: FloatArray, sides: Labels) -> tuple[FloatArray, FloatArray]:
    """The points that have a direction, and unit vectors towards the first of their two labels; float64 (n, 2) each."""
    span = np.arange(-_PATCH_PX, _PATCH_PX + 1)
    offsets = np.stack(np.meshgrid(span, span, indexing="ij"), axis=-1).reshape(-1, 2)
    weights = offsets * np.exp(-0.5 * (offsets**2).sum(axis=1, keepdims=True) / _SMOOTHED_PX**2)
    normal = np.empty(yx.shape)
    for start in range(0, len(yx), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        patch = _looked_up(labels, yx[some, np.newaxis] + offsets)
        normal[some] = ((patch == sides[some, :1]).astype(np.float64) - (patch == sides[some, 1:])) @ weights
    length = np.linalg.norm(normal, axis=1)
    directed = length > 1e-6 * np.abs(weights).sum()
    return yx[directed], normal[directed] / length[directed, np.newaxis]


def _thinned(yx: FloatArray) -> NDArray[np.intp]:
    """Indices of the first few points of each square cell, points (n, 2)."""
    cell = np.unique((yx // _CELL_PX).astype(int), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], cell[order])
    return np.sort(order[np.arange(cell.size) - first < _PER_CELL])


def _looked_up(picture: NDArray[Value], yx: FloatArray) -> NDArray[Value]:
    """Value of the pixel about each point (..., 2) of a picture (H, W); its border goes on beyond it."""
    y, x = (np.clip(np.rint(yx[..., k]).astype(np.intp), 0, picture.shape[k] - 1) for k in (0, 1))
    return picture[y, x]


def _majority(labels: Labels) -> tuple[Labels, Mask]:
    """Median of each row of labels (n, k), and whether nearly all of the row is that."""
    middle = np.sort(labels, axis=1)[:, labels.shape[1] // 2]
    return middle, (labels == middle[:, np.newaxis]).mean(axis=1) > _PURE


def _interpolated(planes: NDArray[np.float32], yx: FloatArray) -> FloatArray:
    """Colours at points (n, a, b, 2), float64 (n, a, b, C)."""
    y, x = (np.ascontiguousarray(yx[..., k].reshape(len(yx), -1), dtype=np.float32) for k in (0, 1))
    channels = [
        cv2.remap(np.ascontiguousarray(planes[..., c]), x, y, cv2.INTER_LINEAR).reshape(yx.shape[:-1])
        for c in range(planes.shape[2])
    ]
    return np.stack(channels, axis=-1).astype(np.float64)


def _discriminant(first: FloatArray, second: FloatArray) -> FloatArray:
    """Fisher's linear discriminant (1936) of two sets of colours (n, k, C): the mixture that tells them best apart."""
    a, b = (colours.reshape(-1, colours.shape[-1]) for colours in (first, second))
    scatter = np.atleast_2d(np.cov(a.T) + np.cov(b.T))
    channels = scatter.shape[0]
    scatter += (_STIFFNESS * np.trace(scatter) / channels + 1e-15) * np.eye(channels)
    mixture = np.linalg.solve(scatter, a.mean(axis=0) - b.mean(axis=0))
    return np.asarray(mixture / max(float(np.abs(mixture).sum()), 1e-30))
