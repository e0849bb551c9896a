"""The reference page names every finding with every severity that the program can give it, and no other finding."""

from __future__ import annotations

import re
from pathlib import Path

import workbench.doctor

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "doctor.md"
MADE = re.compile(r'\b(PROJECT|COMPUTER|CAMERA|STAGE|PANEL)\.(ok|note|warning|error|failure)\(\s*"([a-z -]+)"')
WORD = re.compile(r"\b(ok|note|warning|error)\b")
FROM_THE_CONTROLLER = {(f"stage.{remark}", "note") for remark in ("last-alarm", "limit-switch", "motors", "warning")}


def test_every_finding_is_documented_with_its_severities() -> None:
    made = set(FROM_THE_CONTROLLER)
    for path in Path(workbench.doctor.__file__).parent.glob("*.py"):
        for subject, severity, check in MADE.findall(path.read_text()):
            made.add((f"{subject.lower()}.{check.replace(' ', '-')}", severity.replace("failure", "error")))
    documented = set()
    current = ""
    for line in PAGE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 4:
            current = cells[0].strip("`") or current
            documented |= {(current, word) for word in WORD.findall(f"{cells[1]} {cells[2]}")}
    assert {name for name, _ in made} == {name for name, _ in documented}
    assert made - documented == set()
