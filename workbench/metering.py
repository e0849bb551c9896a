"""Exposure of the point source, chosen from the image: bright, and nowhere saturated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calibration.exposure import choose_exposure
from calibration.exposure import meter as meter_image
from calibration.image import LinearImage
from rigs.errors import CaptureError
from rigs.protocols import Camera, Exposure
from workbench.units import exposure_text

FIRST_TIME_S = 1 / 60
HIGHEST_ISO = 1600
"""Above this a 650D's noise costs more than a longer exposure."""


@dataclass(frozen=True, slots=True)
class MeteredExposure:
    """What metering came to."""

    exposure: Exposure
    peak: float
    """Brightest pixel of the last metering frame, fraction of white."""
    frames: int
    limited: bool
    """The camera's longest or shortest time was reached before the target."""


def meter(
    expose: Callable[[Exposure, Path], LinearImage],
    camera: Camera,
    stem: Path,
    *,
    start: Exposure | None,
    base_iso: int,
    max_shots: int,
) -> MeteredExposure:
    """Take metering frames until the point is exposed well.

    Parameters
    ----------
    expose
        Takes one frame with the point shown and develops it as superpixels.
    camera
        Tells which times and ISO values there are.
    stem
        Path of the metering frames without their number.
    start
        First guess, e.g. the neighbouring depth's exposure.
    base_iso
        ISO preferred; higher ones are used only where the longest time isn't enough.
    max_shots
        Give up after so many frames.

    Raises
    ------
    CaptureError
        No exposure within ``max_shots`` frames avoids saturation: the dot is too bright for this lens.
    """
    times = camera.exposure_times_s()
    isos = tuple(iso for iso in camera.isos() if base_iso <= iso <= HIGHEST_ISO) or (base_iso,)
    exposure = start or Exposure(min(times, key=lambda t: abs(t - FIRST_TIME_S)), isos[0])
    for number in range(1, max_shots + 1):
        metered = meter_image(expose(exposure, stem.with_name(f"{stem.name}-{number}.dng")))
        choice = choose_exposure(metered, time_s=exposure.time_s, iso=exposure.iso, times_s=times, isos=isos)
        stuck = (choice.time_s, choice.iso) == (exposure.time_s, exposure.iso)
        if choice.done or (stuck and not metered.saturated):
            return MeteredExposure(exposure, metered.peak, number, choice.limited and not choice.done)
        if stuck:
            break
        exposure = Exposure(choice.time_s, choice.iso)
    raise CaptureError(
        f"camera: the point is still saturated at {exposure_text(exposure.time_s)}, ISO {exposure.iso}; "
        "dim the panel or make the dot smaller (panel.dot in rig.yaml)"
    )
