"""Off axis, a bank over the field against its own central set: the same photographs, regions and method."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.field import central_bank
from calibration.photograph import develop_photograph
from rigs.simulated.world import PRESET_SHAPES, SimulatedRigSettings
from workbench.bench.accuracy import outcome_of, timed_estimates
from workbench.bench.cases import Case, photograph
from workbench.bench.scoring import Outcome
from workbench.progress import Observer, Step

FIELD_BANK, CENTRAL_BANK = "field bank", "central bank"
OFF_AXIS = 0.6
"""Part of the half frame, along both axes, at which the regions' middles are."""


def compare_over_field(
    bank: Bank, rig: SimulatedRigSettings, cases: Sequence[Case], *, method: str, side_px: int, observer: Observer
) -> list[Outcome]:
    """Measure four regions towards the corners of each case's photograph, with the whole bank and its central set.

    Parameters
    ----------
    bank
        With sets over the field.
    rig
        What photographs the cases: the simulated rig that the bank was made with.
    cases
        Textured planes.
    method
        Name of the estimator.
    side_px
        Side of the square regions, developed pixels.
    observer
        Progress.

    Returns
    -------
    list of Outcome
        Its ``method`` tells the banks apart; order of the cases.
    """
    banks = {FIELD_BANK: bank, CENTRAL_BANK: central_bank(bank)}
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="workbench-bench-") as scratch:
        for done, case in enumerate(cases, start=1):
            for light, path, _ in photograph(case, rig, PRESET_SHAPES[rig.preset], ("normal",), Path(scratch)):
                image = develop_photograph(path, bank)
                path.unlink()
                labels = corner_regions(image.shape, side_px)
                for name, used in banks.items():
                    estimates, seconds = timed_estimates(image, used, labels, method, {})
                    outcomes += [
                        outcome_of(
                            estimate, method=name, texture=case.texture, size=str(side_px), light=light,
                            true_mm=case.true_mm, seconds=seconds, on_grid=case.on_grid, pixels=side_px**2,
                        )
                        for estimate in estimates.values()
                    ]  # fmt: skip
            observer(Step(f"{case.texture} at {case.true_mm / 10:.0f} cm", done, len(cases), None))
    return outcomes


def corner_regions(shape: tuple[int, int], side_px: int) -> NDArray[np.int32]:
    """Label image (H, W) with four squares 1 to 4, their middles at :data:`OFF_AXIS` of the half frame each way."""
    labels = np.zeros(shape, np.int32)
    for label, (down, across) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1)), start=1):
        top = round(shape[0] / 2 * (1 + OFF_AXIS * down) - side_px / 2)
        left = round(shape[1] / 2 * (1 + OFF_AXIS * across) - side_px / 2)
        top, left = (min(max(v, 0), n - side_px) for v, n in zip((top, left), shape, strict=True))
        labels[top : top + side_px, left : left + side_px] = label
    return labels
