"""Wild cluster bootstrap: against literal refits, exactness, inversion, coverage, bad input."""

import itertools

import numpy as np
import pytest

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification import cluster_robust, wild_cluster_bootstrap


def problem(seed, clusters=6, rows=5, p=3):
    rng = np.random.default_rng(seed)
    cluster = rng.permutation(np.repeat(np.arange(clusters), rows))
    B = rng.normal(size=(len(cluster), p)) + rng.normal(size=(clusters, p))[cluster]
    y = B @ np.ones(p) + rng.normal(size=len(B)) + rng.normal(size=clusters)[cluster]
    return B, y, cluster


def solve(B, y):
    return np.linalg.lstsq(B, y, rcond=None)[0]


def refitted_p(B, y, cluster, j, value, points, restricted):
    """The definition: residuals of the (restricted) fit, times v per cluster, refit, |t*| ≥ |t|."""

    def t_of(data, null):
        x = solve(B, data)
        return (x[j] - null) / cluster_robust(B, data - B @ x, cluster, "CR0").std[j]

    if restricted:
        others = np.delete(np.arange(B.shape[1]), j)
        start = np.zeros(B.shape[1])
        start[j] = value
        start[others] = solve(B[:, others], y - value * B[:, j])
    else:
        start = solve(B, y)
    e = y - B @ start
    labels = np.unique(cluster)
    t = abs(t_of(y, value))
    every = [
        abs(t_of(B @ start + np.array(v)[np.searchsorted(labels, cluster)] * e, start[j]))
        for v in itertools.product(points, repeat=len(labels))
    ]
    return np.mean(np.array(every) >= t * (1 - 1e-9))


@pytest.mark.parametrize("restricted", [True, False])
@pytest.mark.parametrize("weights", ["rademacher", "webb"])
def test_equals_literal_refits(weights, restricted):
    """All draws enumerated, so the p-values agree exactly; only half of them are kept, as v and
    −v give the same |t*|."""
    clusters = 6 if weights == "rademacher" else 3
    B, y, cluster = problem(1, clusters, rows=6)
    six = np.sqrt([1.5, 1.0, 0.5])
    points = (-1.0, 1.0) if weights == "rademacher" else (*-six, *six)
    found = wild_cluster_bootstrap(B, y, cluster, weights=weights)
    assert found.exact and found.top.shape[2] == len(points) ** clusters // 2
    for j, value in [(0, 0.0), (1, 0.7), (2, 1.8), (0, 5.0)]:
        expected = refitted_p(B, y, cluster, j, value, points, restricted)
        assert found.p_value(j, value, restricted) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("restricted", [True, False])
def test_the_interval_inverts_the_test(restricted):
    """p exceeds 5 % just inside and not just outside; 1e-6 of std is far over the bisection's
    precision."""
    B, y, cluster = problem(2, clusters=14)
    found = wild_cluster_bootstrap(B, y, cluster, draws=399, seed=3)
    for j, (low, high) in enumerate(found.interval(0.95, restricted)):
        assert low < found.x[j] < high
        step = 1e-6 * found.std[j]
        for end, inwards in ((low, step), (high, -step)):
            assert found.p_value(j, end + inwards, restricted) > 0.05
            assert found.p_value(j, end - inwards, restricted) <= 0.05


def test_unrestricted_interval_is_symmetric_percentile_t():
    """Half-width std times the (draws + 1)·0.95-th smallest |t*|."""
    B, y, cluster = problem(4, clusters=13)
    found = wild_cluster_bootstrap(B, y, cluster, draws=199)
    t = np.abs(found.top[:, 0]) / np.sqrt(found.radicand[:, 0])
    half = np.sort(t, axis=1)[:, 189] * found.std
    expected = np.column_stack([found.x - half, found.x + half])
    np.testing.assert_allclose(found.interval(0.95, restricted=False), expected, rtol=1e-6)


def test_the_data_count_as_one_of_the_random_draws():
    """A value far beyond every draw has p = 1/(draws + 1), never 0."""
    B, y, cluster = problem(4, clusters=13)
    found = wild_cluster_bootstrap(B, y, cluster, draws=199)
    assert found.p_value(0, 1e9, restricted=False) == 1 / 200


def test_data_moved_by_a_fit_move_the_interval():
    """y + B c shifts every interval by c: residuals are what is resampled."""
    B, y, cluster = problem(5)
    c = np.array([3.0, -2.0, 0.5])
    first = wild_cluster_bootstrap(B, y, cluster, draws=199, seed=1).interval()
    moved = wild_cluster_bootstrap(B, y + B @ c, cluster, draws=199, seed=1).interval()
    np.testing.assert_allclose(moved - c[:, None], first, rtol=1e-6, atol=1e-6)


