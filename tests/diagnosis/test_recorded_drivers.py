"""What a table records decides how effects are driven, and the written cell says so."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from support.cells import kr270_cell, kr270_chain, random_table
from support.diagnoses import ECCENTRICITY

from elastocal.diagnosis.hypotheses import model_keys, with_recorded_drivers
from elastocal.model.manipulator import Model


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


def test_a_plan_drives_what_was_found_as_it_was_found() -> None:
    n = len(table())
    sides = np.where(np.arange(n)[:, None] % 2 == 0, 1.0, -1.0) * np.ones((n, 6))
    play = replace(ECCENTRICITY, effect="backlash")
    for keys, law in (({}, "load"), ({"play_side": "load_and_approach"}, "load_and_approach")):
        found = SimpleNamespace(effects=(play,), model_keys=keys)
        told = with_recorded_drivers(bare(), table(approach=sides), found)
        assert told.cell.model.play_side == law
