"""Coverage and efficiency of the default on the paper's campaign: KR 270, 15 poses of Table 2.

Each table is 3 markers × R repeats at 15 configurations with Table 1's σ per configuration and
direction and, in some cases, a deviation common to a configuration.  An interval is right if it
holds the truth as often as it says; an estimate is good if its error is near the one that the
true covariance would give (the oracle: generalised least squares with the simulated V).
"""

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from elastocal.identification.noise_structure import Readings
from elastocal.identification.outliers import settle


@dataclass(frozen=True)
class Campaign:
    """B (readings, 3, 9), σ (readings, 3) in m, and labels (readings,)."""

    B: np.ndarray
    sigma: np.ndarray
    configuration: np.ndarray
    marker: np.ndarray

    def drawn(self, rng, common):
        shared = common * rng.normal(size=(15, 3))[self.configuration]
        e = self.sigma * rng.normal(size=self.sigma.shape) + shared
        zeros = np.zeros(len(e), dtype=int)
        return Readings(self.B, e, self.configuration, zeros, self.marker)

    def oracle(self, common):
        """Variances (9,) of generalised least squares with the simulated covariance."""
        n = len(self.sigma)
        same = self.configuration[:, None] == self.configuration[None]
        V = np.kron(common**2 * same, np.eye(3)) + np.diag(self.sigma.ravel() ** 2)
        B = self.B.reshape(3 * n, 9)
        return np.diag(np.linalg.inv(B.T @ np.linalg.solve(V, B)))


@pytest.fixture(scope="module")
def kr270():
    """B (15, 3, 3, 9) of configuration and marker, unit columns, and σ (15, 3)."""
    folder = Path(__file__).parents[2] / "experiment_design" / "kr270_reproduction"
    spec = importlib.util.spec_from_file_location("kr270_campaign", folder / "campaign.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their module up
    spec.loader.exec_module(module)
    found = module.campaign()
    B = (found.B / np.linalg.norm(found.B, axis=0)).reshape(15, 6, 3, 3, 9)
    sigma = found.sigma.reshape(15, 18, 3)
    assert not np.ptp(B, axis=1).any() and not np.ptp(sigma, axis=1).any()
    return B[:, 0], sigma[:, 0]


def campaign(kr270, repeats):
    B, sigma = kr270
    c, m, _ = np.indices((15, 3, repeats)).reshape(3, -1)
    return Campaign(B[c, m], sigma[c], c, m)


def study(table, common, replicates, seed):
    """Squared errors over the oracle's variance, and coverage at 95 %, (replicates, 9) each."""
    ratio, held = [], []
    oracle = table.oracle(common)
    for k in range(replicates):
        found = settle(table.drawn(np.random.default_rng([seed, k]), common)).noise
        ratio.append(found.x**2 / oracle)
        low, high = found.covariance.interval(found.x, 0.95).T
        held.append((low <= 0) & (high >= 0))
    return np.array(ratio), np.array(held)


def check(ratio, held, efficiency):
    """No parameter held more rarely than the 0.01 % point of the binomial at 95 %, nor, where
    few degrees of freedom make intervals cautious, oftener than that of 97 %; all together within
    one point and four standard errors of tables, whose nine intervals depend on each other."""
    n = len(held)
    low, high = stats.binom.ppf(1e-4, n, 0.95), stats.binom.ppf(1 - 1e-4, n, 0.97)
    assert (held.sum(axis=0) >= low).all(), held.mean(axis=0)
    assert (held.sum(axis=0) <= high).all(), held.mean(axis=0)
    error = held.mean(axis=1).std() / np.sqrt(n)
    assert abs(held.mean() - 0.95) < 4 * error + 0.01
    assert np.sqrt(ratio.mean()) < efficiency


@pytest.mark.parametrize(("repeats", "common"), [(6, 80e-6)])
def test_intervals_hold_and_errors_are_near_the_best(kr270, repeats, common):
    """30 tables: the rms error over the oracle's is itself known to 5 %."""
    check(*study(campaign(kr270, repeats), common, 30, 1), efficiency=1.18)


@pytest.mark.long
@pytest.mark.parametrize(
    ("repeats", "common", "efficiency"),
    [(2, 0.0, 1.20), (6, 0.0, 1.08), (18, 0.0, 1.04), (2, 80e-6, 1.15), (6, 80e-6, 1.12)],
)
def test_intervals_hold_and_errors_are_near_the_best_long(kr270, repeats, common, efficiency):
    """Measured on 1000 tables each: 1.13, 1.05, 1.01, 1.07 and 1.03 times the oracle's error,
    95.4 to 95.8 % held."""
    check(*study(campaign(kr270, repeats), common, 1500, 2), efficiency=efficiency)
