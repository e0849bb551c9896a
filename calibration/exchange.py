"""Banks in and out: NPY, NPZ, MATLAB .mat and TIFF stacks in; NPZ and ImageJ TIFF stacks out."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import tifffile
from numpy.typing import NDArray

from calibration.bank import PITCH_TOLERANCE, Bank, dump, undump
from calibration.build import software_version
from calibration.errors import BankError, DepthListError, FitError, MismatchError
from calibration.lens_fit import LensFit, check_depths, fit_lens
from calibration.template import Spot, fit_spots

FloatArray = NDArray[np.float64]

_PSF_NAMES = ("psf", "psfs", "PSF", "PSFs", "bank", "h", "kernels")
_FACTS = ("recipe", "pixel_pitch_mm", "camera", "exported_from")
_DEPTH_NAMES = ("depths_cm", "depths_mm", "depths", "depth_cm", "depth_mm", "depth", "z")


def import_bank(
    path: str | Path,
    depths_mm: Sequence[float] | None = None,
    *,
    recipe: str | None = None,
    pixel_pitch_mm: float | None = None,
    default_recipe: str = "linear",
    axis: int | None = None,
) -> Bank:
    """Make a bank from a stack of PSFs.

    Parameters
    ----------
    path
        ``.npy``, ``.npz``, ``.mat`` (the array named psf, or the only three-dimensional one) or ``.tif``. An ``.npz``
        written by :func:`export_npz` and unchanged since is the same bank again, id included; an ImageJ TIFF
        written by :func:`export_tiff` comes back with its planes, depths, recipe, pitch and camera.
    depths_mm
        One per plane, in the order of the planes (ascending or descending); None: taken from the file (``depths_mm``,
        ``depths_cm``, or slice labels in cm).
    recipe, pixel_pitch_mm
        How the PSFs' frames were developed, where the file doesn't say so.
    default_recipe
        Where neither says it.
    axis
        Which axis counts planes; default: the one as long as the list of depths (the first in doubt, the last for
        ``.mat``, where that is the habit).

    Raises
    ------
    BankError
        The file can't be read, or holds no stack of PSFs.
    DepthListError
        No list of depths, one of another length, or one that can't be right.
    MismatchError
        The file states another recipe or pitch than the one given.
    """
    path = Path(path)
    try:
        stack, stored = _read(path)
    except (BankError, DepthListError):
        raise
    except FileNotFoundError:
        raise BankError(f"{path}: no such file") from None
    except Exception as error:  # readers raise whatever broken bytes lead them to
        raise BankError(f"{path}: can't be read ({' '.join(str(error).split())[:120]})") from error
    recipe, pixel_pitch_mm = _agreed(path, stored, recipe, pixel_pitch_mm)
    whole = stored.get("bank")
    if isinstance(whole, Bank) and axis is None and _same_depths(whole, depths_mm):
        return whole if whole.pixel_pitch_mm else replace(whole, pixel_pitch_mm=pixel_pitch_mm)
    depths = list(depths_mm) if depths_mm is not None else stored.get("depths_mm")
    if depths is None:
        raise DepthListError(f"{path}: holds no depths; give one per plane")
    try:
        checked = check_depths(depths, ordered=True)
    except DepthListError as error:
        raise DepthListError(f"{path}: {error}") from None
    if stack.ndim == 4 and stored.get("field_yx") is not None:
        planes = stack
    else:
        planes = _planes_first(path, stack, checked.size, axis)[np.newaxis]
    order = np.argsort(checked)
    psf = _odd_square(planes[:, order])
    total = psf.sum(axis=(2, 3), keepdims=True)
    if not np.isfinite(psf).all() or (total <= 0).any():
        raise BankError(f"{path}: a plane is empty or not finite")
    if np.abs(total - 1.0).max() > 1e-5:  # planes that sum to 1 already stay bit for bit
        psf = (psf / total).astype(np.float32)
    stored_se = stored.get("psf_se")
    se = _odd_square(stored_se[:, order]) if stored_se is not None else _guess_se(psf)
    lens = _lens(path, psf, se, checked[order])
    return Bank(
        depths_mm=checked[order],
        psf=psf,
        psf_se=se,
        field_yx=np.asarray(stored.get("field_yx", np.zeros((1, 2))), np.float64),
        lens=lens,
        recipe=recipe or default_recipe,
        pixel_pitch_mm=pixel_pitch_mm,
        manifest={
            "kind": "imported",
            "software": software_version(),
            "source": {
                "name": path.name,
                "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
                "exported_from": stored.get("exported_from"),
            },
            "camera": stored.get("camera", {}),
            "quality": {"verdict": "unknown", "reasons": [_unknown(stored_se is not None)]},
        },
    )


def _agreed(
    path: Path, stored: dict[str, Any], recipe: str | None, pixel_pitch_mm: float | None
) -> tuple[str | None, float | None]:
    """Recipe and pitch from file and operator, who may fill in but not contradict."""
    says, pitch = stored.get("recipe"), stored.get("pixel_pitch_mm")
    if recipe and says and recipe != says:
        raise MismatchError(f"{path}: its PSFs were developed as {says}, not {recipe}; leave the recipe out")
    if pixel_pitch_mm and pitch and abs(pixel_pitch_mm / pitch - 1.0) > PITCH_TOLERANCE:
        raise MismatchError(
            f"{path}: its pixel pitch is {1000 * pitch:.2f} um, not {1000 * pixel_pitch_mm:.2f} um; leave the pitch out"
        )
    return says or recipe, pitch or pixel_pitch_mm


def _same_depths(bank: Bank, depths_mm: Sequence[float] | None) -> bool:
    if depths_mm is None:
        return True
    return len(depths_mm) == bank.depths_mm.size and bool(np.allclose(depths_mm, bank.depths_mm, rtol=0, atol=0.01))


def export_npz(bank: Bank, path: str | Path) -> Path:
    """Write all that the bank holds as a compressed NPZ: its arrays by name, its manifest as JSON text."""
    path = Path(path)
    manifest, arrays = dump(bank)
    with path.open("wb") as stream:
        np.savez_compressed(stream, manifest=np.array(manifest), **arrays)  # type: ignore[arg-type]  # numpy/numpy#28104
    return path


def export_tiff(bank: Bank, path: str | Path) -> Path:
    """Write the central set as an ImageJ hyperstack: float32, one slice a depth, labelled in cm.

    A stack of pictures can't hold the rest: standard errors, other field positions, the lens fit, quality and history.
    """
    path = Path(path)
    labels = [f"{depth / 10:.10g} cm" for depth in bank.depths_mm]
    metadata: dict[str, Any] = {"axes": "ZYX", "Labels": labels, "mode": "grayscale"}
    facts = {
        **_facts(bank.recipe, bank.pixel_pitch_mm, bank.manifest.get("camera", {}), bank.id),
        "depths_mm": bank.depths_mm.tolist(),
    }
    metadata["Info"] = json.dumps(facts)
    written = io.BytesIO()  # into a file that can't grow, tifffile's numpy writes with an error that says nothing
    tifffile.imwrite(written, bank.central.astype(np.float32), imagej=True, metadata=metadata)
    path.write_bytes(written.getvalue())
    return path


def diff(a: Bank, b: Bank) -> dict[str, Any]:
    """Differences of two banks as plain figures.

    Returns
    -------
    dict
        ``same`` (content), ``focus_mm``, ``scale_px``, ``zero_mm`` (b minus a; None where unknown), ``recipe`` and
        ``pixel_pitch_mm`` (pairs), ``depths``: one entry per common depth (to 0.5 mm) with ``depth_mm``,
        ``psf_distance`` (half the L1 distance after aligning the grids, 0 to 1) and ``radius_px`` (b minus a);
        ``only_a``, ``only_b``: depths in mm.
    """
    pairs = [
        (i, int(j[0])) for i, z in enumerate(a.depths_mm) if (j := np.flatnonzero(np.abs(b.depths_mm - z) < 0.5)).size
    ]
    half = max(a.psf.shape[-1], b.psf.shape[-1]) // 2
    first, second = _padded(a.central, half), _padded(b.central, half)
    left = {i for i, _ in pairs}
    right = {j for _, j in pairs}
    return {
        "same": a.id == b.id,
        "focus_mm": _difference(a.lens.focus_mm, b.lens.focus_mm),
        "scale_px": _difference(a.lens.scale_px, b.lens.scale_px),
        "zero_mm": _difference(a.lens.zero_mm, b.lens.zero_mm),
        "recipe": [a.recipe, b.recipe],
        "pixel_pitch_mm": [a.pixel_pitch_mm, b.pixel_pitch_mm],
        "depths": [
            {
                "depth_mm": float(a.depths_mm[i]),
                "psf_distance": float(0.5 * np.abs(first[i] - second[j]).sum()),
                "radius_px": float(b.lens.radius_px[j] - a.lens.radius_px[i]),
            }
            for i, j in pairs
        ],
        "only_a": [float(z) for i, z in enumerate(a.depths_mm) if i not in left],
        "only_b": [float(z) for j, z in enumerate(b.depths_mm) if j not in right],
    }


def _difference(a: float, b: float) -> float | None:
    return float(b - a) if np.isfinite(a) and np.isfinite(b) else None


def _padded(psf: NDArray[np.float32], half: int) -> FloatArray:
    margin = half - psf.shape[-1] // 2
    return np.pad(psf.astype(np.float64), ((0, 0), (margin, margin), (margin, margin)))


def _read(path: Path) -> tuple[NDArray[Any], dict[str, Any]]:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return np.load(path, allow_pickle=False), {}
    if suffix in (".tif", ".tiff"):
        return _read_tiff(path)
    if suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            content = {name: archive[name] for name in archive.files}
    elif suffix == ".mat":
        content = {k: v for k, v in scipy.io.loadmat(path).items() if not k.startswith("__")}
    else:
        raise BankError(f"{path}: can't import {suffix or 'this'}; give .npy, .npz, .mat (up to v7) or .tif")
    stored: dict[str, Any] = {}
    if "manifest" in content:
        stored = _from_manifest(str(content["manifest"]), content)
    for name in ("psf_se", "field_yx"):
        if name in content:
            stored[name] = content[name]
    for name in _DEPTH_NAMES:
        if name in content and np.asarray(content[name]).dtype.kind in "iuf":
            unit = 1.0 if name.endswith("mm") else 10.0
            stored["depths_mm"] = (np.asarray(content[name], np.float64).ravel() * unit).tolist()
            break
    for name in _PSF_NAMES:
        if name in content:
            return np.asarray(content[name]), stored
    stacks = [v for v in content.values() if isinstance(v, np.ndarray) and v.ndim == 3]
    if len(stacks) != 1:
        raise BankError(f"{path}: has {len(stacks)} three-dimensional arrays and none is named psf; rename one")
    return stacks[0], stored


def _facts(recipe: str, pixel_pitch_mm: float | None, camera: object, bank_id: object) -> dict[str, Any]:
    return dict(zip(_FACTS, (recipe, pixel_pitch_mm, camera, bank_id), strict=True))


def _from_manifest(text: str, content: dict[str, Any]) -> dict[str, Any]:
    """What an exported NPZ says of itself: the whole bank if it is as it was written, else only the plain facts."""
    bank = undump(text, content)
    if bank is not None:
        return {"bank": bank, **_facts(bank.recipe, bank.pixel_pitch_mm, bank.manifest.get("camera", {}), bank.id)}
    try:
        told = json.loads(text)
        return _facts(told["recipe"], told["pixel_pitch_mm"], told.get("camera", {}), told["id"])
    except (ValueError, TypeError, KeyError):
        return {}  # a manifest of someone else's


def _unknown(has_errors: bool) -> str:
    known = "" if has_errors else ", their standard errors are taken as 2 % of the level"
    return f"imported PSFs don't tell how they were taken{known}"


def _read_tiff(path: Path) -> tuple[NDArray[Any], dict[str, Any]]:
    with tifffile.TiffFile(path) as tif:
        stack = np.asarray(tif.asarray())
        imagej = tif.imagej_metadata or {}
    stored: dict[str, Any] = {}
    labels = imagej.get("Labels") or []
    if labels and all(str(label).strip().endswith("cm") for label in labels):
        stored["depths_mm"] = [round(float(str(label).strip()[:-2]) * 10.0, 9) for label in labels]
    try:
        facts = json.loads(str(imagej.get("Info", "")))
        stored |= {key: facts[key] for key in (*_FACTS, "depths_mm") if key in facts}
    except (ValueError, TypeError):
        pass  # an Info text of someone else's
    return stack, stored


def _planes_first(path: Path, stack: NDArray[Any], count: int, axis: int | None) -> NDArray[Any]:
    if stack.ndim != 3:
        raise BankError(f"{path}: has shape {stack.shape}; expected a stack of planes (D, K, K)")
    fitting = [k for k in range(3) if stack.shape[k] == count]
    if axis is None:
        if not fitting:
            raise DepthListError(f"{path}: {count} depths for a stack of shape {stack.shape}; give one depth per plane")
        axis = fitting[-1] if path.suffix.lower() == ".mat" else fitting[0]
    if stack.shape[axis] != count:
        raise DepthListError(f"{path}: {count} depths, but axis {axis} holds {stack.shape[axis]} planes")
    return np.moveaxis(stack, axis, 0)


def _odd_square(planes: NDArray[Any]) -> NDArray[np.float32]:
    """Pad (F, D, h, w) with zeros to odd squares; an even side grows at its end, the middle pixel being at n // 2."""
    if planes.dtype.kind not in "buif":
        raise BankError("the stack holds no real numbers")
    h, w = planes.shape[-2:]
    half = max(h // 2, w // 2)
    size = 2 * half + 1
    top, left = half - h // 2, half - w // 2
    pad = ((0, 0), (0, 0), (top, size - h - top), (left, size - w - left))
    return np.pad(planes, pad).astype(np.float32)


def _guess_se(psf: NDArray[np.float32]) -> NDArray[np.float32]:
    """Stand-in errors where a file has none: 2 % of the plane's upper level everywhere."""
    level = np.percentile(psf.reshape(*psf.shape[:2], -1), 99, axis=2)
    return np.asarray(np.broadcast_to(0.02 * level[:, :, np.newaxis, np.newaxis], psf.shape), np.float32).copy()


def _lens(path: Path, psf: NDArray[np.float32], se: NDArray[np.float32], depths: FloatArray) -> LensFit:
    spots = [
        Spot(p.astype(np.float64), np.maximum(s.astype(np.float64), 1e-4 * float(p.max())))
        for p, s in zip(psf[0], se[0], strict=True)
    ]
    try:
        fit = fit_spots(spots, 1.0 / depths)
        radius = np.array([s.radius_px for s in fit.spots])
        return fit_lens(depths, radius, np.array([s.radius_se_px for s in fit.spots]), apply_zero=False)
    except FitError as error:
        raise FitError(f"{path}: {error}") from None
