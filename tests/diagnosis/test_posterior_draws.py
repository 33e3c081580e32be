"""Errors that are expected at new poses against those that a campaign made there has."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from support import diagnosis_data
from support.cells import kr270_chain
from support.diagnosis_data import FAULTS, campaign, cell, measured

from elastocal.diagnosis import (
    Confirmation,
    DiagnosisData,
    Item,
    PosteriorDraw,
    Scan,
    SelectedEffects,
    diagnosis_data_of,
    fit_baseline,
    fit_set,
    generic_blocks,
    possible,
)
from elastocal.diagnosis.shrinkage import NOISES

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
