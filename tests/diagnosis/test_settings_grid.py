"""Grids of searched constants: nothing of what they stand for falls between their points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import kr270_chain
from support.diagnosis_data import campaign

from elastocal.diagnosis.hypotheses import Hypothesis, SettingsGrid, grid_of, possible
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model


@pytest.fixture(scope="module")
def visits() -> Measurements:
    return campaign()[1].take(np.arange(0, 240, 3))


def hypothesis(name: str, where: str, model: Model | None = None) -> Hypothesis:
    model, table = (model or campaign()[0]), campaign()[1]
    return next(h for h in possible(model, table)[0] if (h.name, h.where) == (name, where))


def ripple(orders: tuple[float, ...], q: np.ndarray, visits: Measurements) -> SettingsGrid:
    plain = campaign()[0]
    spec = replace(plain.cell.model, gear_ripple_orders=orders)
    model = Model.assembled(kr270_chain(), replace(plain.cell, model=spec))
    at = visits.q.copy()
    at[:, 3] = q
    return grid_of(hypothesis("gear_ripple", "joint4", model), replace(visits, q=at))


def test_the_prior_of_every_search_sums_to_one(visits) -> None:
    model, table = campaign()
    searched = set()
    for h in possible(model, table)[0]:
        grid = grid_of(h, visits)
        assert np.exp(grid.log_prior).sum() == pytest.approx(1.0)
        assert grid.values.shape == (len(grid.log_prior), len(h.settings)) == grid.step.shape
        searched |= {s.kind for s in h.settings}
    assert searched == {"order", "change_time", "time_constant"}


@pytest.mark.parametrize("spread", [0.5, 2.0, 6.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_ripple_of_any_order_keeps_nine_tenths_of_its_size_on_the_grid(
    seed: int, spread: float, visits
) -> None:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-spread / 2, spread / 2, len(visits))
    orders = ripple((), q, visits).values[:, 0]
    for order in rng.uniform(2.5, 590, 30):
        wave = np.sin(order * q + rng.uniform(0, 2 * np.pi))
        near = orders[np.argsort(np.abs(orders - order))[:2]]
        kept = []
        for n in near:
            A = np.column_stack([np.sin(n * q), np.cos(n * q)])
            kept.append(np.linalg.norm(A @ np.linalg.lstsq(A, wave)[0]) / np.linalg.norm(wave))
        assert max(kept) > 0.9
