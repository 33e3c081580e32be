"""The backlash model that an arm was simulated with is the one that its readings tell."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.cells import kr270_chain
from support.diagnosis_data import FITTED, Fault, cell, measured, plan

from elastocal.diagnosis import (
    DiagnosisData,
    Item,
    OutlierScreening,
    Scan,
    SelectedEffects,
    diagnosis_data_of,
    fit_baseline,
    fit_set,
    possible,
    warnings,
    with_likelier_backlash_model,
    with_recorded_drivers,
)
from elastocal.model import Model

PLAY = Fault("backlash", "joint3", {"backlash": 3e-4})


@lru_cache
def dataset(side: str, fitted: tuple[str, ...] = FITTED, sides: bool = True) -> DiagnosisData:
    """Readings of an arm whose play rests by `side`, looked at as the diagnosis would at first."""
    chain = kr270_chain()
    table = plan(chain, 40, 3)
    table = measured(chain, cell(play_side=side), [PLAY], table, 3)
    if not sides:
        table = replace(table, approach=None)
    model = with_recorded_drivers(Model.assembled(chain, cell(fitted)), table)
    return diagnosis_data_of(fit_baseline(model, table), possible(model, table)[0])


@pytest.mark.parametrize("side", ["load", "load_and_approach"])
def test_the_readings_tell_the_backlash_model(side: str) -> None:
    first = dataset(side)
    assert first.base.model.cell.model.play_side == "load_and_approach"
    told = with_likelier_backlash_model(first)
    assert told.base.model.cell.model.play_side == side
    assert [h.label for h in told.hypotheses] == [h.label for h in first.hypotheses]


@pytest.mark.parametrize(("doubt_of_it", "told"), [(0.05, False), (0.5, True)])
def test_the_reader_is_told_that_the_law_is_open(doubt_of_it: float, told: bool) -> None:
    one = replace(with_likelier_backlash_model(dataset("load")), other_backlash=doubt_of_it)
    (play,) = [h for h in one.hypotheses if (h.name, h.where) == PLAY.key]
    plain = fit_set(one, ())
    nothing: Scan = None  # type: ignore[assignment]
    screened = OutlierScreening(one.data.faulty, one.data.faulty)
    for items, expected in (((Item(play, np.zeros(0), 0.0),), told), ((), False)):
        found = SelectedEffects(one, fit_set(one, items), (), (), plain, nothing, nothing)
        texts = [t for t in warnings(one, found, screened, plain.noise) if "play of joint3" in t]
        assert bool(texts) == expected
