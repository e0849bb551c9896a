"""The simulated lens: from a pupil of any shape to the image of a point at any depth.

Everything follows from similar triangles behind the lens. A point at distance z is imaged sharply at distance
v = f z / (z - f). The sensor stands at s, the conjugate of the focus distance. The cone of rays between the pupil and
the sharp image is cut by the sensor where the pupil has shrunk by the factor 1 - s/v (negative: turned over). The
photograph is shown upright, that is turned by 180 degrees, so that the pupil appears scaled by s/v - 1: upright for
points beyond focus, turned by 180 degrees for nearer ones. The ray through the centre of the pupil is not deviated and
lands at s/z times the point's offset from the axis.

Directions are the photographer's: x right, y up in the pupil and in the scene; rows run down in the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.special import j1

from rigs.simulated.coverage import FloatArray, box_overlap, clip_to_convex, polygon_coverage, signed_area

SEVEN_MM: tuple[tuple[float, float], ...] = (
    (-4.6, 5.25), (4.6, 5.25), (4.6, 3.4), (0.3, -6.9), (-2.4, -6.55), (1.6, 2.75), (-4.6, 2.75),
)  # fmt: skip
"""Outline of the numeral 7 inside a circle of 7 mm radius."""

COMA_FIELD_RADIUS_MM = 13.4
"""Distance from the axis on the sensor at which coma and vignetting have their stated size (corner of APS-C)."""

_OVERSAMPLING = 4
_RIM_VERTICES = 180


@dataclass(frozen=True)
class PolygonPupil:
    """Pupil as loops of (x, y) vertices in mm; loops that turn against the largest are holes."""

    loops_mm: tuple[tuple[tuple[float, float], ...], ...] = (SEVEN_MM,)

    @property
    def radius_mm(self) -> float:
        """Largest distance of a vertex from the centre."""
        return float(max(math.hypot(x, y) for loop in self.loops_mm for x, y in loop))

    @property
    def area_mm2(self) -> float:
        """Area of the opening."""
        return abs(float(sum(signed_area(np.array(loop)) for loop in self.loops_mm)))


@dataclass(frozen=True, eq=False)
class MaskPupil:
    """Pupil as a transmission image.

    Attributes
    ----------
    transmission
        float64 (N, N), 0 to 1, first row at the top as the photographer sees it, centred on the axis.
    side_mm
        Side of the square that the image covers.
    """

    transmission: NDArray[np.float64]
    side_mm: float

    @property
    def radius_mm(self) -> float:
        """Largest distance of an open pixel's far corner from the centre."""
        n = self.transmission.shape[0]
        rows, columns = np.nonzero(self.transmission)
        half = np.abs(np.stack([rows, columns]) + 0.5 - n / 2) + 0.5
        return float(np.hypot(half[0], half[1]).max() * self.side_mm / n)

    @property
    def area_mm2(self) -> float:
        """Open area, weighted with the transmission."""
        return float(self.transmission.sum() * (self.side_mm / self.transmission.shape[0]) ** 2)


Pupil = PolygonPupil | MaskPupil
SEVEN = PolygonPupil()
"""The numeral 7, 7 mm in radius."""


@dataclass(frozen=True)
class Lens:
    """Thin lens with a shaped pupil in its plane, and what real lenses add.

    Attributes
    ----------
    focal_length_mm, focus_mm
        Focal length at infinity; distance from the lens that is in focus.
    pupil
        Shape of the opening.
    aberration_um
        Standard deviation on the sensor (micrometres) of a Gaussian blur that stands for residual aberrations.
    wavelength_um
        For diffraction, taken as that of a round opening of the pupil's area; 0 switches it off.
    vignetting
        Mechanical vignetting: a round rim as large as the pupil's circle, seen displaced by this fraction of its radius
        at the edge of the field, cuts into the pupil.
    coma_um
        Sagittal coma at the edge of the field for the edge of the pupil; tangential coma is three times as much.
    breathing
        Relative loss of focal length per magnification on focusing: f = focal_length (1 - breathing f / focus).
    """

    focal_length_mm: float = 50.0
    focus_mm: float = 1600.0
    pupil: Pupil = SEVEN
    aberration_um: float = 1.5
    wavelength_um: float = 0.55
    vignetting: float = 0.0
    coma_um: float = 0.0
    breathing: float = 0.0

    @property
    def effective_focal_length_mm(self) -> float:
        """Focal length at this focus setting."""
        return self.focal_length_mm * (1.0 - self.breathing * self.focal_length_mm / self.focus_mm)

    @property
    def sensor_distance_mm(self) -> float:
        """Distance lens to sensor: conjugate of the focus distance."""
        return conjugate_mm(self.focus_mm, self.effective_focal_length_mm)

    @property
    def varies_over_field(self) -> bool:
        """Whether the point image depends on where in the frame it lies."""
        return self.vignetting != 0.0 or self.coma_um != 0.0

    def cone_section(self, depth_mm: float) -> float:
        """Size of the cone of rays on the sensor, relative to the pupil; positive = upright in the photograph."""
        return self.sensor_distance_mm / conjugate_mm(depth_mm, self.effective_focal_length_mm) - 1.0

    def magnification(self, depth_mm: float) -> float:
        """Millimetres on the sensor per millimetre in the plane at ``depth_mm``, along the undeviated ray."""
        return self.sensor_distance_mm / depth_mm


