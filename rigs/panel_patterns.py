"""From a pattern to what the page is told to draw: checked, and with its brightness turned into screen values.

Brightness is linear light: ``brightness`` 0.5 asks for half the light of ``colour``. Screens take sRGB values, so
each channel is decoded, multiplied and encoded again with the transfer function of IEC 61966-2-1. How well a real
screen follows it is its own affair; full brightness and black don't depend on it.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigs.charts import BUILT_IN
from rigs.errors import PanelError
from rigs.protocols import Pattern

_COLOUR = re.compile(r"#[0-9a-fA-F]{6}")
_LARGEST_PICTURE_PX = 8192


def srgb_decoded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear light (0 to 1) of sRGB values (0 to 1); IEC 61966-2-1."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_encoded(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """SRGB values (0 to 1) of linear light (0 to 1); IEC 61966-2-1."""
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def dimmed(values: NDArray[np.uint8], brightness: float) -> NDArray[np.uint8]:
    """8-bit sRGB values at ``brightness`` (0 to 1) times their light; any shape, same shape returned."""
    levels = srgb_encoded(brightness * srgb_decoded(np.arange(256) / 255.0))
    table = np.round(255.0 * levels).astype(np.uint8)
    return np.asarray(table[values], dtype=np.uint8)


def drawing(pattern: Pattern) -> dict[str, Any]:
    """What the page draws, as JSON: kind, screen colour after dimming, whole sizes, positions.

    Raises
    ------
    PanelError
        The pattern can't be shown; names the value and what would be allowed.
    """
    _check(pattern)
    channels = np.array([int(pattern.colour[i : i + 2], 16) for i in (1, 3, 5)], dtype=np.uint8)
    shown = dimmed(channels, pattern.brightness)
    if pattern.kind not in ("black", "picture") and pattern.brightness > 0 and channels.any() and not shown.any():
        raise PanelError(
            f"panel: brightness {pattern.brightness:g} of {pattern.colour} is below the screen's first step above "
            "black; raise the brightness and shorten the exposure"
        )
    return {
        "kind": pattern.kind,
        "colour": "#" + bytes(shown).hex(),
        "size_px": max(1, math.floor(pattern.size_px + 0.5)),
        "x_px": pattern.x_px,
        "y_px": pattern.y_px,
        "points_px": [list(point) for point in pattern.points_px],
    }


def _check(pattern: Pattern) -> None:
    if not _COLOUR.fullmatch(pattern.colour):
        raise PanelError(f"panel: colour {pattern.colour!r} is none; write it as #rrggbb")
    if not 0.0 <= pattern.brightness <= 1.0:
        raise PanelError(f"panel: brightness {pattern.brightness!r} isn't between 0 and 1")
    numbers = (pattern.size_px, pattern.x_px, pattern.y_px, *(v for point in pattern.points_px for v in point))
    if not all(math.isfinite(number) for number in numbers) or not 0 < pattern.size_px <= _LARGEST_PICTURE_PX:
        raise PanelError("panel: size and positions have to be finite numbers of pixels, the size above 0")
    if pattern.kind == "grid" and not pattern.points_px:
        raise PanelError("panel: a grid without points; give the dots' positions in points_px")


def outside(pattern: Pattern, width_px: int, height_px: int) -> tuple[float, float] | None:
    """Position of the first dot that doesn't lie wholly on a panel of this size, or None."""
    if pattern.kind not in ("dot", "grid"):
        return None
    points = pattern.points_px if pattern.kind == "grid" else ((pattern.x_px, pattern.y_px),)
    radius = pattern.size_px / 2
    for x, y in points:
        if abs(x) + radius > width_px / 2 or abs(y) + radius > height_px / 2:
            return x, y
    return None


class Picture:
    """The picture of one pattern, as PNG for the panel's size; read and checked at construction.

    Built-in pictures are drawn at the panel's size. Files keep their own; the page shows them pixel for pixel, made
    smaller only where they don't fit.

    Raises
    ------
    PanelError
        Neither a built-in picture nor a readable image file.
    """

    def __init__(self, pattern: Pattern) -> None:
        self._brightness = pattern.brightness
        self._draw = BUILT_IN.get(pattern.picture)
        self._pixels = None if self._draw is not None else _read(pattern.picture)
        self._last: tuple[tuple[int, int], bytes] | None = None

    def png(self, width_px: int, height_px: int) -> bytes:
        """PNG for a panel of this size (1 to 8192 pixels a side)."""
        size = (min(max(width_px, 1), _LARGEST_PICTURE_PX), min(max(height_px, 1), _LARGEST_PICTURE_PX))
        if self._last is None or self._last[0] != size:
            pixels = self._draw(*size) if self._draw is not None else self._pixels
            assert pixels is not None
            done, data = cv2.imencode(".png", dimmed(pixels, self._brightness), [cv2.IMWRITE_PNG_COMPRESSION, 1])
            assert done
            self._last = (size, data.tobytes())
        return self._last[1]


def _read(name: str) -> NDArray[np.uint8]:
    known = f"built-in pictures are {', '.join(sorted(BUILT_IN))}"
    path = Path(name).expanduser()
    try:
        data = path.read_bytes() if name else b""
    except OSError as error:
        raise PanelError(f"panel: picture {name!r} can't be read ({error.strerror}); {known}") from None
    pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR) if data else None
    if pixels is None:
        raise PanelError(f"panel: picture {name!r} is no image file (PNG, JPEG, TIFF); {known}")
    if max(pixels.shape[:2]) > _LARGEST_PICTURE_PX:
        raise PanelError(f"panel: picture {name!r} is larger than {_LARGEST_PICTURE_PX} pixels a side; shrink it")
    return np.asarray(pixels, dtype=np.uint8)
