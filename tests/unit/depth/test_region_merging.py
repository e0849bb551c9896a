import cv2
import numpy as np
import pytest
from drawings import as_image
from numpy.typing import NDArray
from scipy import ndimage

from workbench.depth.merging import absorb_small, merge_regions, region_means
from workbench.depth.regions import SrmOptions, edge_distance, from_roi, inner, srm, whole


def noisy_patches(noise: float, seed: int = 0) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Three colours with noise: left half, right half, and a disc over both."""
    truth = np.zeros((120, 160), np.int32)
    truth[:, 80:] = 1
    cv2.circle(truth, (80, 60), 30, 2, -1)
    colours = np.array([(60, 90, 120), (110, 90, 60), (190, 60, 90)])
    rng = np.random.default_rng(seed)
    levels = colours[truth] + rng.normal(0, noise, (*truth.shape, 3))
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8), truth


def agreement(labels: NDArray[np.int32], truth: NDArray[np.int32]) -> float:
    """Fraction of pixels in the region that is their true region's largest, counted once each way."""
    table = np.zeros((labels.max() + 1, truth.max() + 1))
    np.add.at(table, (labels.ravel(), truth.ravel()), 1)
    return float(min(table.max(axis=0).sum(), table.max(axis=1).sum()) / truth.size)


@pytest.mark.parametrize("noise", [0.0, 5.0, 12.0])
def test_known_regions_are_found_in_noise(noise: float) -> None:
    levels, truth = noisy_patches(noise)
    labels = absorb_small(merge_regions(levels, 32), levels, 50)
    assert labels.max() + 1 == 3
    assert agreement(labels, truth) > 0.98


def test_a_difference_in_one_channel_alone_keeps_regions_apart() -> None:
    levels = np.full((60, 60, 3), 100, np.uint8)
    levels[:, 30:, 2] = 160
    assert merge_regions(levels, 32).max() + 1 == 2


def test_the_published_bound_decides_at_its_very_edge() -> None:
    pixels, half = 64, 32
    delta = 1 / (6 * pixels**2)
    b_squared = 256**2 / (2 * half) * (half * np.log(half + 1) - np.log(delta))
    q_edge = 2 * b_squared / 90**2
    levels = np.full((8, 8, 1), 50, np.uint8)
    levels[:, 4:] = 140
    assert merge_regions(levels, q_edge * 0.999).max() + 1 == 1
    assert merge_regions(levels, q_edge * 1.001).max() + 1 == 2


def test_larger_q_never_gives_fewer_regions() -> None:
    rng = np.random.default_rng(4)
    smooth = cv2.GaussianBlur(rng.normal(0, 1, (120, 120, 3)).astype(np.float32), (0, 0), 5)
    levels = np.clip(128 + 500 * smooth, 0, 255).astype(np.uint8)
    counts = [int(merge_regions(levels, q).max()) + 1 for q in (1, 4, 16, 64, 256)]
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]


def test_regions_are_connected_and_numbered_without_gaps() -> None:
    levels, _ = noisy_patches(20.0, seed=5)
    labels = merge_regions(levels, 64)
    for label in range(labels.max() + 1):
        parts, _ = cv2.connectedComponents((labels == label).astype(np.uint8), connectivity=4)
        assert parts == 2


def test_the_same_image_gives_the_same_labels() -> None:
    levels, _ = noisy_patches(12.0)
    np.testing.assert_array_equal(merge_regions(levels, 32), merge_regions(levels.copy(), 32))


def test_small_regions_go_to_the_neighbour_of_nearest_colour() -> None:
    levels = np.full((20, 40, 1), 50, np.uint8)
    levels[:, 20:] = 200
    levels[8:11, 18:22] = 180
    labels = np.zeros((20, 40), np.int32)
    labels[:, 20:] = 1
    labels[8:11, 18:22] = 2
    absorbed = absorb_small(labels, levels, 20)
    assert absorbed.max() == 1
    assert (absorbed[8:11, 18:22] == absorbed[0, 39]).all()


def test_large_regions_are_never_joined_by_absorbing() -> None:
    levels, _ = noisy_patches(25.0, seed=7)
    before = merge_regions(levels, 200)
    _, counts = region_means(before, levels)
    after = absorb_small(before, levels, 100)
    large = np.flatnonzero(counts >= 100)
    homes = {int(after[before == label][0]) for label in large}
    assert len(homes) == len(large)
    assert np.bincount(after.ravel()).min() >= 100


def test_a_frame_of_one_small_region_stays() -> None:
    assert not absorb_small(np.zeros((3, 3), np.int32), np.zeros((3, 3, 1), np.uint8), 100).any()


