"""Find the image of a point in a developed frame, clean it, and cut it out with its noise.

The search works on significance, not on brightness: sums over boxes of several sizes against their noise, so that a
one-pixel image at focus and a faint wide one far from it are found by the same rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.errors import PointError
from calibration.image import FrameInfo, LinearImage

_BOXES = (1, 3, 9, 25)
_MAD = 1.4826
_EVEN = 0.35
"""Light is even where eight neighbours differ by less than this part of the brightest."""


@dataclass(frozen=True, slots=True)
class PointOptions:
    """What counts as a point. Signal-to-noise figures are ratios to the noise measured in the frame."""

    detect_snr: float = 7.0
    """A box of pixels this far above the noise belongs to a point (5 would be reached by chance once in 18 MP)."""
    min_snr: float = 50.0
    """Total flux over its noise below which the radius can't be measured to a few hundredths of a pixel: faint."""
    double_fraction: float = 0.05
    """A second object with this share of the point's flux makes the frame doubled."""
    ring_sigma: float = 3.0
    """The support ends where two rings in a row hold no flux beyond this many standard errors."""
    margin_px: int = 6
    """Dark pixels kept around the support."""


@dataclass(frozen=True, slots=True)
class PointImage:
    """One point cut out of one frame.

    Attributes
    ----------
    values
        float64 (h, w): luminance above the local background, fraction of white, not normalised.
    variance
        float64 (h, w): noise variance of ``values``.
    support
        bool (h, w): where the point's light is.
    corner_yx
        Row and column in the developed frame of ``values[0, 0]``.
    frame_shape, info
        Shape of the developed frame, and the facts of its file.
    flux, flux_snr
        Sum over the support, and its ratio to its standard error.
    background, background_tilt, noise
        Local background level, its change across the cut-out, and standard deviation per pixel (fractions of white).
    noise_gain
        Variance per unit of signal (shot noise, and whatever else grows with the signal).
    peak
        Brightest channel value in the support (fraction of white), before the background was removed.
    hot_pixels
        Number of single-channel outliers that were replaced in the cut-out.
    """

    values: NDArray[np.float64]
    variance: NDArray[np.float64]
    support: NDArray[np.bool_]
    corner_yx: tuple[int, int]
    frame_shape: tuple[int, int]
    info: FrameInfo
    flux: float
    flux_snr: float
    background: float
    background_tilt: float
    noise: float
    noise_gain: float
    peak: float
    hot_pixels: int


