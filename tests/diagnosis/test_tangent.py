"""A spring whose anchor is nowhere near the example's is still found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import random_poses
from support.diagnosis_data import FAULTS, campaign, diagnosed

from elastocal.diagnosis import (
    Discrimination,
    Item,
    NoiseFloor,
    RivalSet,
    campaign_of,
    compute_columns,
    diagnosis_data_of,
    fit_baseline,
    possible,
    rows_of,
    visit_pool_of,
)

COMPENSATOR = "gravity_compensator:joint2"


@pytest.fixture(scope="module")
def remaining() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fitted columns X, the residual r, and the compensator's columns C, flat."""
    model, table = campaign(COMPENSATOR)
    base = fit_baseline(model, table)
    hypotheses = [h for h in possible(model, table)[0] if h.name == "gravity_compensator"]
    columns = compute_columns(base, hypotheses)
    C = columns.observed(columns.of(hypotheses[0])).reshape(len(base.residual), -1)
    X = model.regressor(table, base.x).B * base.sizes
    return X, base.residual, C


def left(A: np.ndarray, r: np.ndarray) -> float:
    scaled = A / np.maximum(np.abs(A).max(axis=0), 1e-30)
    return float(np.linalg.norm(r - scaled @ np.linalg.lstsq(scaled, r, rcond=1e-10)[0]))


def test_every_parameter_of_the_spring_has_a_column(remaining) -> None:
    _, _, C = remaining
    assert C.shape[1] == 5 and (np.abs(C).max(axis=0) > 0).all()


def test_the_columns_explain_a_spring_anchored_elsewhere(remaining) -> None:
    """At the example's anchor the stiffness alone hardly does; its neighbours are zero there."""
    X, r, C = remaining
    assert left(np.hstack([X, C]), r) < 0.5 * left(X, r)


def test_poses_not_measured_yet_do_not_change_what_the_data_say() -> None:
    """They have no residual: counted as zero, they would make the spring weaker, and the lengths
    of its geometry, whose columns are as large as it is stiff, more expensive."""
    model, table = campaign(COMPENSATOR)
    base = fit_baseline(model, table)
    key = ("gravity_compensator", "joint2")
    spring = [h for h in possible(model, table)[0] if (h.name, h.where) == key]
    force = np.unique(table.force, axis=0)
    late = np.linspace(1e5, 2e5, 100)
    q = random_poses(model.chain, 100, 5)
    pool = visit_pool_of(model, base.x, table, q, np.ones((100, 6)), late, force)
    noise = NoiseFloor(True, 1.0, 1.0, 2e-5, (5e-6,) * 6, 0.0, None)
    diagnosis = type("Found", (), {"noise": noise})
    whole = campaign_of(base, pool, spring, diagnosis).dataset  # type: ignore
    alone = diagnosis_data_of(base, spring)
    np.testing.assert_allclose(whole.sizes[key], alone.sizes[key], rtol=1e-9)
    here, there = (dataset.packed(spring[0], np.zeros(0)) for dataset in (alone, whole))
    same = there[: len(here), : here.shape[1]]
    size = np.abs(here).max(axis=(0, 1))
    assert (np.abs(same - here).max(axis=(0, 1)) < 1e-6 * size).all()


@pytest.fixture(scope="module")
def against_a_spring() -> Discrimination:
    """An eccentric gear of joint 2 against a spring there, with thirty candidates."""
    model, table = campaign(COMPENSATOR)
    base = fit_baseline(model, table)
    keys = [("gear_eccentricity", "joint2"), ("gravity_compensator", "joint2")]
    known = {(h.name, h.where): h for h in possible(model, table)[0]}
    force = np.unique(table.force, axis=0)
    late, q = np.linspace(1e5, 2e5, 30), random_poses(model.chain, 30, 5)
    pool = visit_pool_of(model, base.x, table, q, np.ones((30, 6)), late, force)
    noise = NoiseFloor(True, 1.0, 1.0, 2e-5, (5e-6,) * 6, 0.0, None)
    diagnosis = type("Found", (), {"noise": noise})
    whole = campaign_of(base, pool, [known[k] for k in keys], diagnosis)  # type: ignore
    rivals = RivalSet.of([Item(known[k], np.zeros(0), 0.0) for k in keys], [0.5, 0.5], [])
    return Discrimination.of(rivals, rows_of(whole, rivals), np.random.default_rng(0))


def test_a_plan_lets_a_spring_be_anchored_anew(against_a_spring) -> None:
    """The distance from a spring is the one to whichever start imitates best in all visits, and
    the best start so far is one of them."""
    discrimination, chosen = against_a_spring, (3, 11, 20)
    plain, about = discrimination.rows.alternatives
    assert len(about) == 12 and plain == (discrimination.rows.groups[0],)

    def by(span: slice) -> np.ndarray:
        rows = replace(discrimination.rows, alternatives=(plain, (span,)))
        one = replace(discrimination, rows=rows)
        return one.squared(one.gram(chosen))[0, 1]

    each = np.array([by(span) for span in about])
    both = discrimination.squared(discrimination.gram(chosen))
    np.testing.assert_allclose(both[0, 1], each.min(axis=0), rtol=1e-9)
    kept = by(discrimination.rows.groups[1])
    assert np.isclose(each, kept, rtol=1e-6).all(axis=1).any()
    assert (both[0, 1] < 0.9 * kept).any()


@pytest.mark.long
def test_the_spring_is_in_the_answer() -> None:
    d = diagnosed(COMPENSATOR)
    alike = {(e.effect, e.where) for group in d.indistinguishable for e in group}
    assert FAULTS[COMPENSATOR].key in alike | {(e.effect, e.where) for e in d.effects}
