"""Frames of points -> a bank. Used alike for frames from a session and for files taken elsewhere.

One frame is in memory at a time: it is developed, its points are cut out, and it is let go.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.doubled import find_doubled
from calibration.errors import DepthListError, FitError, PointError
from calibration.exif import known_camera
from calibration.frame_checks import Distinct, check_dark, check_same_camera, longest_exposure
from calibration.image import FrameInfo, LinearImage, Recipe
from calibration.lens_fit import LensFit, aperture_radius_mm, check_aperture, check_depths, fit_lens
from calibration.optics import image_distance_mm
from calibration.points import PointImage, PointOptions, find_points
from calibration.psf import (
    Plane,
    Stacked,
    common_fraction,
    disc_variance,
    dot_radius_px,
    half_size,
    place,
    stack_repeats,
    undo_dot,
)
from calibration.quality import Quality, judge
from calibration.raw import average_darks, develop, subtract_dark
from calibration.swapped import swapped_pair
from calibration.template import Spot, TemplateFit, fit_spots

FloatArray = NDArray[np.float64]
Source = Path | LinearImage


@dataclass(frozen=True, slots=True)
class PointFrame:
    """All exposures of the panel's point (or grid of points) at one nominal depth."""

    depth_nominal_mm: float
    sources: tuple[Source, ...]
    """Files, or images developed already; several are repeats."""
    dot_mm: float = 0.0
    """Diameter of the dot on the panel; 0 where unknown or negligible."""
    offs: tuple[Source, ...] = ()
    """Frames with the point off, same place and exposure: subtracted here instead of the common dark frames."""


@dataclass(frozen=True, slots=True)
class BuildOptions:
    """How a bank is made; goes into its provenance."""

    recipe: Recipe = "superpixel"
    pixel_pitch_mm: float | None = None
    """Photosite pitch (RAW) or pixel pitch (linear files); default: what the files say."""
    focal_length_mm: float | None = None
    """Default: what the files say."""
    expected_points: int = 1
    apply_zero: bool = False
    """Whether the fitted stage zero is added to the depths (own rig) or only reported (files taken elsewhere)."""
    on_bad: Literal["raise", "skip"] = "raise"
    """What a frame without a usable point does: stop, or be left out and named."""
    point: PointOptions = field(default_factory=PointOptions)
    sensor_size: tuple[int, int] | None = None
    """Photosites (height, width) of the whole sensor, where known; then scenes of another size are refused."""
    camera: Mapping[str, str] = field(default_factory=dict)
    """Identity beyond what the files say: serial number, lens, firmware."""
    settings: Mapping[str, str] = field(default_factory=dict)
    plan_sha256: str = ""


@dataclass(frozen=True, slots=True)
class Rejected:
    """A frame that was left out."""

    path: str
    depth_nominal_mm: float
    reason: str
    message: str


@dataclass(frozen=True, slots=True)
class BuiltBank:
    """Result of :func:`build_bank`."""

    bank: Bank
    quality: Quality
    rejected: tuple[Rejected, ...]


@dataclass(frozen=True, slots=True)
class _Field:
    """Everything measured at one field position, by ascending depth."""

    stacks: tuple[Stacked, ...]
    fit: TemplateFit
    lens: LensFit
    chief_yx: FloatArray
    dot_radius: FloatArray


