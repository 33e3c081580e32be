"""Measurements already done count as what identification would make of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.cells import DOWN, TABLE_2, kr270_chain, random_poses
from support.design_cells import as_table, plan_cell, setup_of

from elastocal.cell.arm_description import PolarNoise
from elastocal.cell.work_cell import Cell
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.planning.information import Known, PoseInformation, measured, next_number
from elastocal.planning.plan import predicted
from elastocal.simulation import expand_plan, simulate

CHAIN = kr270_chain()
BOTH = np.array([[0.0, 0, 0], DOWN])
POLAR = PolarNoise(10e-6, 0.3e-6, 15e-6, 6e-6)
POSES = random_poses(CHAIN, 80, seed=1)
FEW = ("base_frame", "joint_offset", "joint_compliance", "marker_position")


def campaign(cell: Cell, q: NDArray, noise: bool = False, x: NDArray | None = None) -> Measurements:
    """The readings of poses q, each repeated, in the cell's load states."""
    model = Model.assembled(CHAIN, cell)
    table = expand_plan(as_table(q), tuple(cell.tool.markers), cell.design.repeats, DOWN)
    return simulate(model, table, model.nominal if x is None else x, 7, noise=noise)


def gathered(cell: Cell, q: NDArray, x: NDArray) -> NDArray:
    """Σ B_iᵀ Σ_i⁻¹ B_i over poses to come, in the parameters' units."""
    n = len(x)
    model = Model.assembled(CHAIN, cell)
    found = PoseInformation(model, x, np.arange(n), np.ones(n)).blocks(q)
    return np.einsum("nri,nrj->ij", found, found)


def relative(found: NDArray, expected: NDArray) -> float:
    scale = np.sqrt(np.diag(expected))
    scale[scale == 0] = 1.0
    return float(np.abs((found - expected) / np.outer(scale, scale)).max())


@pytest.mark.parametrize(
    ("observed", "repeatability", "shuffled"),
    [
        ("deflection", 0.0, True),
        ("deflection", 4e-5, True),
        ("position", 0.0, False),
        ("position", 4e-5, True),
        ("pose", 4e-5, False),
    ],
)
def test_a_campaign_tells_what_its_poses_would(
    observed: str, repeatability: float, shuffled: bool
) -> None:
    effects = ("joint_compliance",) if observed == "deflection" else FEW
    cell = plan_cell(effects, observed, POLAR, loads=BOTH, repeats=3, repeatability=repeatability)
    table = campaign(cell, TABLE_2)
    if shuffled:
        table = table.take(np.random.default_rng(0).permutation(len(table)))
    done = measured(Model.assembled(CHAIN, cell), table, ())
    assert relative(done.information, gathered(cell, TABLE_2, done.x)) < 1e-6
    assert "identified" in done.note
    assert done.numbers == len(table) * {"deflection": 1.5, "position": 3, "pose": 6}[observed]


def test_the_same_campaign_again_halves_the_variances() -> None:
    cell = plan_cell(loads=DOWN[None], repeats=2)
    once = setup_of(cell, POSES)
    done = measured(once.information.model, campaign(cell, TABLE_2), ())
    twice = setup_of(cell, POSES, known=Known(done=done))
    assert twice.value(TABLE_2) == pytest.approx(once.value(TABLE_2) / 2, rel=1e-6)

    def variances(setup: Any) -> NDArray:
        M = setup.gathered(setup.information.blocks(TABLE_2))
        return np.array([p.std**2 for p in predicted(setup.information.model, setup.found, M, 270)])

    assert np.allclose(variances(twice), variances(once) / 2, rtol=1e-6)


def test_a_campaign_shows_what_no_pose_to_come_would() -> None:
    """The load once pulled from the side; a plan with a vertical load needs joint 1 no more."""
    cell = plan_cell(loads=DOWN[None])
    pulled = campaign(cell, TABLE_2)
    force = np.where(pulled.force.any(axis=1)[:, None], [0.0, 1500.0, -500.0], 0.0)
    model = Model.assembled(CHAIN, cell)
    done = measured(model, simulate(model, replace(pulled, force=force), model.nominal, 0), ())
    setup = setup_of(cell, POSES, known=Known(done=done))
    assert setup.information.names == model.names
    assert setup.warnings == ()


@pytest.mark.parametrize(
    ("labels", "number"), [(("1", "2"), 3), (("7+", "7-"), 8), (("warm-up", "12", "3b"), 13)]
)
def test_new_poses_are_numbered_after_those_measured(labels, number):
    assert next_number(labels) == number
    assert next_number(()) == 1
