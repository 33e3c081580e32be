"""Which noise is found, and which readings it does not explain, on made-up linear tables."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from engine.dense import Table, own_parts, readings, shared_part
from scipy import stats

from elastocal.identification.noise_choice import estimate_noise, own_noise
from elastocal.identification.noise_structure import STRUCTURES
from elastocal.identification.outliers import FALSE_ALARM, prediction_errors, settle
from elastocal.messages import InputError, InsufficientDataError

BASE = Table(configurations=12, markers=3, repeats=4, unbalanced=False)


def drawn(kind, rng, r):
    z = rng.normal(size=r.e.shape)
    name, _, shared = kind.partition("+")
    if name == "independent":
        e = 2e-5 * z
    elif name == "axis":
        e = z * [1e-5, 2e-5, 4e-5]
    elif name == "marker":
        e = z * np.array([1e-5, 2e-5, 4e-5])[r.marker, None]
    elif name == "groups":
        e = z * np.exp(rng.normal(np.log(2e-5), 0.8, size=(12, 3)))[r.configuration]
    elif name == "polar":
        across = np.sqrt((1e-5) ** 2 + (1e-5 * r.reach) ** 2)
        frame = np.stack([np.full(len(r), 5e-6), across, across], axis=1)
        e = np.einsum("nij,ni->nj", r.sight, frame * z)
    else:
        e = np.einsum("nij,nj->ni", np.linalg.cholesky(r.stated), z)
    if shared:
        e = e + 4e-5 * rng.normal(size=(12, 3))[r.configuration]
    return e


@pytest.mark.parametrize(
    "kind", ["independent", "marker", "groups", "stated", "axis+configuration",
             "polar+configuration"],
)  # fmt: skip
def test_each_noise_is_told_apart(kind):
    """In at least 4 of 5 tables the very kind: Schwarz's criterion picks a structure with two
    variances too many in 0.2 % of tables of 432 rows, Akaike's shared effects in 1 of 6 at most."""
    rng, r = np.random.default_rng(3), readings(BASE, 9)
    chosen = Counter(estimate_noise(replace(r, e=drawn(kind, rng, r))).kind for _ in range(5))
    assert chosen[kind] >= 4, chosen


def test_what_cannot_be_asked_for_is_refused():
    with pytest.raises(InputError, match=r"found 'axes'.*did you mean 'axis'"):
        estimate_noise(readings(BASE, 0), "axes")
    alone = readings(Table(configurations=40, markers=1, repeats=1, unbalanced=False), 0)
    for kind in (f"{name}+configuration" for name in STRUCTURES):
        needed = "repeats or several markers|too few readings"
        with pytest.raises((InputError, InsufficientDataError), match=needed):
            estimate_noise(alone, kind)
    for kind, table in (("polar", Table(size=1)), ("marker", Table(size=6, markers=1))):
        with pytest.raises(InputError):
            estimate_noise(readings(table, 0), kind)
    few = readings(Table(configurations=8, markers=1, repeats=2, unbalanced=False), 0)
    with pytest.raises(InsufficientDataError, match="repeat readings, or choose another"):
        estimate_noise(few, "groups")
    none = readings(Table(configurations=4, markers=1, repeats=1, p=12, unbalanced=False), 0)
    with pytest.raises(InsufficientDataError, match=r"measure more|fit fewer"):
        estimate_noise(none)
    B = np.concatenate([few.B, few.B[:, :, :1] + 2 * few.B[:, :, 1:2]], axis=2)
    with pytest.raises(InputError, match=r"columns \[\d\] of B depend on the others"):
        estimate_noise(replace(few, B=B))


def test_an_effect_that_the_parameters_explain_is_left_out():
    """A free offset per configuration: what a configuration shares cannot be told from it."""
    r = readings(Table(configurations=4, markers=1, repeats=4, unbalanced=False), 1, shared=5e-5)
    B = np.zeros((len(r), 3, 12))
    for c in range(4):
        B[r.configuration == c, :, 3 * c : 3 * c + 3] = np.eye(3)
    r = replace(r, B=B @ np.random.default_rng(1).normal(size=(12, 12)))
    found, plain = (estimate_noise(r, "independent" + more) for more in ("+configuration", ""))
    assert not found.fit.common.any() and found.fit.converged
    np.testing.assert_allclose(found.covariance.std, plain.covariance.std, rtol=1e-5)


# Which readings are judged to be faulty.


def predicted(r, V, known, i):
    """Error of the best prediction of reading i from those `known`, over its deviation, at V."""
    size = r.size
    a = (known[:, None] * size + np.arange(size)).ravel()
    b = i * size + np.arange(size)
    B, e = r.B.reshape(-1, r.n_parameters), r.e.ravel()
    W = np.linalg.inv(V[np.ix_(a, a)])
    Phi = np.linalg.inv(B[a].T @ W @ B[a])
    x = Phi @ B[a].T @ W @ e[a]
    k = V[np.ix_(b, a)] @ W
    F = B[b] - k @ B[a]
    spread = V[np.ix_(b, b)] - k @ V[np.ix_(a, b)] + F @ Phi @ F.T
    return (e[b] - B[b] @ x - k @ (e[a] - B[a] @ x)) / np.sqrt(np.diag(spread))


def table(seed=0, **changes):
    return readings(Table(**{"configurations": 8, "markers": 3, **changes}), seed, shared=2e-5)


@pytest.mark.parametrize(
    ("own", "shared"), [("marker", ""), ("polar", "+configuration"), ("stated", "+configuration")]
)
def test_readings_are_judged_as_if_each_were_deleted(own, shared):
    """Those of the fit, and those outside it: some with mates in their configuration or set, some
    whose configuration is not fitted."""
    r = table()
    good = np.random.default_rng(3).random(len(r)) < 0.8
    good[r.configuration == 2] = False
    found = estimate_noise(r.take(good), own + shared)
    t = prediction_errors(found, r, good, own_noise(found.fit, r)[0])
    fit = found.fit
    parts = own_parts(own, r, fit.noisy.structure.names) + [
        shared_part(d.name, r) for d in fit.noisy.deviations
    ]
    V = sum(v * part for v, part in zip(fit.theta, parts, strict=True))
    for i in range(len(r)):
        others = np.flatnonzero(good & (np.arange(len(r)) != i))
        np.testing.assert_allclose(t[i], predicted(r, V, others, i), rtol=1e-3, atol=2e-3)


@pytest.mark.parametrize("kind", ["independent", "auto"])
def test_false_alarms_on_clean_tables_are_as_rare_as_stated(kind):
    """1 % per table, Bonferroni; more than the 99.99 % point of the binomial is too many."""
    rng, alarms = np.random.default_rng(12), 0
    r = table(1, configurations=10, repeats=3, unbalanced=False)
    tables = 120 if kind == "independent" else 15
    for _ in range(tables):
        alarms += not settle(replace(r, e=1e-5 * rng.normal(size=r.e.shape)), kind)[1].all()
    assert alarms <= stats.binom.ppf(0.9999, tables, FALSE_ALARM)
