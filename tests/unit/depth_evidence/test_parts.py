"""Regions that have no single depth: told by their parts, which are read one by one."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from calibration.bank import Bank
from calibration.image import LinearImage
from tests.unit.depth_evidence.synthetic import as_image, leaves, photograph, radius_px
from workbench.depth import evidence_findings
from workbench.depth.estimate import DepthEstimate
from workbench.depth.evidence import EvidenceOptions, estimate_evidence, prepare
from workbench.depth.evidence_doubt import uneven
from workbench.depth.evidence_model import Learned
from workbench.depth.evidence_observation import observe
from workbench.depth.evidence_uniform import Reading, fit_parts, parts_loss, quarter_cuts, read_parts
from workbench.depth.evidence_windows import place_windows, soft_mask
from workbench.depth.regions import whole

SIDE = 128 + 40


def parts_read(found: DepthEstimate) -> list[int]:
    """Depths (cm) that the reason names."""
    named = re.search(r"its parts read ([0-9, ]+) cm", found.reason)
    assert named is not None, found.reason
    return [int(depth) for depth in named.group(1).split(", ")]


def halves(first_mm: float, second_mm: float, *, along: int, drawn: int) -> LinearImage:
    """256 pixels square; the first half is the upper (0) or the left (1) one."""
    first, second = (photograph(leaves(SIDE + 128, drawn + i), z) for i, z in enumerate((first_mm, second_mm)))
    upper = np.indices(first.shape)[along] < first.shape[along] // 2
    return as_image(np.where(upper[..., np.newaxis], first.planes, second.planes))


@pytest.mark.parametrize("along", [0, 1])
@pytest.mark.parametrize(("first_mm", "second_mm"), [(1050.0, 2100.0), (2100.0, 1050.0), (3300.0, 1300.0)])
def test_region_of_two_depths_says_so_and_reads_both(bank: Bank, first_mm: float, second_mm: float, along: int) -> None:
    image = halves(first_mm, second_mm, along=along, drawn=16)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "ambiguous"
    assert "not the same all over" in found.reason
    near, far = sorted((first_mm, second_mm))
    assert parts_read(found) == pytest.approx([near / 10, near / 10, far / 10, far / 10], rel=0.06)
    assert found.interval_mm[0] < near
    assert found.interval_mm[1] > far


@pytest.mark.parametrize("seed", [18, 28, 38])
def test_sharp_object_does_not_speak_for_the_blurred_rest_of_its_region(bank: Bank, seed: int) -> None:
    """It outweighs the rest of the spectrum so far that no mixture of blurs fits better: only the parts tell."""
    sharp, blurred = (
        photograph(leaves(SIDE + 100, drawn), depth) for drawn, depth in ((seed, 1800.0), (seed + 1, 2900.0))
    )
    corner = np.zeros((*sharp.shape, 1), bool)
    corner[: sharp.shape[0] * 11 // 20, : sharp.shape[1] * 11 // 20] = True
    image = as_image(np.where(corner, sharp.planes, blurred.planes))
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert found.status == "ambiguous"
    assert "not the same all over" in found.reason
    assert found.interval_mm[0] < 1800.0
    assert found.interval_mm[1] > 2900.0
    deaf = EvidenceOptions(parts_log_likelihood=1e9)
    assert "not the same all over" not in estimate_evidence(image, bank, whole(image.shape), deaf)[1].reason


def test_parts_are_asked_for_the_answers_blur_too(bank: Bank, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three parts far from focus and one that claims it, which counts little: sharing a blur, theirs, costs little."""
    image, options = photograph(leaves(SIDE + 128, 16), 2100.0), EvidenceOptions()
    mask, model = np.ones(image.shape, bool), prepare(bank, options)
    windows = place_windows(mask, soft_mask(mask, margin_px=0, ramp_px=1)[0], 64, least_weight=0.3)
    part = fit_parts(image.luminance, windows, mask, model, options)[0]
    apart = np.abs(np.abs(model.row_radius_px[::3])[:, np.newaxis] - (12.0, 12.0, 12.0, 0.0))
    told = [replace(part, fit=replace(part.fit, log_likelihood=-31.0 * np.minimum(a / 4.0, 1.0))) for a in apart.T]
    assert parts_loss(told, model) == pytest.approx(0.1 * 30.0, rel=0.1)
    assert parts_loss(told, model, 12.0) == pytest.approx(0.1 * 30.0, rel=0.1)
    assert parts_loss(told, model, 0.0) == pytest.approx(3 * 30.0, rel=0.1)

    asked: list[float | None] = []

    def denying(_parts: object, _model: object, radius_px: float | None = None) -> float:
        asked.append(radius_px)
        return 0.0 if radius_px is None else 1e3

    monkeypatch.setattr(evidence_findings, "parts_loss", denying)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert asked[0] is None
    assert asked[-1] == pytest.approx(abs(radius_px(found.depth_mm)), abs=0.2)
    assert found.status == "ambiguous"
    assert "not the same all over" in found.reason


