"""A table in parts gives what the whole table gives, in bounded memory."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.calibration import GEOMETRY, cell_of, planar_chain, table_at, true_values
from support.cells import random_poses

import elastocal as ec
from elastocal.identification import outliers, solve, weighted_problem
from elastocal.identification.least_squares import held_out_by_parts
from elastocal.identification.weighted_problem import Problem, Weights
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe

CAMPAIGN = Path(__file__).parents[1] / "golden" / "inputs" / "campaign"


def identified(model: ec.Model, table: ec.Measurements) -> ec.Calibration:
    return ec.identify(model, table, method="wls", outliers="drop")


@pytest.mark.parametrize("cell, data", [("placed", "placed"), ("deflecting", "data")])
def test_in_parts_equals_whole(cell, data, monkeypatch):
    """Positions, and deflections that share unloaded readings, with two readings off by 3 mm."""
    model = ec.Model(CAMPAIGN / f"{cell}.toml")
    table = model.read(CAMPAIGN / f"{data}.csv")
    position = table.position.copy()
    position[[5, 18]] += [[3e-3, 0, 0], [0, -3e-3, 0]]
    table = replace(table, position=position)
    whole = identified(model, table)
    monkeypatch.setattr(weighted_problem, "LARGE", 0)
    monkeypatch.setattr(weighted_problem, "PART", len(whole.residual) * len(model.names) // 6)
    for module, name in ((solve, "SAMPLE"), (solve, "MANY"), (outliers, "SAMPLE")):
        monkeypatch.setattr(module, name, 25)
    parts = identified(model, table)
    assert [o.line for o in parts.excluded] == [o.line for o in whole.excluded]
    assert len(whole.excluded) == 2
    assert parts.determined == whole.determined and parts.dof == whole.dof
    # Both stop where a step no longer lowers the cost, which leaves the placing open to 1e-4.
    std = np.sqrt(np.diag(whole.covariance))
    kept = [whole.model.names.index(name) for name in whole.determined]
    assert (np.abs(parts.x - whole.x)[kept] < 1e-4 * std).all()
    np.testing.assert_allclose(parts.covariance / np.outer(std, std),
                               whole.covariance / np.outer(std, std), atol=1e-6)  # fmt: skip
    scale = np.abs(whole.residual).max()
    np.testing.assert_allclose(parts.residual, whole.residual, atol=1e-5 * scale)
    np.testing.assert_allclose(parts.held_out, whole.held_out, atol=1e-5 * scale)
    assert parts.nominal_rms == pytest.approx(whole.nominal_rms, rel=1e-6)


def peak_of_a_pass(model, truth, observed):
    """Largest memory traced in a pass that evaluates and in one that leaves out, in bytes."""
    unit = Weights("none", None, False, "")
    columns, kept = np.arange(len(model.parameters)), np.arange(6)
    problem = Problem(model, observed, unit, truth, columns, np.ones(len(truth)))
    assert len(problem.parts) > 1
    tracemalloc.start()
    r_factor = problem.evaluate(truth, columns)[1].of_columns(kept)
    held_out_by_parts(problem, truth, kept, r_factor.half)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_a_longer_table_takes_no_more_than_its_residual(monkeypatch):
    """Parts of 4 MB: B of the longer table is 97 MB, and both tables need the same few parts.
    What grows with the table is one residual (8 bytes a row), and the list of its parts."""
    monkeypatch.setattr(weighted_problem, "PART", 2**19)
    model, rng = Model.assembled(planar_chain(4), cell_of(GEOMETRY)), np.random.default_rng(9)
    plan, truth = table_at(random_poses(model.chain, 500, 9)), true_values(model, rng)
    peaks, rows = [], []
    for n in (50_000, 150_000):
        many = plan.take(np.arange(n) % 500)
        observed = observe(replace(many, configuration=np.arange(n)), "position")
        peaks.append(peak_of_a_pass(model, truth, observed))
        rows.append(len(observed.value))
    assert peaks[1] < 8 * rows[1] * len(model.parameters) / 2
    assert peaks[1] - peaks[0] < 1.5 * 8 * (rows[1] - rows[0]) + 8 * 2**19
