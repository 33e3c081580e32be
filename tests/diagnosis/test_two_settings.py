"""Effects with several settings are searched over all of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from support.cells import kr270_chain
from support.diagnosis_data import VISIT_TIME, Fault, cell, measured, plan
from support.registered import forgotten, write_example

from elastocal.diagnosis import (
    Hypothesis,
    Item,
    diagnosis_data_of,
    fit_baseline,
    fit_set,
    grid_of,
    possible,
    refine,
)
from elastocal.diagnosis.diagnose import diagnose
from elastocal.diagnosis.hypotheses import MOST_POINTS
from elastocal.measurements import Measurements
from elastocal.model import Model, Setting
from elastocal.plugin_loader import load_plugins

FROM, TIME = 900.0, 400.0
SETTLED = Fault(
    "settling_joint", "joint3", {"settled": 3e-4},
    {"settling_from_s": FROM, "settling_time_s": TIME},
)  # fmt: skip


@pytest.fixture(scope="module")
def readings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Model, Measurements]]:
    """A joint that gave way after 900 s, and the model that does not have it."""
    folder = tmp_path_factory.mktemp("plugins")
    with forgotten():
        load_plugins(None, [str(write_example(folder, "settling_joint.py"))])
        chain, plain = kr270_chain(), cell()
        table = measured(chain, plain, [SETTLED], plan(chain, 40, 1), 1)
        yield Model.assembled(chain, plain), table


def hypothesis(model: Model, table: Measurements) -> Hypothesis:
    return next(
        h for h in possible(model, table)[0] if (h.name, h.where) == ("settling_joint", "joint3")
    )


def test_it_is_found_with_both_of_its_settings(readings) -> None:
    why = diagnose(*readings)
    assert why.verdict == "explained"
    (found,) = why.effects
    assert (found.effect, found.where) == SETTLED.key
    assert abs(found.settings["settling_from_s"] - FROM) < 6 * VISIT_TIME
    assert found.settings["settling_time_s"] == pytest.approx(TIME, rel=0.5)
    (settled,) = found.parameters
    assert abs(settled.value - 3e-4) < 4 * settled.std


def test_the_grid_holds_every_combination_and_its_prior_sums_to_one(readings) -> None:
    model, table = readings
    grid = grid_of(hypothesis(model, table), table)
    first, second = (np.unique(column) for column in grid.values.T)
    assert len(grid.values) == len(first) * len(second) == len(np.unique(grid.values, axis=0))
    assert np.exp(grid.log_prior).sum() == pytest.approx(1.0)
    assert grid.step.shape == grid.values.shape and (grid.step > 0).all()
    for k in (0, 17, len(grid.values) - 1):
        assert grid.nearest(grid.values[k] + 0.1 * grid.step[k]) == k


def test_settings_that_depend_on_each_other_are_refined_together(readings) -> None:
    """From a point of the grid to a better one than the grid has."""
    model, table = readings
    h = hypothesis(model, table)
    dataset = diagnosis_data_of(fit_baseline(model, table), [h])
    grid = dataset.grids[h.name, h.where]
    near = grid.values[grid.nearest(np.array([FROM, TIME]))]
    chosen = fit_set(dataset, (Item(h, near, 0.0),))
    refined = refine(dataset, chosen, 0)
    assert refined.score > chosen.score
    at = refined.items[0].settings
    assert at.shape == (2,) and (at != near).any()


def test_a_product_too_large_is_thinned_evenly(readings) -> None:
    model, table = readings
    orders = (
        Setting("first_order", "order", None, 0.5, 1000.0),
        Setting("second_order", "order", 121.0, 0.5, 1000.0),
    )
    grid = grid_of(replace(hypothesis(model, table), settings=orders), table)
    assert MOST_POINTS / 2 < len(grid.values) <= MOST_POINTS
    assert np.exp(grid.log_prior).sum() == pytest.approx(1.0)
    first = np.unique(grid.values[:, 0])
    assert first[0] < 3 and first[-1] > 590
    assert np.diff(first).max() < 2.5 * np.median(np.diff(first))
    assert (grid.values[:, 1] == 121.0).any()
