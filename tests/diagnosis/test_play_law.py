"""The law of play that an arm was simulated with is the one that its readings tell."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import pytest
from support.cells import kr270_chain
from support.diagnosis_data import FITTED, Fault, cell, measured, plan

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.hypotheses import possible
from elastocal.diagnosis.play_law import with_likelier_play
from elastocal.diagnosis.recorded_drivers import with_recorded_drivers
from elastocal.diagnosis.scene import Scene, scene_of
from elastocal.manipulator.model import Model

PLAY = Fault("backlash", "joint3", {"backlash": 3e-4})


@lru_cache
def scene(law: str, fitted: tuple[str, ...] = FITTED, sides: bool = True) -> Scene:
    """Readings of an arm with play under `law`, looked at as the diagnosis would at first."""
    chain = kr270_chain()
    table = plan(chain, 40, 3)
    table = measured(chain, cell(play_side=law), [PLAY], table, 3)
    if not sides:
        table = replace(table, approach=None)
    model = with_recorded_drivers(Model(chain, cell(fitted)), table)
    return scene_of(fit_baseline(model, table), possible(model, table)[0])


@pytest.mark.parametrize("law", ["load", "load_and_approach"])
def test_the_readings_tell_the_law(law: str) -> None:
    first = scene(law)
    assert first.base.model.cell.model.play_side == "load_and_approach"
    told = with_likelier_play(first)
    assert told.base.model.cell.model.play_side == law
    assert [h.label for h in told.hypotheses] == [h.label for h in first.hypotheses]


def test_readings_left_out_stay_so() -> None:
    first = scene("load")
    faulty = first.data.faulty
    faulty[:3] = True
    told = with_likelier_play(first.without(faulty))
    assert told.base.model.cell.model.play_side == "load"
    assert (told.data.faulty == faulty).all()


def test_nothing_is_asked_where_no_side_is_recorded() -> None:
    first = scene("load", sides=False)
    assert with_likelier_play(first) is first


def test_play_in_the_cell_keeps_its_law() -> None:
    first = scene("load", (*FITTED, "backlash:joint2"))
    assert with_likelier_play(first) is first
