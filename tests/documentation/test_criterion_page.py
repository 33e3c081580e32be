"""The criteria that the page on criteria of one's own shows are registered, and plans use them."""

import importlib
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.design_cells import plan_cell

from elastocal.messages import InputError
from elastocal.planning.criteria import CRITERIA, register
from elastocal.planning.design import DesignOptions, design
from elastocal.report.plan_view import plan_lines

PAGE = Path(__file__).parents[2] / "docs" / "adding-a-criterion.md"
BOUNDED, USED, UNBOUNDED = re.findall(
    r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S
)
DOWN = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -2600.0]])


@pytest.fixture
def cell():
    return plan_cell(("joint_compliance", "marker_position"), "position", loads=DOWN)


@pytest.fixture
def own(monkeypatch, tmp_path):
    """A file of the user's own, imported; what it registers is forgotten afterwards."""
    before = dict(CRITERIA)
    monkeypatch.syspath_prepend(tmp_path)

    def load(name, text):
        (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
        monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        return importlib.import_module(name)

    yield load
    CRITERIA.clear()
    CRITERIA.update(before)


def test_the_worked_example_plans_with_a_certificate(own, cell, capsys):
    own("my_criterion", BOUNDED)
    names = {"cell": cell}
    exec(compile(USED, "page", "exec"), names)
    plan = names["plan"]
    std = {p.name: p.std for p in plan.predicted}
    expected = np.hypot(2 * std["joint2.compliance"], std["joint3.compliance"])
    assert plan.reported == pytest.approx(expected, rel=1e-9)
    assert 0.5 < plan.certificate.efficiency_pool <= 1
    assert capsys.readouterr().out.startswith("loaded_joints ")
    told = dict(plan_lines(plan))
    assert told["Criterion"].startswith("loaded_joints = ") and "rad/(N·m)" in told["Criterion"]


def test_the_example_without_a_bound_plans_by_exchange_alone(own, cell):
    own("own_shape", UNBOUNDED)
    asked = replace(cell.design, criterion="volume_and_axis", poses=6, candidates=60)
    plan = design(replace(cell, design=asked), DesignOptions(effort="quick"))
    assert plan.certificate.efficiency_pool is plan.bound_reported is None
    (line,) = re.findall(r"^    Certificate: (none: .*)$", PAGE.read_text("utf-8"), re.M)
    assert dict(plan_lines(plan))["Certificate"] == line
    timed = design(
        replace(cell, design=replace(asked, minutes=40.0)), DesignOptions(effort="quick")
    )
    assert timed.timed and timed.bound_reported is None and timed.execution.total <= 2400


def test_the_same_file_again_replaces_its_criterion_and_another_may_not_take_its_name(own):
    first = own("my_criterion", BOUNDED)
    again = importlib.reload(first)
    assert CRITERIA["loaded_joints"] is again.LoadedJoints
    with pytest.raises(InputError, match="'loaded_joints' is taken by LoadedJoints"):
        own("other", BOUNDED.replace("class LoadedJoints", "class Another"))
    assert register(again.LoadedJoints) is again.LoadedJoints
