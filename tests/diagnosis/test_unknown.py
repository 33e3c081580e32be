"""Blocks without a name: every driver that was recorded, every place, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.diagnosis_data import campaign

from elastocal.diagnosis import (
    DiagnosisData,
    Generic,
    Grams,
    Item,
    NoiseValues,
    diagnosis_data_of,
    direct,
    fit_baseline,
    generic_blocks,
    monomials,
    packed_columns,
    project,
    waves,
    wrenches,
)
from elastocal.measurements import Measurements

N = 24
NOISE = NoiseValues(1.0, np.full(6, 3e-6), np.full(6, 0.2))


@lru_cache
def data_without(*columns: str) -> DiagnosisData:
    model, table = campaign(n=N)
    table = replace(table, **dict.fromkeys(columns))
    return diagnosis_data_of(fit_baseline(model, table), [])


@lru_cache
def blocks() -> tuple[Generic, ...]:
    return tuple(generic_blocks(data_without()))


def test_every_joint_angle_may_move_every_joint_and_link() -> None:
    pairs = {(g.covariate, g.where) for g in blocks() if g.kind == "angle"}
    parts = [f"{what}{k}" for what in ("joint", "link") for k in range(1, 7)]
    assert pairs >= {(f"joint{i} angle", p) for i in range(1, 7) for p in parts}


def test_drivers_that_were_not_recorded_are_not_asked() -> None:
    covariates = {g.covariate for g in blocks()}
    assert "time" in covariates and "load" in covariates and "approach of joint2" in covariates
    rest = {g.covariate for g in generic_blocks(data_without("time"))}
    assert rest == {d for d in covariates if "time" not in d}
    rest = {g.covariate for g in generic_blocks(data_without("approach"))}
    assert rest == {d for d in covariates if "approach" not in d}


def test_a_block_says_where_and_at_which_stage_it_acts() -> None:
    stages = {
        "joint": {"transmission", "compliance"},
        "link": {"geometry", "compliance"},
        "base": {"tracker", "compliance"},
        "load": {"load"},
        "tool": {"tool", "compliance"},
        "marker": {"tool"},
        "tracker": {"tracker"},
    }
    for g in blocks():
        assert g.stage in stages[g.where.partition(":")[0].rstrip("0123456789")]
        assert (g.direction is None) != (g.columns is None)


def test_a_block_scores_as_the_columns_it_stands_for() -> None:
    dataset = data_without()
    grams = Grams(dataset, dataset.data, project(dataset.data, NOISE))
    for g in blocks()[::17]:
        C = packed_columns(dataset, Item(g, np.zeros(0), 0.0))
        expected = direct(C, grams.at).evidence()
        np.testing.assert_allclose(grams.of(g).evidence(), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("covariate", "where"),
    [("joint2 angle", "joint5"), ("time", "link3"), ("load × joint3 angle", "joint4")],
)
def test_a_planted_dependence_is_told_from_every_other(covariate: str, where: str) -> None:
    """A smooth motion that no block holds as such: the right block scores highest."""
    dataset = data_without()
    table = dataset.base.observed.table
    along = {
        "joint2 angle": np.sin(3 * table.q[:, 1]),
        "time": np.tanh((table.time - 500) / 200),
        "load × joint3 angle": (table.force[:, 2] != 0) * np.sin(1.2 * table.q[:, 2]),
    }[covariate]
    entry = "joint_motion" if where.startswith("joint") else "link_frame"
    E = dataset.columns.entry((entry, (where,)))
    amount = 1.5e-4 * np.array([1.0, 0.5, -0.7, 0.3, 1.0, -0.4])[: E.shape[2]]
    moved = E @ amount * along[:, None]
    data = replace(dataset.data, r=dataset.data.r + dataset.pack(moved[:, :, None])[:, :, 0])
    grams = Grams(dataset, data, project(data, NOISE))
    scores = [float(grams.of(g).evidence()[0]) for g in blocks()]
    best = blocks()[int(np.argmax(scores))]
    assert (best.covariate, best.where) == (covariate, where)


def test_waves_follow_any_smooth_function_and_vanish_where_no_visit_is() -> None:
    x = np.random.default_rng(0).uniform(-2, 1, (30, 3))
    present = np.random.default_rng(1).random((30, 3)) < 0.8
    W = waves(x, present, 8)
    assert (W[~present] == 0).all() and np.abs(W).max() <= 1
    A = np.column_stack([np.ones(present.sum()), W[present]])
    for f in (np.sin(2 * x), x**3, np.exp(-x)):
        y = f[present]
        rest = y - A @ np.linalg.lstsq(A, y)[0]
        assert np.std(rest) < 0.1 * np.std(y)


def test_monomials_are_every_product_up_to_the_second_degree() -> None:
    x = np.random.default_rng(0).normal(size=(50, 3))
    made = monomials(x)
    assert made.shape == (50, 9)
    quadratic = x @ [1.0, -2, 0.5] + (x[:, 0] - 2 * x[:, 2]) ** 2 + x[:, 1] * x[:, 2]
    solution = np.linalg.lstsq(made, quadratic)[0]
    np.testing.assert_allclose(made @ solution, quadratic, atol=1e-10)


def test_the_wrench_at_a_link_is_the_load_in_that_links_axes() -> None:
    """R_flangeᵀ F at the last link, largest component one; the load turns the flange a little."""
    dataset = data_without()
    model, table = dataset.base.model, dataset.base.observed.table
    force, _ = list(wrenches(dataset))[-1]
    R = model.flange_poses(table, dataset.base.x)[:, :3, :3]
    expected = np.einsum("nji,nj->ni", R, table.force)
    expected /= np.abs(expected).max()
    rows = dataset.base.observed.lead[np.maximum(dataset.places.example, 0)]
    np.testing.assert_allclose(force[dataset.present], expected[rows][dataset.present], atol=5e-3)


def without_load(table: Measurements) -> Measurements:
    return table.take(table.force[:, 2] == 0)


def test_an_unloaded_campaign_asks_nothing_of_loads() -> None:
    model, table = campaign(n=N)
    dataset = diagnosis_data_of(fit_baseline(model, without_load(table)), [])
    kinds = {g.kind for g in generic_blocks(dataset)}
    assert not any("load" in kind or kind == "force" for kind in kinds)
