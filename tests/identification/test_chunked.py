"""A table in parts gives what the whole table gives, in bounded memory."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from support.calibration import GEOMETRY, measured
from support.parts import CASES, SIGMA, arm, faulty_of, solved

from elastocal.identification import outliers, solve
from elastocal.identification import weighted_problem as chunked
from elastocal.identification import weighted_problem as partition
from elastocal.identification.outliers import describe
from elastocal.identification.residuals import held_out_by_parts
from elastocal.identification.solve import residual_sigma
from elastocal.identification.weighted_problem import Weights
from elastocal.model.observations import observe

UNIT = Weights("none", None, False, "")


@pytest.fixture
def in_parts(monkeypatch):
    """Called, makes every table large, its parts tiny, and samples smaller than the table."""

    def switch(numbers=1500, sample=60):
        monkeypatch.setattr(partition, "LARGE", 0)
        monkeypatch.setattr(partition, "PART", numbers)
        monkeypatch.setattr(solve, "SAMPLE", sample)
        monkeypatch.setattr(solve, "MANY", sample)
        monkeypatch.setattr(outliers, "SAMPLE", sample)

    return switch


# --- identification -------------------------------------------------------------------------


def covariance_of(solution):
    n_kept = len(solution.reduction.kept)
    return residual_sigma(solution.fit, n_kept) ** 2 * solution.fit.cofactor()


def assert_same_estimates(parts, whole):
    """Both stop where a step no longer lowers the cost: 1e-4 of a standard deviation is what the
    placing of base and markers leaves open; the fit itself agrees far closer."""
    kept = whole.reduction.kept
    assert np.array_equal(parts.reduction.kept, kept)
    assert parts.fit.converged and whole.fit.converged
    covariance = covariance_of(whole)
    std = np.sqrt(np.diag(covariance))
    assert (np.abs(parts.fit.x - whole.fit.x)[kept] < 1e-4 * std).all()
    np.testing.assert_allclose(covariance_of(parts) / np.outer(std, std),
                               covariance / np.outer(std, std), atol=1e-6)  # fmt: skip


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=pytest.mark.long if "distances" in c.__name__ else ()) for c in CASES],
    ids=lambda case: case.__name__,
)
def test_in_parts_equals_whole(case, in_parts):
    model, table = case()
    whole = solved(model, table)
    accused = faulty_of(whole)[0]
    in_parts(len(whole.heldout) * len(model.parameters) // 6)
    parts = solved(model, table)
    assert len(parts.problem.parts.spans) > 5
    assert_same_estimates(parts, whole)
    scale = np.abs(whole.fit.residual).max()
    np.testing.assert_allclose(parts.fit.residual, whole.fit.residual, atol=1e-5 * scale)
    np.testing.assert_allclose(parts.heldout, whole.heldout, atol=1e-5 * scale)
    assert parts.nominal_rms == pytest.approx(whole.nominal_rms, rel=1e-6)
    assert np.array_equal(faulty_of(parts)[0], accused)


def test_faulty_readings_are_found_in_parts_too(in_parts):
    """A tenth of the readings off by 1 to 100 mm, as many in the sample as elsewhere."""
    model, plan, truth, rng = arm(GEOMETRY, 8, 120)
    table = measured(model, plan, truth, SIGMA, rng)
    bad = np.sort(rng.permutation(120)[:12])
    table.position[bad] += rng.choice([-1, 1], (12, 3)) * rng.uniform(1e-3, 0.1, (12, 3))
    solution = solved(model, table)
    expected = faulty_of(solution)
    in_parts(3000, 70)
    found = faulty_of(solved(model, table))
    assert np.flatnonzero(expected[0]).tolist() == np.flatnonzero(found[0]).tolist() == bad.tolist()
    one, other = (describe(solution, fitted, faulty) for faulty, fitted in (found, expected))
    np.testing.assert_allclose([o.ratio for o in one], [o.ratio for o in other], rtol=0.01)
    np.testing.assert_allclose([o.residual for o in one], [o.residual for o in other], rtol=0.01)


# --- passes ---------------------------------------------------------------------------------


def peak_of_a_pass(model, truth, observed):
    """Largest memory traced in a pass that evaluates and in one that leaves out, in bytes."""
    parts = partition.partition(observed, UNIT, len(model.parameters))
    columns, kept = np.arange(len(model.parameters)), np.arange(6)
    tracemalloc.start()
    r_factor = chunked.evaluate(model, parts, truth, columns).r_factor.of_columns(kept)
    held_out_by_parts(model, parts, truth, kept, r_factor.half)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_a_longer_table_takes_no_more_than_its_residual(monkeypatch):
    """Parts of 4 MB: B of the longer table is 97 MB, and both tables need the same few parts.
    What grows with the table is one residual (8 bytes a row), and the list of its parts."""
    monkeypatch.setattr(partition, "PART", 2**19)
    model, plan, truth, _ = arm(GEOMETRY, 9, 500)
    peaks, rows = [], []
    for n in (50_000, 150_000):
        many = plan.take(np.arange(n) % 500)
        observed = observe(replace(many, configuration=np.arange(n)), "position")
        assert partition.is_large(observed, len(model.parameters))
        peaks.append(peak_of_a_pass(model, truth, observed))
        rows.append(len(observed.value))
    assert peaks[1] < 8 * rows[1] * len(model.parameters) / 2
    assert peaks[1] - peaks[0] < 1.5 * 8 * (rows[1] - rows[0]) + 8 * 2**19
