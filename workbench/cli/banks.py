"""bank list, show, diff, verify, certify, activate, revoke, learn, import, export."""

from __future__ import annotations

import math
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click

from calibration.bank import Bank, load_bank
from calibration.errors import BankError
from calibration.exchange import diff as diff_banks
from calibration.exchange import export_npz, export_tiff, import_bank
from calibration.lens_fit import MIN_DEPTHS_FOR_ZERO
from calibration.pupil import BetweenPlanes, between_planes
from calibration.registry import Entry, read_registry
from calibration.registry import activate as activate_bank
from calibration.registry import certify as certify_bank
from calibration.registry import revoke as revoke_bank
from workbench.banks import is_bad, open_bank, quality_reasons, quality_verdict, resolve, store_bank
from workbench.cli.common import PITCH, Context, command_options
from workbench.errors import CheckFailedError, InputError
from workbench.files import replacing
from workbench.units import cm, length_mm


def bank_summary(bank: Bank, entry: Entry) -> dict[str, Any]:
    """What ``bank list --json`` prints of each bank."""
    lens = bank.lens
    return {
        "id": bank.id,
        "version": entry.version,
        "state": entry.state,
        "certificate": entry.certificate,
        "depths_mm": [round(float(depth), 3) for depth in bank.depths_mm],
        "fields": len(bank.field_yx),
        "psf_size": int(bank.psf.shape[-1]),
        "recipe": bank.recipe,
        "pixel_pitch_mm": bank.pixel_pitch_mm,
        "lens": {
            "focus_mm": lens.focus_mm,
            "focus_se_mm": lens.focus_se_mm,
            "scale_px": lens.scale_px,
            "scale_se_px": lens.scale_se_px,
            "zero_mm": lens.zero_mm,
            "zero_se_mm": lens.zero_se_mm,
            "zero_applied": lens.zero_applied,
            "rms_residual_px": _rms(lens.residual_px),
            "radius_px": [float(r) for r in lens.radius_px],
            "residual_px": [float(r) for r in lens.residual_px],
            "suspect": [bool(s) for s in lens.suspect],
        },
        "camera": bank.manifest.get("camera", {}),
        "quality": bank.manifest.get("quality", {}),
    }


def tell_bank(context: Context, bank: Bank, entry: Entry) -> dict[str, Any]:
    """Print one bank as ``bank show`` does; gives what its ``--json`` prints: the summary, and ``between_planes``."""
    between = between_planes(bank)
    context.table(("", ""), _bank_rows(bank, entry, between), title=f"Bank v{entry.version} {bank.id}")
    return {**bank_summary(bank, entry), "between_planes": asdict(between) if between else None}


def _bank_rows(bank: Bank, entry: Entry, between: BetweenPlanes | None) -> list[tuple[str, str]]:
    lens = bank.lens
    quality = bank.manifest.get("quality", {})
    pitch = f"{bank.pixel_pitch_mm * 1000:.2f} um" if bank.pixel_pitch_mm else "unknown pitch"
    camera = bank.manifest.get("camera", {})
    zero = f"not known: {len(bank.depths_mm)} depths can't tell it, it takes {MIN_DEPTHS_FOR_ZERO}"
    if math.isfinite(lens.zero_mm):
        applied = "added to the depths" if lens.zero_applied else "reported, not added to the depths"
        zero = f"{lens.zero_mm:.2f} +- {lens.zero_se_mm:.2f} mm, {applied}"
    rows = [
        ("state", f"{entry.state}{f' ({entry.certificate})' if entry.certificate else ''}"),
        ("depths", f"{len(bank.depths_mm)}, {cm(bank.depths_mm[0])} to {cm(bank.depths_mm[-1])}"),
        ("PSFs", f"{len(bank.field_yx)} field position(s), {bank.psf.shape[-1]} px square, {bank.recipe}, {pitch}"),
        ("camera", f"{camera.get('make', '')} {camera.get('model', '')}".strip() or "unknown"),
        ("focus distance", f"{cm(lens.focus_mm, 2)} +- {cm(lens.focus_se_mm, 2)}"),
        ("scale (radius at infinity)", f"{lens.scale_px:.3f} +- {lens.scale_se_px:.3f} px"),
        ("stage zero", zero),
        ("lens fit residual", f"{_rms(lens.residual_px):.3f} px RMS"),
        ("quality", f"{quality.get('verdict', 'unknown')}{''.join(f'; {r}' for r in quality.get('reasons', ()))}"),
    ]
    if between:
        source = "model of the aperture" if between.source == "pupil" else "interpolated, no model of the aperture fits"
        rows.insert(-1, ("PSFs between depths", f"{source}, residual {between.residual:.1%}"))
    suspects = [cm(z, 0) for z, bad in zip(bank.depths_mm, lens.suspect, strict=False) if bad]
    if suspects:
        rows.append(("suspect depths", ", ".join(suspects)))
    return rows


