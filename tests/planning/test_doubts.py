"""Plans that reckon with effects the model may lack."""

from __future__ import annotations

import numpy as np
import pytest
from planning.relaxation.test_two_methods import assert_agreement
from support.cells import DOWN, kr270_chain, random_poses
from support.design_cells import all_loads, plan_cell, set_up, target_poses

from elastocal.identification.knowledge import GaussianPrior
from elastocal.model import Model
from elastocal.model.effects import SOMETHING
from elastocal.planning import Gain, Known, Setup, in_doubt, load_states, missing, relax
from elastocal.planning.doubts import WORTH, leading_directions
from elastocal.planning.plan import Doubt
from elastocal.planning.selection import in_terms, random_plan

CHAIN = kr270_chain()
POSES = random_poses(CHAIN, 60, seed=1)
FEW = {("joint_hardening", "joint3"): 0.3, ("off_axis_compliance", "joint2"): 0.1}


def setup_with(doubts: dict | None, known: Known | None = None, n_poses: int = 5) -> Setup:
    cell = plan_cell(loads=DOWN[None], criterion="robust")
    states, load = load_states(cell), all_loads(POSES)
    model, known, _ = in_doubt(
        Model.assembled(CHAIN, cell), known or Known(), states, POSES, load, doubts
    )
    targets = target_poses.test_poses(cell, CHAIN, None, 0)
    return set_up(model, states, POSES, load, n_poses, targets, known, 0)


@pytest.fixture(scope="module")
def setup() -> Setup:
    return setup_with(FEW)


def test_what_may_be_missing_is_what_poses_and_loads_can_show() -> None:
    model = Model.assembled(CHAIN, plan_cell(loads=DOWN[None]))
    found = missing(model)
    assert ("gear_eccentricity", "joint2") in found and len(found) == len(set(found))
    names = {name for name, _ in found}
    # In the model; asks for times, for sides of approach; an order is searched; the instrument's.
    absent = {"joint_compliance", "joint_drift", "hysteresis", "gear_ripple", "tracker_distortion"}
    assert not names & absent


def test_equal_shares_of_doubt_add_up() -> None:
    cell = plan_cell(("base_frame",), "position", loads=DOWN[None])
    model = Model.assembled(CHAIN, cell)
    whole, known, _ = in_doubt(model, Known(), load_states(cell), POSES, all_loads(POSES))
    prior = known.prior
    assert prior is not None
    at = {p.name: p for p in whole.parameters}
    std = dict(zip(prior.names, np.sqrt(np.diag(prior.covariance)), strict=True))
    share = {
        (at[n].effect, at[n].where): (s / at[n].typical) ** 2
        for n, s in std.items()
        if at[n].typical
    }
    kinds = {name for name, _ in missing(model)}
    joints = [p for (name, _), p in share.items() if name == "gear_eccentricity"]
    assert len(joints) == 6 and sum(joints) == pytest.approx(SOMETHING / len(kinds))
    assert max(share.values()) < SOMETHING / len(kinds) * (1 + 1e-9)


def test_a_stated_prior_stays() -> None:
    stated = GaussianPrior.independent(["joint2.compliance"], [3e-7], [1e-8])
    cell = plan_cell(loads=DOWN[None])
    known = in_doubt(
        Model.assembled(CHAIN, cell), Known(("joint1",), stated), load_states(cell), POSES,
        all_loads(POSES), FEW,
    )[1]  # fmt: skip
    assert known.prior is not None and known.prior.names[0] == "joint2.compliance"
    assert known.prior.covariance[0, 0] == pytest.approx(1e-16) and "joint1" in known.fixed


def test_without_doubts_it_is_the_error_at_the_test_poses() -> None:
    robust = setup_with({})
    cell = plan_cell(loads=DOWN[None], criterion="test_pose")
    model = Model.assembled(CHAIN, cell)
    targets = target_poses.test_poses(cell, CHAIN, None, 0)
    other = set_up(model, load_states(cell), POSES, all_loads(POSES), 5, targets, Known(), 0)
    q, load = POSES[:8], all_loads(POSES[:8])
    assert robust.value(q, load) == pytest.approx(other.value(q, load), rel=1e-9)
    assert robust.information.names == other.information.names


def test_it_is_the_error_of_the_best_linear_estimate(setup: Setup) -> None:
    """By the covariance of the readings, as in kriging with a trend: y = B x + Z u + noise."""
    own = np.array(["hardening" not in n and "off_axis" not in n for n in setup.information.names])
    blocks = setup.information.blocks(POSES[:8], all_loads(POSES[:8]))[0]
    Y = blocks.reshape(-1, blocks.shape[2])
    D = np.linalg.inv(setup.prior[0][np.ix_(~own, ~own)])
    V = np.eye(len(Y)) + Y[:, ~own] @ D @ Y[:, ~own].T
    R = setup.target_rows
    assert R is not None
    W = np.linalg.inv(V)
    K = D @ Y[:, ~own].T @ W  # of u on the readings
    B = Y[:, own]
    rest = R[:, own] - R[:, ~own] @ K @ B
    error = R[:, ~own] @ (D - K @ Y[:, ~own] @ D) @ R[:, ~own].T
    error += rest @ np.linalg.inv(B.T @ W @ B) @ rest.T
    assert setup.value(POSES[:8], all_loads(POSES[:8])) == pytest.approx(np.trace(error), rel=1e-6)


