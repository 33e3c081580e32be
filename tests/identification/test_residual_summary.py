"""Residual summaries: exact under the model, invariant to order, and they name what deviates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import sparse, stats
from support.calibration import binomial_band, table_at

from elastocal.identification.noise_summary import normal_scores, summarise_residuals
from elastocal.model.observations import Observations

LOADS = ((0, 0, 0), (0, 0, -2600.0))


def readings(poses: int, markers: int = 2, forces: Any = LOADS) -> Observations:
    table = table_at(np.zeros((poses, 6)), forces, [f"M{k + 1}" for k in range(markers)])
    n = len(table)
    whole = sparse.csr_array(sparse.eye_array(n))
    return Observations("position", np.zeros(3 * n), whole, np.arange(n), table)


def noise(observed: Observations, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=len(observed.value))


def test_leverage_makes_residuals_of_a_fit_standard_normal() -> None:
    """With p = 40 of 96 rows fitted, raw residuals have mean square 0.58; z of variance 1."""
    observed = readings(8)
    rng = np.random.default_rng(5)
    Q = np.linalg.qr(rng.normal(size=(96, 40)))[0]
    h = (Q**2).sum(axis=1)
    p, below = [], 0
    for _ in range(120):
        e = rng.normal(size=96)
        e -= Q @ (Q.T @ e)
        whole = summarise_residuals(observed, e, h).whole
        p.append(whole.p)
        below += whole.p < 0.05
    low, high = binomial_band(120, 0.05)
    assert low <= below <= high
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_a_group_that_scatters_more_is_named_and_clean_tables_name_none() -> None:
    observed = readings(12)
    wrong = 0
    for seed in range(80):
        wrong += bool(summarise_residuals(observed, noise(observed, seed)).deviating)
    assert wrong <= binomial_band(80, 0.05)[1]  # Holm: at most 5 % of clean tables
    e = noise(observed, 7)
    e[np.repeat(observed.configuration, 3) == 4] *= 3
    assert [(by, g.name) for by, g in summarise_residuals(observed, e).deviating][:1] == [
        ("configuration", "5")
    ]
    quiet = noise(observed, 7)
    quiet.reshape(-1, 3)[:, 2] *= 0.3
    found = dict((g.name, g) for _, g in summarise_residuals(observed, quiet).deviating)
    assert found["z"].mean_square < 1


@pytest.mark.parametrize("n", [8, 50])
def test_band_holds_the_whole_sample_in_95_percent(n: int) -> None:
    """1500 samples: the binomial band at 99.9 % is ± 1.9 %, beside 0.5 % for the approximation."""
    rng = np.random.default_rng(n)
    outside = sum(not normal_scores(rng.normal(size=n), n).inside for _ in range(1500))
    low, high = binomial_band(1500, 0.05)
    assert low - 8 <= outside <= high + 8