def conjugate_mm(depth_mm: float, focal_length_mm: float) -> float:
    """Image distance v = f z / (z - f) of an object at distance z."""
    return focal_length_mm * depth_mm / (depth_mm - focal_length_mm)


@dataclass(frozen=True)
class Spot:
    """Sharp image of a small light source, by which the point image is widened.

    Attributes
    ----------
    shape
        ``disc`` (``size_mm`` its diameter) or ``square`` (its side).
    size_mm
        Size on the sensor.
    """

    shape: str = "disc"
    size_mm: float = 0.0

    @property
    def area_mm2(self) -> float:
        """Area on the sensor."""
        return self.size_mm**2 * (math.pi / 4 if self.shape == "disc" else 1.0)


def point_image(
    lens: Lens,
    depth_mm: float,
    pitch_mm: float,
    *,
    field_mm: tuple[float, float] = (0.0, 0.0),
    offset_px: tuple[float, float] = (0.0, 0.0),
    spot: Spot | None = None,
) -> FloatArray:
    """Image of a point, each pixel holding the light that falls on its area.

    Without any blur of its own, the projected pupil is shared out to the pixels by exact areas. Otherwise the same is
    done on a grid four times finer, blurred there (diffraction, aberrations, the source's own size) by multiplying its
    transform, and summed to pixels.

    Parameters
    ----------
    lens, depth_mm
        The lens and the point's distance from it.
    pitch_mm
        Pixel pitch.
    field_mm
        Where the undeviated ray meets the sensor: (x right, y up) from the axis, as seen in the upright photograph.
    offset_px
        Where it meets the centre pixel: (rows, columns) from that pixel's centre, within half a pixel.
    spot
        Size of the source's sharp image; None: a point.

    Returns
    -------
    FloatArray
        float64 (K, K), K odd, non-negative, unit sum; beyond focus upright.
    """
    section = lens.cone_section(depth_mm) / pitch_mm
    spread = _coma_reach_px(lens, field_mm, pitch_mm)
    core = 5.0 * lens.aberration_um * 1e-3 / pitch_mm + (4.0 if lens.wavelength_um else 0.0)
    reach = abs(section) * lens.pupil.radius_mm + spread + core + (0.75 * spot.size_mm / pitch_mm if spot else 0.0)
    half = math.ceil(reach + 1.0)
    side = 2 * half + 1
    if not (lens.aberration_um or lens.wavelength_um or lens.coma_um or (spot and spot.size_mm)):
        return _projected_pupil(lens, section, field_mm, (half + 0.5 + offset_px[0], half + 0.5 + offset_px[1]), side)
    fine = _OVERSAMPLING * side
    centre_yx = (_OVERSAMPLING * (half + 0.5 + offset_px[0]), _OVERSAMPLING * (half + 0.5 + offset_px[1]))
    moves_yx = (0.0, 0.0)
    if abs(section) * _OVERSAMPLING * lens.pupil.radius_mm < 2.0:
        # A pupil of about a fine cell's size keeps its place only in the middle of a cell: it is drawn there, and moved
        # by the phase of its transform, which the blur limits to frequencies far below the fine grid's.
        middle = _OVERSAMPLING * half + _OVERSAMPLING // 2 + 0.5
        moves_yx = (centre_yx[0] - middle, centre_yx[1] - middle)
        centre_yx = (middle, middle)
    if lens.coma_um:
        sharp = _with_coma(lens, section * _OVERSAMPLING, pitch_mm / _OVERSAMPLING, field_mm, centre_yx, fine)
    else:
        sharp = _projected_pupil(lens, section * _OVERSAMPLING, field_mm, centre_yx, fine)
    size = fft.next_fast_len(fine, real=True)
    transform = fft.rfft2(sharp, s=(size, size)) * _core_transfer(lens, size, pitch_mm / _OVERSAMPLING, spot)
    if moves_yx != (0.0, 0.0):
        transform *= np.exp(-2j * math.pi * moves_yx[0] * fft.fftfreq(size))[:, None]
        transform *= np.exp(-2j * math.pi * moves_yx[1] * fft.rfftfreq(size))[None, :]
    blurred = fft.irfft2(transform, s=(size, size))[:fine, :fine]
    image = np.maximum(blurred, 0.0).reshape(side, _OVERSAMPLING, side, _OVERSAMPLING).sum(axis=(1, 3))
    return np.asarray(image / image.sum(), np.float64)


