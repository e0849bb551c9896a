"""What one look through the camera says of the point: where it is, how bright, how wide."""

from __future__ import annotations

from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.errors import PointError
from calibration.image import FrameInfo, LinearImage
from calibration.optics import image_distance_mm
from calibration.points import find_points, remove_hot_pixels
from rigs.align_feed import AlignSample
from rigs.protocols import Exposure

FloatArray = NDArray[np.float64]

_CROP_MARGIN_PX = 40
_GAMMA = 2.2
_JPEG_WHITE = 254
_SUPPORT = 0.05
"""Of a saturated point, what is brighter than this part of white counts."""


def preview_image(jpeg: bytes) -> LinearImage | None:
    """A live view's JPEG as a linear image; None where it can't be decoded. Its tone curve is undone only roughly."""
    decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    if decoded is None:
        return None
    rgb = decoded[:, :, ::-1]
    planes = (rgb.astype(np.float32) / 255.0) ** _GAMMA
    return LinearImage(planes, rgb.max(axis=2) >= _JPEG_WHITE, "linear", None, FrameInfo("live view", ""))


def panel_mm_per_px(pitch_mm: float, depth_mm: float, focal_length_mm: float, focus_mm: float | None) -> float:
    """What a pixel covers on a panel, mm, by the chief rays of a thin lens focused at ``focus_mm`` (None: infinity)."""
    if focus_mm is None:
        return pitch_mm * depth_mm / focal_length_mm
    return pitch_mm * depth_mm / image_distance_mm(focal_length_mm=focal_length_mm, focus_mm=focus_mm)


def look(image: LinearImage, exposure: Exposure | None) -> AlignSample:
    """Measure the point in one frame.

    Parameters
    ----------
    image
        Developed frame, or a live view.
    exposure
        How it was exposed; None: not known.

    Returns
    -------
    AlignSample
        Centroid, peak and width (twice the root mean square radius of the point's light, pixels); with a note and no
        centroid where there is no point to measure.
    """
    height, width = image.shape
    exposure_s, iso = (exposure.time_s, exposure.iso) if exposure else (None, None)
    saturated = 0  # a point that can be measured isn't: what is at white then is a hot pixel
    try:
        point = find_points(image)[0]
    except PointError as error:
        saturated = int((image.saturated & ~remove_hot_pixels(image.planes)[1]).sum())
        light = _brightest_blob(image) if error.reason in ("saturated", "clipped", "doubled") else None
        if light is None:
            return AlignSample(
                width, height, _picture(image.luminance), peak=float(image.planes.max()), saturated_px=saturated,
                note=_advice(error.reason), exposure_s=exposure_s, iso=iso,
            )  # fmt: skip
        values, corner, note, peak = *light, _advice(error.reason), float(image.planes.max())
    else:
        values, corner = np.where(point.support, point.values, 0.0), point.corner_yx
        note, peak = "", point.peak
    centre_yx, radius = _moments(np.maximum(values, 0.0))
    y, x = corner[0] + centre_yx[0], corner[1] + centre_yx[1]
    box = _around(corner, values.shape, image.shape)
    picture = _picture(image.luminance[box[0] : box[1], box[2] : box[3]])
    return AlignSample(
        width, height, picture, (box[2], box[0], box[3] - box[2], box[1] - box[0]), (x, y),
        peak=peak, saturated_px=saturated, width_px=2.0 * radius, note=note, exposure_s=exposure_s, iso=iso,
    )  # fmt: skip


TASKS = MappingProxyType(
    {
        "cross-hair": "cross-hair: turn the camera until the cross stands in the middle",
        "white": "white: is the whole panel in view, and evenly lit?",
        "black": "black: all light that is left comes from the room",
        "": "the panel was switched during this frame",
    }
)
"""What a frame of each pattern without a point is good for."""


def only_show(image: LinearImage, pattern: str, exposure: Exposure | None) -> AlignSample:
    """A frame of a pattern that holds no point, or of two (empty ``pattern``): shown and metered, not measured."""
    height, width = image.shape
    return AlignSample(
        width, height, _picture(image.luminance, from_zero=pattern != "black"),
        peak=float(image.planes.max()) if pattern else None,
        saturated_px=int(image.saturated.sum()) if pattern else 0, task=TASKS[pattern],
        exposure_s=exposure.time_s if exposure else None, iso=exposure.iso if exposure else None,
    )  # fmt: skip


def _advice(reason: str) -> str:
    return {
        "missing": "no point in the frame: is the dot shown, the panel in view, the lens cap off?",
        "faint": "too faint: lengthen the exposure, or dim the room",
        "saturated": "saturated: shorten the exposure",
        "clipped": "the point touches the frame's border: move panel or camera",
        "doubled": "more than one bright thing: cover reflections and lamps",
    }.get(reason, reason)


def _brightest_blob(image: LinearImage) -> tuple[FloatArray, tuple[int, int]] | None:
    """Light of the largest bright patch and its corner, where no clean point can be cut out."""
    luminance = image.luminance.astype(np.float64)
    light = luminance - float(np.median(luminance))
    labels, found = ndimage.label(light > _SUPPORT)
    if not found:
        return None
    sizes = np.bincount(labels.ravel())[1:]
    largest = int(sizes.argmax()) + 1
    rows, columns = ndimage.find_objects(labels)[largest - 1]
    return np.where(labels[rows, columns] == largest, light[rows, columns], 0.0), (rows.start, columns.start)


def _moments(light: FloatArray) -> tuple[tuple[float, float], float]:
    """Centroid (row, column) and root mean square radius of non-negative light."""
    total = float(light.sum())
    rows, columns = np.arange(light.shape[0])[:, np.newaxis], np.arange(light.shape[1])
    y, x = float((light * rows).sum() / total), float((light * columns).sum() / total)
    return (y, x), float(np.sqrt((light * ((rows - y) ** 2 + (columns - x) ** 2)).sum() / total))


def _around(corner: tuple[int, int], shape: tuple[int, ...], frame: tuple[int, int]) -> tuple[int, int, int, int]:
    top, left = max(0, corner[0] - _CROP_MARGIN_PX), max(0, corner[1] - _CROP_MARGIN_PX)
    bottom = min(frame[0], corner[0] + shape[0] + _CROP_MARGIN_PX)
    return top, bottom, left, min(frame[1], corner[1] + shape[1] + _CROP_MARGIN_PX)


def _picture(luminance: NDArray[np.float32], longest: int = 900, *, from_zero: bool = False) -> bytes:
    """PNG for the page, stretched to what the picture holds and brightened as displays expect.

    ``from_zero`` leaves black where it is: of an even surface nothing but noise would be stretched.
    """
    low, high = map(float, np.percentile(luminance[:: max(1, luminance.shape[0] // 500)], (1.0, 100.0)))
    low = 0.0 if from_zero else low
    shown = np.clip((luminance - low) / max(high - low, 1e-6), 0.0, 1.0) ** (1 / _GAMMA)
    scale = longest / max(shown.shape)
    if scale < 1:
        shown = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".png", np.asarray(shown * 255.0, np.uint8))[1])