def test_quarters_of_a_region_have_as_many_pixels_each() -> None:
    rows, columns = np.mgrid[:600, :800]
    ring = (np.hypot(rows - 300, columns - 370) < 280) & (np.hypot(rows - 300, columns - 370) > 110)
    ring[:, 400:] &= rows[:, 400:] % 2 == 0
    row, (upper, lower) = quarter_cuts(ring)
    sizes = [part.sum() for half, column in ((ring[:row], upper), (ring[row:], lower))
             for part in (half[:, :column], half[:, column:])]  # fmt: skip
    assert sum(sizes) == ring.sum()
    assert max(sizes) < 1.02 * min(sizes)


def test_windows_across_a_cut_count_for_no_part(bank: Bank) -> None:
    image = halves(1250.0, 2100.0, along=0, drawn=16)
    mask = np.ones(image.shape, bool)
    windows = place_windows(mask, soft_mask(mask, margin_px=0, ramp_px=1)[0], 64, least_weight=0.3)
    parts = fit_parts(image.luminance, windows, mask, prepare(bank, EvidenceOptions()), EvidenceOptions())
    assert len(parts) == 4
    middle = image.shape[0] / 2
    for part, (below, right) in zip(parts, ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
        assert part.windows
        assert all((w.row + 32 - middle > 8) if below else (w.row + 32 - middle < -8) for w in part.windows)
        assert all((w.column + 32 - middle > 8) if right else (w.column + 32 - middle < -8) for w in part.windows)
    assert sum(len(part.windows) for part in parts) < len(windows)


def test_parts_of_one_blur_lose_nothing_by_sharing_it_and_one_part_has_none_to_share_with(bank: Bank) -> None:
    image = halves(2100.0, 2100.0, along=0, drawn=16)
    mask, model = np.ones(image.shape, bool), prepare(bank, EvidenceOptions())
    windows = place_windows(mask, soft_mask(mask, margin_px=0, ramp_px=1)[0], 64, least_weight=0.3)
    parts = fit_parts(image.luminance, windows, mask, model, EvidenceOptions())
    assert parts_loss(parts, model) < 3.0
    assert parts_loss(parts[:1], model) == 0.0
    assert parts_loss([], model) == 0.0


def test_a_part_without_texture_reads_nothing(bank: Bank) -> None:
    image = halves(1050.0, 2100.0, along=0, drawn=16)
    planes = image.planes.copy()
    corner = planes[: planes.shape[0] // 2, : planes.shape[1] // 2]
    corner[...] = 0.4 + 0.003 * np.random.default_rng(3).standard_normal(corner.shape)
    image = as_image(planes)
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert parts_read(found) == pytest.approx([105, 210, 210], rel=0.06)


def test_parts_that_read_the_same_are_named_once(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 2), 2000.0)
    estimate = estimate_evidence(image, bank, whole(image.shape))[1]
    read = [Reading(depth_mm, (1500.0, 2500.0)) for depth_mm in (1612.0, 1608.0, 1611.0)]
    assert "(each of its parts reads 161 cm)" in uneven(estimate, read).reason
    assert "(its parts read 161 cm)" in uneven(estimate, read[:1]).reason


def test_a_part_whose_side_is_open_holds_both(bank: Bank) -> None:
    """Gaussian noise has no side."""
    generator = np.random.default_rng(5)
    planes = [
        photograph(0.5 + 0.1 * generator.standard_normal((SIDE + 128, SIDE + 128)), z).planes for z in (1400.0, 3300.0)
    ]
    upper = (np.arange(planes[0].shape[0]) < planes[0].shape[0] // 2)[:, np.newaxis, np.newaxis]
    image = as_image(np.where(upper, *planes))
    found = estimate_evidence(image, bank, whole(image.shape))[1]
    assert "not the same all over" in found.reason
    mirror_mm = 1.0 / (2.0 / 1600.0 - 1.0 / 3300.0)
    assert found.interval_mm[0] < mirror_mm
    assert found.interval_mm[1] > 3300.0


def test_readings_widen_the_interval_and_are_named(bank: Bank) -> None:
    image = photograph(leaves(SIDE, 3), 2400.0)
    entire = estimate_evidence(image, bank, whole(image.shape))[1]
    found = uneven(entire, [])
    assert (found.depth_mm, found.interval_mm) == (entire.depth_mm, entire.interval_mm)
    assert (found.status, found.confidence) == ("ambiguous", 0.5 * entire.confidence)
    assert "parts" not in found.reason
    near, far = (Reading(z, (z - 9.0, z + 9.0)) for z in (1200.0, 3000.0))
    found = uneven(entire, [far, near])
    assert found.interval_mm == (1191.0, 3009.0)
    assert found.depth_mm == entire.depth_mm
    assert found.reason.endswith("(its parts read 120, 300 cm)")
    assert uneven(entire, [near] * 4).interval_mm == (1191.0, entire.interval_mm[1])


def test_region_whose_half_windows_all_lie_on_its_edge_has_no_parts(bank: Bank) -> None:
    """A T: windows of 128 pixels see enough of it, none of 64 does."""
    image = photograph(leaves(600, 3), 2400.0)
    mask = np.zeros(image.shape, np.int32)
    mask[97:139, 20:520] = 1
    mask[70:166, 40:62] = 1
    found = estimate_evidence(image, bank, mask)[1]
    assert found.interval_mm[0] <= 2400.0 <= found.interval_mm[1]


def test_windows_of_a_part_are_spread_over_it(bank: Bank) -> None:
    image = as_image(np.tile(photograph(leaves(SIDE + 128, 3), 2400.0).planes, (2, 4, 1)))
    mask, options = np.ones(image.shape, bool), EvidenceOptions()
    windows = place_windows(mask, soft_mask(mask, margin_px=0, ramp_px=1)[0], 64, least_weight=0.3)
    assert len(windows) > 160
    for part in fit_parts(image.luminance, windows, mask, prepare(bank, options), options):
        assert len({w.row for w in part.windows}) >= 3
        assert len({w.column for w in part.windows}) >= 5


def test_reading_of_a_part_lies_within_the_planes_and_leaves_the_side_out_that_is_not_open(bank: Bank) -> None:
    """The last plane is at 350 cm."""
    options, learned = EvidenceOptions(), Learned()
    model = prepare(bank, options)
    image = halves(2400.0, 3450.0, along=0, drawn=16)
    view_of_image = observe(image.luminance, np.ones(image.shape, bool), model, options)
    assert view_of_image is not None
    readings = read_parts(view_of_image.parts, view_of_image.view, model, learned, options)
    assert len(readings) == 4
    for reading, true_mm in zip(readings, (2400.0, 2400.0, 3450.0, 3450.0), strict=True):
        assert reading.depth_mm == pytest.approx(true_mm, rel=0.06)
        low, high = reading.interval_mm
        assert 1700.0 < low <= true_mm <= high <= 3501.0
