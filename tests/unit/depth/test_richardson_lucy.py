import tracemalloc
from typing import Any

import numpy as np
import pytest
from drawings import blur, draw_chart, draw_psf
from numpy.typing import NDArray
from skimage.restoration import richardson_lucy as reference

from workbench.depth.richardson_lucy import Deconvolver, KernelBank


def dense_matrix(shape: tuple[int, int], psf: NDArray[np.float32]) -> NDArray[np.float64]:
    """H, written out: rows are image pixels, columns pixels of the domain that reaches over the borders."""
    ry, rx = psf.shape[0] // 2, psf.shape[1] // 2
    domain = (shape[0] + 2 * ry, shape[1] + 2 * rx)
    matrix = np.zeros((shape[0] * shape[1], domain[0] * domain[1]))
    for y in range(shape[0]):
        for x in range(shape[1]):
            for dy in range(psf.shape[0]):
                for dx in range(psf.shape[1]):
                    # Light of the scene's pixel (y + ry - (dy - ry)) falls on y through psf[dy].
                    source = (y + 2 * ry - dy) * domain[1] + (x + 2 * rx - dx)
                    matrix[y * shape[1] + x, source] = psf[dy, dx]
    return matrix


def dense_richardson_lucy(
    image: NDArray[np.float32], psf: NDArray[np.float32], mask: NDArray[np.bool_], iterations: int, eps: float
) -> NDArray[np.float64]:
    matrix = dense_matrix(image.shape, psf)
    observed = mask.ravel().astype(float)
    data = image.ravel() * observed
    weight = np.maximum(matrix.T @ observed, eps)
    estimate = np.ones(matrix.shape[1])
    for _ in range(iterations):
        estimate *= (matrix.T @ (data / (matrix @ estimate))) / weight
    ry, rx = psf.shape[0] // 2, psf.shape[1] // 2
    domain = estimate.reshape(image.shape[0] + 2 * ry, image.shape[1] + 2 * rx)
    return domain[ry : ry + image.shape[0], rx : rx + image.shape[1]]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("iterations", [1, 2, 7])
def test_equals_the_textbook_iteration_written_with_matrices(iterations: int, masked: bool) -> None:
    psf = draw_psf(2.4, 7)
    image = blur(draw_chart(24, seed=3), psf)
    mask = np.ones(image.shape, np.bool_)
    if masked:
        mask[5:9, 6:12] = False
    engine = Deconvolver(image.shape, 7, mask=mask if masked else None, weight_floor=0.01)
    expected = dense_richardson_lucy(image, psf, mask, iterations, eps=0.01)
    np.testing.assert_allclose(engine.richardson_lucy(image, psf, iterations), expected, rtol=2e-4, atol=2e-5)


def test_equals_scikit_image_where_borders_are_dark() -> None:
    psf = draw_psf(6.0, 17)
    image = blur(draw_chart(150), psf)[:, :101]
    ours = Deconvolver(image.shape, 17, borders="dark").richardson_lucy(image, psf, 20)
    theirs = reference(image, psf, num_iter=20, clip=False)
    assert np.abs(ours - theirs).max() < 1e-4 * theirs.max()


def test_turned_psf_is_not_mistaken_for_its_mirror() -> None:
    psf = draw_psf(6.0, 17)
    scene = draw_chart(150)
    image = blur(scene, psf)
    engine = Deconvolver(image.shape, 17)
    truth = scene[8:-8, 8:-8]
    right = np.abs(engine.richardson_lucy(image, psf) - truth).mean()
    wrong = np.abs(engine.richardson_lucy(image, psf[::-1, ::-1]) - truth).mean()
    assert right < 0.6 * wrong


def test_light_is_conserved_where_nothing_leaves_the_frame() -> None:
    psf = draw_psf(5.0, 15)
    scene = np.zeros((114, 130), np.float32)
    scene[30:80, 40:90] = draw_chart(50)
    image = blur(scene, psf)
    result = Deconvolver(image.shape, 15).richardson_lucy(image, psf)
    assert result.sum() == pytest.approx(image.sum(), rel=1e-3)


def test_borders_of_a_cropped_image_do_not_ring() -> None:
    psf = draw_psf(8.0, 21)
    scene = draw_chart(220, seed=1)
    image = blur(scene, psf)
    truth = scene[10:-10, 10:-10]
    strip = np.ones(image.shape, np.bool_)
    strip[10:-10, 10:-10] = False

    def error(borders: Any) -> tuple[float, float]:
        deviation = np.abs(Deconvolver(image.shape, 21, borders=borders).richardson_lucy(image, psf) - truth)
        return float(deviation[strip].mean()), float(deviation[~strip].mean())

    (weighted_strip, weighted_middle), (dark_strip, _) = error("weighted"), error("dark")
    assert weighted_strip < 0.5 * dark_strip
    assert weighted_strip < 2.5 * weighted_middle


