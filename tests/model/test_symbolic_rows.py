"""One configuration's B as an expression of q is the model's own B."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.cells import (
    COMPLIANCE,
    DOWN,
    SLANTED,
    kr270_cell,
    kr270_chain,
    random_poses,
    table_of,
)

from elastocal.cell.arm_description import Nominal
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.model.symbolic import SymbolicArm, configuration_rows
from elastocal.units import Array

GEOMETRY = ("base_frame", "joint_offset", "link_geometry", "marker_position")
BASE = Nominal(COMPLIANCE, np.array([0.4, -2.0, 0.3]), np.eye(3)[[1, 2, 0]])


def model_of(effects: tuple[str, ...], observe: str, **options: Any) -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(effects, observe, **options))


def both(model: Model, table: Measurements, x: Array, steps: int = 2) -> tuple[Array, Array]:
    """B of the table's single configuration: as an expression, and as the model has it."""
    columns = np.arange(len(model.names))
    rows, _ = configuration_rows(SymbolicArm(model.chain, model.cell), table, columns, steps)
    return rows(table.q[0], x).full(), model.regressor(table, x).B


def somewhere(model: Model, seed: int) -> Array:
    """Parameter values near the nominal ones, with compliances positive."""
    rng = np.random.default_rng(seed)
    x = model.nominal
    return np.where(x == 0, 1e-3 * rng.normal(size=len(x)), x * rng.uniform(0.8, 1.2, len(x)))


@pytest.mark.parametrize(
    ("effects", "observe", "options"),
    [
        (GEOMETRY, "position", {"nominal": BASE}),
        (("joint_compliance",), "deflection", {"deflection_model": "linear"}),
        ((*GEOMETRY, "joint_compliance"), "position", {"deflection_model": "linear"}),
        (("distance_sensor", "joint_offset", "marker_position"), "distance", {}),
    ],
)
def test_explicit_models_agree_to_rounding(
    effects: tuple[str, ...], observe: str, options: dict[str, Any]
) -> None:
    model = model_of(effects, observe, **options)
    q = random_poses(model.chain, 1, 0)
    table = replace(table_of(q, SLANTED, both=True), distance=np.ones(6))
    symbolic, reference = both(model, table, somewhere(model, 0))
    assert np.abs(symbolic - reference).max() <= 1e-12 * np.abs(reference).max()


def test_adjoint_is_the_slope_of_the_weighted_sum() -> None:
    model = model_of((*GEOMETRY, "joint_compliance"), "position")
    table = table_of(random_poses(model.chain, 1, 6), DOWN, both=True)
    columns = np.arange(len(model.names))
    rows, adjoint = configuration_rows(SymbolicArm(model.chain, model.cell), table, columns)
    W = np.random.default_rng(6).normal(size=rows.size_out(0))
    q, h = table.q[0], 1e-5
    slopes = [
        (W * (rows(q + step, model.nominal) - rows(q - step, model.nominal))).full().sum() / (2 * h)
        for step in h * np.eye(len(q))
    ]
    found = adjoint(q, model.nominal, W).full().ravel()
    np.testing.assert_allclose(found, slopes, rtol=1e-6, atol=1e-6 * np.abs(slopes).max())
