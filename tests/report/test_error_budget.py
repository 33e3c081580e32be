"""The gap budget of an identification: from the nominal arm down to what the fit leaves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from elastocal.identification import error_budget as module
from elastocal.identification.error_budget import gap_budget
from elastocal.report.identification_view import NOMINAL, budget_steps


def test_budget_goes_from_the_nominal_arm_to_the_held_out_error(case: Any) -> None:
    budget = gap_budget(case.result)
    assert budget is not None
    assert [step.step for step in budget.steps] == ["nominal_arm", "geometry", "compliance"]
    first, middle, last = (step.heldout_rms for step in budget.steps)
    # The nominal arm of the result has base and markers placed by all readings; here the
    # configuration in question is left out, and the name says so.
    named = [name for name, *_ in budget_steps(case.result, budget)[0]]
    assert named == ["nominal arm, held out", "geometry", "compliance"]
    assert named[0] != NOMINAL
    assert first == pytest.approx(case.result.nominal_rms, rel=0.5)
    assert first > 3 * middle
    # The true compliances are the nominal ones: to fit them costs a little and buys nothing.
    assert middle == pytest.approx(last, rel=0.1) and middle < last
    assert last == pytest.approx(case.result.heldout_rms)
    for step in budget.steps:
        assert step.ci95[0] < step.heldout_rms < step.ci95[1]


def test_floor_is_the_scatter_of_repeats_where_there_are_some(case: Any) -> None:
    """Every reading twice, moved apart by ± d: the scatter of a pair is √2 d per coordinate."""
    observed, d = case.result.observations, 7e-6
    rows = np.repeat(np.arange(len(observed.table)), 2)
    twice = replace(observed, table=observed.table.take(rows), lead=np.arange(len(rows)))
    apart = np.tile([d, -d], len(rows) // 2)[:, None]
    residual = (np.zeros((len(rows), 3)) + apart).ravel()
    result = replace(case.result, observations=twice, residual=residual)
    floor, name = module._floor(result)
    assert name == "repeats alone"
    assert floor == pytest.approx(np.sqrt(3 * 2) * d)
