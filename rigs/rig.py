"""A rig: one camera, one stage, one panel, and the axis that maps stage coordinates to nominal depth."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from dataclasses import dataclass
from types import TracebackType

from rigs.errors import LimitError, RigError
from rigs.protocols import Camera, Panel, Pattern, Stage


@dataclass(frozen=True, slots=True)
class DepthAxis:
    """depth = offset + sign * scale * position; depth and position in mm.

    The offset is what the operator measured with a tape; its error is found by the lens fit (stage zero).
    """

    offset_mm: float = 0.0
    sign: int = 1
    scale: float = 1.0

    def depth_mm(self, position_mm: float) -> float:
        """Nominal depth of a stage position."""
        return self.offset_mm + self.sign * self.scale * position_mm

    def position_mm(self, depth_mm: float) -> float:
        """Stage position of a nominal depth."""
        return (depth_mm - self.offset_mm) / (self.sign * self.scale)

    def depth_limits_mm(self, limits_mm: tuple[float, float]) -> tuple[float, float]:
        """Nearest and farthest nominal depth that the stage's limits allow."""
        a, b = (self.depth_mm(limit) for limit in limits_mm)
        return min(a, b), max(a, b)


def close_quietly(device: Camera | Stage | Panel) -> None:
    """Close a device whose last words nobody needs."""
    with suppress(RigError):
        device.close()


@dataclass(frozen=True, slots=True)
class Rig:
    """The devices of one session. Closing stops the stage first, and closes what can be closed."""

    camera: Camera
    stage: Stage
    panel: Panel
    axis: DepthAxis

    def check_reach(self, depths_mm: tuple[float, ...]) -> None:
        """Check a whole plan against the stage's travel before anything moves.

        Raises
        ------
        LimitError
            Names the first depth out of reach and the reachable range.
        """
        nearest, farthest = self.axis.depth_limits_mm(self.stage.limits_mm())
        for depth in depths_mm:
            if not nearest - 1e-6 <= depth <= farthest + 1e-6:
                raise LimitError(
                    f"stage: depth {depth / 10:g} cm is out of reach ({nearest / 10:g} to {farthest / 10:g} cm): "
                    "shorten the plan with --from and --to, or correct stage.depth in rig.yaml"
                )

    def check_panel(self, pattern: Pattern) -> None:
        """Show a pattern, to see before anything moves that the panel can, and go dark again.

        Raises
        ------
        PanelError
            It can't.
        """
        self.panel.show(pattern)
        self.panel.show(Pattern("black"))

    def close(self) -> None:
        """Close all three devices, whatever state they are in, and whatever interrupts it."""
        with ExitStack() as closing:
            for device in (self.camera, self.panel, self.stage):  # from the last to the first
                closing.callback(close_quietly, device)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if error is not None:
            with suppress(RigError):
                self.stage.stop()
        self.close()
