"""The information of planned poses is what identification would find in their readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import DOWN, TABLE_2, kr270_cell, kr270_chain

from elastocal.cell.arm_description import CartesianNoise, PolarNoise, Tracker, Unsteadiness
from elastocal.cell.plan_wishes import DesignSpec
from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.information import PoseInformation, pose_covariance
from elastocal.simulation import expand_plan, simulate

POLAR = PolarNoise(10e-6, 0.3e-6, 15e-6, 6e-6)
AXIS = CartesianNoise(np.array([10e-6, 15e-6, 20e-6]))
GEOMETRY = ("base_frame", "joint_offset", "joint_compliance", "marker_position")


def cell_for(observe_: str, noise: object, **design: object) -> Cell:
    effects = ("joint_compliance",) if observe_ == "deflection" else GEOMETRY
    cell = kr270_cell(effects, observe_)
    tracker = Tracker(np.array([3.0, -2.0, 0.5]), noise)
    return replace(cell, tracker=tracker, design=DesignSpec(**design))


def information_of(cell: Cell, x: np.ndarray | None = None) -> PoseInformation:
    model = Model.assembled(kr270_chain(), cell)
    x = model.nominal if x is None else x
    n = len(model.parameters)
    return PoseInformation(model, x, np.arange(n), np.ones(n))


def gathered(information: PoseInformation, q: np.ndarray) -> np.ndarray:
    B = information.blocks(q).reshape(-1, len(information.columns))
    return B.T @ B


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    scale = np.sqrt(np.diag(expected))
    scale[scale == 0] = 1.0
    return float(np.abs((found - expected) / np.outer(scale, scale)).max())


def _plan(information: PoseInformation):
    rows = information.rows(TABLE_2)
    first = np.unique(rows.configuration, return_index=True)[1]
    return replace(rows.take(first), force=np.zeros((len(first), 3)), sigma=None)


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        (cell_for("deflection", AXIS, loads=np.zeros((1, 3))), "needs a load"),
        (cell_for("position", AXIS, marker_sigma={"M1": 1e-5}), "no σ for marker"),
    ],
)
def test_what_a_plan_needs_to_know_is_asked_for(cell: Cell, said: str) -> None:
    with pytest.raises(InputError, match=said):
        information_of(cell).blocks(TABLE_2)


@pytest.mark.parametrize("own", [0.0, 60e-6])
@pytest.mark.parametrize("observed", ["position", "deflection"])
def test_joints_and_configurations_scatter_readings_as_planned(observed: str, own: float) -> None:
    loads = np.array([[0.0, 0, 0], DOWN])
    noise = Unsteadiness(np.array([10.0, 20, 30, 100, 5, 0]) * 1e-6, configuration=own)
    cell = replace(cell_for(observed, AXIS, loads=loads), noise=noise)
    information = information_of(cell)
    model, plan = information.model, _plan(information)
    rows = expand_plan(plan, tuple(cell.tool.markers), 1, DOWN)
    planned = pose_covariance(
        model, observe(rows_read(model, rows), observed), len(plan), model.nominal
    )
    read = [observe(simulate(model, rows, model.nominal, k), observed).value for k in range(200)]
    off = np.array(read) - observe(rows_read(model, rows), observed).value
    off = off.reshape(200, len(plan), -1)
    found = np.einsum("kni,knj->nij", off, off) / 200
    ratio = np.trace(found, axis1=1, axis2=2) / np.trace(planned, axis1=1, axis2=2)
    assert abs(ratio.mean() - 1) < 0.05
    # What a joint does to the markers of a visit it does to all of them.
    assert relative(found.mean(axis=0), planned.mean(axis=0)) < 0.15


def rows_read(model: Model, rows: Measurements) -> Measurements:
    return simulate(model, rows, model.nominal, 0, noise=False)
