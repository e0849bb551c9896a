"""Figures of merit from single outcomes, and the tables made of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from bench_drawings import FOCUS_MM, outcome

from workbench.bench.interval_coverage import confidence_interval, coverage_of
from workbench.bench.scoring import summarise
from workbench.bench.tables import accuracy_tables, band_name, markdown_page, singles_table, tables_json


def test_figures_count_what_they_say() -> None:
    outcomes = [
        outcome(2000, 2030, interval_mm=(1900.0, 2100.0), bound_mm=10.0),  # exact, covered
        outcome(2000, 2140, interval_mm=(2100.0, 2200.0), bound_mm=30.0),  # neighbour, not covered
        outcome(2000, 1340),  # flipped: mirror is 133 cm; gross, unmarked
        outcome(2000, 3000, status="ambiguous"),  # gross, marked
        outcome(2000, float("nan"), status="no-texture"),
    ]
    figures = summarise(outcomes, FOCUS_MM)
    assert figures.count == 5
    assert figures.answered == pytest.approx(0.8)
    assert figures.unmarked == pytest.approx(0.6)
    assert figures.exact == pytest.approx(1 / 4)
    assert figures.neighbour == pytest.approx(2 / 4)
    assert figures.within_10cm == pytest.approx(1 / 4)
    assert figures.gross == pytest.approx(2 / 5)
    assert figures.unmarked_gross == pytest.approx(1 / 5)
    assert figures.side_flips == pytest.approx(1 / 4)
    assert figures.coverage == pytest.approx(1 / 2)
    assert figures.fine_rms_cm == pytest.approx(math.sqrt((3**2 + 14**2) / 2))
    assert figures.bound_cm == pytest.approx(math.sqrt((1 + 9) / 2))


@pytest.mark.parametrize(
    ("true_mm", "depth_mm", "flips"),
    [
        (3500, 1040, 1.0),  # the mirror itself
        (3500, 1580, 0.0),  # the focal plane, a little on the wrong side
        (1610, 1590, 0.0),  # across the focal plane and still exact
        (700, 3500, 0.0),  # gross, but 70 cm has no mirror: another blur altogether
        (3500, 2500, 0.0),  # wrong on the right side
    ],
)
def test_a_flip_is_a_wrong_side_and_not_a_little_across_focus(true_mm: float, depth_mm: float, flips: float) -> None:
    assert summarise([outcome(true_mm, depth_mm)], FOCUS_MM).side_flips == flips


def test_nothing_answered_leaves_rates_open() -> None:
    figures = summarise([outcome(2000, float("nan"), status="no-texture")], FOCUS_MM)
    assert figures.answered == 0.0
    assert figures.gross == 0.0
    assert math.isnan(figures.exact)
    assert math.isnan(figures.rms_cm)


def test_bands_hold_every_depth() -> None:
    assert band_name(607.0) == "nearer than 100 cm"
    assert band_name(1600.0) == "140 to 180 cm"
    assert band_name(9000.0) == "beyond 250 cm"


def test_blank_walls_count_only_in_their_own_table() -> None:
    outcomes = [outcome(2000, 2000), outcome(2000, 3500, texture="blank"),
                outcome(2000, float("nan"), texture="blank", status="no-texture")]  # fmt: skip
    tables = accuracy_tables(outcomes, FOCUS_MM)
    assert [row[2] for row in tables[0].rows] == ["1"]
    assert tables[-1].title == "A blank wall"
    assert tables[-1].rows == (("m", "128", 2, "50.0"),)


def test_methods_that_saw_fewer_cases_are_compared_on_the_common_ones() -> None:
    outcomes = [outcome(2000, 2000), outcome(2100, 3000), outcome(2000, 2000, method="slow")]
    side = next(t for t in accuracy_tables(outcomes, FOCUS_MM) if t.title.startswith("Side by side"))
    assert [(row[0], row[2]) for row in side.rows] == [("m", "1"), ("slow", "1")]
    alike = [outcome(2000, 2000), outcome(2000, 2000, method="slow")]
    assert not any(t.title.startswith("Side by side") for t in accuracy_tables(alike, FOCUS_MM))


def test_depth_table_runs_from_near_to_far() -> None:
    outcomes = [outcome(3400, 3400), outcome(700, 700), outcome(1600, 1600)]
    table = next(t for t in accuracy_tables(outcomes, FOCUS_MM) if t.title.startswith("By depth"))
    assert [row[1] for row in table.rows] == ["nearer than 100 cm", "140 to 180 cm", "beyond 250 cm"]


def test_single_answers_show_doubt_and_missed_intervals() -> None:
    rows = singles_table([
        ("a", outcome(1000, 1004, interval_mm=(990.0, 1010.0))),
        ("b", outcome(1000, 1200, status="ambiguous", interval_mm=(1150.0, 1250.0))),
        ("c", outcome(1000, float("nan"), status="no-texture")),
    ]).rows  # fmt: skip
    assert [row[3] for row in rows] == ["100.4", "120.0?*", "no-texture"]


RIGHT, WRONG = (1900.0, 2100.0), (2010.0, 2100.0)
"""Intervals that hold 2 m, and don't."""