def check_activated(bank: Bank, entry: Entry) -> None:
    """Say so where a bank was stored, but is too bad to be used unseen.

    Raises
    ------
    CheckFailedError
        Its quality is bad and it isn't the active one.
    """
    if is_bad(bank) and not entry.active:
        raise CheckFailedError(
            f"bank v{entry.version} {entry.id} was stored but not activated: its quality is bad "
            f"({quality_reasons(bank)}); mend what its report shows, or use it as it is with "
            f"`workbench bank activate v{entry.version} --force`"
        )


def _rms(values: Any) -> float:
    finite = [float(v) ** 2 for v in values if math.isfinite(v)]
    return math.sqrt(sum(finite) / len(finite)) if finite else float("nan")


@click.group()
@command_options
def bank(context: Context) -> None:
    """Banks of point-spread functions: list, compare, choose, exchange."""


@bank.command("list")
@command_options
def list_banks(context: Context) -> None:
    """List the banks of the project."""
    project = context.project()
    entries = read_registry(project.banks).entries
    rows = []
    for entry in entries:
        loaded = load_bank(project.banks / entry.id)
        verdict = quality_verdict(loaded)
        reach = f"{cm(loaded.depths_mm[0], 0)} to {cm(loaded.depths_mm[-1], 0)}"
        rows.append((f"v{entry.version}", entry.id, entry.state, str(len(loaded.depths_mm)), reach, verdict))
        context.emit(bank_summary(loaded, entry))
    if rows:
        context.table(("version", "id", "state", "depths", "range", "quality"), rows)
    else:
        context.say("No bank yet; make one with `workbench calibrate`.")


@bank.command()
@click.argument("ref", default="active")
@command_options
def show(context: Context, ref: str) -> None:
    """Show one bank: lens fit, quality, provenance."""
    loaded, entry = open_bank(context.project(), ref)
    context.emit(tell_bank(context, loaded, entry))


@bank.command()
@click.argument("first")
@click.argument("second")
@command_options
def diff(context: Context, first: str, second: str) -> None:
    """Compare two banks: lens fit, and PSFs depth by depth."""
    project = context.project()
    a, b = (open_bank(project, ref)[0] for ref in (first, second))
    found = diff_banks(a, b)
    context.emit({"first": a.id, "second": b.id, **found})
    if found["same"]:
        context.say("The banks are identical.")
        return
    for name, words, per_unit, unit in (
        ("focus_mm", "focus distance", 10.0, "cm"),
        ("scale_px", "scale", 1.0, "px"),
        ("zero_mm", "stage zero", 1.0, "mm"),
    ):
        value = found[name]
        context.say(f"{words}: {'unknown' if value is None else f'{value / per_unit:+.3f} {unit}'}")
    rows = [
        (
            cm(d["depth_mm"], 0),
            f"{d['psf_distance']:.4f}",
            f"{d['radius_px']:+.3f}" if d["radius_px"] is not None else "-",
        )
        for d in found["depths"]
    ]
    context.table(("depth", "PSF distance", "radius, px"), rows)
    for name, ref in (("only_a", first), ("only_b", second)):
        if found[name]:
            context.say(f"only in {ref}: {', '.join(cm(depth, 0) for depth in found[name])}")


@bank.command()
@click.argument("ref", default="active")
@command_options
def verify(context: Context, ref: str) -> None:
    """Check every byte of a bank against its hashes, and its quality against the limits."""
    loaded, entry = open_bank(context.project(), ref)
    context.emit({"id": loaded.id, "version": entry.version, "sound": True, "quality": quality_verdict(loaded)})
    context.say(f"bank v{entry.version} {loaded.id}: every byte is as it was written")
    if is_bad(loaded):
        raise CheckFailedError(f"bank v{entry.version}: its quality is bad ({quality_reasons(loaded)})")


@bank.command()
@click.argument("ref")
@click.option("--note", required=True, help="What the bank is certified for, and until when.")
@command_options
def certify(context: Context, ref: str, note: str) -> None:
    """Certify a bank: somebody looked at it and vouches for it."""
    project = context.project()
    loaded, _ = open_bank(project, ref)
    if is_bad(loaded):
        raise CheckFailedError(
            f"bank {ref}: its quality is bad, so it can't be certified; see `workbench bank show {ref}`"
        )
    _told(context, certify_bank(project.banks, ref, note))


