"""What the pages about the camera say is what the driver does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from rigs.gphoto2_faults import RESPONSES, Fault
from workbench.config import RigConfig

DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.parametrize("fault", list(Fault))
def test_page_of_errors_has_each_fault_with_its_message(fault: Fault) -> None:
    page = (DOCS / "reference" / "camera-errors.md").read_text(encoding="utf-8")
    response = RESPONSES[fault]
    (row,) = [line for line in page.splitlines() if line.startswith(f"| {fault} |")]
    assert response.message.replace("`", "'") in row
    assert response.error.__name__ in row
    assert row.split("|")[2].count(";") >= len(response.remedies) - 1


@pytest.mark.parametrize("page", ["connect-a-camera", "connect-a-stage", "use-a-tablet-as-panel"])
def test_examples_of_rig_yaml_are_valid(page: str) -> None:
    text = (DOCS / "how-to" / f"{page}.md").read_text(encoding="utf-8")
    examples = [block for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL) if not block.startswith(" ")]
    assert examples
    for example in examples:
        RigConfig.model_validate(yaml.safe_load(example))
