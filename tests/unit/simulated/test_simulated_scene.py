import math

import numpy as np
import pytest
from matplotlib.path import Path as Outline

from rigs.errors import ConfigError
from rigs.simulated.blur import blur_through
from rigs.simulated.lens import Lens, PolygonPupil, point_image
from rigs.simulated.perspective import in_perspective
from rigs.simulated.rig import render_scene_frame
from rigs.simulated.scene import Scene, SceneObject, scene_light, scene_truth
from rigs.simulated.scenes import four_objects, plane_scene, rectangle, scene_by_name
from rigs.simulated.textures import TEXTURES, texture
from rigs.simulated.world import SimulatedRigSettings

PITCH_MM = 0.0043
WHITE = (1.0, 1.0, 1.0)
BLACK = (0.0, 0.0, 0.0)


def _plain(name: str, outline: tuple[tuple[float, float], ...], depth_mm: float, level: float) -> SceneObject:
    grey = (level, level, level)
    return SceneObject(name, "blank", outline, (depth_mm,) * 3, dark=grey, light=grey)


BACKDROP = rectangle(-5.0, -5.0, 6.0, 6.0)
RIGHT_HALF = rectangle(0.5, -5.0, 6.0, 6.0)


@pytest.mark.parametrize("name", sorted(TEXTURES))
def test_textures_fit_any_size_and_follow_from_the_seed(name: str) -> None:
    for shape in ((61, 130), (200, 97)):
        image = texture(name, shape, 5)
        assert image.shape == shape
        assert image.dtype == np.float32
        assert image.min() >= 0
        assert image.max() <= 1
        np.testing.assert_array_equal(image, texture(name, shape, 5))
    contrast = float(texture(name, (200, 300), 5).astype(np.float64).std())
    assert contrast < 1e-12 if name == "blank" else 0 < contrast < 0.03 if name == "faint" else contrast > 0.05
    assert not np.array_equal(texture(name, (200, 300), 5), texture(name, (200, 300), 6))


def test_an_unknown_texture_names_those_that_there_are() -> None:
    with pytest.raises(ValueError, match="gravel"):
        texture("gravle", (10, 10))


def test_a_plane_is_its_texture_convolved_with_the_point_image() -> None:
    lens, shape = Lens(), (96, 128)
    light = scene_light(plane_scene("leaves", 2600.0, seed=2, dark=BLACK, light=WHITE), lens, shape, PITCH_MM)
    kernel = point_image(lens, 2600.0, PITCH_MM)
    reach = kernel.shape[0] // 2
    drawn = 128  # pixels around the frame for which textures are drawn, whatever the aperture
    sharp = texture("leaves", (96 + 2 * drawn, 128 + 2 * drawn), 2)[drawn - reach :, drawn - reach :]
    direct = np.zeros(shape)
    for y in range(-reach, reach + 1):
        for x in range(-reach, reach + 1):
            direct += kernel[reach + y, reach + x] * sharp[reach - y : reach - y + 96, reach - x : reach - x + 128]
    np.testing.assert_allclose(light, direct, atol=1e-5)


def test_an_object_looks_the_same_through_another_aperture() -> None:
    small = Lens(pupil=PolygonPupil((((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)),)))
    scene = plane_scene("leaves", 1600.0, seed=2, dark=BLACK, light=WHITE)  # in focus: both see it sharp
    seen = [scene_light(scene, lens, (96, 128), PITCH_MM) for lens in (Lens(), small)]
    similarity = np.corrcoef(*(light.ravel() for light in seen))[0, 1]
    assert similarity > 0.9


@pytest.mark.parametrize("depth_mm", [700.0, 1600.0, 3000.0])
def test_at_an_occluding_edge_the_blend_is_monotonic_and_as_wide_as_the_blur(depth_mm: float) -> None:
    scene = Scene("edge", (_plain("back", BACKDROP, 3500.0, 0.0), _plain("front", RIGHT_HALF, depth_mm, 1.0)))
    lens = Lens()
    row = scene_light(scene, lens, (64, 512), PITCH_MM)[32]
    assert (np.diff(row) >= -2e-6).all()
    assert row[0] == pytest.approx(0.0, abs=1e-5)
    assert row[-1] == pytest.approx(1.0, abs=1e-5)
    kernel = point_image(lens, depth_mm, PITCH_MM).sum(axis=0)
    half = kernel.size // 2
    np.testing.assert_allclose(row[256 - half : 256 + half + 1], np.cumsum(kernel), atol=2e-5)