def transmission(lens: Lens, field_mm: tuple[float, float]) -> float:
    """Open area of the pupil as seen from a field position (see :func:`point_image`), relative to that on the axis."""
    if not lens.vignetting:
        return 1.0
    if isinstance(lens.pupil, PolygonPupil):
        area = abs(sum(signed_area(loop) for loop in _clipped_loops(lens, lens.pupil, field_mm) if len(loop)))
        return area / lens.pupil.area_mm2
    return float(_clipped_mask(lens, lens.pupil, field_mm).sum() / lens.pupil.transmission.sum())


def _projected_pupil(
    lens: Lens, scale: float, field_mm: tuple[float, float], centre_yx: tuple[float, float], fine: int
) -> FloatArray:
    """Pupil by exact areas on a (fine, fine) grid; ``scale``: fine pixels per mm, negative turns it by 180 degrees."""
    if abs(scale) * lens.pupil.radius_mm < 1e-6:
        scale = math.copysign(1e-6 / lens.pupil.radius_mm, scale)  # a pupil of no size has no area to share out
    if isinstance(lens.pupil, PolygonPupil):
        loops = [
            np.stack([centre_yx[1] + scale * loop[:, 0], centre_yx[0] - scale * loop[:, 1]], axis=1)
            for loop in _clipped_loops(lens, lens.pupil, field_mm)
            if len(loop)
        ]
        image = polygon_coverage(loops, (fine, fine))
    else:
        mask = _clipped_mask(lens, lens.pupil, field_mm)
        steps = scale * lens.pupil.side_mm * (np.arange(mask.shape[0] + 1) / mask.shape[0] - 0.5)
        image = box_overlap(centre_yx[0] + steps, fine) @ mask @ box_overlap(centre_yx[1] + steps, fine).T
    return np.asarray(image / image.sum(), np.float64)


def _with_coma(
    lens: Lens, scale: float, fine_mm: float, field_mm: tuple[float, float], centre_yx: tuple[float, float], fine: int
) -> FloatArray:
    """Point image with third-order coma: small cells of the pupil, each sent where its ray goes.

    The transverse ray displacement is coma h (3 r^2 + t^2, 2 r t) with r, t the pupil coordinates along and across
    the field direction relative to the pupil's radius (Welford, Aberrations of Optical Systems, 1986).
    """
    radius = lens.pupil.radius_mm
    cells = int(np.clip(math.ceil(4.0 * radius * abs(scale)), 128, 2048))
    cell_mm = 2.0 * radius / cells
    if isinstance(lens.pupil, PolygonPupil):
        half = cells / 2
        loops = [
            np.stack([half + loop[:, 0] / cell_mm, half - loop[:, 1] / cell_mm], axis=1)
            for loop in _clipped_loops(lens, lens.pupil, field_mm)
            if len(loop)
        ]
        weight = polygon_coverage(loops, (cells, cells))
    else:
        mask = _clipped_mask(lens, lens.pupil, field_mm)
        edges = cells / 2 + (lens.pupil.side_mm / cell_mm) * (np.arange(mask.shape[0] + 1) / mask.shape[0] - 0.5)
        weight = box_overlap(edges, cells) @ mask @ box_overlap(edges, cells).T
    rows, columns = np.nonzero(weight)
    light = weight[rows, columns]
    x, y = (columns + 0.5) * cell_mm - radius, radius - (rows + 0.5) * cell_mm
    height = math.hypot(*field_mm)
    ux, uy = (field_mm[0] / height, field_mm[1] / height) if height else (1.0, 0.0)
    r, t = (x * ux + y * uy) / radius, (y * ux - x * uy) / radius
    strength = lens.coma_um * 1e-3 / fine_mm * height / COMA_FIELD_RADIUS_MM
    along, across = strength * (3 * r**2 + t**2), strength * 2 * r * t
    px = centre_yx[1] + scale * x + along * ux - across * uy - 0.5
    py = centre_yx[0] - scale * y - along * uy - across * ux - 0.5
    image = np.zeros(fine * fine)
    column, row = np.floor(px).astype(np.intp), np.floor(py).astype(np.intp)
    fx, fy = px - column, py - row
    for dy, dx, share in ((0, 0, (1 - fy) * (1 - fx)), (0, 1, (1 - fy) * fx), (1, 0, fy * (1 - fx)), (1, 1, fy * fx)):
        image += np.bincount((row + dy) * fine + column + dx, weights=light * share, minlength=fine * fine)
    return np.asarray(image.reshape(fine, fine) / light.sum(), np.float64)