def find_points(image: LinearImage, *, expected: int = 1, options: PointOptions | None = None) -> list[PointImage]:
    """Find the ``expected`` brightest points of a frame and cut each out.

    Parameters
    ----------
    image
        Developed frame with a dark surround (black panel).
    expected
        Number of points that the panel showed.
    options
        Thresholds; the defaults suit all lenses and panels so far.

    Returns
    -------
    list of PointImage
        In rows from top to bottom and, within a row, left to right (order of the cut-outs' centres).

    Raises
    ------
    PointError
        ``missing`` (none or too few), ``faint``, ``saturated``, ``clipped`` by the frame's border, ``doubled`` (more
        points than expected).
    """
    options = options or PointOptions()
    planes, hot = remove_hot_pixels(image.planes)
    lone = _lone_saturated(planes, image.saturated & ~hot)
    if lone.any():
        planes = np.where(lone[:, :, np.newaxis], _medians(planes), planes)
        hot = hot | lone
    cleaned = LinearImage(planes, image.saturated & ~hot, image.recipe, image.pixel_pitch_mm, image.info)
    luminance = cleaned.luminance
    flat, noise = _flatten(luminance)
    labels, boxes, fluxes = _candidates(flat, noise, options)
    path = image.info.path
    if not boxes:
        raise PointError("missing", f"{path}: shows no point above the noise; check panel, focus cap and exposure")
    order = np.argsort(fluxes)[::-1]
    if len(order) < expected:
        raise PointError(
            "missing", f"{path}: shows {len(order)} of {expected} points; expose longer or check the panel"
        )
    weakest = fluxes[order[expected - 1]]
    if len(order) > expected and fluxes[order[expected]] > options.double_fraction * weakest:
        second = boxes[order[expected]]
        where = f"x {second[1].start}, y {second[0].start}"
        raise PointError(
            "doubled",
            f"{path}: shows more than {expected} point{'s' if expected > 1 else ''} (another at {where}); "
            "cover reflections, or take a dark frame if it is a hot pixel",
        )
    found = [_cut_out(cleaned, luminance, hot, labels, int(i) + 1, boxes[i], noise, options) for i in order[:expected]]
    row_height = max(p.values.shape[0] for p in found)
    return sorted(found, key=lambda p: (_centre(p)[0] // (2 * row_height), _centre(p)[1]))


def remove_hot_pixels(planes: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Replace pixels that stand out in one or two of three channels, but not in all, by their neighbours' median.

    A real point, even one smaller than a photosite, lights all channels of its pixel or of a neighbour, since the
    channels lie side by side; a hot photosite lights its own. An image with one channel can't be told apart this way
    and is returned unchanged (a dark frame does it there).

    Returns
    -------
    planes, hot
        float32 (H, W, C) and bool (H, W).
    """
    hot = np.zeros(planes.shape[:2], np.bool_)
    if planes.shape[2] != 3:
        return planes, hot
    medians = [cv2.medianBlur(np.ascontiguousarray(planes[:, :, c]), 3) for c in range(3)]
    deviations = [planes[:, :, c] - medians[c] for c in range(3)]
    sigmas = [_MAD * float(np.median(np.abs(d[::3, ::3]))) + 1e-9 for d in deviations]
    around = [cv2.dilate(d, np.ones((3, 3), np.uint8)) for d in deviations]
    cleaned = planes
    for c in range(3):
        # a share of the local signal allows for shot noise at high ISO
        outlier = deviations[c] > 10.0 * sigmas[c] + 0.3 * np.maximum(medians[c], 0.0)
        where = np.nonzero(outlier)
        dark = np.zeros(where[0].size, np.bool_)
        for k in range(3):
            if k != c:
                dark |= around[k][where] < 0.05 * deviations[c][where] + 4.0 * sigmas[k]
        where = (where[0][dark], where[1][dark])
        if where[0].size:
            if cleaned is planes:
                cleaned = planes.copy()
            cleaned[:, :, c][where] = medians[c][where]
            hot[where] = True
    return cleaned, hot


def _lone_saturated(planes: NDArray[np.float32], saturated: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Saturated pixels within the even light of a large point: hot photosites, which long exposures drive to white.

    A point that is truly too bright takes its brightest pixels to white together, or falls off steeply around the one.
    """
    kernel = np.ones((3, 3), np.uint8)
    ring = kernel.copy()
    ring[1, 1] = 0
    alone = saturated & (cv2.filter2D(saturated.astype(np.uint8), -1, kernel, borderType=cv2.BORDER_CONSTANT) == 1)
    if not alone.any():
        return np.zeros_like(saturated)
    brightest = np.ascontiguousarray(planes.max(axis=2))
    high, low = cv2.dilate(brightest, ring), cv2.erode(brightest, ring)
    return np.asarray(alone & (high < 0.9) & (low > 0.3) & (high - low < _EVEN * high))


def _medians(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    channels = [cv2.medianBlur(np.ascontiguousarray(planes[:, :, c]), 3) for c in range(planes.shape[2])]
    return np.asarray(np.stack(channels, axis=2), np.float32)


def _flatten(luminance: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """Subtract a robust plane (ambient light) and measure the noise from differences of neighbours."""
    height, width = luminance.shape
    step = max(1, min(height, width) // 128)
    sample = luminance[::step, ::step].astype(np.float64)
    yy, xx = np.mgrid[0:height:step, 0:width:step]
    plane = _robust_plane(yy.ravel() / height - 0.5, xx.ravel() / width - 0.5, sample.ravel())
    rows = (plane[0] + plane[1] * (np.arange(height) / height - 0.5)).astype(np.float32)
    columns = (plane[2] * (np.arange(width) / width - 0.5)).astype(np.float32)
    flat = luminance - rows[:, np.newaxis] - columns[np.newaxis, :]
    differences = np.diff(luminance[:: max(1, step // 2)], axis=1)
    noise = _MAD * float(np.median(np.abs(differences))) / np.sqrt(2.0)
    return flat, max(noise, 1e-7)


def _robust_plane(y: NDArray[np.float64], x: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least squares plane (level, slope y, slope x) through what isn't an outlier (3 sigma, iterated)."""
    design = np.stack([np.ones_like(y), y, x], axis=1)
    level = float(np.median(v))
    keep = np.abs(v - level) <= 3.0 * (_MAD * np.median(np.abs(v - level)) + 1e-9)
    plane = np.array([level, 0.0, 0.0])
    for _ in range(4):
        if keep.sum() < 12:
            break
        kept = design[keep]  # by normal equations: three well-scaled unknowns, very many rows
        plane = np.linalg.lstsq(kept.T @ kept, kept.T @ v[keep], rcond=None)[0]
        residual = v - design @ plane
        keep = np.abs(residual) <= 3.0 * (_MAD * np.median(np.abs(residual[keep])) + 1e-9)
    return plane


def _candidates(
    flat: NDArray[np.float32], noise: float, options: PointOptions
) -> tuple[NDArray[np.int32], list[tuple[slice, slice]], NDArray[np.float64]]:
    """Connected areas above the noise at any box size, with their bounding boxes and fluxes."""
    mask = (flat > options.detect_snr * noise).astype(np.uint8)
    # light that is plain to see in single pixels must not spread over the larger boxes, which look for faint light
    rest = np.minimum(flat, np.float32(2.0 * noise))
    bright = (flat > 3.0 * options.detect_snr * noise).astype(np.uint8)
    rest[cv2.dilate(bright, np.ones((3, 3), np.uint8)) > 0] = 0.0
    for box in _BOXES[1:]:
        mean = cv2.blur(rest, (box, box), borderType=cv2.BORDER_REFLECT_101)
        mask |= (mean > options.detect_snr * noise / box).astype(np.uint8)
    joined = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, found = cv2.connectedComponents(joined, connectivity=8)
    labels = np.asarray(found, np.int32)
    if count <= 1:
        return labels, [], np.zeros(0)
    fluxes = np.bincount(labels.ravel(), weights=flat.ravel(), minlength=count)[1:]
    boxes = [box for box in ndimage.find_objects(labels) if box is not None]
    return labels, boxes, np.asarray(fluxes, np.float64)


def _cut_out(
    image: LinearImage,
    luminance: NDArray[np.float32],
    hot: NDArray[np.bool_],
    labels: NDArray[np.int32],
    label: int,
    box: tuple[slice, slice],
    noise: float,
    options: PointOptions,
) -> PointImage:
    path = image.info.path
    height, width = luminance.shape
    size = max(box[0].stop - box[0].start, box[1].stop - box[1].start)
    reach = size // 2 + 16 + options.margin_px
    y0, y1 = max(0, box[0].start - reach), min(height, box[0].stop + reach)
    x0, x1 = max(0, box[1].start - reach), min(width, box[1].stop + reach)
    window = (slice(y0, y1), slice(x0, x1))
    raw = luminance[window].astype(np.float64)
    core = labels[window] == label
    if min(box[0].start, box[1].start) == 0 or box[0].stop == height or box[1].stop == width:
        raise PointError(
            "clipped", f"{path}: the point is cut by the frame's border; centre the panel or go closer to it"
        )
    if bool((image.saturated[window] & core).any()):
        raise PointError("saturated", f"{path}: the point is saturated; halve the exposure or more")
    others = (labels[window] > 0) & ~core
    support, values, plane = _grow(raw, core, others, noise, options)
    rows, columns = np.flatnonzero(support.any(axis=1)), np.flatnonzero(support.any(axis=0))
    top, bottom, left, right = y0 + rows[0], y0 + rows[-1], x0 + columns[0], x0 + columns[-1]
    if top <= 0 or left <= 0 or bottom >= height - 1 or right >= width - 1:
        raise PointError("clipped", f"{path}: the point's light reaches the frame's border; centre the panel")
    margin = options.margin_px
    cut = (
        slice(max(0, rows[0] - margin), min(raw.shape[0], rows[-1] + 1 + margin)),
        slice(max(0, columns[0] - margin), min(raw.shape[1], columns[-1] + 1 + margin)),
    )
    gain = _noise_gain(image.planes[window], support, noise)
    variance = noise**2 + (gain if np.isfinite(gain) else 0.0) * np.maximum(values, 0.0)
    flux = float(values[support].sum())
    # against the background's noise alone: the gain of one small point is an upper bound, and pooled later
    detection = flux / (noise * float(np.sqrt(support.sum())))
    if detection < options.min_snr:
        raise PointError(
            "faint",
            f"{path}: too faint a point (signal to noise {detection:.0f}, needs {options.min_snr:.0f}); expose longer",
        )
    return PointImage(
        values=values[cut],
        variance=variance[cut],
        support=support[cut],
        corner_yx=(int(y0 + cut[0].start), int(x0 + cut[1].start)),
        frame_shape=(height, width),
        info=image.info,
        flux=flux,
        flux_snr=flux / float(np.sqrt(variance[support].sum())),
        background=float(plane[0]),
        background_tilt=float(np.hypot(plane[1] * raw.shape[0], plane[2] * raw.shape[1])),
        noise=noise,
        noise_gain=gain,
        peak=float(image.planes[window][support].max()),
        hot_pixels=int((hot[window] & support).sum()),
    )


def _grow(
    raw: NDArray[np.float64], core: NDArray[np.bool_], others: NDArray[np.bool_], noise: float, options: PointOptions
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Grow the support ring by ring until the rings hold nothing but noise; fit the background outside it.

    Returns support, values above the background plane, and the plane (level at the centre, slope y, slope x per px).
    """
    distance = ndimage.distance_transform_edt(~core)
    yy, xx = np.mgrid[0 : raw.shape[0], 0 : raw.shape[1]]
    yy, xx = yy - raw.shape[0] / 2.0, xx - raw.shape[1] / 2.0
    free = ~others
    limit = float(distance.max())
    radius, quiet = 0.0, 0
    values, plane = raw, np.zeros(3)
    while True:
        outside = (distance > radius + 2.0) & free
        if outside.sum() < 40:
            break
        plane = _robust_plane(yy[outside], xx[outside], raw[outside])
        values = raw - (plane[0] + plane[1] * yy + plane[2] * xx)
        ring = (distance > radius) & (distance <= radius + 1.0) & free
        count = int(ring.sum())
        if count == 0 or radius + 6.0 > limit:
            break
        # the plane's own error is that of a mean over the pixels outside
        error = noise * np.sqrt(count + count**2 / outside.sum())
        quiet = quiet + 1 if abs(values[ring].sum()) <= options.ring_sigma * error else 0
        if quiet == 2:
            radius -= 1.0
            break
        radius += 1.0
    support = distance <= max(radius, 0.0)
    return support & free, values, plane


def _noise_gain(planes: NDArray[np.float32], support: NDArray[np.bool_], noise: float) -> float:
    """Variance of the luminance per unit of signal: an upper bound, infinite where the point is too small to tell.

    Two readings, of which the smaller counts. A second-difference filter in the flat inside of the support: what it
    sees is noise, and structure. And what green doesn't share with red and blue: noise, and edges, since the three sit
    on different photosites of a cell.
    """
    luminance = planes.astype(np.float64).mean(axis=2) if planes.shape[2] == 1 else _cell_mean(planes)
    second = ndimage.convolve(luminance, np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0)
    inside = ndimage.binary_erosion(support, iterations=2) & (luminance > 0.5 * np.quantile(luminance[support], 0.9))
    bounds = [np.inf]
    if inside.sum() >= 30:
        variance = (_MAD * float(np.median(np.abs(second[inside])))) ** 2
        bounds.append((variance - noise**2) / float(np.mean(luminance[inside])))
    if planes.shape[2] == 3 and support.sum() >= 30:
        r, g, b = (planes[:, :, c].astype(np.float64) for c in range(3))
        r, g, b = (c - np.median(c[~support]) for c in (r, g, b))
        rest = 0.5 * (r + b)  # luminance = (g + rest) / 2
        ratio = float((g * rest)[support].sum() / (g * g)[support].sum())
        # with equal gain per photosite var(g) = k g / 2 and var(rest) = k (r + b) / 4 = k rest / 2
        residual = rest - ratio * g
        expected = 0.5 * (np.maximum(rest, 0.0) + ratio**2 * np.maximum(g, 0.0))
        quiet = float(np.median(np.abs(residual[~support])) * _MAD) ** 2
        # luminance variance = (var(g) + var(rest)) / 4 = k (g + rest) / 8 = k L / 4
        excess = float((residual[support] ** 2).sum()) - quiet * support.sum()
        bounds.append(0.25 * excess / float(expected[support].sum()))
    return max(0.0, min(bounds))


def _cell_mean(planes: NDArray[np.float32]) -> NDArray[np.float64]:
    r, g, b = (planes[:, :, c].astype(np.float64) for c in range(3))
    return np.asarray(0.25 * (r + 2.0 * g + b), np.float64)


def _centre(point: PointImage) -> tuple[float, float]:
    return point.corner_yx[0] + point.values.shape[0] / 2.0, point.corner_yx[1] + point.values.shape[1] / 2.0
