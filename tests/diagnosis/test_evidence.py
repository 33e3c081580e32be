"""The closed form of the evidence against dense Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp
from support.noisy_data import dense_noise, random_data, used_rows

from elastocal.diagnosis.baseline import NoiseValues, NoisyData, project
from elastocal.diagnosis.effect_search import Slot
from elastocal.diagnosis.evidence import SCALES, Item, direct, exceedance

NOISE = NoiseValues(0.9, np.array([4e-6, 9e-6, 1e-5]), np.full(3, 0.5))
SEEDS = range(2)


def group(data: NoisyData, seed: int, k: int = 3) -> np.ndarray:
    return data.masked(1e-5 * np.random.default_rng((seed, 11)).normal(size=(*data.r.shape, k)))


def dense_evidence(data: NoisyData, C: np.ndarray, s: float) -> float:
    """log N(r; 0, S + s²CCᵀ) − log N(r; 0, S) with everything else integrated out in S."""
    rows = used_rows(data)
    X, C = (a.reshape(-1, a.shape[2])[rows] * 1e5 for a in (data.X, C))
    r = data.r.ravel()[rows] * 1e5
    S = 1e10 * dense_noise(data, NOISE) + X / data.precision @ X.T
    both = [stats.multivariate_normal(cov=V).logpdf(r) for V in (S + s**2 * C @ C.T, S)]
    return float(both[0] - both[1])


@pytest.mark.parametrize("seed", SEEDS)
def test_the_evidence_is_the_ratio_of_dense_densities(seed: int) -> None:
    data = random_data(seed)
    C = group(data, seed)
    found = direct(C, project(data, NOISE))
    each = [dense_evidence(data, C, s) for s in SCALES]
    for s, expected in zip(SCALES, each, strict=True):
        assert found.evidence(np.array([s]))[0] == pytest.approx(expected, rel=1e-7, abs=1e-7)
    mixed = logsumexp(each) - np.log(len(SCALES))
    assert found.evidence()[0] == pytest.approx(mixed, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize(("kind", "true"), [("one", 5e-4), ("rare", 5e-4)])
def test_p_values_from_the_tail_are_not_below_what_they_are(kind: str, true: float) -> None:
    """Log evidences of one effect, and sums of many: the p-value at the quantile
    that leaves `true` beyond it is no smaller in the median, and nine times as large at most."""

    def draw(rng: np.random.Generator, n: int) -> np.ndarray:
        if kind == "one":
            return rng.chisquare(1, n) / 2
        return logsumexp(rng.chisquare(1, (n, 100)) / 2 - 2, axis=1)

    rng = np.random.default_rng(5)
    observed = float(np.quantile(draw(rng, 100_000), 1 - true))
    told = [exceedance(draw(rng, 199), observed) for _ in range(200)]
    assert true < np.median(told) < 9 * true


def test_an_effect_counts_in_its_slot_at_its_own_settings() -> None:
    """Another round of its settings may not find them again, where it would count less."""
    again, other, found = (Item(what, np.zeros(1), 0.0) for what in ("a", "b", "a"))
    held = Slot((again, other), np.array([3.0, 98.5])).holding(found, 155.6)
    assert held.items[0] is found and held.probabilities()[0][0] > 0.99