def test_the_bound_is_that_of_another_solver(setup: Setup) -> None:
    pool = setup.pool(POSES, all_loads(POSES), np.zeros(len(POSES), dtype=np.int64))
    assert_agreement(setup.problem(pool, np.array([8])))


def test_the_search_is_one_in_directions_that_count() -> None:
    """What they leave out counts as known: no plan errs more, and the best hardly less."""
    setup = setup_with(None)
    pool = setup.pool(POSES, all_loads(POSES), np.zeros(len(POSES), dtype=np.int64))
    problem, R = setup.problem(pool, np.array([8])), setup.target_rows
    own = np.isin(setup.information.names, Model.assembled(CHAIN, plan_cell()).names)
    assert R is not None
    T = leading_directions(problem, R, ~own)
    assert T is not None and own.sum() < T.shape[2] <= WORTH * len(own)
    fewer = in_terms(problem, T)
    assert fewer is not None
    rng = np.random.default_rng(0)
    for chosen in (random_plan(problem, rng) for _ in range(10)):
        whole, some = (p.criterion.value(p.prior + p.sum_of(chosen)) for p in (problem, fewer))
        assert some <= whole * (1 + 1e-9)
    bound = relax(problem).bound
    assert 0.99 * bound < relax(fewer).bound <= bound * (1 + 1e-6)
    assert leading_directions(problem, R, np.zeros(len(own), dtype=bool)) is None


def test_doubt_costs_and_poses_pay_it_back() -> None:
    """More doubt, more error; and more poses lower it."""
    q, load = POSES[:10], all_loads(POSES[:10])
    sure, doubtful = (setup_with({key: p for key in FEW}) for p in (1e-4, 0.5))
    assert doubtful.value(q, load) > sure.value(q, load)
    more, all_of_them = POSES[:30], all_loads(POSES[:30])
    assert doubtful.value(more, all_of_them) < doubtful.value(q, load)


def test_gain_counts_what_the_readings_show_and_leave_open() -> None:
    """One parameter, and one that may be missing, which the model has at zero: by hand."""
    R, before, pull = np.eye(2), np.diag([4.0, 1.0]), np.array([0.0, 100.0])
    one = np.array([1])

    def gain(p: float, spare: float = 0.0) -> Gain:
        return Gain.of(R, before, 4 * before, [Doubt(p, one, np.array([spare]))], pull, 0)

    there = gain(1.0)
    assert there.before == pytest.approx(np.sqrt(0.25 + 1 + 100**2))
    assert there.after == pytest.approx(np.sqrt(1 / 16 + 1 / (3 + 1 / (1 + 100**2))))
    assert there.model_before == pytest.approx(0.5) and there.model_after == pytest.approx(0.25)
    assert there.sure == pytest.approx(100 + 1.645, abs=0.1)
    # Known less well if it is there than with its chance alone: 1/(1 - spare) times the variance.
    assert gain(1.0, 0.5).sure == pytest.approx(200 + 1.645 * np.sqrt(2), abs=0.2)
    # What is missing with a few per cent alone leaves the error that of the model: N(0, 1/4).
    assert gain(1e-9).sure == pytest.approx(1.96 / 2, abs=0.05)
    assert 1.96 / 2 < gain(0.03).sure < 1.5 and gain(0.1).sure > 98
    assert gain(1e-9).before == pytest.approx(there.model_before, rel=1e-4)
    assert Gain.of(R, np.diag([0.0, 1.0]), before, [], np.zeros(2), 0).sure == np.inf


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


def test_before_and_after_are_errors_of_drawn_arms() -> None:
    """Arms as likely as believed, measured once more: the best linear estimate, fitted to them."""
    rng = np.random.default_rng(3)
    B, A, R = (rng.standard_normal((n, 4)) for n in (12, 5, 3))
    own, pull, spare = np.arange(2), rng.standard_normal(4), np.full(1, 0.2)
    before = B.T @ B + np.diag([0.0, 0.0, 1.0, 1.0])
    places = {2: 0.3, 3: 0.2}
    doubts = [Doubt(p, np.array([k]), spare) for k, p in places.items()]
    gain = Gain.of(R, before, before + A.T @ A, doubts, pull, 0)
    n, arms = 60_000, []
    for k, p in {None: 0.5, **places}.items():
        there = own if k is None else np.append(own, k)
        M = before[np.ix_(there, there)] - np.diag([0.0, 0.0, 0.2][: len(there)])
        V = np.linalg.inv(M)
        x = np.zeros((round(p * n), 4))
        x[:, there] = rng.multivariate_normal(V @ pull[there], V, len(x))
        arms.append(x)
    x = np.concatenate(arms)
    y = x @ A.T + rng.standard_normal((n, 5))
    off = (x - y @ np.linalg.lstsq(y, x, rcond=None)[0]) @ R.T
    rms = [np.sqrt((e**2).sum(axis=1).mean()) for e in (x @ R.T, off)]
    assert rms == pytest.approx([gain.before, gain.after], rel=0.015)


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
