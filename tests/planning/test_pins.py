"""Poses of a plan stay or are struck out, and the rest is the best around them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from support.cells import DOWN
from support.design_cells import plan_cell

import elastocal as ec
from elastocal.cell.work_cell import HalfSpace, Workspace
from elastocal.errors import InputError
from elastocal.planning.feasibility import NEARBY
from elastocal.planning.plan import Plan

CELL = plan_cell(loads=DOWN[None], poses=6, candidates=60)


@lru_cache
def first() -> Plan:
    return ec.design(CELL, effort="quick")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    first().save(tmp_path / "plan.csv")
    return tmp_path / "plan.csv"


def test_one_pose_struck_is_replaced_and_no_other_is_better(file) -> None:
    plan = ec.design(CELL, effort="quick", strike=f"{file}:3")
    assert plan.configurations == ("1", "2", "4", "5", "6", "7")
    kept = [k for k, name in enumerate(first().configurations) if name != "3"]
    assert np.allclose(plan.q[:5], first().q[kept], atol=1e-9)
    assert np.abs(plan.q[5] - first().q[2]).max() >= NEARBY
    assert first().value <= plan.value * (1 + 5e-3)
    assert 0.9 < plan.certificate.efficiency_pool <= 1
    assert plan.candidates.removed_by["struck"] >= 0
    loads = {stop.load for stop in plan.execution.stops if stop.pose == 5}
    assert loads == {0, 1}  # without and with load


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"strike": ":9"}, "no pose '9'"),
        ({"strike": ""}, "takes poses"),
        ({"keep": "", "poses": 5}, "no more than 5"),
        ({"keep": ":1", "strike": ":2"}, "kept twice"),
    ],
)
def test_what_cannot_be_is_said(file, asked, told) -> None:
    files = {k: f"{file}{v}" if k != "poses" else v for k, v in asked.items()}
    with pytest.raises(InputError, match=told):
        ec.design(CELL, effort="quick", **files)


def test_a_pose_that_breaks_a_rule_cannot_stay(file) -> None:
    low = HalfSpace("low roof", np.array([0.0, 0, 0.8]), np.array([0.0, 0, -1]))
    cell = replace(CELL, workspace=Workspace(keep_out=(low,), link_radius=(0.1,) * 6))
    with pytest.raises(InputError, match=r"pose '\d', .* breaks keep_out"):
        ec.design(cell, effort="quick", keep=file, poses=8)
