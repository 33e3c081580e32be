"""Errors that are expected at new poses against those that a campaign made there has."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support import diagnosis_data
from support.cells import kr270_chain
from support.diagnosis_data import FAULTS, Fault, campaign, cell, measured, plan

from elastocal.diagnosis import (
    Confirmation,
    DiagnosisData,
    Item,
    NoiseValues,
    PosteriorDraw,
    Scan,
    SelectedEffects,
    diagnosis_data_of,
    fit_baseline,
    fit_set,
    generic_blocks,
    left_out_residual,
    possible,
    project,
    signal_of,
    squared_lengths,
)
from elastocal.diagnosis.shrinkage import DRAWN, NOISES
from elastocal.model import Model

SILENT = 1e-9


@lru_cache
def confirmation(name: str, wrong_setting: float | None = None) -> tuple[Confirmation, Item]:
    """After the fault of that name has been found, at its own constants or at another."""
    model, table = campaign(name)
    base = fit_baseline(model, table)
    dataset = diagnosis_data_of(base, possible(model, table)[0])
    fault = FAULTS[name]
    (h,) = (h for h in dataset.hypotheses if (h.name, h.where) == fault.key)
    values = [fault.settings[s.key] for s in h.settings]
    item = Item(h, np.array(values if wrong_setting is None else [wrong_setting]), 0.0)
    found = _found(dataset, (item,))
    return Confirmation.of(found, base, np.random.default_rng(3)), item


def _found(dataset: DiagnosisData, items: tuple[Item, ...]) -> SelectedEffects:
    """Only what the confirmation reads of it."""
    nothing: Scan = None  # type: ignore[assignment]
    plain, chosen = fit_set(dataset, ()), fit_set(dataset, items)
    return SelectedEffects(dataset, chosen, (), (), plain, nothing, nothing)


def rms(rows: np.ndarray) -> float:
    return float(np.sqrt((rows**2).sum(axis=1).mean()))


def of_one(found: Confirmation, item: Item) -> PosteriorDraw:
    return found.posterior_draws(0, ((item, 1.0),))[0]


@pytest.mark.parametrize("name", ["encoder_scale:joint3", "payload_error:load"])
def test_the_errors_expected_are_those_of_fresh_readings(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before: the effect that the plain fit could not absorb.  After: what noise left."""
    found, item = confirmation(name)
    monkeypatch.setattr(diagnosis_data, "REPEATABILITY", 0.0)  # of the new readings
    posterior_draw = of_one(found, item)
    new = found.observed.table
    plain = cell(sigma=SILENT)
    readings = measured(kr270_chain(), plain, [FAULTS[name]], new, 1).position.ravel()
    before, after = (
        rms((fit.model.predict(new, fit.x) - readings).reshape(-1, 3))
        for fit in (found.plain, found.fitted)
    )
    spread = float(np.sqrt((posterior_draw.spread**2).sum(axis=(1, 2)).mean()))
    assert np.hypot(rms(posterior_draw.before), spread) == pytest.approx(before, rel=0.1)
    # One campaign's few dozen fitted numbers make its error, which scatters by a third.
    assert 0.6 < after / np.hypot(rms(posterior_draw.after), spread) < 1.6
    assert after < 0.5 * before


def test_a_constant_that_is_not_known_well_widens_what_is_possible() -> None:
    found, item = confirmation("gear_ripple:joint5")
    posterior_draw = of_one(found, item)
    known = len(found.fitted.x)
    assert posterior_draw.spread.shape[2] == known + 1
    column = found._by_constant(found.fitted, [item], item)[1]
    assert rms(column.reshape(-1, 3)) > 0


