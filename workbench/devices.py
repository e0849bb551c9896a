"""From rig.yaml to devices: the one place that knows which driver belongs to which ``kind``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

from rigs.browser_panel import BrowserPanel, BrowserPanelSettings
from rigs.errors import RigError
from rigs.grbl_stage import GrblSettings, GrblStage
from rigs.manual_stage import ManualSettings, ManualStage
from rigs.protocols import Camera, Panel, Stage
from rigs.rig import DepthAxis, Rig
from rigs.simulated.devices import SimulatedCamera, SimulatedPanel, SimulatedStage
from rigs.simulated.followers import FollowedPanel, FollowedStage
from rigs.simulated.panel_view import PanelSurface
from rigs.simulated.scene import SceneTruth, scene_truth
from rigs.simulated.scenes import scene_by_name
from rigs.simulated.world import SimulatedRigSettings, SimulatedWorld
from rigs.zaber_stage import ZaberSettings, ZaberStage
from workbench.config import PanelConfig, RigConfig, StageConfig
from workbench.units import cm

Tell = Callable[[str], None]

MANUAL_LIMITS_MM = (0.0, 3000.0)
"""Where a panel that is moved by hand may stand, unless rig.yaml says otherwise."""
_PAGE_PATIENCE_S = 300.0
"""How long the operator has to open the panel's page."""


def simulated_world(config: RigConfig) -> SimulatedWorld:
    """The world that the simulated devices of this rig share."""
    truth, depth = config.simulation, config.stage.depth
    return SimulatedWorld(
        SimulatedRigSettings(
            preset=truth.preset,
            seed=truth.seed,
            focal_length_mm=config.optics.focal_length_mm,
            focus_mm=truth.focus_mm,
            vignetting=truth.vignetting,
            coma=truth.coma,
            focus_breathing=truth.focus_breathing,
            stage_offset_mm=depth.offset_mm,
            stage_sign=depth.sign,
            stage_scale=depth.scale,
            stage_zero_mm=truth.stage_zero_mm,
            stage_repeatability_mm=truth.stage_repeatability_mm,
            surface=PanelSurface(pitch_mm=config.panel.pixel_pitch_mm),
            ambient=truth.ambient,
            scene=truth.scene,
        )
    )


@dataclass
class _Opening:
    """Devices opened so far, so that a failure half way closes them."""

    config: RigConfig
    tell: Tell
    opened: list[Camera | Stage | Panel] = field(default_factory=list)
    _world: SimulatedWorld | None = None

    @property
    def world(self) -> SimulatedWorld:
        """One world for all simulated devices."""
        if self._world is None:
            self._world = simulated_world(self.config)
        return self._world


def open_scene_camera(config: RigConfig, *, tell: Tell) -> tuple[Camera, SceneTruth]:
    """Open the camera alone, looking at the scene, with the scene's truth.

    Raises
    ------
    RigError
        The camera is missing, busy or wrong; or there is no scene of the configured name.
    """
    opening = _Opening(config, tell)
    world = opening.world
    scene = scene_by_name(config.simulation.scene, config.simulation.seed)
    world.subject = scene
    return open_camera(opening), scene_truth(scene, world.sensor.shape)


def open_rig(config: RigConfig, *, tell: Tell) -> Rig:
    """Open the devices that rig.yaml names.

    Parameters
    ----------
    config
        The rig.
    tell
        Shows the operator a line (the panel's address, a request to move a manual stage).

    Raises
    ------
    RigError
        A device is missing, busy or wrong; whatever was opened before is closed again.
    """
    opening = _Opening(config, tell)
    try:
        camera = open_camera(opening)
        opening.opened.append(camera)
        stage = open_stage(opening)
        opening.opened.append(stage)
        panel = open_panel(opening)
    except BaseException:
        for device in reversed(opening.opened):
            with suppress(RigError):
                device.close()
        raise
    depth = config.stage.depth
    return Rig(camera, stage, panel, DepthAxis(depth.offset_mm, depth.sign, depth.scale))


def open_camera(opening: _Opening) -> Camera:
    """The camera of rig.yaml."""
    return SimulatedCamera(opening.world)


def open_stage(opening: _Opening) -> Stage:
    """The stage of rig.yaml; the simulated camera sees where a real one has moved the panel."""
    config = opening.config.stage
    match config.kind:
        case "simulated":
            return SimulatedStage(opening.world)
        case "manual":
            stage: Stage = _manual_stage(config)
        case "grbl":
            stage = GrblStage(grbl_settings(config))
        case "zaber":
            stage = ZaberStage(zaber_settings(config))
    return FollowedStage(stage, opening.world)


def _manual_stage(config: StageConfig) -> ManualStage:
    axis = DepthAxis(config.depth.offset_mm, config.depth.sign, config.depth.scale)
    limits = config.limits_mm or MANUAL_LIMITS_MM
    settings = ManualSettings(limits, lambda position: cm(axis.depth_mm(position)))
    return ManualStage(settings, _ask_operator)


def grbl_settings(config: StageConfig) -> GrblSettings:
    """What rig.yaml says of a GRBL stage."""
    return GrblSettings(
        port=config.port,
        baud_rate=config.baud_rate,
        axis=config.axis if isinstance(config.axis, str) else "X",
        speed_mm_s=config.speed_mm_s,
        limits_mm=config.limits_mm,
        allow_without_homing=config.allow_without_homing,
        allow_without_soft_limits=config.allow_without_soft_limits,
    )


def zaber_settings(config: StageConfig) -> ZaberSettings:
    """What rig.yaml says of a Zaber stage."""
    return ZaberSettings(
        port=config.port,
        microstep_mm=config.microstep_mm or 0.0,
        baud_rate=config.baud_rate,
        device=config.device,
        axis=config.axis if isinstance(config.axis, int) else 1,
        speed_mm_s=config.speed_mm_s,
        limits_mm=config.limits_mm,
    )


def _ask_operator(question: str) -> str:
    print(question, end="", file=sys.stderr, flush=True)
    answer = sys.stdin.readline()
    if not answer:
        raise EOFError
    return answer.rstrip("\n")


def browser_panel_settings(config: PanelConfig) -> BrowserPanelSettings:
    """What rig.yaml says of a panel in a browser."""
    return BrowserPanelSettings(
        host=config.host,
        port=config.port,
        token=config.token,
        ack_timeout_s=config.ack_timeout_s,
        require_fullscreen=config.require_fullscreen,
    )


def open_panel(opening: _Opening) -> Panel:
    """The panel of rig.yaml; one in a browser is waited for until a page is connected and ready."""
    config = opening.config.panel
    if config.kind == "browser":
        panel = BrowserPanel(browser_panel_settings(config))
        opening.tell(panel.invitation())
        try:
            panel.wait_ready(_PAGE_PATIENCE_S)
        except BaseException:
            panel.close()
            raise
        return FollowedPanel(panel, opening.world)
    return SimulatedPanel(opening.world)
