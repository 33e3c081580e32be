"""What a table records decides how effects are driven, and the written cell says so."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from support.cells import kr270_cell, kr270_chain, random_table
from support.diagnoses import ECCENTRICITY

from elastocal.diagnosis import Hypothesis, model_keys, with_recorded_drivers
from elastocal.diagnosis.hypotheses import RegressorDirection
from elastocal.identification.upright import as_placed
from elastocal.model import Model
from elastocal.model.effects import CATALOGUE


def bare(**model) -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(("base_frame",), link_gravity=True, **model))


def table(**columns):
    return replace(random_table(kr270_chain(), 6, seed=2), **columns)


def test_recorded_columns_choose_the_driver() -> None:
    n = len(table())
    sides = np.where(np.arange(n)[:, None] % 2 == 0, 1.0, -1.0) * np.ones((n, 6))
    told = with_recorded_drivers(
        bare(), table(approach=sides, temperature=20 + np.arange(n) / n, time=np.arange(n) * 60.0)
    )
    assert told.cell.model.play_side == "load_and_approach"
    assert told.cell.model.thermal_driver == "temperature"
    silent = with_recorded_drivers(bare(), table(approach=None, temperature=None))
    assert silent.cell.model.play_side == "load"
    assert silent.cell.model.thermal_driver == "time"


def test_an_effect_that_the_cell_has_keeps_its_driver() -> None:
    model = Model.assembled(kr270_chain(), kr270_cell(("backlash:joint2",), link_gravity=True))
    n = len(table())
    sides = np.where(np.arange(n)[:, None] % 2 == 0, 1.0, -1.0) * np.ones((n, 6))
    assert with_recorded_drivers(model, table(approach=sides)).cell.model.play_side == "load"


def test_keys_are_those_of_the_effects_found() -> None:
    model = bare(play_side="load_and_approach")
    play = replace(ECCENTRICITY, effect="backlash")
    assert model_keys(model, (play,)) == {"play_side": "load_and_approach"}
    assert model_keys(model, (ECCENTRICITY,)) == {}


def test_the_order_of_visits_is_a_key_of_what_rests_on_it() -> None:
    model = bare(approach="order")
    for effect in ("hysteresis", "backlash"):
        assert model_keys(model, (replace(ECCENTRICITY, effect=effect),)) == {"approach": "order"}
    assert model_keys(model, (ECCENTRICITY,)) == {}
    assert with_recorded_drivers(bare(), table()).cell.model.approach == "column"


def test_the_vertical_of_a_driven_effect_is_that_of_the_fitted_base() -> None:
    model, effect = bare(), CATALOGUE["gravity_sag"]
    spec = effect.parameters("joint1", model.chain, model.cell)
    h = Hypothesis(effect, "joint1", spec, ())
    x = model.nominal
    upright = RegressorDirection(h, model.chain, as_placed(model, x))(table(), np.zeros((1, 0)))
    x[3:6] = [0.2, 0.0, 0.0]
    tilted = RegressorDirection(h, model.chain, as_placed(model, x))(table(), np.zeros((1, 0)))
    assert np.abs(upright).max() < 1e-12 < 0.1 < np.abs(tilted).max()


def test_without_load_the_joint_lags_behind_its_last_motion() -> None:
    """Joint 1 of an upright arm bears no torque: its play is decided by the approach alone."""
    cell = kr270_cell(("backlash:joint1",), link_gravity=True, play_side="load_and_approach")
    model = Model.assembled(kr270_chain(), cell)
    plain = random_table(kr270_chain(), 4, seed=5)
    still = replace(plain, force=np.zeros_like(plain.force))
    beta = 4e-4
    reading = {}
    for side in (1.0, -1.0):
        sides = np.full_like(plain.q, side)
        reading[side] = model.predict(replace(still, approach=sides), np.array([beta]))
    turned = {}
    rigid = Model.assembled(kr270_chain(), kr270_cell((), link_gravity=True))
    for side in (1.0, -1.0):
        q = plain.q.copy()
        q[:, 0] -= side * beta / 2 * np.tanh(3.0)
        turned[side] = rigid.predict(replace(still, q=q))
    for side in (1.0, -1.0):
        np.testing.assert_allclose(reading[side], turned[side], atol=2e-8)


def test_a_plan_drives_what_was_found_as_it_was_found() -> None:
    n = len(table())
    sides = np.where(np.arange(n)[:, None] % 2 == 0, 1.0, -1.0) * np.ones((n, 6))
    play = replace(ECCENTRICITY, effect="backlash")
    for keys, law in (({}, "load"), ({"play_side": "load_and_approach"}, "load_and_approach")):
        found = SimpleNamespace(effects=(play,), model_keys=keys)
        told = with_recorded_drivers(bare(), table(approach=sides), found)
        assert told.cell.model.play_side == law
