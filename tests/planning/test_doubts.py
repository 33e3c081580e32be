"""Plans that reckon with effects the model may lack."""

from __future__ import annotations

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain, random_poses
from support.design_cells import plan_cell, set_up, target_poses

from elastocal.model.manipulator import Model
from elastocal.planning.exchange import exact_plan
from elastocal.planning.plan import Doubt, Gain
from elastocal.planning.relaxation import balanced, relax
from elastocal.planning.setup import Known, Setup, in_doubt

CHAIN = kr270_chain()
POSES = random_poses(CHAIN, 60, seed=1)
FEW = {("joint_hardening", "joint3"): 0.3, ("off_axis_compliance", "joint2"): 0.1}


def setup_with(doubts: dict | None, known: Known | None = None, n_poses: int = 5) -> Setup:
    cell = plan_cell(loads=DOWN[None], criterion="robust")
    model, known, _ = in_doubt(Model.assembled(CHAIN, cell), known or Known(), POSES, doubts)
    targets = target_poses.test_poses(cell, CHAIN, None, 0)
    return set_up(model, POSES, n_poses, targets, known)


@pytest.fixture(scope="module")
def setup() -> Setup:
    return setup_with(FEW)


def test_it_is_the_error_of_the_best_linear_estimate(setup: Setup) -> None:
    """By the covariance of the readings, as in kriging with a trend: y = B x + Z u + noise."""
    own = np.array(["hardening" not in n and "off_axis" not in n for n in setup.information.names])
    blocks = setup.information.blocks(POSES[:8])
    Y = blocks.reshape(-1, blocks.shape[2])
    D = np.linalg.inv(setup.prior[np.ix_(~own, ~own)])
    V = np.eye(len(Y)) + Y[:, ~own] @ D @ Y[:, ~own].T
    R = setup.target_rows
    assert R is not None
    W = np.linalg.inv(V)
    K = D @ Y[:, ~own].T @ W  # of u on the readings
    B = Y[:, own]
    rest = R[:, own] - R[:, ~own] @ K @ B
    error = R[:, ~own] @ (D - K @ Y[:, ~own] @ D) @ R[:, ~own].T
    error += rest @ np.linalg.inv(B.T @ W @ B) @ rest.T
    assert setup.value(POSES[:8]) == pytest.approx(np.trace(error), rel=1e-6)


def test_no_plan_beats_the_bound(setup: Setup) -> None:
    pool = setup.pool(POSES, np.zeros(len(POSES), dtype=np.int64))
    problem, _ = balanced(setup.problem(pool, np.array([8])))
    relaxed = relax(problem)
    assert relaxed.gap < 1e-3
    assert relaxed.bound <= exact_plan(problem, relaxed)[1]


def test_the_stated_error_holds_in_as_many_campaigns_as_it_says() -> None:
    """Arms drawn from what is believed: the right one of the effects, or none, with its size."""
    rng = np.random.default_rng(0)
    B, R, s, p = rng.standard_normal((30, 5)), rng.standard_normal((4, 5)), 2.0, 0.15
    own, places = np.arange(3), (np.array([3]), np.array([4]))
    held = []
    for _ in range(300):
        x = np.append(rng.standard_normal(3), [0.0, 0.0])
        which = rng.choice(3, p=[1 - 2 * p, p, p])
        if which:
            x[2 + which] = s * rng.standard_normal()
        y = B @ x + 3 * rng.standard_normal(30)
        fit = np.append(np.linalg.lstsq(B[:, own], y, rcond=None)[0], [0.0, 0.0])
        chance = _posterior(B, y, own, places, s, p)
        spare = (1 - chance) / (chance * s**2)
        before = B.T @ B / 9 + np.diag([0.0, 0.0, 0.0, *(1 / (chance * s**2))])
        doubts = [Doubt(c, k, v[None]) for c, k, v in zip(chance, places, spare, strict=True)]
        sure = Gain.of(R, before, before, doubts, B.T @ (y - B @ fit) / 9, 1).sure
        held.append(np.linalg.norm(R @ (x - fit)) <= sure)
    assert 0.92 < np.mean(held) < 0.98


def _posterior(
    B: np.ndarray, y: np.ndarray, own: np.ndarray, places: tuple, s: float, p: float
) -> np.ndarray:
    """Probability of each effect by its marginal likelihood, the others' sizes flat."""
    Q = np.linalg.qr(B[:, own], mode="complete")[0][:, len(own) :]
    logs = [np.log(1 - 2 * p)]
    for k in (None, *places):
        V = 9 * np.eye(Q.shape[1])
        if k is not None:
            V += s**2 * (Q.T @ B[:, k]) @ (Q.T @ B[:, k]).T
        z = Q.T @ y
        log = -0.5 * (np.linalg.slogdet(V)[1] + z @ np.linalg.solve(V, z))
        logs = [logs[0] + log] if k is None else [*logs, np.log(p) + log]
    odds = np.exp(np.array(logs) - max(logs))
    return odds[1:] / odds.sum()