@pytest.mark.parametrize("bound", [0.5, 1000.0])
def test_a_constant_at_its_bound_has_the_slope_of_one_beside_it(bound: float) -> None:
    """The search may end there, and no model can be written beyond it."""
    found, item = confirmation("gear_ripple:joint5")
    known = {p.name: k for k, p in enumerate(found.fitted.model.parameters)}
    base = replace(found.fitted, x=found.fitted.x.copy())
    base.x[[known["joint5.ripple_sin"], known["joint5.ripple_cos"]]] = 1e-4, 5e-5
    inside = bound + (1e-4 if bound < 1 else -1e-4)
    at, beside = (
        found._by_constant(base, [one], one)[0]
        for one in (replace(item, settings=np.array([v])) for v in (bound, inside))
    )
    assert rms(at - beside) < 0.05 * rms(beside)


def test_a_change_time_has_no_slope() -> None:
    found, item = confirmation("encoder_jump:joint4")
    assert of_one(found, item).spread.shape[2] == len(found.fitted.x)


def test_a_large_effect_is_not_held_to_be_smaller_than_it_was_found() -> None:
    """A stiff spring, dozens of times the size that a first guess gives: what may be true must
    lie about the fit, and not between it and nothing."""
    stiff = Fault("gravity_compensator", "joint2", {"compensator_stiffness": 2e5})
    chain, plain = kr270_chain(), cell(sigma=5e-5)
    table = measured(chain, plain, [stiff], plan(chain, 40, 1), 1)
    base = fit_baseline(Model.assembled(chain, plain), table)
    dataset = diagnosis_data_of(
        base, [h for h in possible(base.model, table)[0] if h.name == stiff.effect]
    )
    item = Item(dataset.hypotheses[0], np.zeros(0), 0.0)
    found = Confirmation.of(_found(dataset, (item,)), base, np.random.default_rng(3))
    posterior_draw = of_one(found, item)
    assert found.chosen.scales[0] > 1
    moved = np.linalg.norm(posterior_draw.spread, axis=2)
    assert rms(posterior_draw.after) < 0.3 * float(np.sqrt((moved**2).sum(axis=1).mean()))


def test_readings_are_numbered_by_fresh_pose() -> None:
    found, item = confirmation("encoder_scale:joint3")
    posterior_draw = of_one(found, item)
    assert len(np.unique(posterior_draw.pose)) == DRAWN
    assert (
        posterior_draw.before.shape == posterior_draw.after.shape == posterior_draw.spread.shape[:2]
    )


def test_a_rival_is_held_for_true_as_often_as_it_is_probable() -> None:
    """Unlikely ones and blocks without a name never are; the settings share the item's."""
    found, item = confirmation("encoder_scale:joint3")
    others = {(h.name, h.where): h for h in found.dataset.hypotheses}
    rival = Item(others["gear_eccentricity", "joint4"], np.zeros(0), 0.0)
    block = Item(generic_blocks(found.dataset)[0], np.zeros(0), 0.0)
    posterior_draws = found.posterior_draws(
        0, ((item, 0.7), (rival, 0.2), (block, 0.1), (rival, 1e-4))
    )
    shares = [t.probability for t in posterior_draws]
    assert shares == pytest.approx([0.07] * NOISES + [0.02] * NOISES)
    # If the rival were true the model with the item in it would be wrong.
    assert rms(posterior_draws[-1].after) > 3 * rms(posterior_draws[0].after)


def test_what_has_no_name_is_as_large_as_what_it_stands_for() -> None:
    found, item = confirmation("encoder_scale:joint3")
    assert found.unnamed == 0.0
    (block,) = (
        b
        for b in generic_blocks(found.dataset)
        if (b.covariate, b.where) == ("joint3 angle", "joint3")
    )
    noise = NoiseValues.usual(6)
    only = fit_set(found.dataset, (Item(block, np.zeros(0), 0.0),), noise)
    unnamed = replace(found, chosen=only).unnamed
    named = fit_set(found.dataset, (item,), noise)
    data = replace(found.dataset.data, r=signal_of(found.dataset, named, 0))
    error = left_out_residual(project(data, noise.of_instrument()))
    squares, count = squared_lengths(data, data.masked(error))
    assert unnamed == pytest.approx(float(squares.sum() / count.sum()), rel=0.5)
