"""The dark room around libgphoto2's virtual camera: what its next frame shows is rendered when its shutter opens.

A capture of that camera copies the first JPEG of its card, whatever that file holds. Here it is a RAW frame of the
simulated world, for the exposure time that the camera is set to and for where panel and carriage are just then.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rigs.gphoto2_shot import CameraFile, Shooter
from rigs.protocols import Pattern
from rigs.simulated.devices import frame_tags
from rigs.simulated.dng import encode_dng
from rigs.simulated.sensor import expose
from rigs.simulated.world import SimulatedWorld

ISO = 100
"""The virtual camera has no setting for it."""
BRIGHTER = 5.0
"""The panel's light, relative to the simulated rig's: the virtual camera's longest exposure is 1 s."""


class DarkRoom:
    """A world with the virtual camera in it.

    Parameters
    ----------
    card
        Directory of the virtual camera's files.
    world
        What the camera sees.
    """

    def __init__(self, card: Path, world: SimulatedWorld) -> None:
        self._card, self._world = card, world
        self.position_mm: Callable[[], float] | None = None
        """Where the carriage is, if a real stage moves it."""
        self.pattern: Callable[[], Pattern] | None = None
        """What the panel shows, if it is a real one."""
        self.frames = 0
        self.spoil: Callable[[int, bytes], bytes] = lambda _, data: data
        """Changes what the n-th frame holds."""
        self.hand_over(0.01)  # the camera looks at its card when it is opened

    def hand_over(self, time_s: float) -> None:
        """Expose the next frame."""
        if self.position_mm is not None and (now := round(self.position_mm(), 3)) != self._world.commanded_mm:
            self._world.carry_to(now)
        if self.pattern is not None:
            self._world.pattern = self.pattern()
        light = self._world.light() * BRIGHTER
        mosaic = expose(light, self._world.sensor, time_s=time_s, iso=ISO, shot=self.frames)
        data = encode_dng(mosaic, frame_tags(self._world, time_s, ISO), compression="none")
        self._card.mkdir(parents=True, exist_ok=True)
        (self._card / "a.jpg").write_bytes(self.spoil(self.frames, data))
        self.frames += 1

    def look_through_every_shutter(self, patch: pytest.MonkeyPatch) -> None:
        """Have each release of a camera in this process photograph this room."""
        release = Shooter.expose

        def expose_here(shooter: Shooter, exposure_s: float) -> CameraFile:
            self.hand_over(exposure_s)
            return release(shooter, exposure_s)

        patch.setattr(Shooter, "expose", expose_here)
