"""The report of a plan: its key figures, what removed candidates, harmless, whole or not at all."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from report.test_words import seen
from support.design_commands import design as design_command
from support.design_commands import everything_in, write_cell
from support.pages import Page

from elastocal.errors import InputError
from elastocal.planning.plan import PlanSize
from elastocal.report.arm_view import plan_arm
from elastocal.report.page import page_of, write_page

SCRIPT = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def page(plan: Any) -> Page:
    told = {"command": f"elastocal design {SCRIPT}", "inputs": {SCRIPT: "0" * 64}}
    text = page_of(replace(plan, curve=(PlanSize(4, 6.5, 6.1), PlanSize(8, 4.5, None))), **told)
    found = Page(text)
    found.check_harmless(text)
    assert len(text) < 6e6
    return found


def test_view_has_the_poses_of_the_plan(page: Page, plan: Any) -> None:
    (view,) = (json.loads(text) for text in page.data)
    space = plan_arm(plan).space
    assert [pose["name"] for pose in view["poses"]] == ["1", "2", "3", "4"]
    assert view["poses"][0]["names"][0] == SCRIPT
    assert not view["arrows"]
    assert view["tracker"] == [3.0, 0.0, 1.0]
    for pose, q in zip(space.poses, plan.q, strict=True):
        assert f"q1 {np.degrees(q[0]):.2f} °" in pose.about
        # Markers are as far from the flange as the cell says.
        away = np.linalg.norm(pose.markers - pose.flange[:3, 3], axis=1)
        local = np.array(list(plan.model.cell.tool.markers.values()))
        assert away == pytest.approx(np.linalg.norm(local, axis=1))


def test_a_plan_has_600_words_open_and_among_them_every_stop(plan: Any, no_figures: None) -> None:
    text = seen(page_of(plan))
    assert len(text.split()) <= 600
    assert text.count("☐") == len(plan.execution.stops) > 0


def test_writing_is_whole_or_not_at_all(plan: Any, tmp_path: Any) -> None:
    with pytest.raises(InputError, match="no such file"):
        write_page(plan, tmp_path / "r.html", inputs=[tmp_path / "missing.toml"])
    with pytest.raises(InputError, match="does not exist"):
        write_page(plan, tmp_path / "none" / "r.html")
    assert list(tmp_path.iterdir()) == []


def test_design_writes_its_report_and_checks_the_place_first(tmp_path: Any) -> None:
    cell = write_cell(tmp_path)
    for place, complaint in ((tmp_path, "is a directory"), (cell, "ends in .toml"),
                             (tmp_path / "plan.json", "ends in .json")):  # fmt: skip
        refused = design_command(cell, "--report", place)
        assert refused.exit_code == 2
        assert complaint in refused.stderr
    assert everything_in(tmp_path) == ["cell.toml"]
    result = design_command(cell, "--report", tmp_path / "plan.html")
    assert result.exit_code == 0, result.stderr
    assert f"wrote {tmp_path / 'plan.html'}" in result.stdout.replace("\n", "")
    found = Page((tmp_path / "plan.html").read_text(encoding="utf-8"))
    assert str(cell) in found.named_rows()