def test_background_past_the_edge_of_a_near_object_is_seen_through_part_of_the_pupil() -> None:
    """Against brute force: every point of the pupil sees a sharp scene with the near object shifted by its parallax."""
    lens = Lens(aberration_um=0.0, wavelength_um=0.0)
    near_mm, far_mm, shape = 900.0, 3000.0, (40, 256)
    scene = Scene("edge", (_plain("back", BACKDROP, far_mm, 0.3), _plain("front", RIGHT_HALF, near_mm, 0.8)))
    row = scene_light(scene, lens, shape, PITCH_MM)[20]
    grid = (np.arange(400) + 0.5) / 400 * 14 - 7
    x, y = np.meshgrid(grid, grid)

    inside = Outline(lens.pupil.loops_mm[0]).contains_points(np.stack([x.ravel(), y.ravel()], 1)).reshape(x.shape)
    shift = lens.cone_section(near_mm) * x[inside] / PITCH_MM
    centres = np.arange(256) + 0.5
    seen = np.array([np.where(c - shift > 128, 0.8, 0.3).mean() for c in centres])
    np.testing.assert_allclose(row, seen, atol=6e-3)


def test_three_layers_hide_each_other_in_order_of_depth_not_of_listing() -> None:
    middle = _plain("middle", rectangle(0.2, -5.0, 0.8, 6.0), 2000.0, 0.5)
    front = _plain("front", RIGHT_HALF, 1600.0, 1.0)
    back = _plain("back", BACKDROP, 3000.0, 0.1)
    lights = [
        scene_light(Scene("s", objects), Lens(), (32, 256), PITCH_MM)
        for objects in ((back, middle, front), (front, back, middle))
    ]
    np.testing.assert_array_equal(lights[0], lights[1])
    assert lights[0][16, [10, 90, 200]] == pytest.approx([0.1, 0.5, 1.0], abs=1e-3)


def test_no_background_shines_through_the_seams_of_a_slanted_object() -> None:
    depths = (600.0, 3500.0, 600.0)
    slanted = SceneObject("slant", "blank", rectangle(-0.5, -5.0, 1.5, 6.0), depths, dark=(0.5,) * 3, light=(0.5,) * 3)
    behind = _plain("back", BACKDROP, 9000.0, 0.0)
    light = scene_light(Scene("s", (behind, slanted)), Lens(), (64, 200), PITCH_MM)
    np.testing.assert_allclose(light, 0.5, atol=1e-3)


def test_a_slanted_plane_is_sharp_where_it_crosses_the_focus() -> None:
    scene = plane_scene("noise", 900.0, depth_right_mm=6000.0, seed=1)
    light = scene_light(scene, Lens(), (96, 512), PITCH_MM)
    detail = np.abs(np.diff(light, axis=1)).reshape(96, -1)[:, :504].reshape(96, 9, 56).mean(axis=(0, 2))
    truth = scene_truth(scene, (96, 512)).depth_mm[24]
    focus_at = int(np.argmin(np.abs(truth - 1600.0))) * 2 // 56
    assert abs(int(np.argmax(detail)) - focus_at) <= 1
    assert detail.max() > 3 * detail[0]


