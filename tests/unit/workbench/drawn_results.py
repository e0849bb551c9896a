"""A bank and a measurement drawn from scratch, as real ones look: a numeral 7, a scene of planes, posteriors."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.image import FrameInfo, LinearImage
from calibration.lens_fit import LensFit
from calibration.optics import mirror_depth, signed_radius
from calibration.quality import LIMITS
from workbench.depth.estimate import DepthEstimate, Status
from workbench.measurement import Measurement

FOCUS_MM, SCALE_PX = 1600.0, 8.0
SEVEN = np.array(
    [[-0.67, -0.74], [0.67, -0.74], [0.67, -0.41], [0.03, 0.74], [-0.39, 0.74], [0.25, -0.41], [-0.67, -0.41]]
)
"""Outline in aperture radii, x right, y down, as the PSF beyond focus."""
SUSPECT_INDEX = 20
NAN = float("nan")


def draw_seven(radius_px: float, size: int, fine: int = 8) -> NDArray[np.float32]:
    """Unit-sum PSF (size, size) of a signed radius; turned by 180 degrees where negative."""
    centre = (size * fine - 1) / 2
    points = SEVEN * np.sign(radius_px) * max(abs(radius_px), 0.4) * fine + centre
    canvas = np.zeros((size * fine, size * fine), np.uint8)
    cv2.fillPoly(canvas, [np.rint(points * 16).astype(np.int32)], 255, shift=4)
    small = canvas.reshape(size, fine, size, fine).mean(axis=(1, 3)) + 1e-9
    return (small / small.sum()).astype(np.float32)


def draw_bank(*, judged: bool = True, fields: int = 1) -> Bank:
    """30 depths, 60 to 350 cm; one of them suspect, one frame rejected. ``judged=False``: as if imported."""
    depths = np.arange(600.0, 3501.0, 100.0)
    radius = signed_radius(depths, focus_mm=FOCUS_MM, scale=SCALE_PX)
    rng = np.random.default_rng(3)
    error = 0.004 + 0.02 / (1 + np.abs(radius))
    residual = error * rng.standard_normal(depths.size)
    residual[SUSPECT_INDEX] = 0.31
    size = 2 * int(np.ceil(np.abs(radius).max())) + 5
    psf = np.stack([draw_seven(float(r), size) for r in radius])
    suspect = tuple(k == SUSPECT_INDEX for k in range(depths.size))
    lens = LensFit(
        focus_mm=FOCUS_MM, focus_se_mm=0.21, scale_px=SCALE_PX, scale_se_px=0.003, zero_mm=7.03, zero_se_mm=0.12,
        radius_px=radius + residual, radius_se_px=error, residual_px=residual, suspect=suspect,
    )  # fmt: skip
    positions = np.array([[0.0, 0.0], [-0.7, -0.7], [0.7, 0.7], [-0.7, 0.7], [0.7, -0.7]])[:fields]
    manifest = _manifest(depths, radius, residual, suspect) if judged else {"kind": "imported"}
    return Bank(
        depths_mm=depths, psf=np.stack([psf] * fields), psf_se=np.stack([0.01 * psf] * fields), field_yx=positions,
        lens=lens, recipe="superpixel", pixel_pitch_mm=0.0086 if judged else None, manifest=manifest,
        extras={"aperture": draw_seven(40.0, 101)} if judged else {},
    )  # fmt: skip


def _manifest(depths: NDArray[np.float64], radius: NDArray[np.float64], residual: NDArray[np.float64],
              suspect: tuple[bool, ...]) -> dict[str, object]:  # fmt: skip
    frames = [
        {"name": f"psf_{int(d / 10):03d}cm_{r}.dng", "sha256": f"{k:02x}{r}" * 16 + "0" * 16, "depth_nominal_mm": d - 7,
         "exposure_s": 0.008 * (1 + abs(radius[k])), "iso": 100.0, "dark": "pixelwise"}
        for k, d in enumerate(depths.tolist()) for r in (1, 2)
    ]  # fmt: skip
    judged = []
    for k, depth in enumerate(depths.tolist()):
        figures = {name: None if name == "flux_spread" else 0.3 * limit.suspect if not limit.low_is_bad
                   else 4 * limit.suspect for name, limit in LIMITS.items()}  # fmt: skip
        figures["residual_px"] = abs(float(residual[k]))
        figures["flux_snr"] = 400.0 + 300 * abs(float(radius[k])) ** 2
        reasons = ["residual_px"] if suspect[k] else []
        judged.append({"depth_nominal_mm": depth - 7, "verdict": "suspect" if suspect[k] else "good",
                       "reasons": reasons, "figures": figures})  # fmt: skip
    return {
        "kind": "measured", "software": "0.1.0", "nominal_depths_mm": (depths - 7).tolist(),
        "camera": {"make": "Canon", "model": "EOS 650D", "cfa": "RGGB", "focal_length_mm": 50.0, "f_number": 3.5,
                   "serial": "0123456789", "raw_sizes": [[320, 480]], "sensor_size": [320, 480]},
        "aperture": {"radius_mm": 7.0}, "frames": frames,
        "rejected": [{"name": "psf_175cm_1.dng", "depth_nominal_mm": 1750.0, "reason": "saturated"}],
        "settings": {"camera": "simulated small"}, "plan_sha256": "ab" * 32,
        "quality": {"verdict": "suspect", "reasons": ["260 cm: residual_px"], "figures": {}, "depths": judged},
    }  # fmt: skip


def draw_scene(height: int = 160, width: int = 240, channels: int = 3) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Linear image (H, W, C) and labels 1 to 4: wall, plain card, board, ball."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:height, :width]
    labels = np.ones((height, width), np.int32)
    labels[height // 8 : height // 2, width // 12 : width // 3] = 2
    labels[height // 2 :, width // 6 : width // 2] = 3
    labels[(y - 0.55 * height) ** 2 + (x - 0.75 * width) ** 2 < (0.3 * height) ** 2] = 4
    noise = rng.random((height, width)).astype(np.float32)
    wall = 0.06 + 0.04 * cv2.GaussianBlur(noise, (0, 0), 2.0) + 0.03 * ((x // 20 + y // 12) % 2)
    ball = 0.1 + 0.3 * cv2.GaussianBlur(noise, (0, 0), 1.0)
    texture = [0.0, wall, np.full_like(noise, 0.2), 0.05 + 0.25 * ((x // 7) % 2), ball]
    tint = [None, (0.9, 1.0, 1.0), (1.0, 1.0, 0.9), (0.9, 0.5, 0.4), (0.4, 0.7, 1.0)]
    image = np.zeros((height, width, 3), np.float32)
    for label in range(1, 5):
        mask = labels == label
        image[mask] = (np.asarray(texture[label])[mask][:, np.newaxis] * np.array(tint[label])).astype(np.float32)
    image += 0.002 * rng.standard_normal(image.shape).astype(np.float32)
    return image[:, :, :channels], labels


def posterior(depth_mm: float, spread: float, p_mirror: float, *, status: Status = "ok", reason: str = "",
              pixels: int = 5000) -> DepthEstimate:  # fmt: skip
    """A posterior on 400 depths even in 1/z, with a second mode at the mirror depth."""
    inverse = np.linspace(1 / 600, 1 / 3500, 400)
    mirror = mirror_depth(depth_mm, focus_mm=FOCUS_MM)
    mass = (1 - p_mirror) * np.exp(-0.5 * ((inverse - 1 / depth_mm) / spread) ** 2) + 1e-9
    mass += p_mirror * np.exp(-0.5 * ((inverse - 1 / mirror) / spread) ** 2)
    low, high = 1 / (1 / depth_mm + 2 * spread), 1 / (1 / depth_mm - 2 * spread)
    return DepthEstimate(
        depth_mm=depth_mm, interval_mm=(low, high), confidence=0.95 * (1 - p_mirror), mirror_mm=mirror,
        mirror_probability=p_mirror, status=status, depths_mm=1 / inverse, score=mass / mass.sum(), second_mm=mirror,
        pixels=pixels, reason=reason,
    )  # fmt: skip


def no_texture(pixels: int = 900) -> DepthEstimate:
    """A region that says nothing."""
    inverse = np.linspace(1 / 600, 1 / 3500, 400)
    return DepthEstimate(
        depth_mm=NAN, interval_mm=(NAN, NAN), confidence=0.0, mirror_mm=NAN, mirror_probability=NAN,
        status="no-texture", depths_mm=1 / inverse, score=np.zeros(400), second_mm=NAN, pixels=pixels,
        reason="contrast is within the noise <0.4 %>",
    )  # fmt: skip


def score_estimate(depth_mm: float = 2000.0) -> DepthEstimate:
    """A sharpness score with everything that its figures need."""
    rng = np.random.default_rng(5)
    depths = np.arange(600.0, 3501.0, 100.0)
    score = 0.8 + 0.2 * np.exp(-(((1 / depths - 1 / depth_mm) / 5e-5) ** 2))
    found: dict[str, NDArray[np.float64]] = {"scores": np.stack([score, score**2, score**0.5, score]),
                                             "lambda": 1 - 0.1 * np.abs(np.log(depths / 1600))}  # fmt: skip
    for name in ("x", "y", "xx", "yy"):
        values = rng.gamma(1.5, 1.0, (40, 60))
        values /= values.sum()
        ends = np.quantile(values, np.linspace(0, 1, 11))
        counts, edges = np.histogram(values, 64)
        found |= {
            f"window_{name}": values, f"denoised_{name}": np.where(values > ends[9], values, 0.0),
            f"histogram_{name}": counts.astype(float), f"magnitude_{name}": edges, f"sections_{name}": ends,
            f"threshold_{name}": ends[9:10],
        }  # fmt: skip
    return DepthEstimate(
        depth_mm=depth_mm, interval_mm=(depth_mm - 50, depth_mm + 50), confidence=0.6, mirror_mm=NAN,
        mirror_probability=NAN, status="ok", depths_mm=depths, score=score / score.max(), second_mm=NAN, pixels=700,
        diagnostics=found,
    )  # fmt: skip


def draw_measurement(estimates: dict[int, DepthEstimate] | None = None, *, channels: int = 3) -> Measurement:
    """A measurement of :func:`draw_scene`: ok, no-texture, ambiguous and ok."""
    planes, labels = draw_scene(channels=channels)
    if estimates is None:
        estimates = {
            1: posterior(3212.0, 4e-6, 0.0004, pixels=19000),
            2: no_texture(),
            3: posterior(1873.0, 9e-6, 0.38, status="ambiguous", reason="1396 mm explains the region nearly as well"),
            4: posterior(874.0, 3e-6, 0.012),
        }
    depth = np.full(labels.shape, np.nan, np.float32)
    for label, estimate in estimates.items():
        depth[labels == label] = estimate.depth_mm
    info = FrameInfo(
        path="scene.dng", sha256="cd" * 32, make="Canon", model="EOS 650D", raw_size=(320, 480), cfa="RGGB",
        exposure_s=0.008, iso=200.0, focal_length_mm=50.0, f_number=3.5, pixel_pitch_mm=0.0043,
    )  # fmt: skip
    image = LinearImage(planes, planes.max(axis=2) > 0.39, "superpixel", 0.0086, info)
    return Measurement(
        image=image, image_name="shots/scene.dng", bank_ref="active", bank_id="0123456789abcdef", method="evidence",
        options={"roi": None, "srm_q": 32.0, "method_options": {"prior": "1/f"}}, labels=labels, estimates=estimates,
        depth_map_mm=depth, all_focus=planes, seconds=3.4, files={"depth_png": Path("m/depth.png")},
    )  # fmt: skip
