"""The bank: an immutable, content-addressed set of point-spread functions (arrays and manifest)."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import BankError, MismatchError
from calibration.image import LinearImage
from calibration.lens_fit import LensFit

__all__ = ["Bank", "LensFit", "check_fits", "dump", "load_bank", "save_bank", "undump"]

FORMAT = 1
_CORE = ("depths_mm", "psf", "psf_se", "field_yx", "radius_px", "radius_se_px", "residual_px")
PITCH_TOLERANCE = 0.01
"""Pitches that differ by less than this part are the same."""
_OPTICS_TOLERANCE = 0.05


@dataclass(frozen=True)
class Bank:
    """PSFs of one camera, lens and focus setting, over depth (and, where measured, over the field).

    Attributes
    ----------
    depths_mm
        float64 (D,), ascending, measured from the reference plane of the lens fit.
    psf
        float32 (F, D, K, K), non-negative up to noise, unit sum; K odd; the chief ray is in the centre pixel.
    psf_se
        float32 (F, D, K, K), standard error per pixel.
    field_yx
        float64 (F, 2): where in the frame each set was measured, as a fraction of the half frame
        ((0, 0) = centre, (-1, -1) = top left corner). F = 1 for a central bank.
    lens
        Thin lens fitted to the central set.
    recipe, pixel_pitch_mm
        Recipe and pitch (mm) of the developed image; pitch None where neither file nor operator knows it.
    manifest
        Everything else: provenance, quality, camera, see docs/reference.
    extras
        Further arrays by name, stored and hashed with the rest: ``chief_yx`` (F, D, 2), the chief ray's position
        relative to the centre pixel; ``middle_yx`` (F, D, 2), the centre pixel's place in the frame;
        ``place_yx`` (F, D, 2), where each depth's point was, like ``field_yx``, its mean (F > 1 only);
        ``field_radius_px`` (F, D), signed radii per set; ``aperture`` (N, N), the
        aperture's picture, +-1.25 radii wide, oriented as the PSF beyond focus; models fitted later.
    """

    depths_mm: NDArray[np.float64]
    psf: NDArray[np.float32]
    psf_se: NDArray[np.float32]
    field_yx: NDArray[np.float64]
    lens: LensFit
    recipe: str
    pixel_pitch_mm: float | None
    manifest: Mapping[str, Any] = field(default_factory=dict)
    extras: Mapping[str, NDArray[Any]] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def central(self) -> NDArray[np.float32]:
        """float32 (D, K, K): the set nearest to the centre of the frame."""
        return np.asarray(self.psf[self.central_index])

    @property
    def central_index(self) -> int:
        """Index of the set nearest to the centre of the frame."""
        return int(np.argmin(np.hypot(*self.field_yx.T)))

    @property
    def id(self) -> str:
        """16 hexadecimal digits, from the content alone."""
        return _identify(_manifest_of(self, _serialise(self)))


def save_bank(bank: Bank, banks_dir: str | Path) -> Path:
    """Write a bank to ``banks_dir/ID`` and return that directory; an identical bank that is there already is kept.

    Everything is written to a temporary directory, synced and renamed, so that a bank is there complete or not at all.

    Raises
    ------
    BankError
        The disk is full or not writable; nothing is left behind.
    """
    banks_dir = Path(banks_dir)
    files = _serialise(bank)
    manifest = _manifest_of(bank, files)
    target = banks_dir / _identify(manifest)
    if target.exists():
        load_bank(target)
        return target
    text = json.dumps({"id": target.name, **manifest}, indent=1, sort_keys=True, allow_nan=False) + "\n"
    temporary: Path | None = None
    try:
        banks_dir.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", suffix=".tmp", dir=banks_dir))
        for name, content in {**files, "manifest.json": text.encode()}.items():
            with (temporary / name).open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
        temporary.chmod(0o755)
        _sync_directory(temporary)
        temporary.rename(target)
        _sync_directory(banks_dir)
    except OSError as error:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
        what = "no space left on the disk" if error.errno == errno.ENOSPC else error.strerror or str(error)
        raise BankError(f"{banks_dir}: can't write the bank: {what}; nothing was left behind") from error
    except BaseException:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
        raise
    return target


def load_bank(directory: str | Path) -> Bank:
    """Read a bank and verify the hash of every file and of the manifest.

    Raises
    ------
    BankError
        No bank there, a file is missing, or a byte has changed (the message names the file).
    """
    directory = Path(directory)
    path = directory / "manifest.json"
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BankError(f"{directory}: is no bank (no manifest.json)") from None
    except (OSError, ValueError) as error:
        raise BankError(f"{path}: can't be read ({error}); restore the bank from a copy") from error
    if not isinstance(stored, dict) or stored.get("format") != FORMAT:
        raise BankError(f"{path}: is not a manifest of format {FORMAT}; made by another version of this software?")
    manifest = {key: value for key, value in stored.items() if key != "id"}
    if stored.get("id") != _identify(manifest):
        raise BankError(f"{path}: was changed after the bank was made (hash differs); restore the bank from a copy")
    arrays = {}
    for name, facts in manifest["arrays"].items():
        arrays[name] = _read_array(directory / f"{name}.npy", str(facts["sha256"]))
    missing = [name for name in _CORE if name not in arrays]
    if missing:
        raise BankError(f"{path}: lists no array {missing[0]}; restore the bank from a copy")
    return _assembled(manifest, arrays)


def dump(bank: Bank) -> tuple[str, dict[str, NDArray[Any]]]:
    """Everything that a bank holds: its manifest as JSON text, its arrays by name; :func:`undump` reverses it."""
    files = _serialise(bank)
    manifest = _manifest_of(bank, files)
    text = json.dumps({"id": _identify(manifest), **manifest}, sort_keys=True, allow_nan=False)
    return text, {name.removesuffix(".npy"): np.load(io.BytesIO(data)) for name, data in files.items()}


def undump(text: str, arrays: Mapping[str, NDArray[Any]]) -> Bank | None:
    """Put a bank together again from what :func:`dump` gave; None if anything was changed since."""
    try:
        stored = json.loads(text)
        manifest = {key: value for key, value in stored.items() if key != "id"}
        bank = _assembled(manifest, {name: arrays[name] for name in manifest["arrays"]})
        return bank if bank.id == stored["id"] == _identify(manifest) else None
    except (ValueError, TypeError, KeyError, AttributeError, BankError):
        return None


def _assembled(manifest: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Bank:
    lens = manifest["lens"]
    return Bank(
        depths_mm=arrays["depths_mm"],
        psf=arrays["psf"],
        psf_se=arrays["psf_se"],
        field_yx=arrays["field_yx"],
        lens=LensFit(
            **{name: float("nan") if lens[name] is None else float(lens[name]) for name in _LENS_NUMBERS},
            radius_px=arrays["radius_px"],
            radius_se_px=arrays["radius_se_px"],
            residual_px=arrays["residual_px"],
            zero_applied=bool(lens["zero_applied"]),
            suspect=tuple(bool(b) for b in lens["suspect"]),
        ),
        recipe=manifest["recipe"],
        pixel_pitch_mm=manifest["pixel_pitch_mm"],
        manifest={key: value for key, value in manifest.items() if key not in _DERIVED},
        extras={name: array for name, array in arrays.items() if name not in _CORE},
    )


def check_fits(bank: Bank, image: LinearImage) -> None:
    """Refuse an image that this bank can't measure.

    RAW: recipe, pixel pitch (1 %), colour pattern, camera model, focal length and f-number (5 %) must agree wherever
    both sides know them; the size only where the bank knows the sensor's (frames may be crops of one sensor). Linear
    arrays say nothing about themselves and count as developed like the bank; a stated pitch must agree.

    Raises
    ------
    MismatchError
        Naming the file and the first thing that differs.
    """
    path, info = image.info.path, image.info
    camera = bank.manifest.get("camera", {})

    def refuse(what: str, theirs: object, ours: object) -> MismatchError:
        return MismatchError(
            f"{path}: {what} is {theirs}, but the bank's is {ours}; use a bank made with this camera and lens"
        )

    pitches = image.pixel_pitch_mm, bank.pixel_pitch_mm
    if pitches[0] and pitches[1] and abs(pitches[0] / pitches[1] - 1.0) > PITCH_TOLERANCE:
        if image.recipe != bank.recipe and "linear" not in (image.recipe, bank.recipe):
            raise _recipe_error(path, image.recipe, bank.recipe)
        raise refuse("pixel pitch", f"{pitches[0] * 1000:.2f} um", f"{pitches[1] * 1000:.2f} um")
    if image.recipe == "linear":
        return
    if bank.recipe != image.recipe and not (bank.recipe == "linear" and all(pitches)):
        raise _recipe_error(path, image.recipe, bank.recipe)
    for what, theirs, ours in (
        ("colour pattern", info.cfa, camera.get("cfa")),
        ("camera", info.model, camera.get("model")),
    ):
        if theirs and ours and theirs != ours:
            raise refuse(what, theirs, ours)
    for what, number, own in (
        ("focal length", info.focal_length_mm, camera.get("focal_length_mm")),
        ("f-number", info.f_number, camera.get("f_number")),
    ):
        if number and own and abs(number / own - 1.0) > _OPTICS_TOLERANCE:
            raise refuse(what, f"{number:g}", f"{own:g}")
    size = camera.get("sensor_size")
    if size and info.raw_size and tuple(size) != tuple(info.raw_size):
        raise refuse("sensor size", f"{info.raw_size[1]} x {info.raw_size[0]}", f"{size[1]} x {size[0]}")


def _recipe_error(path: str, theirs: str, ours: str) -> MismatchError:
    return MismatchError(f"{path}: was developed as {theirs}, but the bank as {ours}; develop it as {ours}")


_LENS_NUMBERS = ("focus_mm", "focus_se_mm", "scale_px", "scale_se_px", "zero_mm", "zero_se_mm")
_DERIVED = ("format", "arrays", "lens", "recipe", "pixel_pitch_mm")


def _serialise(bank: Bank) -> dict[str, bytes]:
    arrays: dict[str, NDArray[Any]] = {
        "depths_mm": bank.depths_mm.astype(np.float64),
        "psf": bank.psf.astype(np.float32),
        "psf_se": bank.psf_se.astype(np.float32),
        "field_yx": bank.field_yx.astype(np.float64),
        "radius_px": bank.lens.radius_px.astype(np.float64),
        "radius_se_px": bank.lens.radius_se_px.astype(np.float64),
        "residual_px": bank.lens.residual_px.astype(np.float64),
    }
    for name, extra in bank.extras.items():
        if name in arrays or not name.isidentifier() or extra.dtype.kind not in "biuf":
            raise BankError(
                f"extra array {name!r} of {extra.dtype} can't be stored: name taken or not a plain numeric array"
            )
        arrays[name] = extra
    files = {}
    for name, array in arrays.items():
        buffer = io.BytesIO()
        little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
        np.save(buffer, little, allow_pickle=False)
        files[f"{name}.npy"] = buffer.getvalue()
    return files


def _manifest_of(bank: Bank, files: Mapping[str, bytes]) -> dict[str, Any]:
    lens: dict[str, Any] = {name: _finite(getattr(bank.lens, name)) for name in _LENS_NUMBERS}
    lens |= {"zero_applied": bank.lens.zero_applied, "suspect": [bool(b) for b in bank.lens.suspect]}
    hashes = {name.removesuffix(".npy"): {"sha256": hashlib.sha256(data).hexdigest()} for name, data in files.items()}
    return {
        **bank.manifest,
        "format": FORMAT,
        "arrays": hashes,
        "lens": lens,
        "recipe": bank.recipe,
        "pixel_pitch_mm": bank.pixel_pitch_mm,
    }


def _identify(manifest: Mapping[str, Any]) -> str:
    canonical = json.dumps(manifest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _read_array(path: Path, sha256: str) -> NDArray[Any]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BankError(f"{path}: can't be read ({error.strerror or error}); restore the bank from a copy") from error
    if hashlib.sha256(content).hexdigest() != sha256:
        raise BankError(f"{path}: was changed after the bank was made (hash differs); restore the bank from a copy")
    array = np.load(io.BytesIO(content), allow_pickle=False)
    array.setflags(write=False)
    return np.asarray(array)


def _sync_directory(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
