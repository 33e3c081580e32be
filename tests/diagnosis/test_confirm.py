"""The measured shrinkage against the true one, on a linear world where what is true is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from elastocal.diagnosis.shrinkage import NEW_POSES, Change, PosteriorDraw, shrinkage

SIGMA, P, K = 1e-5, 8, 2
N = 10_000  # measured poses: as many kinds of pose as there are
SURE = Change()


def columns(poses: int, rng: np.random.Generator) -> np.ndarray:
    """(poses, 3 readings, 3 components, P + K) independent normal numbers, the effect's last."""
    return 1e-5 * rng.normal(size=(poses, 3, 3, P + K))


def world(seed: int, poses: int, size: float) -> tuple[PosteriorDraw, float]:
    """What is known of an effect of rms `size` (m) after a fit with and one without it, and by
    how much the errors at 100 new poses really fall."""
    rng = np.random.default_rng((seed, poses))
    X = columns(poses, rng).reshape(-1, P + K)
    true = np.concatenate([rng.normal(size=P), size / 1e-5 * np.array([0.8, -0.6])])
    y = X @ true + SIGMA * rng.normal(size=len(X))
    after = np.linalg.lstsq(X, y)[0]
    before = np.concatenate([np.linalg.lstsq(X[:, :P], y)[0], np.zeros(K)])
    spread = SIGMA * np.linalg.inv(np.linalg.cholesky(X.T @ X)).T
    real = columns(NEW_POSES, rng)
    rms = [np.sqrt(((real @ (fit - true)) ** 2).sum(axis=2).mean()) for fit in (before, after)]
    new = columns(300, rng)
    rows = new.reshape(-1, 3, P + K)
    pose = np.repeat(np.arange(300), 3)
    found = PosteriorDraw(rows @ (before - after), rows @ (after - after), rows @ spread, pose, 1.0)
    return found, float(1 - rms[1] / rms[0])


def outcomes(poses: int, size: float, worlds: int = 60) -> np.ndarray:
    """True reduction, estimate, and both ends of the 90 % interval (worlds, 4)."""
    rows = []
    for seed in range(worlds):
        found, true = world(seed, poses, size)
        fall = shrinkage([found], N, 0.0, SURE, np.random.default_rng(seed))
        assert fall.ci95[0] <= fall.ci90[0] <= fall.reduction <= fall.ci90[1] <= fall.ci95[1]
        rows.append((true, fall.reduction, *fall.ci90))
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
    found, _ = world(1, 24, 3e-6)
    likely = replace(found, probability=0.7)
    nothing = replace(found, before=found.after, after=-found.before, probability=0.3)
    rng = np.random.default_rng(0)
    sure = shrinkage([found], N, 0.0, SURE, rng)
    doubtful = shrinkage([likely, nothing], N, 0.0, SURE, rng)
    assert np.ptp(doubtful.ci90) > 1.2 * np.ptp(sure.ci90)


def test_what_is_there_without_a_name_stays() -> None:
    """Both squared errors grow by its square: large enough, it leaves nothing of the reduction."""
    found, _ = world(3, 60, 1e-5)
    falls = [
        shrinkage([found], N, u, SURE, np.random.default_rng(0)).reduction for u in (0, 3e-10, 1e-6)
    ]
    assert falls[0] > falls[1] > falls[2]
    left, whole = (1 - falls[0]) ** 2, ((found.before**2).sum(axis=1)).mean()
    expected = 1 - np.sqrt((left * whole + 3e-10) / (whole + 3e-10))
    assert falls[1] == pytest.approx(expected, abs=0.02)
    assert falls[2] < 1e-3
