"""The measured shrinkage against the true one, on a linear world whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.diagnosis_data import random_data

from elastocal.diagnosis.blocks import Blocks
from elastocal.diagnosis.confirm import shrinkage
from elastocal.diagnosis.model_set import ModelSet
from elastocal.diagnosis.noise import NoiseValues

NOISE = NoiseValues(1.0, np.array([1e-9]), 0.1)
SIGMA, P, K = 1e-5, 8, 2


def world(seed: int, poses: int, size: float) -> tuple[ModelSet, ModelSet, float]:
    """Sets without and with an effect of rms `size` (m), and the true reduction.

    Columns are independent normal numbers, so that the expected squared error on fresh poses is
    the squared error of the coefficients.
    """
    rng = np.random.default_rng((seed, poses))
    configuration = np.repeat(np.arange(poses), 3)
    blocks = Blocks.of(configuration, configuration, 3)
    base = random_data(seed, blocks, p=P, joints=1)
    X, C = (1e-5 * rng.normal(size=(poses, 9, k)) for k in (P, K))
    beta, gamma = rng.normal(size=P), size / 1e-5 * np.array([0.8, -0.6])
    r = X @ beta + C @ gamma + SIGMA * rng.normal(size=(poses, 9))
    base = replace(
        base, r=r, X=X, precision=np.full(P, 1e-8), G=np.zeros((poses, 9, 1)),
        covariance=np.tile(SIGMA**2 * np.eye(9), (poses, 1, 1)), left_out=blocks.absent,
    )  # fmt: skip
    scale = 1.0 / (size / 1e-5) ** 2
    before = ModelSet((), NOISE, base, 0.0, ())
    after = ModelSet((), NOISE, base.with_columns(C, np.full(K, scale)), 0.0, ())
    squares = []
    for chosen, truth in ((before, beta), (after, np.concatenate([beta, gamma]))):
        A = chosen.data.X.reshape(-1, chosen.data.X.shape[2])
        M = A.T @ A / SIGMA**2 + np.diag(chosen.data.precision)
        error = np.linalg.solve(M, A.T @ r.ravel() / SIGMA**2) - truth[: A.shape[1]]
        missing = truth[A.shape[1] :] if len(truth) > A.shape[1] else np.zeros(0)
        squares.append(float(error @ error + missing @ missing))
    squares[0] += float(gamma @ gamma)
    return before, after, 1 - np.sqrt(squares[1] / squares[0])


@lru_cache
def outcomes(poses: int, size: float, worlds: int = 60) -> np.ndarray:
    """True reduction, estimate, and both ends of the 90 % interval (worlds, 4)."""
    rows = []
    for seed in range(worlds):
        before, after, true = world(seed, poses, size)
        found = shrinkage(before, after, [(after, 1.0)], 0.0, np.random.default_rng(seed))
        assert found.ci95[0] <= found.ci90[0] <= found.reduction <= found.ci90[1] <= found.ci95[1]
        rows.append((true, found.reduction, *found.ci90))
    return np.array(rows)


CASES = [(24, 1e-5), (24, 3e-6), (60, 3e-6)]


@pytest.mark.parametrize(("poses", "size"), CASES)
def test_the_interval_covers_the_true_reduction_as_often_as_it_says(
    poses: int, size: float
) -> None:
    """54 of 60 are expected; fewer than 48 or all but one would come up in one of 100 tries."""
    true, _, low, high = outcomes(poses, size).T
    assert 0.8 <= np.mean((low <= true) & (true <= high)) <= 0.98


@pytest.mark.parametrize(("poses", "size"), CASES)
def test_the_reduction_is_not_biased(poses: int, size: float) -> None:
    true, found, low, high = outcomes(poses, size).T
    assert abs(np.mean(found - true)) < 0.05
    assert abs(np.mean(found - true)) < 0.5 * np.mean(high - low)


def test_more_poses_make_the_interval_narrower() -> None:
    few, many = (outcomes(poses, 3e-6) for poses in (24, 60))
    assert np.mean(many[:, 3] - many[:, 2]) < 0.8 * np.mean(few[:, 3] - few[:, 2])


def test_a_rival_that_may_be_the_truth_widens_the_interval() -> None:
    before, after, _ = world(1, 24, 3e-6)
    rng = np.random.default_rng(0)
    sure = shrinkage(before, after, [(after, 1.0)], 0.0, rng)
    doubtful = shrinkage(before, after, [(after, 0.7), (before, 0.3)], 0.0, rng)
    assert np.ptp(doubtful.ci90) > 1.2 * np.ptp(sure.ci90)


def test_adding_nothing_shrinks_nothing() -> None:
    before, _, _ = world(2, 24, 1e-5)
    found = shrinkage(before, before, [(before, 1.0)], 0.0, np.random.default_rng(0))
    assert found.reduction == 0.0 and found.ci95 == (0.0, 0.0)


def test_a_change_between_visits_leaves_an_error_on_its_wrong_side() -> None:
    """On average half of `between` is added to what is left."""
    before, after, _ = world(3, 60, 1e-5)
    sharp, blurred = (
        shrinkage(before, after, [(after, 1.0)], b, np.random.default_rng(0)) for b in (0, 1e-10)
    )
    assert blurred.reduction < sharp.reduction and blurred.ci90[0] < sharp.ci90[0]
    # Squared errors of a configuration's nine rows: 9 · (1e-5)² before.
    left = (1 - sharp.reduction) ** 2 + 0.5 * 1e-10 / 9e-10
    assert (1 - blurred.reduction) ** 2 == pytest.approx(left, rel=0.15)
