"""The criterion finds the noise that was simulated; what cannot be asked for is refused."""

from collections import Counter

import numpy as np
import pytest
from identification.variance.dense import Table, readings

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.noise_choice import estimate_noise
from elastocal.identification.noise_structure import noise_models

BASE = Table(configurations=12, markers=3, repeats=4, unbalanced=False)


def drawn(kind, rng, r):
    """Residuals under a noise of that kind, in m."""
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
    "kind",
    [
        "independent",
        "marker",
        "groups",
        "polar",
        "stated",
        "axis+configuration",
        "polar+configuration",
    ],
)
def test_each_noise_is_told_apart(kind):
    """In at least 9 of 12 tables the very kind: Schwarz's criterion picks a structure with two
    variances too many in 0.2 % of tables of 432 rows, Akaike's shared effects in 1 of 6 at most."""
    rng = np.random.default_rng(3)
    r = readings(BASE, 9)
    chosen = Counter(estimate_noise(r.moved(drawn(kind, rng, r))).kind for _ in range(12))
    assert chosen[kind] >= 9, chosen


def test_variances_are_the_simulated_ones():
    """Median over tables, within 10 %: axis, polar and shared variances."""
    rng = np.random.default_rng(4)
    r = readings(BASE, 9)
    axis = [estimate_noise(r.moved(drawn("axis", rng, r)), "axis").fit.own for _ in range(20)]
    np.testing.assert_allclose(np.median(axis, axis=0), [1e-10, 4e-10, 16e-10], rtol=0.1)
    polar = [estimate_noise(r.moved(drawn("polar", rng, r)), "polar").fit.own for _ in range(40)]
    np.testing.assert_allclose(np.median(polar, axis=0)[[0, 2]], [25e-12, 1e-10], rtol=0.1)
    kind = "independent+configuration"
    common = [estimate_noise(r.moved(drawn(kind, rng, r)), kind).fit.common for _ in range(40)]
    assert np.median(common, axis=0)[0] == pytest.approx(16e-10, rel=0.1)
    stated = [estimate_noise(r.moved(drawn("stated", rng, r)), "stated").fit.own for _ in range(20)]
    np.testing.assert_allclose(np.median(stated, axis=0), 1.0, rtol=0.1)


def test_an_unknown_kind_is_refused_with_the_nearest_name():
    with pytest.raises(InputError, match=r"found 'axes'.*did you mean 'axis'"):
        estimate_noise(readings(BASE, 0), "axes")


@pytest.mark.parametrize("kind", [k for k in noise_models() if k.endswith("+configuration")])
def test_shared_effects_need_something_to_share(kind):
    """One reading in each configuration: its own noise covers what it would share."""
    r = readings(Table(configurations=40, markers=1, repeats=1, unbalanced=False), 0)
    needed = "repeats or several markers|too few readings"
    with pytest.raises((InputError, InsufficientDataError), match=needed):
        estimate_noise(r, kind)


@pytest.mark.parametrize(
    ("kind", "table"),
    [
        ("polar", Table(size=1)),
        ("polar", Table(size=6, markers=1)),
        ("marker", Table(size=1)),
        ("marker", Table(size=6)),
    ],
)
def test_kinds_that_the_readings_do_not_allow_are_refused(kind, table):
    with pytest.raises(InputError):
        estimate_noise(readings(table, 0), kind)


@pytest.mark.parametrize("kind", ["auto", "independent"])
def test_no_more_rows_than_parameters_is_not_enough(kind):
    r = readings(Table(configurations=4, markers=1, repeats=1, p=12, unbalanced=False), 0)
    with pytest.raises(InsufficientDataError, match=r"measure more|fit fewer"):
        estimate_noise(r, kind)


def test_few_rows_to_spare_leave_one_variance():
    """Sixteen rows beyond the parameters are enough for three variances, twelve for one only."""
    few = readings(Table(configurations=8, markers=1, repeats=1, p=12, unbalanced=False), 0)
    found = estimate_noise(few)
    assert {t.kind for t in found.trials} == {"independent", "stated"}
    more = readings(Table(configurations=10, markers=1, repeats=1, p=12, unbalanced=False), 0)
    assert "axis" in {t.kind for t in estimate_noise(more).trials}
