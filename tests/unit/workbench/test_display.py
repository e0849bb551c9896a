import numpy as np
import pytest

from workbench.display import exposure_gain, srgb_transfer, to_srgb8


def test_the_transfer_has_the_standard_values() -> None:
    assert srgb_transfer([0.0, 0.002, 0.2140411, 1.0]) == pytest.approx([0.0, 0.02584, 0.5, 1.0], abs=1e-4)


def test_shape_and_type_are_kept_for_one_and_three_channels() -> None:
    for shape in ((4, 5), (4, 5, 1), (4, 5, 3)):
        out = to_srgb8(np.full(shape, 0.1, np.float32))
        assert out.shape == shape
        assert out.dtype == np.uint8


def test_a_hot_pixel_does_not_darken_the_picture() -> None:
    image = np.linspace(0.01, 0.05, 10_000, dtype=np.float32).reshape(100, 100)
    spiked = image.copy()
    spiked[3, 3] = 1.0
    assert np.median(to_srgb8(spiked)) == np.median(to_srgb8(image)) > 150


def test_what_is_not_a_number_becomes_black_and_disturbs_nothing() -> None:
    image = np.full((20, 20), 0.3, np.float32)
    image[0, 0], image[0, 1] = np.nan, np.inf
    out = to_srgb8(image)
    assert out[0, 0] == 0
    assert (out[1:] == 255).all()


def test_an_image_without_light_is_black_and_a_lone_point_is_seen() -> None:
    assert not to_srgb8(np.zeros((8, 8), np.float32)).any()
    assert exposure_gain(np.full((4, 4), np.nan)) == 1.0
    point = np.zeros((100, 100), np.float32)
    point[50, 50] = 0.2
    assert to_srgb8(point)[50, 50] == 255


def test_images_to_be_compared_can_share_an_exposure() -> None:
    bright, dim = np.full((8, 8), 0.4, np.float32), np.full((8, 8), 0.1, np.float32)
    gain = exposure_gain(bright)
    assert to_srgb8(dim, gain).max() < to_srgb8(bright, gain).max() == 255
