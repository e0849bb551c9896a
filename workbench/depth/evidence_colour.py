"""One plane from three colour channels: the mixture in which a region's texture stands highest above the noise.

A surface of two colours that are equally bright has no texture in the luminance. Of all mixtures of the channels the
one with the largest ratio of texture to noise is the first generalised eigenvector of the two covariances (the
"noise-adjusted principal component" of Lee, Woodyatt and Berman 1990). The bank's PSFs are those of the luminance; a
mixture differs from it by less than half a photosite, yet only a clear gain is worth even that.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from calibration.image import LinearImage
from workbench.depth.regions import bounding_box

Mask = NDArray[np.bool_]
Plane = NDArray[np.float32]

_FINE_PX, _COARSE_PX = 1.5, 8.0
"""Texture: what lies between these two Gaussian blurs. Noise: what second differences leave."""
_REDUCED = 4
"""The coarse blur is made of a picture so many times smaller, and is the same within a hundredth of the texture."""
_LUMINANCE = np.array([0.25, 0.5, 0.25])
_LUMINANCE_AND_CHROMA = np.array([[0.25, 0.25, 0.25], [0.5, -0.5, 0.0], [0.25, 0.25, -0.25]])
"""Of R, G and B (rows): luminance, and what lies on the diagonal's carrier, and on each of the two others."""
_SECOND = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], np.float32) / 6.0
"""Second differences along both axes; white noise keeps its power."""
_BAND_NOISE = 0.066
"""Part of white noise's power between Gaussian blurs of 1 and 4 pixels."""
_CHROMA_SIDE = 512
_ENOUGH_PIXELS, _MANY_PIXELS = 400, 60_000
"""With fewer pixels there is no telling; of more than so many only some are taken."""


def informative_mixture(image: LinearImage, mask: Mask, least_gain: float) -> NDArray[np.float64] | None:
    """Mixture of the channels that shows a region's texture better than the luminance does.

    Parameters
    ----------
    image
        Developed image.
    mask
        bool (H, W): usable pixels of the region.
    least_gain
        Ratio of texture to noise (in power), relative to the luminance's, from which on the mixture is used.

    Returns
    -------
    float64 (3,) or None
        Weights of R, G and B, whose absolute values sum to 1. None where the luminance is as good, of a grey image, and
        of a region too small to tell.
    """
    if image.planes.shape[2] != 3:
        return None
    if not mask.any():
        return None
    box = bounding_box(mask)
    reach = 2 * int(_COARSE_PX) + 1
    whole = cv2.erode(
        np.ascontiguousarray(mask[box]).astype(np.uint8), np.ones((reach, reach), np.uint8),
        borderType=cv2.BORDER_CONSTANT, borderValue=1,
    )  # fmt: skip
    part = np.ascontiguousarray(image.planes[box])
    thin = max(1, int(np.sqrt(whole.size / _MANY_PIXELS)))
    inner = whole[::thin, ::thin] > 0
    if inner.sum() < _ENOUGH_PIXELS:
        return None
    band = cv2.GaussianBlur(part, (0, 0), _FINE_PX) - _coarse(part)
    texture = _covariance(np.asarray(band[::thin, ::thin], np.float32), inner)
    noise = _covariance(np.asarray(cv2.filter2D(part, -1, _SECOND)[::thin, ::thin], np.float32), inner)
    noise += 1e-3 * np.trace(noise) / 3.0 * np.eye(3) + 1e-16 * np.eye(3)
    ratios, vectors = linalg.eigh(texture, noise)
    plain = (_LUMINANCE @ texture @ _LUMINANCE) / (_LUMINANCE @ noise @ _LUMINANCE)
    if ratios[-1] < least_gain * plain:
        return None
    weights = vectors[:, -1] / np.abs(vectors[:, -1]).sum()
    return np.asarray(weights * np.sign(weights[np.abs(weights).argmax()]))


def chroma_over_luminance(planes: Plane, mask: Mask) -> float:
    """Power of the texture that colour filters modulate onto their carriers, relative to the luminance's.

    A mosaic is its luminance and two colour differences, one on the carrier of the diagonal, one on those of rows and
    of columns (Alleysson, Suesstrunk and Herault 2005). Colours count relative to the region's mean.

    Parameters
    ----------
    planes
        float32 (H, W, 3): superpixels, R, G and B.
    mask
        bool (H, W): usable ones.
    """
    rows, columns = (slice(max(0, (n - _CHROMA_SIDE) // 2), (n + _CHROMA_SIDE) // 2) for n in mask.shape)
    if mask[rows, columns].sum() < _ENOUGH_PIXELS:
        rows, columns = (slice(0, n) for n in mask.shape)
    inside, part = mask[rows, columns], planes[rows, columns]
    thin = max(1, int(np.sqrt(inside.size / _MANY_PIXELS)))
    if inside[::thin, ::thin].sum() < _ENOUGH_PIXELS:
        thin = 1
    counted = inside[::thin, ::thin]
    mean = np.maximum(part[::thin, ::thin][counted].mean(axis=0, dtype=np.float64), 1e-6)
    signals = np.asarray(part @ (_LUMINANCE_AND_CHROMA / mean[:, np.newaxis]).astype(np.float32))
    band = cv2.GaussianBlur(signals, (0, 0), 1.0) - cv2.GaussianBlur(signals, (0, 0), 4.0)
    noise = cv2.filter2D(signals, -1, _SECOND)
    texture, fine = (_covariance(np.asarray(seen[::thin, ::thin], np.float32), counted) for seen in (band, noise))
    power = np.diag(texture - _BAND_NOISE * fine)
    return float(max(power[1] + 2.0 * power[2], 0.0) / max(power[0], 1e-12))


def _coarse(part: Plane) -> Plane:
    height, width = part.shape[:2]
    small = cv2.resize(part, (-(-width // _REDUCED), -(-height // _REDUCED)), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), _COARSE_PX / _REDUCED)
    return np.asarray(cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _covariance(planes: Plane, inner: Mask) -> NDArray[np.float64]:
    values = planes[inner]
    values -= values.mean(axis=0)
    return np.asarray(values.T @ values, np.float64) / len(values)
