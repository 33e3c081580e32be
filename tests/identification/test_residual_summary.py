"""Residual summaries: exact under the model, invariant to order, and they name what deviates."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse, stats
from support.calibration import binomial_band, table_at

from elastocal.errors import InputError
from elastocal.identification.residuals import (
    MOST_BINS,
    MOST_LISTED,
    ResidualSummary,
    normal_scores,
    simultaneous_level,
    summarise_residuals,
)
from elastocal.model.observations import Observations

LOADS = ((0, 0, 0), (0, 0, -2600.0))


def readings(poses: int, markers: int = 2, forces: Any = LOADS) -> Observations:
    table = table_at(np.zeros((poses, 6)), forces, [f"M{k + 1}" for k in range(markers)])
    n = len(table)
    whole = sparse.csr_array(sparse.eye_array(n))
    return Observations("position", np.zeros(3 * n), whole, np.arange(n), table)


def noise(observed: Observations, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=len(observed.value))


def summary(*arguments: Any, **options: Any) -> ResidualSummary:
    found = summarise_residuals(*arguments, **options)
    assert found is not None
    return found


def test_every_value_is_counted_once_in_every_grouping() -> None:
    observed = readings(10)
    found = summary(observed, noise(observed, 0))
    assert [g.by for g in found.groupings] == ["component", "marker", "configuration", "load state"]
    for g in found.groupings:
        assert sum(group.n for group in g.groups) == len(observed.value)
        for group in g.groups:
            assert group.counts.sum() + group.beyond == group.n
            assert group.expected.sum() == pytest.approx(group.n, rel=0.05)
    names = {g.by: [group.name for group in g.groups] for g in found.groupings}
    assert names["component"] == ["x", "y", "z"]
    assert names["load state"] == ["unloaded", "(0, 0, -2600) N"]


def test_statistics_are_those_of_scipy() -> None:
    observed = readings(40)
    e = noise(observed, 1)
    found = summary(observed, e).groupings[0].groups[1]
    y = e.reshape(-1, 3)[:, 1]
    assert found.mean_square == pytest.approx(np.mean(y**2))
    assert found.skewness == pytest.approx(stats.skew(y))
    assert found.excess_kurtosis == pytest.approx(stats.kurtosis(y))
    assert found.normality_p == pytest.approx(stats.normaltest(y).pvalue)
    assert found.p == pytest.approx(2 * min(stats.chi2.cdf(y @ y, 160), stats.chi2.sf(y @ y, 160)))


def test_the_order_of_the_readings_does_not_matter() -> None:
    observed = readings(10)
    e = noise(observed, 2)
    order = np.random.default_rng(3).permutation(len(observed.lead))
    shuffled = Observations(
        "position", observed.value, observed.combine, observed.lead[order], observed.table
    )
    one = summary(observed, e)
    two = summary(shuffled, e.reshape(-1, 3)[order].ravel())
    np.testing.assert_allclose(one.whole.scores.observed, two.whole.scores.observed)
    for a, b in zip(one.groupings, two.groupings, strict=True):
        first = {g.name: (g.mean_square, g.p_holm) for g in a.groups}
        assert first == {g.name: pytest.approx((g.mean_square, g.p_holm)) for g in b.groups}


def test_unknown_size_of_the_noise_drops_out() -> None:
    observed = readings(10)
    e, h = noise(observed, 4), np.full(len(observed.value), 0.2)
    one = summary(observed, e, h, absolute=False)
    two = summary(observed, 3.7e-5 * e, h, absolute=False)
    np.testing.assert_allclose(one.whole.scores.observed, two.whole.scores.observed)
    assert one.whole.mean_square == pytest.approx(1.0)
    assert one.whole.counts.tolist() == two.whole.counts.tolist()


def test_leverage_makes_residuals_of_a_fit_standard_normal() -> None:
    """With p = 40 of 96 rows fitted, raw residuals have mean square 0.58; z of variance 1."""
    observed = readings(8)
    rng = np.random.default_rng(5)
    Q = np.linalg.qr(rng.normal(size=(96, 40)))[0]
    h = (Q**2).sum(axis=1)
    p, below = [], 0
    for _ in range(250):
        e = rng.normal(size=96)
        e -= Q @ (Q.T @ e)
        whole = summary(observed, e, h).whole
        p.append(whole.p)
        below += whole.p < 0.05
    low, high = binomial_band(250, 0.05)
    assert low <= below <= high
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_expected_counts_of_internally_studentised_residuals() -> None:
    """With 6 degrees of freedom |z| cannot exceed √6; the expected counts are the mean counts."""
    observed = readings(1)
    rng = np.random.default_rng(6)
    Q = np.linalg.qr(rng.normal(size=(12, 6)))[0]
    h = (Q**2).sum(axis=1)
    total = np.zeros(2)
    runs = 600
    for _ in range(runs):
        e = rng.normal(size=12)
        e -= Q @ (Q.T @ e)
        whole = summary(observed, e, h, absolute=False)
        assert np.abs(whole.whole.scores.observed).max() <= np.sqrt(6)
        middle = len(whole.whole.counts) // 2
        total += whole.whole.counts[middle], whole.whole.expected[middle]
    # A count of 12 correlated values has a standard deviation below 2 (measured: 1.6).
    assert abs(total[0] - total[1]) / runs < 4 * 2 / np.sqrt(runs)


def test_a_group_that_scatters_more_is_named_and_clean_tables_name_none() -> None:
    observed = readings(12)
    wrong = 0
    for seed in range(200):
        wrong += bool(summary(observed, noise(observed, seed)).deviating)
    assert wrong <= binomial_band(200, 0.05)[1]  # Holm: at most 5 % of clean tables
    e = noise(observed, 7)
    e[np.repeat(observed.configuration, 3) == 4] *= 3
    assert [(by, g.name) for by, g in summary(observed, e).deviating][:1] == [
        ("configuration", "5")
    ]
    quiet = noise(observed, 7)
    quiet.reshape(-1, 3)[:, 2] *= 0.3
    found = dict((g.name, g) for _, g in summary(observed, quiet).deviating)
    assert found["z"].mean_square < 1


def test_only_the_most_conspicuous_of_many_groups_are_listed() -> None:
    observed = readings(100)
    e = noise(observed, 8)
    loud = np.isin(np.repeat(observed.configuration, 3), [17, 71])
    e[loud] *= 4
    g = next(g for g in summary(observed, e).groupings if g.by == "configuration")
    assert (g.n_groups, g.n_small, len(g.groups)) == (100, 0, MOST_LISTED)
    assert [group.name for group in g.groups if group.deviates] == ["18", "72"]
    assert g.n_deviating == 2


def test_small_groups_are_left_out_and_counted() -> None:
    observed = readings(5, markers=1)  # 6 values in a configuration
    g = next(g for g in summary(observed, noise(observed, 9)).groupings if g.by == "configuration")
    assert (g.n_groups, g.n_small, g.groups) == (5, 5, ())


def test_rows_without_a_residual_are_left_out() -> None:
    observed = readings(10)
    e, h = noise(observed, 10), np.zeros(len(observed.value))
    e[:6], h[:6] = 0.0, 1.0
    found = summary(observed, e, h)
    assert (found.n_alone, found.whole.n) == (6, len(e) - 6)
    assert found.whole.mean_square == pytest.approx(np.mean(e[6:] ** 2))


def test_held_out_mean_square_passes_over_what_cannot_be_held_out() -> None:
    observed = readings(10)
    e = noise(observed, 11)
    held = 2 * e
    held[:12] = np.inf
    assert summary(observed, e).whole.held_out_mean_square is None
    found = summary(observed, e, held_out=held).whole
    assert found.held_out_mean_square == pytest.approx(4 * np.mean(e[12:] ** 2))


def test_nothing_to_summarise() -> None:
    observed = readings(10)
    assert summarise_residuals(observed, np.zeros(len(observed.value))) is None
    assert summarise_residuals(observed, noise(observed, 0), np.ones(len(observed.value))) is None


def test_wild_values_do_not_blow_up_the_histogram() -> None:
    observed = readings(10)
    e = noise(observed, 12)
    e[0] = 1e9
    whole = summary(observed, e).whole
    assert len(whole.counts) <= MOST_BINS
    assert whole.beyond == 1


@given(
    e=st.lists(st.floats(-1e6, 1e6, allow_subnormal=False), min_size=24, max_size=24),
    h=st.lists(st.floats(0, 1), min_size=24, max_size=24),
    absolute=st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_any_finite_residuals_give_a_summary_that_json_can_hold(
    e: list[float], h: list[float], absolute: bool
) -> None:
    found = summarise_residuals(readings(2), e, h, absolute=absolute)
    if found is not None:
        json.loads(json.dumps(found.to_json(), allow_nan=False))
        assert found.whole.counts.sum() + found.whole.beyond == found.whole.n


@pytest.mark.parametrize(
    ("e", "h", "message"),
    [
        (np.zeros(5), None, "must be 12 values"),
        (np.full(12, np.nan), None, "finite"),
        (np.ones(12), np.full(12, 1.5), "between 0 and 1; found 0 to 1.5"),
        (np.ones(12), np.zeros(3), "leverages must be 12 values"),
    ],
)
def test_wrong_input(e: np.ndarray, h: np.ndarray | None, message: str) -> None:
    with pytest.raises(InputError, match=message):
        summarise_residuals(readings(1), e, h)


@pytest.mark.parametrize("n", [8, 15, 50, 150, 400])
def test_band_holds_the_whole_sample_in_95_percent(n: int) -> None:
    """1500 samples: the binomial band at 99.9 % is ± 1.9 %, beside 0.5 % for the approximation."""
    rng = np.random.default_rng(n)
    outside = sum(not normal_scores(rng.normal(size=n), n).inside for _ in range(1500))
    low, high = binomial_band(1500, 0.05)
    assert low - 8 <= outside <= high + 8


def test_scores_of_a_small_sample_are_all_of_it() -> None:
    z = np.random.default_rng(13).normal(size=30)
    found = normal_scores(z)
    np.testing.assert_array_equal(found.observed, np.sort(z))
    np.testing.assert_allclose(found.expected, -found.expected[::-1], atol=1e-12)
    np.testing.assert_allclose(found.low, -found.high[::-1], rtol=1e-9)
    np.testing.assert_allclose(found.expected[0], stats.norm.ppf(0.625 / 30.25))


def test_scores_of_a_large_sample_are_thinned_evenly_and_keep_its_ends() -> None:
    z = np.random.default_rng(14).normal(size=100_000)
    found = normal_scores(z, 200)
    assert 100 < len(found.observed) <= 200
    assert (found.observed[0], found.observed[-1]) == (z.min(), z.max())
    assert np.diff(found.expected).max() < 0.35
    assert np.isin(found.observed, z).all()
    assert (np.diff(found.high) > 0).all()


def test_local_level_falls_with_n_and_lies_above_bonferroni() -> None:
    n = np.array([8, 9, 20, 49, 50, 199, 200, 1000, 10**6])
    level = np.array([simultaneous_level(int(k)) for k in n])
    assert ((level > 0.05 / n) & (level < 0.05)).all()
    assert (np.diff(level[[0, 2, 4, 6, 7, 8]]) < 0).all()