def build_bank(
    frames: Sequence[PointFrame], darks: Sequence[Source] = (), options: BuildOptions | None = None
) -> BuiltBank:
    """Make a bank from frames of points.

    Parameters
    ----------
    frames
        One entry per depth, any order, at least three depths.
    darks
        Frames with the panel off or the cap on; those of the frames' size are averaged and subtracted pixel by pixel,
        of another size as a level.
    options
        How; the defaults suit files taken elsewhere.

    Raises
    ------
    DepthListError, FrameError, PointError, FitError
        Bad input; with ``on_bad='skip'`` a PointError only leaves its frame out, as long as three depths remain.
    """
    options = options or BuildOptions()
    frames = sorted(frames, key=lambda frame: frame.depth_nominal_mm)
    check_depths([frame.depth_nominal_mm for frame in frames])
    distinct = Distinct()
    longest = longest_exposure(source for frame in frames for source in frame.sources)

    def averaged(sources: Sequence[Source]) -> dict[tuple[int, ...], LinearImage]:
        return _average_darks(sources, longest, distinct, options)

    dark_by_shape = averaged(darks)
    measured: list[tuple[PointFrame, list[list[PointImage]]]] = []
    rejected: list[Rejected] = []
    infos: list[tuple[float, FrameInfo]] = []
    pitch: float | None = None
    for frame in frames:
        repeats: list[list[PointImage]] = []
        dark_here = averaged(frame.offs) if frame.offs else dark_by_shape
        for image in _developed(frame.sources, dark_here, options):
            distinct.check(image.info)
            infos.append((frame.depth_nominal_mm, image.info))
            check_same_camera(infos[0][1], image.info)
            pitch = pitch or image.pixel_pitch_mm
            try:
                repeats.append(find_points(image, expected=options.expected_points, options=options.point))
            except PointError as error:
                if options.on_bad == "raise":
                    raise
                rejected.append(Rejected(image.info.path, frame.depth_nominal_mm, error.reason, str(error)))
        if repeats:
            measured.append((frame, repeats))
    if len(measured) < 3:
        reasons = "; ".join(sorted({r.reason for r in rejected}))
        raise DepthListError(f"only {len(measured)} depths show a usable point ({reasons}); a bank needs at least 3")
    measured = _pool_noise_gain(measured)
    nominal = np.array([frame.depth_nominal_mm for frame, _ in measured])
    focal = options.focal_length_mm or infos[0][1].focal_length_mm
    tracks = _tracks([repeats for _, repeats in measured], options.expected_points)
    dots = np.array([frame.dot_mm for frame, _ in measured])
    fields = [_measure_field(track, nominal, dots, focal, pitch, options) for track in tracks]
    return _assemble(fields, nominal, infos, rejected, pitch, focal, options)


def _developed(
    sources: Iterable[Source], darks: Mapping[tuple[int, ...], LinearImage], options: BuildOptions
) -> Iterable[LinearImage]:
    for source in sources:
        if isinstance(source, LinearImage):
            image = source
        else:
            image = develop(source, recipe=options.recipe, pixel_pitch_mm=options.pixel_pitch_mm)
        if darks:
            image = subtract_dark(image, darks.get(image.planes.shape) or next(iter(darks.values())))
        yield image


def _average_darks(
    darks: Sequence[Source], longest: FrameInfo | None, distinct: Distinct, options: BuildOptions
) -> dict[tuple[int, ...], LinearImage]:
    groups: dict[tuple[int, ...], list[LinearImage]] = {}
    for image in _developed(darks, {}, options):
        distinct.check(image.info)
        check_dark(image, longest, options.point)
        groups.setdefault(image.planes.shape, []).append(image)
    return {shape: average_darks(group) for shape, group in groups.items()}


def _pool_noise_gain(
    measured: list[tuple[PointFrame, list[list[PointImage]]]],
) -> list[tuple[PointFrame, list[list[PointImage]]]]:
    """Give every cut-out the smallest noise gain of its ISO's frames: each one's own is an upper bound."""
    gains: dict[float | None, float] = {}
    for _, repeats in measured:
        for point in (p for points in repeats for p in points):
            gains[point.info.iso] = min(gains.get(point.info.iso, np.inf), point.noise_gain)

    def pooled(p: PointImage) -> PointImage:
        gain = gains[p.info.iso] if np.isfinite(gains[p.info.iso]) else 0.0
        variance = p.noise**2 + gain * np.maximum(p.values, 0.0)
        return replace(
            p, noise_gain=gain, variance=variance, flux_snr=p.flux / float(np.sqrt(variance[p.support].sum()))
        )

    return [(frame, [[pooled(p) for p in points] for points in repeats]) for frame, repeats in measured]