def test_masked_pixels_leave_no_trace_around_them() -> None:
    psf = draw_psf(4.0, 13)
    scene = draw_chart(112, seed=2)
    image = blur(scene, psf)
    damaged = image.copy()
    damaged[40:46, 50:56] = 1.0
    observed = np.ones(image.shape, np.bool_)
    observed[40:46, 50:56] = False
    around = np.s_[32:54, 42:64]
    clean = Deconvolver(image.shape, 13).richardson_lucy(image, psf)[around]
    masked = Deconvolver(image.shape, 13, mask=observed).richardson_lucy(damaged, psf)[around]
    blind = Deconvolver(image.shape, 13).richardson_lucy(damaged, psf)[around]
    assert np.abs(masked - clean).mean() < 0.25 * np.abs(blind - clean).mean()


def test_scales_with_the_image() -> None:
    psf = draw_psf(4.0, 13)
    image = blur(draw_chart(76), psf)
    engine = Deconvolver(image.shape, 13)
    once = engine.richardson_lucy(image, psf)
    np.testing.assert_allclose(engine.richardson_lucy(image * np.float32(1e-3), psf) * 1e3, once, rtol=1e-3, atol=1e-4)


def test_prepared_values_and_threads_change_nothing() -> None:
    psf = draw_psf(4.0, 13)
    image = blur(draw_chart(300), psf)
    engine = Deconvolver(image.shape, 13, workers=2)
    threaded = engine.richardson_lucy(engine.prepare(image), engine.kernel(psf), 5)
    np.testing.assert_array_equal(threaded, Deconvolver(image.shape, 13).richardson_lucy(image, psf, 5))


def test_darkness_and_negative_noise_stay_finite_and_not_negative() -> None:
    psf = draw_psf(4.0, 13)
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.01, (64, 64)).astype(np.float32)
    engine = Deconvolver((64, 64), 13)
    result = engine.richardson_lucy(noise, psf)
    assert np.isfinite(result).all()
    assert result.min() >= 0
    assert not engine.richardson_lucy(np.zeros((64, 64)), psf).any()


def test_memory_does_not_grow_with_the_number_of_depths() -> None:
    psfs = np.stack([draw_psf(1.0 + 0.2 * i, 17) for i in range(24)])
    image = blur(draw_chart(240), psfs[0])
    engine = Deconvolver(image.shape, 17)
    prepared = engine.prepare(image)

    def peak_bytes(depths: int) -> int:
        kernels = KernelBank(engine, psfs[:depths], max_bytes=2 << 20)
        tracemalloc.start()
        for index in range(depths):
            engine.richardson_lucy(prepared, kernels[index], 2)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    peak_bytes(2)
    assert peak_bytes(24) < 1.1 * peak_bytes(4)


def test_kernels_are_made_once_and_the_least_used_dropped() -> None:
    psfs = np.stack([draw_psf(r, 9) for r in (1.0, 2.0, 3.0)])
    engine = Deconvolver((40, 40), 9)
    kernels = KernelBank(engine, psfs, max_bytes=2 * engine.kernel(psfs[0]).nbytes)
    first, second = kernels[0], kernels[1]
    assert kernels[0] is first
    kernels[2]
    assert kernels[0] is first
    assert kernels[1] is not second


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda e: e.kernel(np.ones((4, 5))), "odd"),
        (lambda e: e.kernel(np.ones((11, 11))), "at most 9"),
        (lambda e: e.kernel(np.zeros((5, 5))), "without any light"),
        (lambda e: e.prepare(np.zeros((5, 5))), "is for"),
        (lambda e: e.richardson_lucy(np.ones((40, 40)), np.ones((3, 3)), 0), "at least 1"),
    ],
)
def test_what_does_not_fit_is_refused(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(Deconvolver((40, 40), 9))


def test_speed(benchmark: Any) -> None:
    psf = draw_psf(12.0, 31)
    image = blur(draw_chart(414), psf)
    engine = Deconvolver(image.shape, 31)
    engine.richardson_lucy(image, psf, 2)
    result = benchmark.pedantic(engine.richardson_lucy, (image, psf, 20), rounds=3)
    assert result.shape == image.shape
