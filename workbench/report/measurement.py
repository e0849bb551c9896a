"""The report of a measurement: table of regions, pictures, the curves that decided, provenance."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.bank import Bank
from workbench.banks import is_bad, quality_reasons
from workbench.depth.estimate import DepthEstimate
from workbench.figures import curves, pictures, sharpness
from workbench.figures.bank import in_words
from workbench.figures.perspective import perspective
from workbench.files import write_text
from workbench.measurement import Measurement
from workbench.report.page import (
    GLYPHS,
    UNKNOWN,
    Facts,
    Shown,
    cm,
    fixed,
    pitch_text,
    plain,
    plain_facts,
    render,
    shown,
)
from workbench.units import exposure_text, seconds_text

MAX_CURVES = 24
"""Regions whose curves are drawn, the largest first; the table has all."""
CURVES_PER_FIGURE = 12
MAX_WORKINGS = 3
"""Regions whose edge maps are drawn."""


def write_measurement_report(
    measurement: Measurement,
    bank: Bank,
    path: Path,
    *,
    true_depths_mm: Mapping[int, float] | None = None,
    names: Mapping[int, str] | None = None,
) -> None:
    """Write the report of a measurement: table of regions, pictures, curves that decided, provenance.

    Parameters
    ----------
    measurement
        What to report; its ``files`` are listed by name.
    bank
        The bank it was measured with.
    path
        HTML file, replaced as a whole.
    true_depths_mm
        True depth by region, where it is known (simulated or surveyed scenes); adds differences.
    names
        Name of the object by region.

    Raises
    ------
    OSError
        The file can't be written.
    """
    estimates = measurement.estimates
    truth, names = true_depths_mm or {}, names or {}
    counts = Counter[str](estimate.status for estimate in estimates.values())
    said = ", ".join(f"{counts[status]} {status}" for status in curves.STATUS_STYLE if counts[status])
    write_text(
        path,
        render(
            "measurement.html.j2",
            title=Path(measurement.image_name).name,
            lead=f"{len(estimates)} {'region' if len(estimates) == 1 else 'regions'} ({said}) measured by the method "
            f"“{measurement.method}” with bank {measurement.bank_id}, in {seconds_text(measurement.seconds)}.",
            named=bool(names),
            true_known=bool(truth),
            regions=[_region_row(n, e, truth.get(n), names.get(n, "")) for n, e in sorted(estimates.items())],
            focus=f"{bank.lens.focus_mm / 10:.1f}",
            confidence_note=_confidence_note(measurement),
            scene=_scene_figures(measurement),
            decisions=_decision_figures(measurement, truth),
            workings=_working_figures(estimates),
            bad_bank=in_words(quality_reasons(bank)) if is_bad(bank) else "",
            provenance=_measurement_provenance(measurement, bank),
        ),
    )


_TELLING_NATS = 1.0
"""Outlines that speak for a side by less are not worth a note."""


def _region_row(number: int, e: DepthEstimate, true_mm: float | None, name: str) -> dict[str, Any]:
    low, high = e.interval_mm
    bounded = math.isfinite(low) and math.isfinite(high)
    return {
        "number": number, "name": name, "depth": cm(e.depth_mm, 1),
        "interval": f"{cm(low, 1)} to {cm(high, 1)}" if bounded else UNKNOWN,
        "true": cm(true_mm, 1),
        "difference": fixed((e.depth_mm - true_mm) / 10, 1, sign=True) if true_mm is not None else UNKNOWN,
        "confidence": fixed(e.confidence, 2), "mirror": cm(e.mirror_mm, 1),
        "mirror_probability": _mirror_probability(e), "second": cm(e.second_mm, 1),
        "pixels": _count(e.pixels), "status": e.status,
        "glyph": GLYPHS[e.status], "notes": [note for note in (e.reason, _outline_note(e), _left_out_note(e)) if note],
    }  # fmt: skip


def _outline_note(e: DepthEstimate) -> str:
    """What a region's outlines say of its side of focus, where they say something."""
    if abs(e.outline_odds) < _TELLING_NATS:
        return ""
    speak = "for" if e.outline_odds > 0 else "against"
    return f"its outlines speak {speak} this side of focus ({abs(e.outline_odds):.1f} nats)"


