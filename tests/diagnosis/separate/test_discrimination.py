"""Distances of rivals against dense least squares, and what further visits do to them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from planning.feasibility.small_cells import gantry_at, gantry_rules
from support.cells import choices, kr270_cell, kr270_chain, random_poses, table_of

from elastocal.cell.arm_description import CartesianNoise, Tool, Tracker
from elastocal.cell.workspace_rules import Visibility, Workspace
from elastocal.diagnosis.baseline import Baseline, fit_baseline, prior_deviations
from elastocal.diagnosis.diagnosis import NoiseFloor
from elastocal.diagnosis.discrimination import (
    DRAWS,
    Discrimination,
    VisitPool,
    _hidden,
    campaign_of,
    joined,
    visit_pool_of,
)
from elastocal.diagnosis.extra_poses import expected, expected_of_random, fewest
from elastocal.diagnosis.hypotheses import possible
from elastocal.diagnosis.model_set import Item
from elastocal.diagnosis.noise_floor import NoiseValues
from elastocal.diagnosis.rivals import SETTINGS, RivalSet, alternatives
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.simulation.simulate import simulate, values_from
from elastocal.units import Array

FITTED = ("base_frame", "joint_offset", "marker_position")
RIVALS = (("gear_eccentricity", "joint3"), ("encoder_scale", "joint3"), ("joint_drift", "joint2"))
TIME_CONSTANT = 1800.0
SIGMA = 20e-6
NOISE = NoiseValues(1.3, np.linspace(4e-6, 9e-6, 6), np.linspace(0.2, 0.9, 6))
CHOSEN = (4, 1, 7)
PROBABILITY = np.array([0.5, 0.3, 0.2])


@pytest.fixture(scope="module")
def base() -> Baseline:
    """A fit to an unloaded campaign in a narrow range of joint 3."""
    cell = kr270_cell(FITTED)
    cell = replace(cell, tracker=replace(cell.tracker, noise=CartesianNoise(np.full(3, SIGMA))))
    chain = kr270_chain()
    q = random_poses(chain, 14, 1)
    q[:, 2] = np.random.default_rng(2).uniform(-0.6, 0.6, 14)
    table = table_of(q, np.zeros(3))
    table = replace(table, time=600.0 * table.configuration)
    spec = replace(
        cell.model, effects=(*cell.model.effects, *choices(["gear_eccentricity:joint3"]))
    )
    posterior_draw = Model.assembled(chain, replace(cell, model=spec))
    sizes = {"joint3.eccentricity_sin": 2e-4, "joint3.eccentricity_cos": -1e-4}
    read = simulate(posterior_draw, table, values_from(posterior_draw, sizes), 3)
    return fit_baseline(Model.assembled(chain, cell), read)


@pytest.fixture(scope="module")
def pool(base: Baseline) -> VisitPool:
    q = random_poses(base.model.chain, 10, 5)
    late = np.linspace(9000.0, 12000.0, 10)
    return visit_pool_of(base.model, base.x, base.observed.table, q, None, late, np.zeros((1, 3)))


@pytest.fixture(scope="module")
def discrimination(base: Baseline, pool: VisitPool) -> Discrimination:
    known = {(h.name, h.where): h for h in possible(base.model, base.observed.table)[0]}
    settings = [[], [], [TIME_CONSTANT]]
    items = [Item(known[k], np.array(s), 0.0) for k, s in zip(RIVALS, settings, strict=True)]
    joints = tuple(NOISE.joint), 0.5, None, tuple(NOISE.shared)
    found = NoiseFloor(True, NOISE.factor, NOISE.factor, SIGMA, *joints)
    diagnosis = type("Found", (), {"noise": found})
    whole = campaign_of(base, pool, [known[k] for k in RIVALS], diagnosis)  # type: ignore
    rivals = RivalSet.of(items, list(PROBABILITY), [])
    return Discrimination.of(whole, rivals, np.random.default_rng(0))


def dense_distance(base: Baseline, table: Measurements, a: int, b: int, size: Array) -> float:
    """d² of rival a with parameters `size` from rival b: one dense weighted least-squares problem
    over all rows, from the B of a model with all rivals active."""
    model = base.model
    effects = choices([*FITTED, *(f"{e}:{w}" for e, w in RIVALS)])
    nominal = replace(
        model.cell.model.nominal, settings={"joint2": {"time_constant_s": TIME_CONSTANT}}
    )
    spec = replace(model.cell.model, effects=effects, nominal=nominal)
    whole = Model.assembled(model.chain, replace(model.cell, model=spec))
    fitted = dict(zip(model.names, base.x, strict=True))
    x = np.array([fitted.get(p.name, 0.0) for p in whole.parameters])
    B = whole.regressor(table, x).B
    of = {key: [i for i, p in enumerate(whole.parameters) if p.effect == key[0]] for key in RIVALS}
    X = B[:, [whole.names.index(name) for name in model.names]] * prior_deviations(base)
    # Five times the widest of the size prior, as large as the verdict lets a rival be.
    widest = np.array([15 * whole.parameters[i].typical for i in of[RIVALS[b]]])
    Z = np.hstack([X, B[:, of[RIVALS[b]]] * widest])
    typical = np.array([whole.parameters[i].typical for i in of[RIVALS[a]]])
    signal = B[:, of[RIVALS[a]]] @ (typical * size)
    V = NOISE.factor**2 * SIGMA**2 * np.eye(len(B))
    step = 1e-6
    for j in range(6):
        moved = [replace(table, q=table.q + s * step * np.eye(6)[j]) for s in (1, -1)]
        g = (whole.predict(moved[0], x) - whole.predict(moved[1], x)) / (2 * step)
        same = np.repeat(table.configuration, 3)
        shared = (same[:, None] == same[None, :]) * (1 + NOISE.shared[j] ** 2)
        V += NOISE.joint[j] ** 2 * np.outer(g, g) * shared
    L = np.linalg.cholesky(V)
    white = np.linalg.solve(L, np.column_stack([Z, signal]))
    tied = np.vstack([white[:, :-1], np.eye(Z.shape[1])])
    aim = np.concatenate([white[:, -1], np.zeros(Z.shape[1])])
    left = aim - tied @ np.linalg.lstsq(tied, aim, rcond=None)[0]
    return float(left @ left)


@pytest.mark.parametrize("chosen", [(), CHOSEN])
@pytest.mark.parametrize(("a", "b"), [(0, 1), (1, 0), (2, 0)])
def test_distance_is_that_of_dense_least_squares(base, pool, discrimination, chosen, a, b) -> None:
    squared = discrimination.squared(discrimination.gram(chosen))[a, b]
    rows = np.flatnonzero(np.isin(pool.table.configuration - 14, chosen))
    table = joined(base.observed.table, pool.table.take(rows))
    for k in (0, DRAWS, 2 * DRAWS - 1):
        expected_square = dense_distance(base, table, a, b, discrimination.draws[a][k])
        assert squared[k] == pytest.approx(expected_square, rel=1e-3)


def test_the_plan_beats_random_visits(discrimination) -> None:
    chosen = fewest([discrimination], 2)
    rng = np.random.default_rng(1)
    assert expected([discrimination], chosen) > expected_of_random(
        [discrimination], len(chosen), rng
    )


def test_a_rival_with_settings_imitates_by_its_best_ones(base, pool, discrimination) -> None:
    """A drift of 1800 s is imitated by the same drift, whatever constant was found for it."""
    drift = discrimination.rivals.rivals[2]
    quick = replace(drift, settings=np.array([700.0]))
    joints = tuple(NOISE.joint), 0.5, None, tuple(NOISE.shared)
    found = NoiseFloor(True, NOISE.factor, NOISE.factor, SIGMA, *joints)
    whole = campaign_of(base, pool, [drift.what], type("Found", (), {"noise": found}))
    rivals = RivalSet.of([drift, quick], [0.5, 0.5], [])
    drifts = alternatives(whole.so_far, NOISE, rivals)[1]
    assert drifts[0].settings[0] == pytest.approx(TIME_CONSTANT)
    assert 1 < len({float(item.settings[0]) for item in drifts}) == len(drifts) <= SETTINGS
    d = Discrimination.of(whole, rivals, np.random.default_rng(0))
    assert d.distances(d.before)[0, 1] < 0.1


@pytest.mark.parametrize("observe", ["position", "deflection"])
def test_markers_that_the_tracker_does_not_see_are_not_read(observe: str) -> None:
    markers = {"L": np.array([0, -1.0, 0]), "R": np.array([0, 1.0, 0])}
    sight = Visibility({"L": np.array([-1.0, 0, 0])}, np.radians(30), min_markers=1)
    eye = Tracker(position=np.array([3.0, 0.0, 0.0]))
    rules = gantry_rules(Workspace(visibility=sight), Tool(markers=markers), eye)
    arm: Any = SimpleNamespace(cell=rules.cell, chain=rules.chain, observe=observe)
    hidden = _hidden(arm, gantry_at((0.2, 0, 0), (0, 0.1, 0)), np.zeros((2, 3)), ("R", "L"))
    assert hidden.tolist() == [False, True] * 4
