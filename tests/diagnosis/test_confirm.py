"""The measured shrinkage against the true one, on a linear world where what is true is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from elastocal.diagnosis.shrinkage import NEW_POSES, Change, Shrinkage, Truth, shrinkage

SIGMA, P, K = 1e-5, 8, 2
SURE = Change()
World = tuple[tuple[np.ndarray, np.ndarray], Truth, np.ndarray]


def columns(poses: int, rng: np.random.Generator) -> np.ndarray:
    """(poses, 3 readings, 3 components, P + K) independent normal numbers, the effect's last."""
    return 1e-5 * rng.normal(size=(poses, 3, 3, P + K))


def world(seed: int, poses: int, size: float) -> tuple[World, float]:
    """What is known of an effect of rms `size` (m) after fits with and without it, and by how much
    the errors at 100 new poses really fall."""
    rng = np.random.default_rng((seed, poses))
    X = columns(poses, rng)
    true = np.concatenate([rng.normal(size=P), size / 1e-5 * np.array([0.8, -0.6])])
    y = X @ true + SIGMA * rng.normal(size=X.shape[:-1])
    free = [np.arange(P), np.arange(P + K)]

    def fitted(own: np.ndarray, kept: np.ndarray) -> np.ndarray:
        out = np.zeros(P + K)
        out[own] = np.linalg.lstsq(X[kept][..., own].reshape(-1, len(own)), y[kept].ravel())[0]
        return out

    every = np.arange(poses)
    before = np.concatenate([X[c] @ fitted(free[0], every != c) for c in every])
    rows, each = X.reshape(-1, P + K), X.reshape(-1, 3, P + K)
    after = each @ fitted(free[1], every >= 0)
    spread = each @ np.linalg.inv(np.linalg.cholesky(rows.T @ rows)).T
    # As uncertain as a pose that is left out.
    H = np.einsum("cik,cjk->cij", *[spread.reshape(poses, 9, -1)] * 2)
    left_out = np.trace(np.linalg.inv(np.eye(9) - H) - np.eye(9), axis1=1, axis2=2)
    grown = np.sqrt(left_out / np.trace(H, axis1=1, axis2=2))
    truth = Truth(after, SIGMA * spread * np.repeat(grown, 3)[:, None, None], 1.0)
    real = columns(NEW_POSES, rng)
    rms = [
        np.sqrt(((real @ (fitted(own, every >= 0) - true)) ** 2).sum(axis=2).mean()) for own in free
    ]
    return ((before, after), truth, np.repeat(every, 3)), float(1 - rms[1] / rms[0])


def fall(known: World, seed: int = 0, unnamed: float = 0.0) -> Shrinkage:
    predicted, truth, pose = known
    return shrinkage(predicted, [truth], pose, unnamed, SURE, np.random.default_rng(seed))


def outcomes(poses: int, size: float, worlds: int = 60) -> np.ndarray:
    """True reduction, estimate, and both ends of the 90 % interval (worlds, 4)."""
    rows = []
    for seed in range(worlds):
        known, true = world(seed, poses, size)
        found = fall(known, seed)
        assert found.ci95[0] <= found.ci90[0] <= found.reduction <= found.ci90[1] <= found.ci95[1]
        rows.append((true, found.reduction, *found.ci90))
    return np.array(rows)


@pytest.mark.parametrize(("poses", "size"), [(24, 1e-5), (60, 3e-6)])
def test_the_interval_covers_the_true_reduction_as_often_as_it_says(
    poses: int, size: float
) -> None:
    """54 of 60 are expected; fewer than 48 or all but one would come up in one of 100 tries."""
    true, found, low, high = outcomes(poses, size).T
    assert 0.8 <= np.mean((low <= true) & (true <= high)) <= 0.98
    assert abs(np.mean(found - true)) < 0.05
    assert abs(np.mean(found - true)) < 0.5 * np.mean(high - low)


def test_a_rival_that_may_be_the_truth_widens_the_interval() -> None:
    """If nothing is there, the model before is the one that is right."""
    (predicted, truth, pose), _ = world(1, 24, 3e-6)
    likely = replace(truth, probability=0.7)
    nothing = replace(truth, readings=predicted[0], probability=0.3)
    sure = fall((predicted, truth, pose))
    rng = np.random.default_rng(0)
    doubtful = shrinkage(predicted, [likely, nothing], pose, 0.0, SURE, rng)
    assert np.ptp(doubtful.ci90) > 1.2 * np.ptp(sure.ci90)


def test_what_is_there_without_a_name_stays() -> None:
    """Both squared errors grow by its square: large enough, it leaves nothing of the reduction."""
    known, _ = world(3, 60, 1e-5)
    falls = [fall(known, unnamed=u).reduction for u in (0, 3e-10, 1e-6)]
    assert falls[0] > falls[1] > falls[2]
    whole = ((known[0][0] - known[1].readings) ** 2).sum(axis=1).mean()
    expected = 1 - np.sqrt(((1 - falls[0]) ** 2 * whole + 3e-10) / (whole + 3e-10))
    assert falls[1] == pytest.approx(expected, abs=0.02)
    assert falls[2] < 1e-3
