"""Covariances of a fit: clusters against statsmodels and clubSandwich, bad input, mixtures.

The printed values are outputs in the documentation of the R package clubSandwich (Pustejovsky;
reference pages vcovCR.lm and vcovCR.lm_robust) for R's data set ChickWeight (Crowder & Hand 1990):
growth curves of 50 chicks on four diets, clusters of 2 to 12.
"""

from pathlib import Path

import numpy as np
import pytest
import statsmodels.api as sm
from scipy import stats

from elastocal.identification.least_squares import Covariance, clustered, drawing_root, orthogonal
from elastocal.messages import InputError, InsufficientDataError


def cluster_robust(B, e, cluster, kind="CR2"):
    Q, V = orthogonal(B)
    return clustered([(Q, e, cluster)], V, kind)


def hc(B, e, kind):
    return cluster_robust(B, e, np.arange(len(e)), kind)


def residual(B, y):
    return y - B @ np.linalg.lstsq(B, y, rcond=None)[0]


def problem(seed, n=40, p=4, clusters=7):
    """Unequal clusters in no order, with an error common to each."""
    rng = np.random.default_rng(seed)
    cluster = rng.integers(0, clusters, n) * 3 - 5
    cluster[:clusters] = np.arange(clusters) * 3 - 5  # none empty
    B = rng.normal(size=(n, p))
    y = rng.normal(size=n) + rng.normal(size=clusters)[(cluster + 5) // 3]
    return B, residual(B, y), cluster


@pytest.mark.parametrize("kind", ["HC0", "HC1", "HC2", "HC3"])
def test_singleton_clusters_are_rows(kind):
    """HC of statsmodels, with n − p degrees of freedom where leverage is not corrected."""
    B, e, _ = problem(5)
    found = hc(B, e, kind)
    fitted = sm.OLS(B @ np.arange(4.0) + e, B).fit()
    np.testing.assert_allclose(found.matrix, getattr(fitted, f"cov_{kind}"), rtol=1e-8)
    assert (found.dof == 36.0).all() == (kind in ("HC0", "HC1"))


def test_a_row_of_leverage_one_leaves_its_parameter_unbounded():
    B, e, _ = problem(8)
    B = np.column_stack([B, np.eye(len(B))[17]])
    assert hc(B, residual(B, e), "HC2").dof[4] == 0
    with pytest.raises(InsufficientDataError, match=r"17 alone .* use HC2"):
        hc(B, residual(B, e), "HC3")


def test_clusters_are_those_of_statsmodels():
    B, e, cluster = problem(7)
    fitted = sm.OLS(B @ np.arange(4.0) + e, B).fit()
    theirs = fitted.get_robustcov_results("cluster", groups=cluster + 5).cov_params()
    np.testing.assert_allclose(cluster_robust(B, e, cluster, "CR1").matrix, theirs, rtol=1e-8)


def test_rows_may_come_in_parts(kind="CR2"):
    B, e, cluster = problem(6)
    whole, (Q, V) = cluster_robust(B, e, cluster, kind), orthogonal(B)
    some = np.isin(cluster, np.unique(cluster)[:3])
    parts = [(Q[own], e[own], cluster[own]) for own in (some, ~some)]
    found = clustered(parts, V, kind)
    np.testing.assert_allclose(found.matrix, whole.matrix, rtol=1e-9)
    np.testing.assert_allclose(found.dof, whole.dof, rtol=1e-9)


def test_bad_input_is_told():
    B, e, cluster = problem(11)
    with pytest.raises(InsufficientDataError, match="all rows are in one"):
        cluster_robust(B, e, np.zeros(len(B), dtype=int))
    with pytest.raises(InputError, match=r"columns \[\d\] of B depend"):
        cluster_robust(np.column_stack([B, B[:, 0] - B[:, 1]]), e, cluster)
    with pytest.raises(InsufficientDataError, match="no residual"):
        cluster_robust(B[:4], e[:4], cluster[:4])


def chicks():
    """weight (578,), time (578,), chick (578,), diet (578,)."""
    lines = (Path(__file__).parent / "chick_weight.csv").read_text().splitlines()[1:]
    days = [*range(0, 21, 2), 21]
    rows = []
    for chick, line in enumerate(lines, start=1):
        diet, weights = line.split(",")
        rows += [
            (float(w), d, chick, int(diet)) for w, d in zip(weights.split(), days, strict=False)
        ]
    weight, time, chick, diet = np.array(rows).T
    return weight, time, chick.astype(int), diet.astype(int)


def test_clubsandwich_vcov_of_chick_weights():
    """lm(weight ~ Time + Diet:Time), vcovCR(type = "CR2") as printed, 7 decimals; SE and d.f. as
    conf_int prints them for the same fit by lm_robust."""
    weight, time, chick, diet = chicks()
    assert len(weight) == 578
    B = np.column_stack([np.ones(578), time, *(time * (diet == d) for d in (2, 3, 4))])
    order = np.random.default_rng(1).permutation(578)
    found = cluster_robust(B[order], residual(B, weight)[order], chick[order], "CR2")
    printed = [
        [3.9317840, -0.7851508, -0.2560762, -0.0750498, 0.2695861],
        [-0.7851508, 0.4360726, -0.3314209, -0.3436398, -0.3665016],
        [-0.2560762, -0.3314209, 1.3680862, 0.3475327, 0.3482061],
        [-0.0750498, -0.3436398, 0.3475327, 1.1195632, 0.3483146],
        [0.2695861, -0.3665016, 0.3482061, 0.3483146, 0.5416587],
    ]
    np.testing.assert_allclose(found.matrix, printed, rtol=0, atol=5.1e-8)
    np.testing.assert_allclose(found.std, [1.983, 0.660, 1.170, 1.058, 0.736], atol=5.1e-4)
    np.testing.assert_allclose(found.dof, [48.7, 31.4, 19.0, 19.0, 18.4], atol=0.051)
    x = np.linalg.lstsq(B, weight, rcond=None)[0]
    low, high = found.interval(x).T
    np.testing.assert_allclose(low, [23.874, 5.703, -0.837, 1.524, 1.317], atol=5.1e-4)
    np.testing.assert_allclose(high[[0, 1]], [31.84, 8.40], atol=5.1e-3)


@pytest.mark.parametrize("sizes", [(1.0, 1.0, 1.0), (0.3, 1.0, 4.0)])
def test_a_mixture_of_models_holds_what_it_says(sizes):
    """Errors that are normal with one of several variances: t with their variance and kurtosis."""
    weights = (0.3, 0.5, 0.2)
    among = tuple((w, np.diag([s, 1.0])) for w, s in zip(weights, sizes, strict=True))
    mean = sum(w * C for w, C in among)
    found = Covariance("x", mean, np.full(2, np.inf), "", among)
    dof, share = found.tails(np.eye(2)[:, None])
    assert dof[1] == np.inf and share[1] == 1.0
    found = Covariance("x", mean, dof, "", among)
    for level, slack in ((0.95, 0.008), (0.9973, 0.003)):
        half = found.interval(np.zeros(2), level)[0, 1]
        beyond = sum(w * 2 * stats.norm.sf(half / np.sqrt(C[0, 0])) for w, C in among)
        assert beyond == pytest.approx(1 - level, abs=slack)


def test_what_does_not_vary_correlates_with_nothing():
    pinned = Covariance(
        "t", np.array([[4.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0] * 3]), np.ones(3), ""
    )
    assert np.array_equal(pinned.correlation, [[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0] * 3])


def test_draws_do_not_turn_by_rounding():
    """Alike eigenvalues turn their axes by last digits; what does not vary is not drawn."""
    rng, unit = np.random.default_rng(0), np.array([1.0, 1.0, 1e6, 1e6, 0.0])
    rounded = 1 + 1e-14 * rng.normal(size=(5, 5))
    covariance = np.eye(5) * unit**2
    covariance[0, 1] = covariance[1, 0] = 1e-13
    root = drawing_root(covariance)
    np.testing.assert_allclose(root @ root.T, covariance, rtol=1e-12, atol=1e-12)
    again = drawing_root(covariance * (rounded + rounded.T) / 2)
    np.testing.assert_allclose(again, root, rtol=0, atol=1e-12 * unit.max())
