"""The page of camera errors says what the driver does and what the operator reads, fault by fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigs.gphoto2_faults import RESPONSES, Fault

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "camera-errors.md"


def rows() -> dict[str, list[str]]:
    table = PAGE.read_text(encoding="utf-8").split("| fault, as in the journal |")[1].split("\n\n")[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    return {row[0]: row[1:] for row in cells}


def test_page_has_a_row_for_each_fault_and_no_other() -> None:
    assert list(rows()) == [str(fault) for fault in Fault]


@pytest.mark.parametrize("fault", Fault)
def test_row_says_what_the_driver_does(fault: Fault) -> None:
    how, remedies, error, message = rows()[fault]
    response = RESPONSES[fault]
    assert how
    assert remedies == ("; then ".join(response.remedies) or "–")
    assert error == f"`{response.error.__name__}`"
    assert message == response.message
