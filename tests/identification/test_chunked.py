"""A table in parts gives what the whole table gives, in bounded memory."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from support.calibration import GEOMETRY, cell_of, measured, planar_chain, table_at
from support.cells import random_poses
from support.parts import (
    CASES,
    SIGMA,
    arm,
    faulty_of,
    positions,
    solved,
)

from elastocal.cell.arm_description import Nominal
from elastocal.errors import ElastocalError
from elastocal.identification import outliers, solve
from elastocal.identification import weighted_problem as chunked
from elastocal.identification import weighted_problem as partition
from elastocal.identification.linear_solver import solve_weighted
from elastocal.identification.outliers import describe
from elastocal.identification.residuals import held_out_by_parts, held_out_residual
from elastocal.identification.solve import residual_sigma
from elastocal.identification.weighted_problem import Weights
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe

UNIT = Weights("none", None, False, "")


@pytest.fixture
def in_parts(monkeypatch):
    """Called, makes every table large, its parts tiny, and samples smaller than the table."""

    def switch(numbers=1500, sample=60):
        monkeypatch.setattr(partition, "LARGE", 0)
        monkeypatch.setattr(partition, "PART", numbers)
        monkeypatch.setattr(solve, "SAMPLE", sample)
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


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
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


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_many_readings_on_their_triangle_equal_the_exact_solver(case, monkeypatch):
    whole = solved(*case())
    monkeypatch.setattr(partition, "MANY", 0)
    reduced = solved(*case())
    assert not reduced.problem.large and len(reduced.problem.parts.spans) == 1
    assert_same_estimates(reduced, whole)
    np.testing.assert_allclose(
        reduced.heldout, whole.heldout, atol=1e-5 * np.abs(whole.heldout).max()
    )


def test_the_last_evaluation_leaves_the_triangle_of_all_columns_to_choose_from(in_parts):
    """It is that of another pass at the fitted values, and the fit's own is a part of it.

    Where rounding lets the last step be taken back it is not there, and another pass is made."""
    in_parts()
    left = []
    for case in CASES[:3]:
        solution = solved(*case())
        problem, fitted = solution.problem, solution.fit
        assert len(fitted.columns) < len(problem.free)
        again, own = (
            chunked.evaluate(problem.model, problem.parts, fitted.x, columns).r_factor
            for columns in (problem.free, fitted.columns)
        )
        left.append(fitted.wide is not None)
        for one, other in ((fitted.wide or again, again), (fitted.r_factor, own)):
            scale = np.linalg.norm(other.augmented, axis=0)
            scale[scale == 0] = 1.0
            found, expected = (
                t.augmented.T @ t.augmented / np.outer(scale, scale) for t in (one, other)
            )
            np.testing.assert_allclose(found, expected, atol=1e-12)
    assert any(left)


def test_what_is_dropped_of_base_or_marker_is_placed_to_the_last_digit(in_parts):
    """Where joint 1 stands still the marker's way out of the plane is the base's as well.  It is
    held for good where placing ends, on an arm whose joints are off by 30 mrad; a placing that
    ends where the choice of parameters may begin leaves 7e-11 m."""
    model, plan, truth, rng = arm(("base_frame", "marker_position", "joint_offset"), 12, 120)
    truth[[p.effect == "joint_offset" for p in model.parameters]] *= 30
    plan.q[:, 0] = 0.3
    table = measured(model, plan, truth, SIGMA, rng)
    whole = solved(model, table)
    held = whole.reduction.dropped[solve.is_placed(model)[whole.reduction.dropped]]
    assert len(held)
    in_parts()
    parts = solved(model, table)
    assert_same_estimates(parts, whole)
    np.testing.assert_allclose(parts.fit.x[held], whole.fit.x[held], rtol=0, atol=3e-11)


def test_a_covariance_that_links_configurations_keeps_them_together(in_parts):
    """Neighbouring observations are correlated in runs of five, across configurations."""
    model, plan, truth, rng = arm(GEOMETRY, 7)
    table = measured(model, plan, truth, SIGMA, rng)
    run = np.exp(-np.abs(np.subtract.outer(np.arange(15), np.arange(15))) / 4)
    covariance = SIGMA**2 * np.kron(np.eye(12), run)
    whole = solved(model, table, covariance=covariance)
    in_parts()
    parts = solved(model, table, covariance=covariance)
    assert len(parts.problem.parts.spans) > 3
    assert_same_estimates(parts, whole)


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


@pytest.mark.parametrize("configurations", [120, 40])
def test_bounds_spare_b_and_change_no_verdict(configurations, in_parts, monkeypatch):
    """Readings by themselves and three to a configuration: some are looked at, all judged alike."""
    model, plan, truth, rng = arm(GEOMETRY, 8, 120)
    table = measured(model, plan, truth, SIGMA, rng)
    table = replace(table, configuration=np.arange(120) * configurations // 120)
    table.position[::20] += rng.uniform(-5e-4, 5e-4, (6, 3))
    in_parts(3000, 70)
    solution = solved(model, table)
    looked = []

    def counted(parts, chosen, work):
        looked.append(int(chosen.sum()))
        return partition.of_some(parts, chosen, work)

    monkeypatch.setattr(outliers, "of_some", counted)
    every = np.ones(120, dtype=bool)
    few = every.copy()
    few[60:] = False
    few[::20] = False
    for good in (every, few):
        least = outliers.judge(solution, solution, good)
        spared, looked[:] = looked[-1], []
        with monkeypatch.context() as all_of_them:
            unknown = np.full(120, np.inf), np.empty(120)
            all_of_them.setattr(outliers, "_at_most", lambda *_, told=unknown: told)
            expected = outliers.judge(solution, solution, good)
        assert spared < looked[-1] == 120
        assert 0 < expected[0].sum() < 60 and np.array_equal(least[0], expected[0])
        assert least[1] == pytest.approx(expected[1], rel=1e-9)


def test_a_bounded_fit_in_parts_is_the_constrained_minimum(in_parts):
    """Two true compliances are zero.  Nowhere outside the bounds, never above the sum of squares
    that the interior-point fit of the whole table reaches (it stops 1e-10 rad/(N m) short of a
    bound), and the free minimum where that is inside."""
    chain = planar_chain(4)
    cell = cell_of(("joint_compliance",), nominal=Nominal(joint_compliance=(1e-5,) * 4))
    model = Model.assembled(chain, cell)
    truth = np.array([1e-5, 0.0, 1e-5, 0.0])
    plan = table_at(random_poses(chain, 60, 3), [[0, 0, 0], [80, 40, -200]])
    tables = [measured(model, plan, truth, SIGMA, np.random.default_rng(k)) for k in range(3)]
    free = [solved(model, table).fit for table in tables]
    whole = [solved(model, table, bounded=True).fit for table in tables]
    in_parts()
    parts = [solved(model, table, bounded=True).fit for table in tables]
    inside = [bool((f.x >= 0).all()) for f in free]
    assert True in inside and False in inside
    for f, w, p, free_is_inside in zip(free, whole, parts, inside, strict=True):
        assert (p.x >= 0).all() and (p.x == 0).any() != free_is_inside
        assert p.residual @ p.residual <= w.residual @ w.residual * (1 + 1e-12)
        if free_is_inside:
            np.testing.assert_allclose(p.x, f.x, rtol=1e-6)


@pytest.mark.parametrize("configurations", [1, 2, 7])
def test_held_out_where_a_configuration_is_larger_than_a_part(configurations, in_parts):
    """60 readings in a few configurations, parts of five; one alone has no held-out residual."""
    model, table = positions()
    code = np.random.default_rng(0).integers(0, configurations, len(table))
    observed = observe(replace(table, configuration=code), "position")
    x, columns = model.nominal, np.array([0, 1, 2, 6, 7])
    at = model.regressor(observed.table, x, columns, observed)
    step = solve_weighted(at.B, at.residual).x
    whole = held_out_residual(at.B, at.residual - at.B @ step, UNIT, code, 3)
    in_parts(15 * len(model.parameters))
    parts = partition.partition(observed, UNIT, len(model.parameters))
    assert max(len(group) for group in parts.groups) > 1
    r_factor = chunked.evaluate(model, parts, x, columns).r_factor
    held = held_out_by_parts(model, parts, x, columns, r_factor, step)
    assert np.isinf(whole).all() == (configurations == 1)
    np.testing.assert_allclose(held, whole, rtol=1e-9, atol=1e-12)


# --- passes ---------------------------------------------------------------------------------


def test_results_come_in_order_and_failures_come_out():
    assert list(chunked.in_order(range(50), lambda k: k * k)) == [k * k for k in range(50)]

    def refuse(k):
        if k == 7:
            raise ElastocalError("seven")
        return k

    with pytest.raises(ElastocalError, match="seven"):
        list(chunked.in_order(range(50), refuse))


@pytest.mark.parametrize("workers", [1, 3])
def test_the_number_of_workers_changes_no_bit(workers, in_parts, monkeypatch):
    model, table = positions()
    in_parts()
    parts = partition.partition(observe(table, "position"), UNIT, len(model.parameters))
    columns = np.arange(len(model.parameters))
    reference = chunked.evaluate(model, parts, model.nominal, columns)
    monkeypatch.setattr(chunked, "AT_ONCE", workers)
    found = chunked.evaluate(model, parts, model.nominal, columns)
    assert np.array_equal(found.r_factor.augmented, reference.r_factor.augmented)
    assert np.array_equal(found.residual, reference.residual)


def peak_of_a_pass(model, truth, observed):
    """Largest memory traced in a pass that evaluates and in one that leaves out, in bytes."""
    parts = partition.partition(observed, UNIT, len(model.parameters))
    columns, kept = np.arange(len(model.parameters)), np.arange(6)
    tracemalloc.start()
    r_factor = chunked.evaluate(model, parts, truth, columns).r_factor.of_columns(kept)
    held_out_by_parts(model, parts, truth, kept, r_factor, np.zeros(len(kept)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_a_longer_table_takes_no_more_than_its_residual(monkeypatch):
    """Parts of 4 MB: B of the longer table is 194 MB, and both tables need the same few parts.
    What grows with the table is one residual (8 bytes a row), and the list of its parts."""
    monkeypatch.setattr(partition, "PART", 2**19)
    model, plan, truth, _ = arm(GEOMETRY, 9, 500)
    peaks, rows = [], []
    for n in (100_000, 300_000):
        many = plan.take(np.arange(n) % 500)
        observed = observe(replace(many, configuration=np.arange(n)), "position")
        assert partition.is_large(observed, len(model.parameters))
        peaks.append(peak_of_a_pass(model, truth, observed))
        rows.append(len(observed.value))
    assert peaks[1] < 8 * rows[1] * len(model.parameters) / 2
    assert peaks[1] - peaks[0] < 1.5 * 8 * (rows[1] - rows[0]) + 8 * 2**19
