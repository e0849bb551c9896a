"""The reference page of rig.yaml names every key that there is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from workbench.config import RigConfig

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "rig-yaml.md"


def keys_of(model: type[BaseModel], before: str = "") -> set[str]:
    found: set[str] = set()
    for name, field in model.model_fields.items():
        key = before + (field.alias or name)
        kind = field.annotation
        found |= keys_of(kind, f"{key}.") if isinstance(kind, type) and issubclass(kind, BaseModel) else {key}
    return found


@pytest.mark.parametrize("section", sorted(RigConfig.model_fields))
def test_page_names_every_key_of_a_section_and_no_other(section: str) -> None:
    text = PAGE.read_text(encoding="utf-8")
    part = text.split(f"\n## {section}\n")[1].split("\n## ")[0]
    rows = [line for line in part.splitlines() if line.startswith("| `")]
    named = {key for row in rows for key in re.findall(r"`([a-z_.]+)`", row.split("|")[1])}
    kind = RigConfig.model_fields[section].annotation
    assert isinstance(kind, type)
    assert named == keys_of(kind)
