"""The backlash model that an arm was simulated with is the one that its readings tell."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import pytest
from support.cells import kr270_chain
from support.diagnosis_data import FITTED, Fault, cell, measured, plan

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.hypotheses import possible, with_recorded_drivers
from elastocal.diagnosis.model_set import with_likelier_backlash_model
from elastocal.model.manipulator import Model

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
