"""Each published method on its own ground, on photographs by the simulated lens and sensor."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from scipy.signal import fftconvolve
from simulated_views import (
    ELL,
    FOCUS_MM,
    SEVEN,
    SMALL,
    bank_through,
    gaussian_pupil,
    labels_of,
    photograph,
    step_edges,
    textured,
)

from calibration.bank import Bank
from calibration.errors import MismatchError
from calibration.image import LinearImage
from calibration.optics import mirror_depth
from workbench.depth.estimate import DepthEstimate
from workbench.depth.methods import (
    METHODS,
    MethodError,
    estimate_depths,
    make_options,
    needs_second_view,
    option_values,
)
from workbench.depth.references.bae_durand import cross_bilateral
from workbench.depth.references.blur_size import blur_scale
from workbench.depth.references.sparse_deconvolution import SparsePrior, sparse_deconvolve

SIDE = 160
GAUSSIAN = gaussian_pupil()
FEW_MM = (1000.0, 1200.0, 1400.0, 1600.0, 1900.0, 2300.0, 2900.0)
EDGE_METHODS = ("zhuo-sim", "bae-durand", "elder-zucker")
TWO_VIEWS = ("pair", "pentland")
ALL = (*EDGE_METHODS, "levin", *TWO_VIEWS)
QUICK = {"levin": {"samples": "48"}}


def measure(method: str, image: LinearImage, bank: Bank, settings: Mapping[str, Any] | None = None) -> DepthEstimate:
    return estimate_depths(image, bank, labels_of(image), method, {**QUICK.get(method, {}), **(settings or {})})[1]


def second_view(method: str, texture: str, depth_mm: float) -> dict[str, Any]:
    if method not in TWO_VIEWS:
        return {}
    pupil = ELL if method == "pair" else SMALL
    depths = {} if method == "pentland" else {"depths_mm": FEW_MM}
    return {
        "second_image": photograph(textured(texture, depth_mm), pupil, SIDE, shot=2),
        "second_bank": bank_through(pupil, **depths),
    }


# A soft aperture's blur is the Gaussian that these methods assume, and lone straight edges are what they look at.
@pytest.mark.parametrize("depth_mm", [1800.0, 2200.0, 2600.0])
@pytest.mark.parametrize(("method", "tolerance_mm"), [("zhuo-sim", 100.0), ("bae-durand", 100.0)])
def test_lone_soft_edges_beyond_focus_have_their_depth(method: str, tolerance_mm: float, depth_mm: float) -> None:
    found = measure(method, photograph(step_edges(depth_mm), GAUSSIAN, SIDE), bank_through(GAUSSIAN))
    assert found.depth_mm == pytest.approx(depth_mm, abs=tolerance_mm)


@pytest.mark.parametrize("depth_mm", [1800.0, 2200.0, 2600.0])
def test_extrema_of_the_second_derivative_tell_the_blur_of_lone_soft_edges(depth_mm: float) -> None:
    bank = bank_through(GAUSSIAN)
    found = measure("elder-zucker", photograph(step_edges(depth_mm), GAUSSIAN, SIDE), bank)
    true = float(blur_scale(bank).std_px(bank.lens.sigma_px(np.array([depth_mm])))[0])
    assert found.diagnostics["blur_std_px"][0] == pytest.approx(true, rel=0.3)


@pytest.mark.parametrize("method", EDGE_METHODS)
def test_blur_of_edges_grows_with_distance_from_focus(method: str) -> None:
    bank = bank_through(GAUSSIAN)
    blurs = [
        measure(method, photograph(step_edges(z), GAUSSIAN, SIDE), bank).diagnostics["blur_std_px"][0]
        for z in (1600.0, 1900.0, 2300.0, 3000.0)
    ]
    assert np.diff(blurs).min() > 0.3


@pytest.mark.parametrize("method", EDGE_METHODS)
def test_near_side_is_taken_for_the_far_side_and_named_as_mirror(method: str) -> None:
    depth_mm = 1200.0
    found = measure(method, photograph(step_edges(depth_mm), GAUSSIAN, SIDE), bank_through(GAUSSIAN))
    assert found.depth_mm > FOCUS_MM
    assert found.mirror_mm == pytest.approx(depth_mm, abs=100)
    assert found.mirror_mm == pytest.approx(mirror_depth(found.depth_mm, focus_mm=FOCUS_MM), rel=1e-6)
    assert found.mirror_probability == 0.5
    assert found.status == "ambiguous"


def test_blur_beyond_that_of_infinity_can_only_be_near() -> None:
    found = measure("zhuo-sim", photograph(step_edges(850.0), GAUSSIAN, SIDE), bank_through(GAUSSIAN))
    assert found.depth_mm == pytest.approx(850.0, abs=100)
    assert np.isnan(found.mirror_mm)
    assert found.status == "ok"


def test_width_of_the_banks_blur_follows_the_radius() -> None:
    bank = bank_through(SEVEN)
    scale = blur_scale(bank)
    for radius in (0.0, 3.0, 20.0):
        assert scale.radius_px(float(scale.std_px(np.array(radius)))) == pytest.approx(radius, abs=1e-6)
    noisy = dataclasses.replace(
        bank, psf=bank.psf + np.random.default_rng(0).normal(0, 2e-5, bank.psf.shape).astype(np.float32)
    )
    assert blur_scale(noisy).share == pytest.approx(scale.share, rel=0.05)


@pytest.mark.parametrize("texture", ["leaves", "text"])
@pytest.mark.parametrize("depth_mm", [1000.0, 1200.0, 1400.0, 1900.0, 2300.0, 2900.0])
def test_pair_of_apertures_knows_the_side_of_focus(depth_mm: float, texture: str) -> None:
    image = photograph(textured(texture, depth_mm), SEVEN, SIDE)
    found = measure("pair", image, bank_through(SEVEN, FEW_MM), second_view("pair", texture, depth_mm))
    assert found.depth_mm == depth_mm
    assert found.status == "ok"


def test_pair_doesnt_mind_different_exposures() -> None:
    view = second_view("pair", "leaves", 1900.0)
    darker = dataclasses.replace(view["second_image"], planes=view["second_image"].planes * np.float32(0.4))
    image = photograph(textured("leaves", 1900.0), SEVEN, SIDE)
    assert measure("pair", image, bank_through(SEVEN, FEW_MM), {**view, "second_image": darker}).depth_mm == 1900.0


@pytest.mark.parametrize("depth_mm", [1000.0, 1200.0, 1900.0, 2300.0, 2900.0])
def test_sparse_deconvolution_error_finds_the_radius_of_blur(depth_mm: float) -> None:
    bank = bank_through(SEVEN, FEW_MM)
    found = measure("levin", photograph(textured("leaves", depth_mm), SEVEN, SIDE), bank)
    true, measured = np.abs(bank.lens.sigma_px(np.array([depth_mm, found.depth_mm])))
    assert measured == pytest.approx(true, abs=1.5)
    # without the learned weights the sharpest PSF explains everything
    assert FEW_MM[int(np.argmin(found.diagnostics["error"]))] == FOCUS_MM


@pytest.mark.parametrize("depth_mm", [1300.0, 2000.0, 2400.0])
def test_loss_of_power_between_two_apertures_tells_the_radius_of_blur(depth_mm: float) -> None:
    bank = bank_through(SEVEN)
    image = photograph(textured("noise", depth_mm), SEVEN, SIDE)
    found = measure("pentland", image, bank, second_view("pentland", "noise", depth_mm))
    true = abs(float(bank.lens.sigma_px(np.array([depth_mm]))[0]))
    assert found.diagnostics["radius_px"][0] == pytest.approx(true, rel=0.15)
    assert found.status == "ambiguous"


def test_sparse_prior_restores_sharper_edges_than_the_quadratic_one() -> None:
    sharp = np.full((90, 90), 0.2, np.float32)
    sharp[30:60, 25:70] = 0.9
    psf = bank_through(SEVEN, FEW_MM).central[5][8:-8, 8:-8]
    psf = np.asarray(psf / psf.sum(), np.float32)
    half = psf.shape[0] // 2
    seen = fftconvolve(np.pad(sharp, half, mode="edge"), psf, mode="valid")
    seen = np.asarray(seen + np.random.default_rng(0).normal(0, 2e-3, seen.shape), np.float32)
    errors = {}
    for reweightings in (0, 2):
        restored, left = sparse_deconvolve(seen, psf, SparsePrior(0.8, 1e-3, 0.1, 0.01, reweightings, 12))
        errors[reweightings] = float(np.sqrt(((restored - sharp)[5:-5, 5:-5] ** 2).mean()))
        assert float(left.std()) < 6e-3
    assert errors[2] < 0.7 * errors[0]


def test_outlying_edges_are_drawn_to_their_neighbours_and_to_sharpness() -> None:
    yx = np.stack([np.zeros(9), np.arange(9.0)])
    blurs = np.array([2.0, 2, 2, 2, 8, 2, 2, 2, 2])
    filtered = cross_bilateral(blurs, yx, np.zeros(9), space=3.0, brightness=1.0, bias=2.0)
    assert filtered[4] < 2.3
    apart = cross_bilateral(blurs, yx, np.where(blurs > 5, 1.0, 0.0), space=3.0, brightness=0.05, bias=None)
    np.testing.assert_allclose(apart, blurs, atol=1e-3)


@pytest.mark.parametrize("method", ALL)
def test_every_method_keeps_labels_and_refuses_what_says_nothing(method: str) -> None:
    bank = bank_through(SEVEN) if method == "pentland" else bank_through(SEVEN, FEW_MM)
    image = photograph(textured("leaves", 1900.0), SEVEN, SIDE)
    noise = np.random.default_rng(0).normal(0.4, 0.003, (SIDE, 60, 3)).astype(np.float32)
    planes = np.concatenate([image.planes, noise], axis=1)
    saturated = np.zeros(planes.shape[:2], np.bool_)
    view = second_view(method, "leaves", 1900.0)
    if view:
        second = view["second_image"]
        view["second_image"] = dataclasses.replace(
            second, planes=np.concatenate([second.planes, noise], axis=1), saturated=saturated
        )
    labels = np.zeros(planes.shape[:2], np.int32)
    labels[:, :SIDE] = 4
    labels[:12, :12] = 2
    labels[:, SIDE + 5 :] = 9
    wide = dataclasses.replace(image, planes=planes, saturated=saturated)
    found = estimate_depths(wide, bank, labels, method, {**QUICK.get(method, {}), **view})
    assert list(found) == [2, 4, 9]
    assert [found[label].status for label in (2, 9)] == ["no-texture", "no-texture"]
    assert "inner pixels" in found[2].reason
    assert "texture" in found[9].reason
    answer = found[4]
    assert bank.depths_mm[0] <= answer.depth_mm <= bank.depths_mm[-1]
    assert np.isnan(answer.interval_mm).all()
    assert answer.score.shape == bank.depths_mm.shape
    assert answer.score.max() == pytest.approx(1.0)
    assert 0 < answer.pixels < SIDE * SIDE
    clipped = saturated.copy()
    clipped[40:120, 40:120] = True
    bright = estimate_depths(
        dataclasses.replace(wide, saturated=clipped), bank, labels, method, {**QUICK.get(method, {}), **view}
    )[4]
    assert bright.status in ("saturated", "no-texture")


@pytest.mark.parametrize("method", TWO_VIEWS)
def test_methods_of_two_photographs_say_what_is_missing(method: str) -> None:
    image = photograph(textured("leaves", 1900.0), SEVEN, SIDE)
    bank = bank_through(SEVEN, FEW_MM)
    with pytest.raises(MismatchError, match="second_image"):
        measure(method, image, bank)
    with pytest.raises(MismatchError, match="second_bank"):
        measure(method, image, bank, {"second_image": image})
    smaller = dataclasses.replace(image, planes=image.planes[:-2], saturated=image.saturated[:-2])
    with pytest.raises(MismatchError, match="same camera"):
        measure(method, image, bank, {"second_image": smaller, "second_bank": bank})
    with pytest.raises(MethodError, match="second_image"):
        make_options(method, {"second_image": "b.dng"})


def test_second_bank_must_cover_the_depths_of_the_first() -> None:
    image = photograph(textured("leaves", 1900.0), SEVEN, SIDE)
    with pytest.raises(MismatchError, match="no plane near"):
        measure(
            "pair", image, bank_through(SEVEN, FEW_MM),
            {"second_image": image, "second_bank": bank_through(ELL, FEW_MM[:-2])},
        )  # fmt: skip


def test_second_view_is_recorded_by_hash_and_id() -> None:
    view = second_view("pair", "leaves", 1900.0)
    values = option_values("pair", view)
    assert values["second_bank"] == view["second_bank"].id
    assert values["second_image"] == {"path": "simulated", "sha256": ""}
    assert [name for name in METHODS if needs_second_view(name)] == ["pair", "pentland"]


@pytest.mark.parametrize(
    ("method", "name", "text"),
    [
        ("zhuo-sim", "second_px", "0.5"),
        ("elder-zucker", "significance", "2"),
        ("bae-durand", "models", "1"),
        ("levin", "exponent", "0"),
        ("pair", "noise", "-1"),
        ("pentland", "most_log_ratio", "0"),
        ("levin", "keep_fraction", "0"),
    ],
)
def test_constants_out_of_range_are_refused_by_name(method: str, name: str, text: str) -> None:
    with pytest.raises(MethodError, match=name):
        make_options(method, {name: text})
