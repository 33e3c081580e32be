"""The backlash model that an arm was simulated with is the one that its readings tell."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.cells import kr270_chain
from support.diagnosis_data import FITTED, Fault, cell, measured, plan

from elastocal.diagnosis import (
    Confirmation,
    DiagnosisData,
    Item,
    ModelSet,
    OutlierScreening,
    Scan,
    SelectedEffects,
    diagnosis_data_of,
    doubt,
    fit_baseline,
    fit_set,
    possible,
    under_other_backlash_model,
    warnings,
    with_likelier_backlash_model,
    with_recorded_drivers,
)
from elastocal.diagnosis.shrinkage import NOISES
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


def test_readings_left_out_stay_so() -> None:
    first = dataset("load")
    faulty = first.data.faulty
    faulty[:3] = True
    told = with_likelier_backlash_model(first.without(faulty))
    assert told.base.model.cell.model.play_side == "load"
    assert (told.data.faulty == faulty).all()


def test_nothing_is_asked_where_no_side_is_recorded() -> None:
    first = dataset("load", sides=False)
    assert with_likelier_backlash_model(first) is first


def test_play_in_the_cell_keeps_its_law() -> None:
    first = dataset("load", (*FITTED, "backlash:joint2"))
    assert with_likelier_backlash_model(first) is first


def set_of(side: str, told: DiagnosisData) -> ModelSet:
    model = told.base.model
    if model.cell.model.play_side != side:
        model = under_other_backlash_model(model)
    under = diagnosis_data_of(replace(told.base, model=model), list(told.hypotheses))
    (play,) = [h for h in under.hypotheses if (h.name, h.where) == PLAY.key]
    return fit_set(under, (Item(play, np.zeros(0), 0.0),), told.noise)


def test_a_few_readings_in_the_dead_zone_leave_less_doubt_of_the_law() -> None:
    assert with_likelier_backlash_model(dataset("load_and_approach")).other_backlash < 0.25


def test_laws_that_say_the_same_are_as_likely() -> None:
    told = with_likelier_backlash_model(dataset("load"))
    same = set_of("load", told)
    assert doubt(same, same) == pytest.approx(0.5)


def test_one_configuration_alone_does_not_settle_the_law() -> None:
    """However far off the other model is there: it may be off for a reason of its own."""
    told = with_likelier_backlash_model(dataset("load"))
    right = set_of("load", told)
    r = right.data.r.copy()
    r[4] += 1e-3
    assert doubt(right, replace(right, data=replace(right.data, r=r))) > 0.1


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


def test_the_scatter_that_is_told_is_that_of_the_answer() -> None:
    """A sum may explain what the forward search took for noise, and the other way round."""
    one = dataset("load")
    plain, nothing = fit_set(one, ()), None
    found = SelectedEffects(one, plain, (), (), plain, nothing, nothing)  # type: ignore[arg-type]
    screened = OutlierScreening(one.data.faulty, one.data.faulty)
    for factor in (1.0, 0.5):
        told = warnings(one, found, screened, replace(plain.noise, factor=factor))
        assert any("scatter 0.5 times" in t for t in told) == (factor == 0.5)


def test_play_by_either_law_may_be_true_at_fresh_poses() -> None:
    """As probable as each model is; nothing else is drawn under another."""
    told = replace(with_likelier_backlash_model(dataset("load")), other_backlash=0.3)
    (play,) = [h for h in told.hypotheses if (h.name, h.where) == PLAY.key]
    item = Item(play, np.zeros(0), 0.0)
    plain, chosen = fit_set(told, ()), fit_set(told, (item,))
    nothing: Scan = None  # type: ignore[assignment]
    found = SelectedEffects(told, chosen, (), (), plain, nothing, nothing)
    posterior_draws = Confirmation.of(found, told.base, np.random.default_rng(1)).posterior_draws(
        0, ((item, 1.0),)
    )
    assert [t.probability for t in posterior_draws] == pytest.approx(
        [0.7 / NOISES] * NOISES + [0.3 / NOISES] * NOISES
    )
    own, other = (
        float(np.sqrt((t.after**2).mean())) for t in (posterior_draws[0], posterior_draws[-1])
    )
    assert other > 3 * own