def test_photograph_is_segmented_at_its_own_size_whatever_the_working_size() -> None:
    levels, truth = noisy_patches(4.0)
    large = np.kron(levels, np.ones((3, 3, 1), np.uint8))[:355, :478]
    truth = np.kron(truth, np.ones((3, 3), np.int32))[:355, :478]
    image = as_image((large / 255.0).astype(np.float32) ** 2.2)
    for side in (0, 200):
        labels = srm(image, SrmOptions(working_side=side, white_percentile=100))
        assert labels.shape == image.shape
        assert agreement(labels - 1, truth) > 0.95
        counts = np.bincount(labels.ravel())
        assert counts[0] == 0
        assert list(counts[1:]) == sorted(counts[1:], reverse=True)


def test_defocused_textured_objects_come_out_whole() -> None:
    """Noise, bricks and text on coloured grounds, each blurred by its own amount."""
    rng = np.random.default_rng(2)
    height, width = 240, 320
    noise = rng.normal(0, 1, (height, width)).astype(np.float32)
    grain = cv2.GaussianBlur(noise, (0, 0), 2)
    y, x = np.mgrid[:height, :width]
    bricks = np.where((y % 16 < 2) | ((x + 16 * (y // 16 % 2)) % 32 < 2), 1.6, 1.0)
    text = np.where((grain > grain.std() * 1.3) & (y % 12 < 6), 0.4, 1.0)
    truth = np.zeros((height, width), np.int32)
    truth[60:200, 30:130] = 1
    truth[40:180, 180:300] = 2
    planes = np.zeros((height, width, 3), np.float32)
    layers = [
        ((0.15, 0.17, 0.2), bricks, 3.0),
        ((0.45, 0.2, 0.1), 1 + 0.3 * grain / grain.std(), 1.5),
        ((0.6,) * 3, text, 4),
    ]
    for label, (colour, texture, sigma) in enumerate(layers):
        layer = cv2.GaussianBlur(texture[:, :, None] * np.array(colour), (0, 0), sigma)
        coverage = cv2.GaussianBlur((truth == label).astype(np.float64), (0, 0), sigma)[:, :, None]
        planes += (layer * coverage).astype(np.float32)
    image = as_image(planes + rng.normal(0, 0.004, planes.shape).astype(np.float32))
    labels = srm(image)
    assert labels.max() <= 6
    assert agreement(labels - 1, truth) > 0.9


def test_dark_objects_are_told_apart_on_linear_data() -> None:
    plane = np.full((100, 100, 3), 0.05, np.float32)
    plane[:, 50:] = 0.004
    plane[:10, :10] = 1.0
    image = as_image(plane)
    toned = srm(image, SrmOptions(white_percentile=100))
    linear = srm(image, SrmOptions(white_percentile=100, gamma=1.0))
    assert toned[60, 20] != toned[60, 80]
    assert linear[60, 20] == linear[60, 80]


def test_inner_part_keeps_its_distance_from_edges_and_on_request_from_the_frame() -> None:
    mask = np.zeros((40, 60), np.bool_)
    mask[:, :30] = True
    kept = inner(mask, 5)
    assert kept[:, :25].all()
    assert not kept[:, 25:].any()
    closer = inner(mask, 5, frame_is_edge=True)
    assert closer[5:35, 5:25].all()
    assert closer.sum() == 30 * 20
    assert np.isinf(edge_distance(np.ones((4, 4), np.bool_))).all()


def test_given_regions() -> None:
    assert (whole((4, 6)) == 1).all()
    roi = from_roi((10, 20), (3, 2, 5, 4))
    assert roi.sum() == 20
    assert roi[2:6, 3:8].all()
    with pytest.raises(ValueError, match="isn't within the frame of 20 x 10"):
        from_roi((10, 20), (16, 2, 5, 4))


@pytest.mark.parametrize("bad", [{"q": 0.0}, {"min_fraction": 1.0}, {"gamma": -1.0}, {"working_side": -5}])
def test_options_out_of_range_are_refused_by_name(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        SrmOptions(**bad)


@pytest.mark.parametrize("threads", [1, 2])
def test_distances_from_edges_are_exact_whatever_the_threads(threads: int) -> None:
    y, x = np.mgrid[:300, :260]
    mask = (np.hypot(y - 150, x - 120) < 110) & (np.hypot(y - 120, x - 140) > 17)
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        found = edge_distance(mask)
    finally:
        cv2.setNumThreads(before)
    np.testing.assert_array_equal(found, ndimage.distance_transform_edt(mask).astype(np.float32))