@bank.command()
@click.argument("ref")
@click.option("--force", is_flag=True, help="Even though its quality is bad.")
@command_options
def activate(context: Context, ref: str, force: bool) -> None:
    """Make a bank the active one (an older one: a roll-back)."""
    project = context.project()
    loaded, entry = open_bank(project, ref)
    if is_bad(loaded) and not force:
        raise CheckFailedError(
            f"bank v{entry.version} {entry.id}: its quality is bad ({quality_reasons(loaded)}); look at its report, "
            "then activate it anyway with --force"
        )
    _told(context, activate_bank(project.banks, ref))


@bank.command()
@click.argument("ref")
@click.option("--reason", required=True, help="Why it must not be used any more.")
@click.option("--yes", is_flag=True, help="Do not ask.")
@command_options
def revoke(context: Context, ref: str, reason: str, yes: bool) -> None:
    """Withdraw a bank for good; its files stay."""
    project = context.project()
    entry = resolve(project, ref)
    if not (yes or entry.revoked):
        if not sys.stdin.isatty():
            raise InputError(f"bank v{entry.version} {entry.id}: revoking is for good; confirm it with --yes")
        if not click.confirm(f"Revoke bank v{entry.version} {entry.id} for good?", err=True):
            context.say("Nothing was changed.")
            return
    _told(context, revoke_bank(project.banks, ref, reason))


def _told(context: Context, entry: Entry) -> None:
    context.say(f"bank v{entry.version} {entry.id}: {entry.state}")
    context.emit({"id": entry.id, "version": entry.version, "state": entry.state, "certificate": entry.certificate})


def parse_depths(text: str) -> list[float]:
    """Depths in mm from ``60,70,80cm`` or a file with one depth a line; bare numbers are centimetres."""
    source = text
    if len(text) < 256 and Path(text).is_file():  # a longer one is a list: no file's name is
        try:
            source = Path(text).read_text(encoding="utf-8")
        except UnicodeDecodeError:
            raise InputError(f"--depths {text}: is no text file; give one depth a line") from None
    parts = [part for line in source.splitlines() for part in line.replace(";", ",").split(",") if part.strip()]
    if not parts:
        raise InputError(f"--depths {text!r}: no depths in it; give for example 60cm,70cm,80cm or a file")
    try:
        return [length_mm(part, default_unit="cm") for part in parts]
    except InputError as error:
        raise InputError(f"--depths: {error}") from None


@bank.command("import")
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--depths", help="Depth of each plane: 60,70,80 (cm), or a file with one depth a line.")
@click.option("--recipe", type=click.Choice(["linear", "superpixel", "native"]),
              help="How the images were developed that the PSFs were taken from.  [default: what the file says, "
              "else superpixel]")  # fmt: skip
@click.option("--pixel-pitch", type=PITCH, help="Pitch of the PSFs' pixels, e.g. 8.6um.")
@command_options
def import_(context: Context, path: Path, depths: str | None, recipe: str | None, pixel_pitch: float | None) -> None:
    """Make a bank from a stack of PSFs: .npy, .npz, .mat or .tif."""
    project = context.project()
    made = import_bank(
        context.existing(path, "stack of PSFs"), parse_depths(depths) if depths else None,
        recipe=recipe, pixel_pitch_mm=pixel_pitch, default_recipe="superpixel",
    )  # fmt: skip
    entry = store_bank(project, made).entry
    context.emit(tell_bank(context, made, entry))
    check_activated(made, entry)


@bank.command()
@click.argument("ref", default="active")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the generated textures.")
@command_options
def learn(context: Context, ref: str, seed: int) -> None:
    """Learn the estimator's weights from a bank's own PSFs; makes a new version of the bank that holds them."""
    from workbench.depth.evidence_learn import learn as learn_weights

    project = context.project()
    loaded, entry = open_bank(project, ref)
    context.note(f"bank v{entry.version}: generating textures, blurring them with its PSFs; about a minute")
    made = replace(loaded, extras={**loaded.extras, **learn_weights(loaded, seed)})
    new = store_bank(project, made).entry
    _told(context, new)
    check_activated(made, new)


@bank.command()
@click.argument("ref")
@click.argument("path", type=click.Path(path_type=Path))
@command_options
def export(context: Context, ref: str, path: Path) -> None:
    """Write a bank's PSFs as .npz or as an ImageJ stack (.tif)."""
    writers = {".npz": export_npz, ".tif": export_tiff, ".tiff": export_tiff}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise BankError(f"{path}: can't export to {path.suffix or 'this'}; name a .npz or .tif file")
    loaded, _ = open_bank(context.project(), ref)
    with replacing(path) as temporary:
        writer(loaded, temporary)
    rest = "the central PSFs; their errors, the lens fit, quality and history stay behind (.npz takes all along)"
    context.say(f"wrote {path}: {'the whole bank' if writer is export_npz else rest}")
    context.emit({"id": loaded.id, "file": str(path)})