def _coma_reach_px(lens: Lens, field_mm: tuple[float, float], pitch_mm: float) -> float:
    return 3.0 * abs(lens.coma_um) * 1e-3 / pitch_mm * math.hypot(*field_mm) / COMA_FIELD_RADIUS_MM


def _core_transfer(lens: Lens, size: int, fine_mm: float, spot: Spot | None) -> FloatArray:
    """Transfer function (size, size//2 + 1) of diffraction, residual aberrations and the source's own size."""
    fy = fft.fftfreq(size, fine_mm)[:, None]
    fx = fft.rfftfreq(size, fine_mm)[None, :]
    frequency = np.hypot(fy, fx)
    transfer = np.exp(-2.0 * (math.pi * lens.aberration_um * 1e-3 * frequency) ** 2)
    if lens.wavelength_um:
        # Incoherent transfer function of a round opening (Goodman, Introduction to Fourier Optics, section 6.3).
        diameter = 2.0 * math.sqrt(lens.pupil.area_mm2 / math.pi)
        cutoff = diameter / (lens.wavelength_um * 1e-3 * lens.sensor_distance_mm)
        nu = np.minimum(frequency / cutoff, 1.0)
        transfer *= 2.0 / math.pi * (np.arccos(nu) - nu * np.sqrt(1.0 - nu**2))
    if spot is not None and spot.size_mm > 0:
        if spot.shape == "disc":
            t = np.maximum(math.pi * spot.size_mm * frequency, 1e-9)
            transfer *= 2.0 * j1(t) / t
        else:
            transfer *= np.sinc(fy * spot.size_mm) * np.sinc(fx * spot.size_mm)
    return np.asarray(transfer, np.float64)


def _rim(lens: Lens, field_mm: tuple[float, float]) -> FloatArray:
    """Outline (N, 2) in mm of the displaced rim as seen in the pupil's plane."""
    angle = 2.0 * math.pi * np.arange(_RIM_VERTICES) / _RIM_VERTICES
    radius = lens.pupil.radius_mm
    # Drawn around its circle, so that on the axis it cuts nothing.
    vertex = radius / math.cos(math.pi / _RIM_VERTICES)
    shift = np.array(field_mm) / COMA_FIELD_RADIUS_MM * lens.vignetting * radius
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) * vertex + shift


def _clipped_loops(lens: Lens, pupil: PolygonPupil, field_mm: tuple[float, float]) -> list[FloatArray]:
    loops = [np.array(loop, np.float64) for loop in pupil.loops_mm]
    if not lens.vignetting or field_mm == (0.0, 0.0):
        return loops
    rim = _rim(lens, field_mm)
    return [clip_to_convex(loop, rim) for loop in loops]


def _clipped_mask(lens: Lens, pupil: MaskPupil, field_mm: tuple[float, float]) -> FloatArray:
    if not lens.vignetting or field_mm == (0.0, 0.0):
        return pupil.transmission
    n = pupil.transmission.shape[0]
    rim = _rim(lens, field_mm) * (n / pupil.side_mm)
    loop = np.stack([n / 2 + rim[:, 0], n / 2 - rim[:, 1]], axis=1)
    return pupil.transmission * polygon_coverage([loop], (n, n))


@lru_cache(maxsize=256)
def point_image_at_centre(lens: Lens, depth_mm: float, pitch_mm: float) -> NDArray[np.float32]:
    """Cached float32 image of an on-axis point in the middle of a pixel; see :func:`point_image`."""
    kernel = point_image(lens, depth_mm, pitch_mm).astype(np.float32)
    kernel.setflags(write=False)
    return kernel
