"""plan.csv and plan.json: read back exactly, and taken by simulate and identify."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cells import TABLE_2, kr270_chain
from support.discs import Discs
from support.files import write_campaign
from typer.testing import CliRunner

from elastocal.cell.plan_wishes import Motion
from elastocal.cli.main import app
from elastocal.errors import InputError
from elastocal.measurements import read_plan
from elastocal.planning.execution import schedule
from elastocal.planning.plan import PlanRows, plan_rows, write_plan
from elastocal.text import is_label

FORCES = np.array([[0.0, 0, 0], [0, 0, -2600.0]])
KINDS = kr270_chain().kinds
NAMES = [str(i + 1) for i in range(len(TABLE_2))]
LEVEL = np.repeat(np.arange(5), 3) + 1
LIMITS = (np.full(6, -9.0), np.full(6, 9.0))


def execution_of(q=TABLE_2, forces=FORCES, **motion):
    return schedule(q, Motion(**motion), Discs(), loads=forces, limits=LIMITS, kicks=30)


joint_values = st.floats(-6.3, 6.3) | st.sampled_from([0.0, -0.0, np.pi, 1e-12, -1e-300])
labels = st.text(st.characters(codec="utf-8"), min_size=1, max_size=12).filter(is_label)
# What is less than a micronewton is read as no load.
forces = st.just(0.0) | st.floats(1e-3, 1e5) | st.floats(-1e5, -1e-3)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_what_is_written_is_read_back(tmp_path_factory, data):
    kinds = data.draw(st.lists(st.sampled_from(["revolute", "prismatic"]), min_size=4, max_size=9))
    names = data.draw(st.lists(labels, min_size=1, max_size=8, unique=True))
    n, joints = len(names), len(kinds)
    numbers = st.lists(joint_values, min_size=n * joints, max_size=n * joints)
    q = np.array(data.draw(numbers)).reshape(n, joints)
    drawn = st.lists(forces, min_size=3 * n, max_size=3 * n)
    force = data.draw(st.none() | drawn)
    signs = st.lists(st.sampled_from([-1, 1]), min_size=n * joints, max_size=n * joints)
    approach = data.draw(st.none() | signs)
    rows = PlanRows(
        configuration=tuple(names),
        q=q,
        level=np.ones(n, dtype=int),
        order=np.arange(n) + 1,
        force=None if force is None else np.reshape(force, (n, 3)),
        approach=None if approach is None else np.reshape(approach, (n, joints)),
        notes={"note_order_2": ["x"] * n},
    )
    path = tmp_path_factory.mktemp("plan") / "plan.csv"
    write_plan(path, rows, kinds)
    plan = read_plan(path, joint_kinds=tuple(kinds))
    assert np.allclose(plan.q, q, rtol=0, atol=1e-9)
    assert [plan.configuration_labels[k] for k in plan.configuration] == names
    assert np.array_equal(plan.force, np.zeros((n, 3)) if force is None else rows.force)
    assert (
        plan.approach is None if approach is None else np.array_equal(plan.approach, rows.approach)
    )


@pytest.mark.parametrize(
    "change, message",
    [
        ({"q": np.full((2, 6), np.nan)}, "finite"),
        ({"force": np.full((2, 3), np.inf)}, "finite"),
        ({"configuration": ("a", " b")}, "cannot stand in a table"),
        ({"configuration": ("a", "a")}, "same name"),
    ],
)
def test_what_no_table_can_hold_is_refused_and_nothing_is_written(tmp_path, change, message):
    rows = {"configuration": ("a", "b"), "q": np.zeros((2, 6)), "level": np.ones(2),
            "order": np.arange(2)}  # fmt: skip
    with pytest.raises(InputError, match=message):
        write_plan(tmp_path / "plan.csv", PlanRows(**(rows | change)), KINDS)
    with pytest.raises(InputError, match="does not exist"):
        write_plan(tmp_path / "no" / "plan.csv", PlanRows(**rows), KINDS)
    assert not list(tmp_path.iterdir())


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.stderr


DEFLECTION = """
[robot]
urdf = "arm.urdf"
[tool]
load_point_m = [0.2, 0.0, 0.25]
[tool.markers_m]
M1 = [0.25, 0.0, 0.05]
M2 = [-0.12, 0.22, 0.10]
[tracker]
sigma_um = 10
[model]
observe = "deflection"
effects = ["joint_compliance"]
[model.nominal]
joint_compliance = [3.5e-7, 0.287e-6, 0.416e-6, 2.786e-6, 3.483e-6, 2.074e-6]
"""


@pytest.mark.parametrize("stated", [True, False])
def test_simulate_and_identify_take_a_plan_of_deflections(tmp_path, stated):
    write_campaign(tmp_path)
    cell, plan, data = (tmp_path / name for name in ("cell.toml", "plan.csv", "data.csv"))
    cell.write_text(DEFLECTION, encoding="utf-8")
    rows = plan_rows(execution_of(), NAMES, LEVEL, FORCES if stated else None)
    write_plan(plan, rows, KINDS)
    load = () if stated else ("--load", "0", "0", "-2600")
    run(
        "simulate",
        cell,
        plan,
        "-o",
        data,
        "--set",
        "joint3.compliance=5e-7",
        "--repeats",
        "2",
        *load,
    )
    assert len(data.read_text().splitlines()) == 1 + 15 * 2 * 2 * 2
    run("identify", cell, data, "-o", tmp_path / "result.json", "-q")
    result = json.loads((tmp_path / "result.json").read_text())
    found = {p["name"]: p["value"] for p in result["parameters"]}
    assert found["joint3.compliance"] == pytest.approx(5e-7, rel=0.02)
