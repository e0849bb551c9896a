"""Exposure of the point source, chosen from the image: bright, and nowhere saturated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calibration.exposure import next_exposure
from calibration.raw import develop
from rigs.errors import CaptureError
from rigs.protocols import Camera, CaptureResult, Exposure
from workbench.units import exposure_text