def test_coverage_has_a_confidence_interval() -> None:
    outcomes = [outcome(2000, 2000, interval_mm=RIGHT, texture=str(i)) for i in range(18)]
    outcomes += [outcome(2000, 2050, interval_mm=WRONG, texture="18"), outcome(2000, 1400, interval_mm=WRONG)]
    found = coverage_of([*outcomes, outcome(2000, 2000)])
    assert found.count == 20  # the last one has no interval
    assert found.coverage == pytest.approx(18 / 20)
    assert found.confidence_interval == pytest.approx((0.683, 0.988), abs=1e-3)  # Clopper and Pearson's for 18 of 20
    assert found.half_width_cm == pytest.approx(10.0)
    assert math.isnan(coverage_of([outcome(2000, 2000)]).coverage)


def test_regions_that_err_together_tell_less() -> None:
    """Twenty frames of four regions: in two of them all four are wrong, or eight frames have one that is."""
    total = np.full(20, 4.0)
    together = confidence_interval(np.array([0.0, 0.0, *[4.0] * 18]), total)
    apart = confidence_interval(np.array([*[3.0] * 8, *[4.0] * 12]), total)
    assert apart == pytest.approx((0.812, 0.956), abs=1e-3)  # as of 72 of 80 independent ones
    assert together == pytest.approx((0.662, 0.990), abs=1e-3)  # as of 17 independent ones, 18 of 20 give 0.683, 0.988
    evenly = confidence_interval(np.full(20, 3.0), total)
    assert evenly == pytest.approx((0.641, 0.840), abs=1e-3)  # never as of more than the 80 that there are
    assert confidence_interval(np.array([4.0, 4.0]), np.array([4.0, 4.0])) == pytest.approx((0.631, 1.0), abs=1e-3)


def test_intervals_by_texture_band_and_size_in_one_light() -> None:
    outcomes = [
        outcome(true_mm, true_mm, interval_mm=(true_mm - 10.0, true_mm + 10.0), method=method, light=light)
        for light in ("dim", "dimmer") for method in ("a", "b") for true_mm in (3000.0, 700.0)
    ]  # fmt: skip
    # a texture's name may be that of a size
    outcomes.append(
        outcome(700, 700, interval_mm=(0.0, 1.0), method="a", light="dim", texture="128", status="ambiguous")
    )
    table = next(t for t in accuracy_tables(outcomes, FOCUS_MM) if t.title == "Intervals of 95 % (dim light)")
    assert [row[:5] for row in table.rows] == [
        ("a", "texture", "chart", 2, "100.0"),
        ("b", "texture", "chart", 2, "100.0"),
        ("a", "texture", "128", 1, "0.0"),
        ("a", "depth", "nearer than 100 cm", 2, "50.0"),
        ("b", "depth", "nearer than 100 cm", 1, "100.0"),
        ("a", "depth", "beyond 250 cm", 1, "100.0"),
        ("b", "depth", "beyond 250 cm", 1, "100.0"),
        ("a", "size", "128", 3, "66.7"),
        ("b", "size", "128", 2, "100.0"),
    ]
    assert [row[table.columns.index("unm. n")] for row in table.rows] == [2, 2, 0, 1, 1, 1, 1, 2, 2]
    entry = tables_json(outcomes, FOCUS_MM)["intervals"][2]
    assert (entry["by"], entry["regions"], entry["light"]) == ("texture", "128", "dim")
    assert (entry["all"]["count"], entry["unmarked"]["count"]) == (1, 0)


def test_methods_without_intervals_have_no_table_of_them() -> None:
    assert not any(t.title.startswith("Intervals") for t in accuracy_tables([outcome(2000, 2000)], FOCUS_MM))


def test_page_and_json_hold_every_group() -> None:
    outcomes = [outcome(2000, 2000, light=light) for light in ("normal", "dim")]
    page = markdown_page("Accuracy", {"seed": 0}, accuracy_tables(outcomes, FOCUS_MM), ["a.png"])
    assert "| m | 128, dim | 1 |" in page
    assert "![a.png](a.png)" in page
    assert [g["light"] for g in tables_json(outcomes, FOCUS_MM)["size and light"]] == ["normal", "dim"]