def _tracks(by_depth: list[list[list[PointImage]]], count: int) -> list[list[list[PointImage]]]:
    """Follow each point of the grid through depths and repeats: result[field][depth] is a list of repeats.

    The grid's picture grows and shrinks with depth, so positions are compared after removing their mean and spread.
    """
    if count == 1:
        return [[[points[0] for points in repeats] for repeats in by_depth]]
    reference = _normalised(by_depth[len(by_depth) // 2][0])
    tracks: list[list[list[PointImage]]] = [[] for _ in range(count)]
    for repeats in by_depth:
        for track in tracks:
            track.append([])
        for points in repeats:
            here = _normalised(points)
            distance = np.hypot(*(reference[:, np.newaxis] - here[np.newaxis]).transpose(2, 0, 1))
            nearest = distance.argmin(axis=1)
            if len(set(nearest.tolist())) != count:
                raise PointError(
                    "missing", f"{points[0].info.path}: its points don't form the same grid as the other depths'"
                )
            for k, index in enumerate(nearest):
                tracks[k][-1].append(points[int(index)])
    return tracks


def _normalised(points: list[PointImage]) -> FloatArray:
    centres = np.array([np.add(p.corner_yx, np.array(p.values.shape) / 2.0) for p in points])
    centres -= centres.mean(axis=0)
    return np.asarray(centres / np.sqrt((centres**2).sum(axis=1).mean()), np.float64)


def _measure_field(
    track: list[list[PointImage]],
    nominal: FloatArray,
    dots_mm: FloatArray,
    focal_mm: float | None,
    pitch_mm: float | None,
    options: BuildOptions,
) -> _Field:
    stacks = tuple(stack_repeats(repeats) for repeats in track)

    def fitted(dot_radius: FloatArray, start: TemplateFit | None) -> tuple[TemplateFit, LensFit]:
        spots = [_spot(s.point, r) for s, r in zip(stacks, dot_radius, strict=True)]
        fit = fit_spots(spots, 1.0 / nominal, start=start)
        radius = np.array([s.radius_px for s in fit.spots])
        errors = np.array([s.radius_se_px for s in fit.spots])
        pair = None
        try:
            lens = fit_lens(nominal, radius, errors, apply_zero=options.apply_zero)
            if any(lens.suspect):
                pair = swapped_pair(nominal, radius, errors, apply_zero=options.apply_zero)
        except FitError:
            for side in (1.0, -1.0):  # exchanged ends of the range turn the guess of the sides around
                pair = pair or swapped_pair(nominal, side * radius, errors, apply_zero=options.apply_zero)
            if pair is None:
                raise
        if pair is not None:
            raise DepthListError(_swapped_message(track, nominal, pair))
        return fit, lens

    dot_radius = np.zeros(nominal.size)
    fit, lens = fitted(dot_radius, None)
    if focal_mm and pitch_mm:
        image_distance = image_distance_mm(focal_length_mm=focal_mm, focus_mm=lens.focus_mm)
        dot_radius = np.array(
            [
                dot_radius_px(d, z, image_distance_mm=image_distance, pitch_mm=pitch_mm)
                for d, z in zip(dots_mm, nominal, strict=True)
            ]
        )
        if dot_radius.max() >= 0.1:
            fit, lens = fitted(dot_radius, fit)
    _refuse_doubled(track, stacks, nominal, dot_radius, fit, lens)
    chief = np.array(
        [
            (s.point.corner_yx[0] + f.centre_y, s.point.corner_yx[1] + f.centre_x)
            for s, f in zip(stacks, fit.spots, strict=True)
        ]
    )
    return _Field(stacks, fit, lens, chief, dot_radius)


def _swapped_message(track: list[list[PointImage]], nominal: FloatArray, pair: tuple[int, int]) -> str:
    first, second = (f"{Path(track[k][0].info.path).name} ({nominal[k] / 10:g} cm)" for k in pair)
    return (
        f"{first} and {second} have the blur of each other's depth: they seem to be exchanged; give each its own depth"
    )


def _spot(point: PointImage, dot_radius_px: float) -> Spot:
    return Spot(point.values, np.sqrt(point.variance), disc_variance(dot_radius_px))


def _refuse_doubled(
    track: list[list[PointImage]],
    stacks: Sequence[Stacked],
    nominal: FloatArray,
    dot_radius: FloatArray,
    fit: TemplateFit,
    lens: LensFit,
) -> None:
    """Refuse a frame that shows its point twice, one copy over the other."""

    def lit(point: PointImage, radius: float) -> Spot:
        spot = _spot(point, radius)
        return replace(spot, values=np.where(point.support, spot.values, 0.0))

    found = find_doubled(
        [lit(s.point, r) for s, r in zip(stacks, dot_radius, strict=True)],
        [[lit(p, r) for p in repeats] for repeats, r in zip(track, dot_radius, strict=True)],
        nominal,
        fit,
        lens,
    )
    if found is not None:
        path = track[found.depth][found.repeat].info.path
        raise PointError(
            "doubled",
            f"{path}: shows its point twice, {found.copy.distance_px:.0f} px apart (the fainter with "
            f"{100 * found.copy.share:.0f} % of the light); cover reflections, and take it again or leave it out",
        )


def _assemble(
    fields: list[_Field],
    nominal: FloatArray,
    infos: list[tuple[float, FrameInfo]],
    rejected: list[Rejected],
    pitch: float | None,
    focal: float | None,
    options: BuildOptions,
) -> BuiltBank:
    centres = [np.round(f.chief_yx - common_fraction(f.chief_yx)).astype(int) for f in fields]
    half = 1 + max(
        half_size(s.point, (int(c[0]), int(c[1])))
        for f, cs in zip(fields, centres, strict=True)
        for s, c in zip(f.stacks, cs, strict=True)
    )
    planes: list[list[Plane]] = []
    for f, cs in zip(fields, centres, strict=True):
        row = []
        for stacked, chief, c, dot in zip(f.stacks, f.chief_yx, cs, f.dot_radius, strict=True):
            plane = place(stacked.point, (float(chief[0]), float(chief[1])), (int(c[0]), int(c[1])), half)
            row.append(undo_dot(plane, float(dot)))
        planes.append(row)
    frame_shape = np.array(fields[0].stacks[0].point.frame_shape)
    middle = (frame_shape - 1) / 2.0
    field_yx = np.array([(f.chief_yx.mean(axis=0) - middle) / (frame_shape / 2.0) for f in fields])
    central = int(np.argmin(np.hypot(*field_yx.T)))
    # a grid's images move with depth where the panel is too small for the frame
    places = (
        {"place_yx": np.array([(f.chief_yx - middle) / (frame_shape / 2.0) for f in fields])} if len(fields) > 1 else {}
    )
    lens = fields[central].lens
    zero = lens.zero_mm if lens.zero_applied else 0.0
    quality = judge(
        nominal_mm=nominal,
        lens=lens,
        spots=fields[central].fit.spots,
        stacks=fields[central].stacks,
        psf=np.stack([p.psf for p in planes[central]]),
        psf_se=np.stack([p.se for p in planes[central]]),
        core_px=fields[central].fit.core.sigma_px,
    )
    size = options.sensor_size or _known_size(infos[0][1])
    radius_mm = None
    if focal and pitch:
        radius_mm = aperture_radius_mm(lens, focal_length_mm=focal, pixel_pitch_mm=pitch)
        check_aperture(radius_mm, focal_length_mm=focal, f_number=infos[0][1].f_number)
    manifest: dict[str, Any] = {
        "kind": "measured",
        "software": software_version(),
        "nominal_depths_mm": nominal.tolist(),
        "camera": {
            **options.camera,
            "make": infos[0][1].make,
            "model": infos[0][1].model,
            "cfa": infos[0][1].cfa,
            "focal_length_mm": focal,
            "f_number": infos[0][1].f_number,
            "raw_sizes": sorted({info.raw_size for _, info in infos if info.raw_size}),
            "sensor_size": list(size) if size else None,
        },
        "aperture": {
            "radius_mm": radius_mm,
            "core_px": [f.fit.core.sigma_px for f in fields],
            "core_wings": [f.fit.core.wings for f in fields],
        },
        "dot_radius_px": fields[central].dot_radius.tolist(),
        "frames": [
            {
                "name": Path(info.path).name,
                "sha256": info.sha256,
                "depth_nominal_mm": depth,
                "exposure_s": info.exposure_s,
                "iso": info.iso,
                "dark": info.dark,
            }
            for depth, info in infos
        ],
        "rejected": [
            {"name": Path(r.path).name, "depth_nominal_mm": r.depth_nominal_mm, "reason": r.reason} for r in rejected
        ],
        "settings": dict(options.settings),
        "plan_sha256": options.plan_sha256,
        "quality": quality.as_dict(),
    }
    manifest["camera"]["raw_sizes"] = [list(s) for s in manifest["camera"]["raw_sizes"]]
    bank = Bank(
        depths_mm=nominal + zero,
        psf=np.array([[p.psf for p in row] for row in planes], np.float32),
        psf_se=np.array([[p.se for p in row] for row in planes], np.float32),
        field_yx=field_yx,
        lens=lens,
        recipe=options.recipe if infos[0][1].raw_size else "linear",
        pixel_pitch_mm=pitch,
        manifest=manifest,
        extras={
            "chief_yx": np.array([[p.offset_yx for p in row] for row in planes]),
            "middle_yx": np.array(centres, np.float64),
            "field_radius_px": np.array([f.lens.radius_px for f in fields]),
            "aperture": fields[central].fit.template.astype(np.float32),
            **places,
        },
    )
    return BuiltBank(bank, quality, tuple(rejected))


def software_version() -> str:
    """Version of this software, for provenance."""
    return metadata.version("depth-workbench")


def _known_size(info: FrameInfo) -> tuple[int, int] | None:
    """Size of a whole frame of a known camera, where this frame is one (within 2 %), so that crops are told apart."""
    facts = known_camera(info.make, info.model)
    if facts is None or info.raw_size is None:
        return None
    whole = all(abs(a / b - 1.0) < 0.02 for a, b in zip(info.raw_size, facts.full_frame, strict=True))
    return info.raw_size if whole else None
