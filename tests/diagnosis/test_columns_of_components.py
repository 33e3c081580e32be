"""Effects that are judged together: their columns by entry and drive are those of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import COMPLIANCE, kr270_cell, kr270_chain, random_table

from elastocal.cell_tables import EffectChoice, Nominal
from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.hypotheses import Hypothesis, RegressorDirection, compute_columns
from elastocal.identification.start import as_placed
from elastocal.measurements import with_moves
from elastocal.model.effects.base import Arm
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model

FIELD = {"field_joint2_size": 1e-4, "field_time_size": 2e-4, "field_time_length": 1500.0}
SETTINGS = {
    "joint2": FIELD | {"order_1": 9.25, "order_2": 60.5, "order_sd_2": 0.1},
    "link3": FIELD,
    "base": FIELD,
    "marker:M2": FIELD,
}
TILTED = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
PLACES = [
    ("gravity_sag", "joint1"), ("gravity_sag", "joint2"), ("move_lag", "joint3"),
    ("torque_coupling", "joint2"), ("torque_tilt", "link3"), ("gear_spectrum", "joint2"),
    ("joint_curve", "joint4"), ("residual_field", "joint2"), ("residual_field", "link3"),
    ("residual_field", "base"), ("residual_field", "marker:M2"),
]  # fmt: skip


@pytest.mark.parametrize("name, where", PLACES)
def test_columns_by_entry_and_drive_are_those_of_the_model_with_the_effect(
    name: str, where: str
) -> None:
    nominal = Nominal(COMPLIANCE, base_rotation=TILTED, settings=SETTINGS)
    chain, cell = kr270_chain(), kr270_cell(["base_frame", "marker_position"], nominal=nominal)
    model, effect = Model.assembled(chain, cell), CATALOGUE[name]
    table = with_moves(random_table(chain, 12, seed=5))
    table = replace(table, position=model.predict(table).reshape(-1, 3), distance=None)
    base = fit_baseline(model, table, x0=model.nominal)
    h = Hypothesis(effect, where, effect.parameters(where, chain, cell), ())
    D = RegressorDirection(h, Arm(chain, as_placed(model, base.x)))(table, np.zeros((1, 0)))[:, 0]
    E = compute_columns(base, []).entry(h.entry_key(model))
    whole = model.with_effects((*cell.model.effects, EffectChoice(name, where)))
    own = [k for k, p in enumerate(whole.parameters) if p.effect == name]
    x = whole.nominal
    x[[k for k in range(len(x)) if k not in own]] = base.x
    B = whole.regressor(table, x).B[:, own]
    assert np.abs(B).max() > 0
    np.testing.assert_allclose((E @ D).reshape(len(B), -1), B, atol=1e-9 * np.abs(B).max())