def _left_out_note(e: DepthEstimate) -> str:
    """How much of a found region was left out, if anything."""
    if e.left_out is None:
        return ""
    return f"{_count(int(e.left_out.sum()))} pixels were left out: most of their windows have another blur"


def _count(number: int) -> str:
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def _mirror_probability(e: DepthEstimate) -> str:
    if not (math.isfinite(e.mirror_mm) and math.isfinite(e.mirror_probability)):
        return UNKNOWN
    return fixed(e.mirror_probability, 3) if e.mirror_probability >= 0.0005 else "< 0.001"


def _confidence_note(measurement: Measurement) -> str:
    known = [e for e in measurement.estimates.values() if math.isfinite(e.depth_mm)]
    if not known:
        return "No region has a depth."
    if any(curves.is_posterior(e) for e in known):
        return "Confidence is the probability that the depth is on the right side of focus and within the interval."
    return (
        "Scores of this method are no probabilities: interval and confidence say how peaked the score is, "
        "not how often the answer is right."
    )


def _scene_figures(measurement: Measurement) -> list[Shown]:
    unknown = not np.isfinite(measurement.depth_map_mm).all()
    ambiguous = any(e.status == "ambiguous" for e in measurement.estimates.values())
    found = [
        shown(
            "Photograph and all-focus image",
            "Left: the photograph. Right: each region deconvolved with the PSF of its depth, at the same exposure."
            + ("" if measurement.labels.all() else " What is in no region stays as photographed."),
            pictures.photograph_and_all_focus(measurement), "jpeg",
        ),
        shown(
            "Regions",
            "Outlines and numbers of the regions of the table, over the photograph in grey; colours only tell "
            "neighbours apart. Hatched regions have no depth.",
            pictures.segmentation(measurement), "jpeg", "narrow",
        ),
        shown(
            "Depth map",
            "Depth in centimetres; near is light, far is dark."
            + (" A question mark: ambiguous." if ambiguous else "")
            + (" Hatched grey is unknown." if unknown else ""),
            pictures.depth_map(measurement), "png", "narrow",
        ),
    ]  # fmt: skip
    if np.isfinite(measurement.depth_map_mm).any():
        found.append(
            shown(
                "The scene in perspective",
                "The all-focus image with each pixel at its measured depth, seen from the upper left. Bars on the "
                "floor show where each plane stands; rims carry the colours of the depth map. What has no depth is "
                "left out.",
                perspective(measurement), "jpeg",
            )
        )  # fmt: skip
    return found


def _decision_figures(measurement: Measurement, truth: Mapping[int, float]) -> list[Shown]:
    estimates = measurement.estimates
    found = []
    if any(math.isfinite(e.depth_mm) for e in estimates.values()):
        found.append(
            shown("Depths with their intervals", "Bars are 95 % intervals; the symbol tells the status. "
                   "Mirror depths beyond the bank's reach are in the table only.",
                   curves.depths_with_intervals(estimates, truth or None))
        )  # fmt: skip
    if any(number in estimates for number in truth):
        found.append(
            shown("Difference from the true depth", "Measured minus true depth, with 95 % intervals; numbers are "
                   "regions.", curves.depth_difference(estimates, truth), shape="narrow")
        )  # fmt: skip
    chosen = sorted(_largest(estimates, MAX_CURVES, lambda _: True))
    posterior = any(curves.is_posterior(e) for e in estimates.values())
    caption = (
        "Probability of each depth relative to the most probable one, on a logarithmic axis."
        if posterior
        else "Score of each depth relative to the best; all panels share one axis, which does not start at zero."
    )
    left_out = len(estimates) - len(chosen)
    if left_out:
        caption += f" The {left_out} smallest regions are in the table only."
    for start in range(0, len(chosen), CURVES_PER_FIGURE):
        part = {number: estimates[number] for number in chosen[start : start + CURVES_PER_FIGURE]}
        found.append(shown("What each region says about its depth", caption, curves.score_curves(part)))
    return found


