"""Real stage or panel beside a simulated camera: the simulated world follows what the real device does."""

from __future__ import annotations

from rigs.protocols import DeviceIdentity, Panel, PanelAck, Pattern, Stage
from rigs.simulated.world import SimulatedWorld


class FollowedStage:
    """A stage whose confirmed positions the simulated world takes over."""

    def __init__(self, stage: Stage, world: SimulatedWorld) -> None:
        self._stage, self._world = stage, world

    def identify(self) -> DeviceIdentity:
        """The real stage's."""
        return self._stage.identify()

    def homed(self) -> bool:
        """The real stage's."""
        return self._stage.homed()

    def home(self) -> None:
        """Home the real stage."""
        self._stage.home()

    def position_mm(self) -> float:
        """The real stage's."""
        return self._stage.position_mm()

    def limits_mm(self) -> tuple[float, float]:
        """The real stage's."""
        return self._stage.limits_mm()

    def move_to_mm(self, position_mm: float) -> float:
        """Move the real stage, and the simulated panel with it."""
        confirmed = self._stage.move_to_mm(position_mm)
        self._world.carry_to(confirmed)
        return confirmed

    def travel_time_s(self, distance_mm: float) -> float:
        """The real stage's."""
        return self._stage.travel_time_s(distance_mm)

    def stop(self) -> None:
        """Stop the real stage."""
        self._stage.stop()

    def close(self) -> None:
        """Close the real stage."""
        self._stage.close()


class FollowedPanel:
    """A panel whose acknowledged patterns the simulated camera sees."""

    def __init__(self, panel: Panel, world: SimulatedWorld) -> None:
        self._panel, self._world = panel, world

    def identify(self) -> DeviceIdentity:
        """The real panel's."""
        return self._panel.identify()

    def show(self, pattern: Pattern) -> PanelAck:
        """Show on the real panel; once acknowledged, the simulated one shows it too."""
        acknowledged = self._panel.show(pattern)
        self._world.pattern = pattern
        return acknowledged

    def check_shown(self) -> None:
        """The real panel's."""
        self._panel.check_shown()

    def close(self) -> None:
        """Close the real panel."""
        self._panel.close()
