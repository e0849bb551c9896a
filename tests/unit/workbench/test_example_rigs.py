"""Examples in the documentation are what they say: rigs of real devices that load and whose plans are in reach."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rigs.rig import DepthAxis
from workbench.config import load_rig_config
from workbench.devices import MANUAL_LIMITS_MM, browser_panel_settings, gphoto2_settings, grbl_settings
from workbench.planning import cost, make_plan

HOW_TO = Path(__file__).parents[3] / "docs" / "how-to"
EXAMPLES = sorted((HOW_TO / "examples").glob("*.yaml"))
RAIL_MM = (-2895.0, 0.0)
"""Machine positions of the rail that the example speaks of."""


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_loads_and_its_plan_is_in_reach(path: Path) -> None:
    config = load_rig_config(path)
    assert config.camera.kind == "gphoto2"
    assert config.panel.kind == "browser"
    assert gphoto2_settings(config.camera).model == "650D"
    assert browser_panel_settings(config.panel).require_fullscreen
    plan = make_plan(config)
    assert len(plan.depths_mm) >= 10
    assert cost(plan, config).bytes > 1e9
    depth = config.stage.depth
    limits = RAIL_MM if config.stage.kind == "grbl" else config.stage.limits_mm or MANUAL_LIMITS_MM
    near, far = DepthAxis(depth.offset_mm, depth.sign, depth.scale).depth_limits_mm(limits)
    assert near <= plan.depths_mm[0]
    assert plan.depths_mm[-1] <= far


def test_there_is_one_with_a_rail_and_one_without() -> None:
    kinds = {path.stem: load_rig_config(path).stage for path in EXAMPLES}
    assert kinds["650d-manual"].kind == "manual"
    assert grbl_settings(kinds["650d-grbl-tablet"]).port == "usb:1a86:7523"


@pytest.mark.parametrize("page", ["connect-a-camera", "connect-a-stage", "use-a-tablet-as-panel"])
def test_snippets_of_the_pages_load(page: str, tmp_path: Path) -> None:
    blocks = re.findall(r"```yaml\n(.*?)```", (HOW_TO / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    sections = [block for block in blocks if not block.startswith(" ")]
    assert sections
    for block in sections:
        (tmp_path / "rig.yaml").write_text(block)
        load_rig_config(tmp_path / "rig.yaml")