def _working_figures(estimates: Mapping[int, DepthEstimate]) -> list[Shown]:
    found = []
    for number in _largest(estimates, MAX_WORKINGS, sharpness.has_edge_maps):
        estimate = estimates[number]
        place = f"region {number} at {cm(estimate.depth_mm)} cm"
        found += [
            shown(
                f"Edge maps, {place}",
                "Window sums of the absolute differences of the deconvolved image, each map divided by its sum over "
                "the region; above as they are, below what the threshold keeps.",
                sharpness.window_sums(estimate), "jpeg",
            ),
            shown(
                f"Threshold, {place}",
                "Histogram of the first-difference map along x and its cumulative distribution, cut into sections of "
                "equal share. The threshold ends the first section whose successor spans at least twice its "
                "magnitude; the dark part of the histogram is kept.",
                sharpness.threshold(estimate),
            ),
            shown(
                f"Contributions, {place}",
                "Mean of the kept values of each map, and the factor that makes up for the PSF's size.",
                sharpness.contributions(estimate), shape="narrow",
            ),
        ]  # fmt: skip
    return found


def _largest(estimates: Mapping[int, DepthEstimate], most: int, wanted: Callable[[DepthEstimate], bool]) -> list[int]:
    numbers = [number for number, estimate in estimates.items() if wanted(estimate)]
    return sorted(numbers, key=lambda number: -estimates[number].pixels)[:most]


def _measurement_provenance(measurement: Measurement, bank: Bank) -> list[tuple[str, Facts]]:
    image, info = measurement.image, measurement.image.info
    raw = f"{info.raw_size[1]} × {info.raw_size[0]} photosites {info.cfa}" if info.raw_size else UNKNOWN
    photograph: Facts = [
        ("File", measurement.image_name), ("SHA-256", info.sha256 or UNKNOWN),
        ("Camera", f"{info.make} {info.model}".strip() or UNKNOWN), ("RAW", raw),
        ("Developed", f"{image.shape[1]} × {image.shape[0]} px, recipe {image.recipe}"),
        ("Pixel pitch", pitch_text(image.pixel_pitch_mm)),
        ("Exposure", exposure_text(info.exposure_s) if info.exposure_s else UNKNOWN),
        ("ISO", plain(info.iso)), ("Focal length", f"{info.focal_length_mm:g} mm" if info.focal_length_mm else UNKNOWN),
        ("F-number", plain(info.f_number)), ("Dark frame", info.dark or "none"),
        ("Saturated pixels", f"{100 * float(image.saturated.mean()):.2f} %"),
    ]  # fmt: skip
    lens = bank.lens
    calibration: Facts = [
        ("Bank", measurement.bank_id), ("Asked for as", measurement.bank_ref), ("Quality", measurement.bank_quality),
        ("Recipe", bank.recipe),
        ("Depths", f"{bank.depths_mm.size}, {cm(bank.depths_mm[0])} to {cm(bank.depths_mm[-1])} cm"),
        ("Focus", f"{lens.focus_mm / 10:.2f} ± {lens.focus_se_mm / 10:.2f} cm"),
        ("Made by", f"depth-workbench {bank.manifest.get('software', UNKNOWN)}"),
    ]  # fmt: skip
    method: Facts = plain_facts(measurement.options)
    files = [(role.replace("_", " "), path.name) for role, path in measurement.files.items()]
    sections = [("Photograph", photograph), ("Bank", calibration), ("Method and options", method)]
    return sections + ([("Files beside this report", files)] if files else [])