def test_a_grazing_view_shortens_a_texture_and_leaves_its_width_sharp() -> None:
    fine = (np.random.default_rng(1).random((256, 256)) > 0.5).astype(np.float32)

    def lying(rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shape = np.broadcast_shapes(rows.shape, columns.shape)
        return np.broadcast_to(columns, shape).astype(np.float32), np.broadcast_to(6.0 * rows, shape).astype(np.float32)

    seen = in_perspective(fine, (40, 200), lying)
    expected = fine[:240, :200].reshape(40, 6, 200).mean(axis=1)
    assert np.abs(seen - expected).mean() < 0.3 * expected.std()
    assert seen.std() > 0.7 * expected.std()  # linear interpolation takes a little


def test_truth_gives_the_nearest_object_and_perspective_depth() -> None:
    scene = four_objects()
    truth = scene_truth(scene, (400, 600))
    assert truth.depth_mm.shape == truth.object_id.shape == (200, 300)
    assert truth.names == ("wall", "table", "poster", "box", "book", "cushion")
    for name, depth_mm in (("wall", 3500), ("poster", 3200), ("box", 2500), ("book", 1600), ("cushion", 1000)):
        found = truth.depth_mm[truth.object_id == truth.names.index(name) + 1]
        assert found.size > 500
        assert found == pytest.approx(depth_mm, rel=1e-5)
    column = truth.object_id[:, 297] == 2
    inverse = 1 / truth.depth_mm[column, 297].astype(np.float64)
    assert inverse.size > 60
    assert np.abs(np.diff(inverse, n=2)).max() < 1e-3 * np.diff(inverse).mean()


def test_objects_stand_where_the_table_has_their_depth() -> None:
    truth = scene_truth(four_objects(), (800, 1200))
    for name, depth_mm in (("book", 1600.0), ("cushion", 1000.0)):
        number = truth.names.index(name) + 1
        rows, columns = np.nonzero(truth.object_id == number)
        foot = int(rows.max())
        below = truth.depth_mm[foot + 1, int(np.median(columns))]
        assert below == pytest.approx(depth_mm, rel=0.02)


def test_the_same_scene_fits_every_frame_size() -> None:
    small, large = (scene_truth(four_objects(), shape) for shape in ((200, 300), (400, 600)))
    agree = small.object_id == large.object_id[::2, ::2]
    assert agree.mean() > 0.97


def test_vignetting_darkens_the_corners_and_keeps_coverage_whole() -> None:
    settings = SimulatedRigSettings(vignetting=0.8)
    flat = Scene("flat", (_plain("wall", BACKDROP, 2000.0, 0.5),))
    light = scene_light(flat, settings.lens(), (400, 3000), 0.0086)
    assert light[200, 1500] == pytest.approx(0.5, rel=2e-3)
    assert light[200, 20] < 0.45
    assert light[200, 2980] < 0.45


def test_a_frame_of_a_scene_is_exposed_by_itself_and_repeatable() -> None:
    first, second = (render_scene_frame("plane:gravel:200cm", frame_shape=(96, 128), shot=3) for _ in range(2))
    np.testing.assert_array_equal(first.mosaic, second.mosaic)
    assert 6000 < np.percentile(first.mosaic, 99.9) < 15000
    assert (first.truth.depth_mm == 2000).all()
    other = render_scene_frame("plane:gravel:200cm", frame_shape=(96, 128), shot=4)
    assert not np.array_equal(first.mosaic, other.mosaic)


@pytest.mark.parametrize(
    ("name", "word"), [("kitchen", "four-objects"), ("plane:gravle:2cm", "gravel"), ("plane:gravel:3cm", "20cm")]
)
def test_an_unknown_scene_is_refused_with_the_way_out(name: str, word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        scene_by_name(name)


def test_wide_pupils_of_a_pair_see_the_same_scene_differently() -> None:
    half = math.pi / 16
    arcs = [tuple((7 * math.cos(a), s * 7 * math.sin(a)) for a in np.arange(0, 17) * half) for s in (1, -1)]

    images = [
        scene_light(plane_scene("text", 3000.0), Lens(pupil=PolygonPupil((arc,))), (64, 64), PITCH_MM) for arc in arcs
    ]
    assert np.abs(images[0] - images[1]).max() > 0.02


def test_a_field_dependent_lens_keeps_light_and_blurs_each_place_its_own_way() -> None:
    lens, shape = Lens(coma_um=20.0), (64, 1600)
    dots = np.zeros(shape, np.float32)
    for column in (100, 800, 1500):
        dots[32, column] = 1.0
    (image,) = blur_through(lens, 1600.0, PITCH_MM, [dots], (0, 0), shape)
    assert image.sum() == pytest.approx(3.0, rel=1e-4)
    columns = np.arange(1600)
    for column in (100, 800, 1500):
        part = image[:, column - 60 : column + 61]
        drift = float((part.sum(axis=0) * columns[column - 60 : column + 61]).sum() / part.sum()) - column
        kernel = point_image(lens, 1600.0, PITCH_MM, field_mm=((column + 0.5 - 800) * PITCH_MM, 0.0)).sum(axis=0)
        half = kernel.size // 2
        assert drift == pytest.approx(float((kernel * np.arange(-half, half + 1)).sum()), abs=0.1)
    assert drift > 0.3
