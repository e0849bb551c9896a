import numpy as np
import pytest
from drawings import as_image, blur, draw_bank, draw_chart
from numpy.typing import NDArray

from calibration.image import LinearImage
from workbench.depth.allfocus import all_focus, depth_map
from workbench.depth.estimate import DepthEstimate

DEPTHS_MM = [900.0, 1600.0, 2600.0]
BANK = draw_bank(DEPTHS_MM)


def estimate(depth_mm: float) -> DepthEstimate:
    nan = float("nan")
    curve = np.zeros(3)
    return DepthEstimate(depth_mm, (nan, nan), 0.5, nan, nan, "ok", BANK.depths_mm, curve, nan, 1)


def side_by_side() -> tuple[LinearImage, NDArray[np.int32], NDArray[np.float32]]:
    """A near bright half and a far dark half, each blurred on its own; labels and the sharp truth."""
    reach = BANK.psf.shape[-1] // 2
    scenes = [draw_chart(100 + 2 * reach, seed=0), draw_chart(100 + 2 * reach, seed=1) * np.float32(0.3)]
    plane = np.concatenate([blur(scenes[0], BANK.central[0]), blur(scenes[1], BANK.central[2])], axis=1)
    truth = np.concatenate([scene[reach:-reach, reach:-reach] for scene in scenes], axis=1)
    labels = np.repeat([[1, 2]], 100, axis=0).repeat(100, axis=1).astype(np.int32)
    return as_image(plane), labels, truth


def test_each_region_becomes_sharper_with_its_own_psf() -> None:
    image, labels, truth = side_by_side()
    result = all_focus(image, BANK, labels, {1: estimate(900.0), 2: estimate(2600.0)})[:, :, 1]
    swapped = all_focus(image, BANK, labels, {1: estimate(2600.0), 2: estimate(900.0)})[:, :, 1]
    for half in (np.s_[:, :100], np.s_[:, 100:]):
        blurred_error = np.abs(image.planes[half][:, :, 1] - truth[half]).mean()
        assert np.abs(result[half] - truth[half]).mean() < 0.75 * blurred_error
        assert np.abs(result[half] - truth[half]).mean() < 0.75 * np.abs(swapped[half] - truth[half]).mean()


def test_outside_of_all_regions_the_photograph_stays() -> None:
    image, labels, _ = side_by_side()
    part = np.where(np.arange(200) < 100, labels, 0).astype(np.int32)
    result = all_focus(image, BANK, part, {1: estimate(900.0)})
    np.testing.assert_allclose(result[:, 104:], image.planes[:, 104:], rtol=1e-5, atol=1e-6)
    whole = all_focus(image, BANK, labels, {1: estimate(900.0), 2: estimate(2600.0)})
    np.testing.assert_allclose(result[:, :96], whole[:, :96], rtol=1e-5, atol=1e-6)


def test_no_dark_seam_between_regions_or_at_the_frame() -> None:
    plane = np.full((80, 160), 0.5, np.float32)
    labels = np.ones((80, 160), np.int32)
    labels[:, 80:] = 2
    labels[30:50, 60:100] = 0
    result = all_focus(as_image(plane), BANK, labels, {1: estimate(900.0), 2: estimate(1600.0)})
    np.testing.assert_allclose(result, 0.5, rtol=0.02)


def test_saturated_pixels_in_focus_do_not_turn_black() -> None:
    image, labels, _ = side_by_side()
    saturated = np.zeros(image.shape, np.bool_)
    saturated[20:60, 20:60] = True
    planes = np.where(saturated[:, :, None], np.float32(1), image.planes)
    result = all_focus(as_image(planes, saturated), BANK, np.ones_like(labels), {1: estimate(1600.0)})
    assert result[25:55, 25:55].min() > 0.95


def test_colour_is_kept() -> None:
    planes = np.ones((60, 60, 3), np.float32) * np.array([0.6, 0.3, 0.1], np.float32)
    result = all_focus(as_image(planes), BANK, np.ones((60, 60), np.int32), {1: estimate(900.0)})
    np.testing.assert_allclose(result, planes, rtol=0.02)


def test_regions_without_depth_are_taken_for_the_farthest() -> None:
    image, labels, _ = side_by_side()
    known = all_focus(image, BANK, labels, {1: estimate(900.0), 2: estimate(2600.0)})
    no_texture = all_focus(image, BANK, labels, {1: estimate(900.0), 2: estimate(float("nan"))})
    np.testing.assert_array_equal(no_texture, known)


def test_depth_between_planes_takes_the_psf_nearest_in_inverse_depth() -> None:
    image, labels, _ = side_by_side()
    labels = np.ones_like(labels)
    # Midway between 1600 and 2600 mm in inverse depth lies 1981 mm, in depth 2100 mm.
    at_1600, at_2600 = (all_focus(image, BANK, labels, {1: estimate(z)}) for z in (1600.0, 2600.0))
    np.testing.assert_array_equal(all_focus(image, BANK, labels, {1: estimate(1970.0)}), at_1600)
    np.testing.assert_array_equal(all_focus(image, BANK, labels, {1: estimate(1990.0)}), at_2600)


def test_depth_map_knows_what_it_does_not_know() -> None:
    labels = np.array([[0, 1, 2, 5]], np.int32)
    result = depth_map(labels, {1: estimate(900.0), 2: estimate(float("nan"))})
    assert result.dtype == np.float32
    np.testing.assert_array_equal(result, [[np.nan, 900.0, np.nan, np.nan]])


def test_labels_of_another_size_are_refused() -> None:
    image, labels, _ = side_by_side()
    with pytest.raises(ValueError, match="labels are"):
        all_focus(image, BANK, labels[:-1], {1: estimate(900.0)})
