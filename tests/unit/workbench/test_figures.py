import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from drawn_results import (
    FOCUS_MM,
    SUSPECT_INDEX,
    draw_bank,
    draw_measurement,
    no_texture,
    posterior,
    score_estimate,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from workbench.figures import bank as bank_figures
from workbench.figures import curves, perspective, pictures, sharpness, style

TRUE = {1: 3200.0, 4: 880.0}
FIGURES: dict[str, tuple[Callable[[], Figure], tuple[str, ...]]] = {
    "psf montage": (lambda: bank_figures.psf_montage(draw_bank()), ("cm", "px", "µm")),
    "field": (lambda: bank_figures.field_montage(draw_bank(fields=5)), ("half frame widths", "half frame heights")),
    "aperture": (lambda: bank_figures.aperture_picture(draw_bank()), ("x (mm)", "y (mm)")),
    "radius": (
        lambda: bank_figures.radius_against_depth(draw_bank()),
        ("depth (cm)", "signed radius (px)", "on the sensor (µm)", "measured − fit (px)", "dioptres"),
    ),
    "quality": (lambda: bank_figures.quality_by_depth(draw_bank()), ("depth (cm)", "px", "fraction of white")),
    "pair": (lambda: pictures.photograph_and_all_focus(draw_measurement()), ("x (px)", "y (px)")),
    "segmentation": (lambda: pictures.segmentation(draw_measurement()), ("x (px", "y (px)")),
    "depth map": (lambda: pictures.depth_map(draw_measurement()), ("x (px", "y (px)", "depth (cm)", "unknown")),
    "perspective": (lambda: perspective.perspective(draw_measurement()), ("depth (cm)", "across the photograph")),
    "posteriors": (lambda: curves.score_curves(draw_measurement().estimates), ("depth (cm)", "probability / peak")),
    "scores": (lambda: curves.score_curves({1: score_estimate()}), ("depth (cm)", "score / best")),
    "intervals": (lambda: curves.depths_with_intervals(draw_measurement().estimates, TRUE), ("depth (cm)", "region")),
    "difference": (
        lambda: curves.depth_difference(draw_measurement().estimates, TRUE),
        ("true depth (cm)", "measured − true (cm)"),
    ),
    "window sums": (lambda: sharpness.window_sums(score_estimate()), ("window sum", "denoised", "x (px)", "y (px)")),
    "threshold": (lambda: sharpness.threshold(score_estimate()), ("normalised window sum", "pixels", "cumulative")),
    "contributions": (lambda: sharpness.contributions(score_estimate()), ("depth (cm)", "each / its largest")),
}


def words(figure: Figure) -> str:
    """All text of a figure."""
    return " | ".join(item.get_text() for item in figure.findobj(Text))


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_names_its_axes_with_units_and_leaves_no_trace(name: str) -> None:
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    make, expected = FIGURES[name]
    figure = make()
    assert isinstance(figure, Figure)
    text = words(figure)
    for word in expected:
        assert word in text, f"{word!r} not in {text}"
    assert dict(mpl.rcParams) == before


def test_equal_values_give_equal_bytes() -> None:
    def svg() -> bytes:
        return style.to_bytes(curves.score_curves({1: posterior(2000.0, 1e-5, 0.2)}), "svg")

    assert svg() == svg()


def test_formats_are_what_they_say() -> None:
    figure = bank_figures.aperture_picture(draw_bank())
    assert style.to_bytes(figure, "png").startswith(b"\x89PNG")
    assert style.to_bytes(figure, "jpeg").startswith(b"\xff\xd8")
    assert b"<svg" in style.to_bytes(figure, "svg")[:1500]
    assert style.to_data_uri(figure, "svg").startswith("data:image/svg+xml;base64,")


def test_the_suspect_depth_is_marked_by_its_own_sign_not_by_colour_alone() -> None:
    bank = draw_bank()
    montage = words(bank_figures.psf_montage(bank))
    assert f"{bank.depths_mm[SUSPECT_INDEX] / 10:.4g} cm ▲" in montage
    assert montage.count("▲") == 1
    assert "260 cm" in words(bank_figures.radius_against_depth(bank))
    assert len({marker for marker, _, _ in bank_figures.VERDICT_STYLE.values()}) == 3
    assert len({marker for marker, _ in curves.STATUS_STYLE.values()}) == 4


def test_a_bank_without_quality_figures_is_judged_by_its_lens_fit_and_says_there_are_none() -> None:
    bank = draw_bank(judged=False)
    assert bank_figures.verdicts(bank)[SUSPECT_INDEX] == "suspect"
    assert bank_figures.verdicts(bank).count("suspect") == 1
    with pytest.raises(ValueError, match="no quality figures"):
        bank_figures.quality_by_depth(bank)
    assert "µm" not in words(bank_figures.radius_against_depth(bank))


def test_a_montage_of_very_many_depths_stays_within_its_tiles() -> None:
    bank = draw_bank()
    many = dataclasses.replace(
        bank,
        depths_mm=np.linspace(600, 3500, 120),
        psf=np.repeat(bank.psf, 4, axis=1),
        manifest={},
        lens=dataclasses.replace(bank.lens, suspect=()),
    )
    figure = bank_figures.psf_montage(many)
    titled = [axes for axes in figure.axes if axes.get_title(loc="left")]
    assert len(titled) == bank_figures.MAX_TILES
    assert titled[0].get_title(loc="left") == "60 cm"
    assert titled[-1].get_title(loc="left") == "350 cm"


def test_the_drawn_lens_passes_through_zero_at_focus() -> None:
    axes = bank_figures.radius_against_depth(draw_bank()).axes[0]
    curve = next(line for line in axes.lines if line.get_label() == "fitted thin lens")
    x, y = np.asarray(curve.get_xdata(), float), np.asarray(curve.get_ydata(), float)
    assert np.interp(FOCUS_MM / 10, x, y) == pytest.approx(0, abs=0.01)


def test_a_region_without_depth_shows_its_reason_and_no_number() -> None:
    text = words(curves.score_curves({7: no_texture()}))
    assert "region 7: no depth" in text
    assert "contrast is within the noise" in text.replace("\n", " ")
    assert "nan" not in text


def _marks(axes: Axes, marker: str) -> list[float]:
    return [float(np.asarray(line.get_xdata(), float)[0]) for line in axes.lines if line.get_marker() == marker]


def test_peak_second_best_and_mirror_are_marked_where_they_are() -> None:
    estimate = posterior(2000.0, 1e-5, 0.2)
    axes = curves.score_curves({1: estimate}).axes[0]
    assert _marks(axes, "o") == [pytest.approx(200.0)]
    assert _marks(axes, "D") == [pytest.approx(estimate.mirror_mm / 10)]
    assert "P 0.20" in words(axes.figure)  # type: ignore[arg-type]


def test_a_mirror_beyond_the_depths_that_were_looked_at_does_not_stretch_the_axis() -> None:
    near = posterior(874.0, 3e-6, 0.01)
    assert near.mirror_mm > 9000
    figure = curves.score_curves({1: near})
    assert _marks(figure.axes[0], "D") == []
    assert curves.depths_with_intervals({1: near}).axes[0].get_xlim()[1] < 400


def test_scores_share_one_axis_so_that_a_flat_curve_looks_flat() -> None:
    peaked = score_estimate()
    flat = dataclasses.replace(peaked, score=np.linspace(0.99, 1.0, peaked.score.size))
    first, second = (axes.get_ylim() for axes in curves.score_curves({1: peaked, 2: flat}).axes[:2])
    assert first == second


def test_a_posterior_is_told_from_a_score() -> None:
    assert curves.is_posterior(posterior(2000.0, 1e-5, 0.2))
    assert not curves.is_posterior(score_estimate())
    assert not curves.is_posterior(no_texture())


def test_ambiguous_depths_carry_a_question_mark_in_the_depth_map() -> None:
    shown = words(pictures.depth_map(draw_measurement()))
    assert "187?" in shown
    assert "321" in shown
    assert "321?" not in shown


def test_the_depth_map_is_hatched_where_unknown_and_has_no_bar_without_any_depth() -> None:
    assert "depth (cm)" in words(pictures.depth_map(draw_measurement()))
    blank = draw_measurement({1: no_texture(), 2: no_texture(), 3: no_texture(), 4: no_texture()})
    assert "depth (cm)" not in words(pictures.depth_map(blank))
    assert perspective.depth_layers(blank.depth_map_mm) == []
    assert isinstance(perspective.perspective(blank), Figure)


def test_one_single_depth_is_a_sensible_picture_too() -> None:
    one = draw_measurement({n: posterior(2000.0, 1e-5, 0.1) for n in range(1, 5)}, channels=1)
    norm = pictures.depth_norm(np.array([200.0]))
    assert norm.vmin is not None
    assert norm.vmax is not None
    assert norm.vmin < 200 < norm.vmax
    assert len(perspective.depth_layers(one.depth_map_mm / 10)) == 1
    assert isinstance(perspective.perspective(one), Figure)


def test_a_smooth_depth_map_becomes_layers_that_hold_every_known_pixel_once() -> None:
    depth = np.linspace(80, 350, 60 * 90, dtype=np.float32).reshape(60, 90)
    depth[:5] = np.nan
    layers = perspective.depth_layers(depth)
    assert len(layers) <= perspective.MAX_LAYERS
    assert np.array_equal(sum(mask.astype(int) for _, mask in layers), np.isfinite(depth).astype(int))
    far_to_near = [depth_cm for depth_cm, _ in layers]
    assert far_to_near == sorted(far_to_near, reverse=True)
    for depth_cm, mask in layers:
        assert np.abs(1 / depth[mask] - 1 / depth_cm).max() < (1 / 80 - 1 / 350) / perspective.MAX_LAYERS


def test_nearer_layers_hide_farther_ones() -> None:
    measurement = draw_measurement()
    layout = perspective.perspective(measurement).axes[0].images[0].get_array()
    assert layout is not None
    rgba = np.asarray(layout)
    assert rgba.shape[2] == 4
    assert 0.05 < (rgba[:, :, 3] > 250).mean() < 0.8
    assert (rgba[:, :, 3] == 0).any()


def test_large_photographs_are_reduced_without_making_up_depths() -> None:
    depth = np.full((1500, 2100), 800.0, np.float32)
    depth[:, 1000:] = 3000.0
    depth[:30] = np.nan
    small = pictures.reduced_depth(depth, (500, 700))
    assert set(np.unique(small[np.isfinite(small)])) == {800.0, 3000.0}
    assert pictures.reduced(np.ones((1500, 2100, 3), np.float32)).shape == (714, 1000, 3)
    assert pictures.reduced(np.ones((1500, 2100, 1), np.float32)).shape == (714, 1000, 1)


def test_numbers_stand_inside_their_regions_and_outlines_run_along_pixel_edges() -> None:
    mask = np.zeros((40, 60), np.bool_)
    mask[5:35, 5:12] = mask[28:35, 5:55] = True
    x, y, room = pictures.inner_point(mask)
    assert mask[int(y), int(x)]
    assert room >= 3
    (line,) = pictures.outlines(mask)
    assert line.min() == pytest.approx(5, abs=0.3)
    assert line.max() == pytest.approx(55, abs=0.3)
    assert cv2.contourArea(line.astype(np.float32)) == pytest.approx(mask.sum(), rel=0.1)


def test_round_lengths_for_scale_bars() -> None:
    assert [style.nice_length(v) for v in (1, 4.9, 5, 37, 260)] == [1, 2, 5, 20, 200]
