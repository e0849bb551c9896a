"""What an accuracy run looks at: textures, depths, light and regions, photographed by the simulated rig.

One frame shows one textured plane. Regions of every size lie in it side by side, disjoint, so that one rendering serves
them all; the same light is exposed at each light level. Everything random follows from the run's seed.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigs.protocols import Exposure
from rigs.simulated.devices import EXPOSURE_TIMES_S
from rigs.simulated.rig import SceneFrame, auto_exposure
from rigs.simulated.scene import scene_light, scene_truth
from rigs.simulated.scenes import plane_scene
from rigs.simulated.sensor import expose
from rigs.simulated.world import SimulatedRigSettings, SimulatedWorld

Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]

TEXTURES = ("chart", "text", "leaves", "noise", "gravel", "grass", "brick", "weave", "faint", "letters")
"""Classes that have a depth; ``blank`` has none, and only shows whether a method says so."""
BLANK = "blank"
LIGHTS = {"normal": 1.0, "dim": 8.0, "dimmer": 32.0}
"""Light levels: the metered exposure time is divided by so much."""
SIZES = ("64", "128", "256", "irregular")
"""Sides of square regions in developed pixels; ``irregular`` is a bay-and-holes shape of the area of 128 x 128."""

_GAP, _BORDER = 8, 8
_IRREGULAR_SIDE, _IRREGULAR_AREA = 184, 128 * 128


@dataclass(frozen=True, slots=True)
class Case:
    """One textured plane."""

    texture: str
    true_mm: float
    on_grid: bool
    """Whether the panel stood at this very depth when the 10 cm bank was taken."""
    seed: int
    """Of texture, region shapes and noise."""


def depth_list(zero_mm: float, seed: int) -> list[tuple[float, bool]]:
    """All depths: 60 to 350 cm in steps of 10 cm, and one at random (uniform in 1/z) between each two.

    Parameters
    ----------
    zero_mm
        True minus nominal depth of the stage: planes of the grid are where the panel truly stood.
    seed
        Of the depths between.

    Returns
    -------
    list of (float, bool)
        Depth in mm and whether it is on the grid, ascending.
    """
    grid = [float(nominal) + zero_mm for nominal in range(600, 3501, 100)]
    generator = np.random.default_rng([seed, 0xDE])
    between = [1.0 / generator.uniform(1.0 / far, 1.0 / near) for near, far in pairwise(grid)]
    return sorted([(z, True) for z in grid] + [(z, False) for z in between])


def make_cases(
    textures: Sequence[str], depths: Sequence[tuple[float, bool]], per_texture: int, seed: int
) -> list[Case]:
    """Cases in an order in which any first part of them covers textures and depths evenly.

    Parameters
    ----------
    textures
        Names.
    depths
        All depths, see :func:`depth_list`.
    per_texture
        How many of the depths each texture gets: one, at random, of each of so many equal shares of the list. All of
        them where there are no more.
    seed
        Of the choice, and of the cases' own seeds.
    """
    count = min(per_texture, len(depths))
    generator = np.random.default_rng([seed, 0xCA])
    shares = np.array_split(np.arange(len(depths)), count)
    order = generator.permutation(count)
    cases = []
    for turn in range(count):
        for place, texture in enumerate(textures):
            share = shares[order[(turn + place) % count]]  # in each turn the textures stand at different depths
            true_mm, on_grid = depths[int(generator.choice(share))]
            cases.append(Case(texture, true_mm, on_grid, _case_seed(seed, texture, true_mm)))
    return cases


def _case_seed(seed: int, texture: str, true_mm: float) -> int:
    return zlib.crc32(f"{seed}/{texture}/{true_mm:.3f}".encode())


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the regions of one frame lie.

    Attributes
    ----------
    labels
        int32 (H, W), developed pixels: region k + 1 has size ``sizes[k]``.
    sizes
        Names of :data:`SIZES` or sides as text.
    """

    labels: Labels
    sizes: tuple[str, ...]

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Photosites (height, width) of a frame that holds them."""
        return 2 * self.labels.shape[0], 2 * self.labels.shape[1]


def lay_out(sizes: Sequence[str], seed: int) -> Layout:
    """Place regions in columns, largest first, with gaps between them; irregular shapes follow from the seed.

    The frame and every region's place in it are the same whichever sizes are wanted: so are the results.
    """
    masks = {
        size: irregular_mask(seed) if size == "irregular" else np.ones((int(size), int(size)), np.bool_)
        for size in SIZES
    }
    ordered = sorted(masks, key=lambda size: -masks[size].shape[0])
    tallest = masks[ordered[0]].shape[0]
    columns: list[tuple[int, int, int]] = []  # left, width, rows in use
    places: dict[str, tuple[int, int]] = {}
    for size in ordered:
        side = masks[size].shape[0]
        fitting = (i for i, (_, width, used) in enumerate(columns) if width >= side and used + side <= tallest)
        index = next(fitting, len(columns))
        if index == len(columns):
            columns.append((columns[-1][0] + columns[-1][1] + _GAP if columns else _BORDER, side, 0))
        left, width, used = columns[index]
        places[size] = (_BORDER + used, left)
        columns[index] = (left, width, used + side + _GAP)
    labels = np.zeros((tallest + 2 * _BORDER, columns[-1][0] + columns[-1][1] + _BORDER), np.int32)
    for number, size in enumerate(sizes, start=1):
        (top, left), mask = places[size], masks[size]
        labels[top : top + mask.shape[0], left : left + mask.shape[1]][mask] = number
    return Layout(labels, tuple(sizes))


def irregular_mask(seed: int) -> Mask:
    """A shape with bays and three holes, bool (184, 184), of about 128 x 128 pixels in all."""
    generator = np.random.default_rng([seed, 0x1E])
    half = _IRREGULAR_SIDE / 2
    y, x = np.mgrid[:_IRREGULAR_SIDE, :_IRREGULAR_SIDE] + 0.5 - half
    angle, radius = np.arctan2(y, x), np.hypot(y, x)
    outline = np.ones_like(angle)
    for order in (2, 3, 4, 5):
        outline += generator.uniform(0.05, 0.35 / order) * np.cos(order * angle + generator.uniform(0, 2 * np.pi))
    holes = np.zeros(angle.shape, np.bool_)
    for turn in generator.uniform(0, 2 * np.pi) + np.arange(3) * 2 * np.pi / 3:
        away, size = generator.uniform(0.3, 0.55) * half, generator.uniform(6.0, 14.0)
        holes |= np.hypot(y - away * np.sin(turn), x - away * np.cos(turn)) < size
    relative = np.where(holes, np.inf, radius / outline)
    # as wide as the area asks for, as far as the box allows
    threshold = float(np.sort(relative, axis=None)[_IRREGULAR_AREA])
    return np.asarray(relative < threshold)


def photograph(
    case: Case, settings: SimulatedRigSettings, frame_shape: tuple[int, int], lights: Sequence[str], directory: Path
) -> Iterator[tuple[str, Path, SceneFrame]]:
    """Render a case once, expose it at each light level and write the frames.

    Parameters
    ----------
    case
        What stands before the camera.
    settings
        Lens and sensor.
    frame_shape
        Photosites (height, width).
    lights
        Names of :data:`LIGHTS`.
    directory
        Where the DNG files go.

    Yields
    ------
    (str, Path, SceneFrame)
        Light level, file, and what made it.
    """
    world = SimulatedWorld(settings)
    world.resize(frame_shape)
    scene, sensor = plane_scene(case.texture, case.true_mm, seed=case.seed), world.sensor
    light = scene_light(
        scene, world.lens, sensor.shape, sensor.pitch_mm,
        response=sensor.response, illumination=settings.scene_illumination,
    )  # fmt: skip
    metered = auto_exposure(light, world)
    for number, name in enumerate(lights):
        wanted = metered.time_s / LIGHTS[name]
        time_s = min(EXPOSURE_TIMES_S, key=lambda offered: abs(np.log(offered / wanted)))
        exposure = Exposure(time_s, metered.iso)
        mosaic = expose(light, sensor, time_s=exposure.time_s, iso=exposure.iso, shot=case.seed + number)
        frame = SceneFrame(mosaic, exposure, scene_truth(scene, sensor.shape), world)
        path = directory / f"{case.texture}-{case.true_mm:.0f}mm-{case.seed:08x}-{name}.dng"
        frame.write(path)
        yield name, path, frame
