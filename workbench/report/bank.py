"""The report of a bank: lens, PSFs, quality of every depth, provenance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.bank import Bank
from calibration.lens_fit import MIN_DEPTHS_FOR_ZERO
from calibration.optics import depth_from_radius
from calibration.pupil import between_planes
from calibration.quality import LIMITS
from workbench.figures import bank as bank_figures
from workbench.files import write_text
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
from workbench.units import exposure_text


def write_bank_report(bank: Bank, path: Path, *, version: str = "") -> None:
    """Write the report of a bank: lens, PSFs, quality of every depth, provenance.

    Parameters
    ----------
    bank
        What to report; manifests that know little (imported banks) make shorter reports.
    path
        HTML file, replaced as a whole.
    version
        Version in the registry (``v3``), for the title.

    Raises
    ------
    OSError
        The file can't be written.
    """
    quality = bank.manifest.get("quality", {})
    depths = bank.depths_mm
    nominal = bank.manifest.get("nominal_depths_mm") or depths.tolist()
    camera = bank.manifest.get("camera", {})
    who = " ".join(str(camera[key]) for key in ("make", "model") if camera.get(key)) or "an unnamed camera"
    write_text(
        path,
        render(
            "bank.html.j2",
            title=f"Bank {bank.id}" + (f", {version}" if version else ""),
            lead=f"{depths.size} depths from {cm(depths[0])} to {cm(depths[-1])} cm, {len(bank.psf)} "
            f"{'place' if len(bank.psf) == 1 else 'places'} in the frame, PSFs of {bank.psf.shape[-1]} px, taken with "
            f"{who}.",
            glyphs=GLYPHS,
            verdict=quality.get("verdict"),
            reasons=[bank_figures.in_words(reason) for reason in quality.get("reasons", [])],
            lens=_lens_rows(bank),
            lens_figures=[_radius_figure(bank)],
            psf_figures=_psf_figures(bank),
            quality_figures=_quality_figures(bank),
            rejected=[
                {"name": one["name"], "depth": cm(one["depth_nominal_mm"]), "reason": one["reason"]}
                for one in bank.manifest.get("rejected", [])
            ],
            shifted=not np.allclose(nominal, depths),
            depths=_depth_rows(bank, nominal),
            limits=_limit_rows(bank),
            provenance=_bank_provenance(bank, camera),
            frames=_frame_rows(bank),
        ),
    )


def _lens_rows(bank: Bank) -> list[dict[str, str]]:
    lens = bank.lens
    rows = [
        ("Focus distance", lens.focus_mm / 10, lens.focus_se_mm / 10, 2, "cm", "depth at which the blur vanishes"),
        ("Blur radius at infinity", lens.scale_px, lens.scale_se_px, 3, "px", "aperture radius × f / (focus − f)"),
        ("Stage zero", lens.zero_mm / 10, lens.zero_se_mm / 10, 3, "cm", "true minus nominal depth; "
         + _zero_note(bank)),
    ]  # fmt: skip
    radius_mm = bank.manifest.get("aperture", {}).get("radius_mm")
    if radius_mm:
        rows.append(("Aperture radius", radius_mm, math.nan, 3, "mm", "circle about the aperture, from the fit"))
    if between := between_planes(bank):
        meaning = (
            "of a picture of the aperture, which gives the PSF at any depth, against the measured ones"
            if between.source == "pupil"
            else "of PSFs interpolated between depths, since no picture of the aperture fits; each left out in turn"
        )
        rows.append(("PSF residual", 100 * between.residual, math.nan, 1, "%", meaning))
    return [
        {"name": name, "value": fixed(value, digits), "error": fixed(error, digits + 1), "unit": unit,
         "meaning": meaning}
        for name, value, error, digits, unit, meaning in rows
    ]  # fmt: skip


def _zero_note(bank: Bank) -> str:
    if not math.isfinite(bank.lens.zero_mm):
        return f"{bank.depths_mm.size} depths can't tell it, it takes {MIN_DEPTHS_FOR_ZERO}"
    return "added to all depths" if bank.lens.zero_applied else "reported only, the depths are nominal"


def _radius_figure(bank: Bank) -> Shown:
    near, far = float(bank.depths_mm[0]), float(bank.depths_mm[-1])
    return shown(
        "Signed blur radius against depth",
        "Radius of the circle about the blurred aperture, measured on each PSF, with the thin lens fitted to all of "
        "them. Negative radii lie nearer than focus, where the PSF is turned by 180 degrees. Error bars are one "
        "standard error, mostly smaller than the symbols. Below: measured minus fitted. A radius error of 0.1 px is "
        f"{_radius_error_cm(bank, near, 0.1):.2g} cm at {cm(near)} cm and {_radius_error_cm(bank, far, 0.1):.2g} cm at "
        f"{cm(far)} cm.",
        bank_figures.radius_against_depth(bank),
    )


def _radius_error_cm(bank: Bank, depth_mm: float, radius_px: float) -> float:
    """Depth error (cm) that a small radius error makes: z^2 / (focus scale) * error (METHOD Eq. 1, differentiated)."""
    return depth_mm**2 / (bank.lens.focus_mm * bank.lens.scale_px) * radius_px / 10


def _psf_figures(bank: Bank) -> list[Shown]:
    some = bank.depths_mm.size > bank_figures.MAX_TILES
    found = [
        shown(
            "PSFs over depth",
            "Measured PSFs at one common scale, each shaded from zero (white) to its own peak (black); small ones are "
            "repeated magnified in a corner. A sign beside the depth and a coloured frame mark what is not good. The "
            "aperture is upright beyond focus and turned by 180 degrees nearer than focus: this is what tells the two "
            "sides apart."
            + (f" {bank_figures.MAX_TILES} of {bank.depths_mm.size} depths are shown." if some else ""),
            bank_figures.psf_montage(bank), "png",
        )
    ]  # fmt: skip
    if len(bank.psf) > 1:
        found.append(
            shown("PSFs over the field", "The most blurred PSF at each measured place of the frame.",
                   bank_figures.field_montage(bank), "png", "narrow")
        )  # fmt: skip
    if "aperture" in bank.extras:
        found.append(
            shown(
                "The aperture that the PSFs have in common",
                "Fitted jointly to all depths, oriented as the PSF beyond focus. The cross marks the chief ray, the "
                "dashed circle has the radius that the lens fit speaks of.",
                bank_figures.aperture_picture(bank), "png", "small",
            )
        )  # fmt: skip
    return found


def _quality_figures(bank: Bank) -> list[Shown]:
    if not bank.manifest.get("quality", {}).get("depths"):
        return []
    return [
        shown(
            "Quality of each depth",
            "One panel per figure; the table below says what they mean. Dashed line: suspect beyond it; full line: "
            "bad. Circles are good, triangles suspect, crosses bad. Figures that don't apply, as at focus, are left "
            "out.",
            bank_figures.quality_by_depth(bank),
        )
    ]


def _depth_rows(bank: Bank, nominal: Sequence[float]) -> list[dict[str, Any]]:
    lens, words = bank.lens, bank_figures.verdicts(bank)
    judged = bank.manifest.get("quality", {}).get("depths", [])
    frames = bank.manifest.get("frames", [])
    rows = []
    for k, depth in enumerate(bank.depths_mm):
        reasons = judged[k]["reasons"] if len(judged) == bank.depths_mm.size else []
        fitted = float(lens.sigma_px(bank.depths_mm[k : k + 1])[0])
        implied = depth_from_radius(fitted + float(lens.residual_px[k]), focus_mm=lens.focus_mm, scale=lens.scale_px)
        off_cm = (implied - depth) / 10 if math.isfinite(implied) and implied > 0 else math.nan
        rows.append(
            {
                "depth": cm(depth, 2), "nominal": cm(nominal[k], 2),
                "radius": fixed(float(lens.radius_px[k]), 3), "error": fixed(float(lens.radius_se_px[k]), 3),
                "residual": fixed(float(lens.residual_px[k]), 3, sign=True),
                "residual_cm": fixed(off_cm, 2, sign=True), "verdict": words[k],
                "reasons": [bank_figures.figure_name(name) for name in reasons],
                "frames": [f["name"] for f in frames if f.get("depth_nominal_mm") == nominal[k]],
            }
        )  # fmt: skip
    return rows


def _limit_rows(bank: Bank) -> list[dict[str, str]]:
    judged = bank.manifest.get("quality", {}).get("depths", [])
    used = [name for name in LIMITS if any(entry["figures"].get(name) is not None for entry in judged)]
    return [
        {
            "name": bank_figures.figure_name(name), "meaning": LIMITS[name].meaning,
            "suspect": f"{'below' if LIMITS[name].low_is_bad else 'above'} {LIMITS[name].suspect:g}",
            "bad": f"{'below' if LIMITS[name].low_is_bad else 'above'} {LIMITS[name].bad:g}",
        }
        for name in used
    ]  # fmt: skip


def _bank_provenance(bank: Bank, camera: Mapping[str, Any]) -> list[tuple[str, Facts]]:
    manifest = bank.manifest
    general: Facts = [
        ("Bank", bank.id), ("Kind", str(manifest.get("kind", UNKNOWN))),
        ("Made by", f"depth-workbench {manifest.get('software', UNKNOWN)}"), ("Recipe", bank.recipe),
        ("Pixel pitch", pitch_text(bank.pixel_pitch_mm)),
        ("Plan, SHA-256", str(manifest.get("plan_sha256") or UNKNOWN)),
    ]  # fmt: skip
    sections = [("Bank", general), ("Camera", _camera_facts(camera))]
    settings = manifest.get("settings")
    return sections + ([("Settings and devices", plain_facts(settings))] if settings else [])


_CAMERA = {
    "make": "Make", "model": "Model", "serial": "Serial number", "firmware": "Firmware", "lens": "Lens",
    "focal_length_mm": "Focal length (mm)", "f_number": "F-number", "cfa": "Colour pattern",
}  # fmt: skip


def _camera_facts(camera: Mapping[str, Any]) -> Facts:
    known = [(words, plain(camera[key])) for key, words in _CAMERA.items() if camera.get(key)]
    sizes = [camera["sensor_size"]] if camera.get("sensor_size") else camera.get("raw_sizes") or []
    return [*known, ("RAW size", ", ".join(f"{width} × {height}" for height, width in sizes) or UNKNOWN)]


def _frame_rows(bank: Bank) -> list[dict[str, str]]:
    return [
        {
            "name": frame.get("name", UNKNOWN), "depth": cm(frame.get("depth_nominal_mm"), 2),
            "exposure": exposure_text(frame["exposure_s"]).removesuffix(" s") if frame.get("exposure_s") else UNKNOWN,
            "iso": f"{frame['iso']:g}" if frame.get("iso") else UNKNOWN, "dark": frame.get("dark") or "none",
            "sha256": str(frame.get("sha256", ""))[:16],
        }
        for frame in bank.manifest.get("frames", [])
    ]  # fmt: skip
