"""From rig.yaml to devices: the one place that knows which driver belongs to which ``kind``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from rigs.browser_panel import BrowserPanel, BrowserPanelSettings
from rigs.gphoto2_camera import Gphoto2Camera
from rigs.gphoto2_config import CameraEvent, Gphoto2Settings
from rigs.grbl_stage import GrblSettings, GrblStage
from rigs.manual_stage import ManualSettings, ManualStage
from rigs.protocols import Camera, Panel, Stage
from rigs.rig import Rig, close_quietly
from rigs.simulated.devices import SimulatedCamera, SimulatedPanel, SimulatedStage
from rigs.simulated.followers import FollowedPanel, FollowedStage
from rigs.simulated.panel_view import PanelSurface
from rigs.simulated.scene import SceneTruth, scene_truth
from rigs.simulated.scenes import scene_by_name
from rigs.simulated.world import SimulatedRigSettings, SimulatedWorld
from rigs.zaber_stage import ZaberSettings, ZaberStage
from workbench.config import CameraConfig, PanelConfig, RigConfig, StageConfig
from workbench.device_news import DeviceNews
from workbench.errors import InputError
from workbench.frame_reader import FrameReader
from workbench.units import cm, length_mm

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
class Opening:
    """Devices of one rig on their way to being opened, one by one.

    Attributes
    ----------
    config
        The rig.
    tell
        Shows the operator a line (the panel's address, a request to move a manual stage).
    frames
        Checks what a real camera delivers; None: a reader of its own.
    news
        Hears what a real camera reports; None: only the operator does.
    """

    config: RigConfig
    tell: Tell
    frames: FrameReader | None = None
    news: DeviceNews | None = None
    _world: SimulatedWorld | None = None

    @property
    def world(self) -> SimulatedWorld:
        """One world for all simulated devices."""
        if self._world is None:
            self._world = simulated_world(self.config)
        return self._world

    @property
    def camera_is_simulated(self) -> bool:
        """Whether the camera has to be told what real devices do, since it can't see them."""
        return self.config.camera.kind == "simulated"


def open_scene_camera(config: RigConfig, *, tell: Tell, frames: FrameReader | None = None) -> Camera:
    """Open the camera alone; a simulated one looks at the scene that rig.yaml names.

    Raises
    ------
    RigError
        The camera is missing, busy or wrong; or there is no scene of the configured name.
    """
    opening = Opening(config, tell, frames)
    if opening.camera_is_simulated:
        opening.world.subject = scene_by_name(config.simulation.scene, config.simulation.seed)
    return open_camera(opening)


def simulated_scene_truth(config: RigConfig) -> SceneTruth:
    """What a measurement of the simulated camera's scene should find.

    Raises
    ------
    RigError
        There is no scene of the configured name.
    """
    scene = scene_by_name(config.simulation.scene, config.simulation.seed)
    return scene_truth(scene, simulated_world(config).sensor.shape)


@contextmanager
def open_camera_and_panel(
    config: RigConfig, *, tell: Tell, frames: FrameReader, news: DeviceNews
) -> Iterator[tuple[Camera, Panel]]:
    """Open what is needed to look at the panel where it stands; both are closed in the end.

    Raises
    ------
    RigError
        A device is missing, busy or wrong.
    """
    opening = Opening(config, tell, frames, news)
    with ExitStack() as opened:
        camera = open_camera(opening)
        opened.callback(close_quietly, camera)
        panel = open_panel(opening)
        opened.callback(close_quietly, panel)
        yield camera, panel


def open_rig(
    config: RigConfig, *, tell: Tell, frames: FrameReader | None = None, news: DeviceNews | None = None
) -> Rig:
    """Open the devices that rig.yaml names.

    Parameters
    ----------
    config, tell, frames, news
        See :class:`Opening`.

    Raises
    ------
    RigError
        A device is missing, busy or wrong; whatever was opened before is closed again.
    """
    opening = Opening(config, tell, frames, news)
    opened: list[Camera | Stage] = []
    try:
        camera = open_camera(opening)
        opened.append(camera)
        stage = open_stage(opening)
        opened.append(stage)
        panel = open_panel(opening)
    except BaseException:
        for device in reversed(opened):
            close_quietly(device)
        raise
    return Rig(camera, stage, panel, config.stage.depth.axis)


def open_camera(opening: Opening) -> Camera:
    """The camera of rig.yaml; what a real one delivers is looked at before it gets its name."""
    config = opening.config.camera
    if config.kind == "gphoto2":
        frames = opening.frames or FrameReader(config.pixel_pitch_mm)
        news = opening.news or DeviceNews(opening.tell)
        return Gphoto2Camera(gphoto2_settings(config), validate=frames.check, on_event=news)
    return SimulatedCamera(opening.world)


def gphoto2_settings(config: CameraConfig) -> Gphoto2Settings:
    """What rig.yaml says of a camera on USB."""
    return Gphoto2Settings(
        model=config.model,
        serial=config.serial,
        port=config.port,
        image_format=config.image_format,
        capture_target=config.capture_target,
        keep_on_card=config.keep_on_card,
        aperture=config.aperture,
        release=config.release,
        may_be_absent=config.may_be_absent,
        restart_every=config.restart_every,
        call_timeout_s=config.call_timeout_s,
        arrive_timeout_s=config.arrive_timeout_s,
        download_timeout_s=config.download_timeout_s,
        return_timeout_s=config.return_timeout_s,
        power_cycle_timeout_s=config.power_cycle_timeout_s,
    )


def open_stage(opening: Opening) -> Stage:
    """The stage of rig.yaml; a simulated camera sees where a real one has moved the panel."""
    config = opening.config.stage
    match config.kind:
        case "simulated":
            return SimulatedStage(opening.world, config.limits_mm)
        case "manual":
            stage: Stage = _manual_stage(config)
        case "grbl":
            stage = GrblStage(grbl_settings(config))
        case "zaber":
            stage = ZaberStage(zaber_settings(config))
    return FollowedStage(stage, opening.world) if opening.camera_is_simulated else stage


def _manual_stage(config: StageConfig) -> ManualStage:
    axis = config.depth.axis
    limits = config.limits_mm or MANUAL_LIMITS_MM

    def read(text: str) -> float:
        try:
            return axis.position_mm(length_mm(text, default_unit="cm"))
        except InputError as error:
            raise ValueError(str(error)) from None

    return ManualStage(ManualSettings(limits, lambda position: cm(axis.depth_mm(position)), read), _ask_operator)


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
        print(file=sys.stderr)  # what is said next begins a line of its own
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


def open_panel(opening: Opening) -> Panel:
    """The panel of rig.yaml; one in a browser is waited for until a page is connected and ready."""
    config = opening.config.panel
    if config.kind == "simulated":
        return SimulatedPanel(opening.world)
    news = opening.news or DeviceNews(opening.tell)
    panel = BrowserPanel(browser_panel_settings(config), on_notice=lambda text: news(CameraEvent(text)))
    opening.tell(panel.invitation())
    try:
        panel.wait_ready(_PAGE_PATIENCE_S)
    except BaseException:
        panel.close()
        raise
    return FollowedPanel(panel, opening.world) if opening.camera_is_simulated else panel