def test_seed_blocks_and_weights(monkeypatch):
    """Reproducible by seed, whatever the blocks; "auto" is Webb below twelve clusters."""
    B, y, cluster = problem(6, clusters=11)
    one = wild_cluster_bootstrap(B, y, cluster, draws=99, seed=5)
    other = wild_cluster_bootstrap(B, y, cluster, draws=99, seed=6)
    assert one.weights == "webb" and not np.array_equal(one.top, other.top)
    monkeypatch.setattr("elastocal.identification.bootstrap.ENTRIES", 11 * 7)
    again = wild_cluster_bootstrap(B, y, cluster, draws=99, seed=5)
    np.testing.assert_allclose(again.top, one.top, rtol=1e-12)
    B, y, cluster = problem(6, clusters=12)
    assert wild_cluster_bootstrap(B, y, cluster, draws=99).weights == "rademacher"


def test_too_few_clusters_leave_the_interval_unbounded():
    """Rademacher with five clusters: 16 distinct |t*|, so p never falls below 1/16 > 5 %; Webb
    weights tell more."""
    B, y, cluster = problem(7, clusters=5, rows=12)
    found = wild_cluster_bootstrap(B, y, cluster, weights="rademacher")
    assert np.isinf(found.interval(0.95)).all()
    assert "all 16 distinct draws of rademacher" in found.description
    assert np.isfinite(found.interval(0.90)).any()


def test_parameters_of_a_single_cluster_are_unbounded():
    rng = np.random.default_rng(8)
    cluster = np.repeat(np.arange(12), 4)
    B = np.column_stack([rng.normal(size=48), cluster == 3]).astype(float)
    B[cluster == 3, 0] = 0.0
    found = wild_cluster_bootstrap(B, rng.normal(size=48), cluster, draws=199)
    interval = found.interval()
    assert np.isfinite(interval[0]).all() and np.isinf(interval[1]).all()
    assert found.p_value(1, 100.0) == 1.0


def coverage(replications, clusters, seed):
    """Share of p ≤ 5 % at the truth: restricted bootstrap, and CR0 with normal quantiles."""
    rng = np.random.default_rng(seed)
    cluster = np.repeat(np.arange(clusters), 5)
    level = rng.normal(size=clusters)
    B = np.column_stack([np.ones(len(cluster)), level[cluster]])
    spread = 0.5 + np.abs(level) / np.abs(level).max()
    rejected, naive = np.zeros(2), np.zeros(2)
    for k in range(replications):
        u = spread[cluster] * (rng.normal(size=clusters)[cluster] + rng.normal(size=len(cluster)))
        found = wild_cluster_bootstrap(B, u, cluster, draws=199, seed=k)
        rejected += [found.p_value(j, 0.0) <= 0.05 for j in range(2)]
        naive += np.abs(found.x) > 1.96 * found.std
    return rejected / replications, naive / replications


def test_holds_its_level_where_cr0_does_not():
    """800 data sets of 9 heteroscedastic clusters: 5 % within 3.5 % (three binomial standard
    deviations are 2.3 %, the bootstrap's own error at nine clusters about 1 %)."""
    rejected, naive = coverage(800, 9, 9)
    assert (np.abs(rejected - 0.05) < 0.035).all()
    assert (naive > 0.1).all()


@pytest.mark.long
@pytest.mark.parametrize("clusters", [8, 15, 30])
def test_holds_its_level_over_many_data_sets(clusters):
    rejected, _ = coverage(5000, clusters, clusters)
    assert (np.abs(rejected - 0.05) < 0.025).all()


def test_bad_input_is_told():
    B, y, cluster = problem(10, clusters=14)
    with pytest.raises(InputError, match="draws must be at least 1"):
        wild_cluster_bootstrap(B, y, cluster, draws=0)
    with pytest.raises(InputError, match="mammen"):
        wild_cluster_bootstrap(B, y, cluster, weights="mammen")
    with pytest.raises(InputError, match="no residual in some parameter"):
        wild_cluster_bootstrap(B, np.zeros(len(B)), cluster)
    with pytest.raises(InsufficientDataError, match="all rows are in one"):
        wild_cluster_bootstrap(B, y, 0 * cluster)
    with pytest.raises(InputError, match="needs at least 999 draws"):
        wild_cluster_bootstrap(B, y, cluster, draws=99).interval(0.999)
    with pytest.raises(InputError, match="level"):
        wild_cluster_bootstrap(B, y, cluster, draws=99).interval(95)
