"""Influence in closed form equals leaving out and refitting."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from statsmodels.api import OLS

from elastocal.errors import InputError
from elastocal.identification import influence


def refits(B, y, labels, size):
    """Everything that `influence` states, by solving without each group."""
    m, p = B.shape
    x = np.linalg.lstsq(B, y)[0]
    cofactor = np.linalg.inv(B.T @ B)
    rss = ((y - B @ x) ** 2).sum()
    s2 = rss / (m - p)
    for label in np.unique(labels):
        out = np.repeat(labels == label, size)
        without = np.linalg.lstsq(B[~out], y[~out])[0]
        rss_out = ((y[~out] - B[~out] @ without) ** 2).sum()
        dof = m - out.sum() - p
        s2_out = rss_out / dof
        shift = x - without
        F = (rss - rss_out) / out.sum() / s2_out
        yield {
            "shift": shift,
            "dfbetas": shift / np.sqrt(s2_out * np.diag(cofactor)),
            "cook": shift @ (B.T @ B) @ shift / (p * s2),
            "covratio": np.linalg.det(s2_out * np.linalg.inv(B[~out].T @ B[~out]))
            / np.linalg.det(s2 * cofactor),
            "F": F,
            "p_value": stats.f.sf(F, out.sum(), dof),
            "held_out": (y - B @ without)[out],
        }


@pytest.mark.parametrize("grouping", ["reading", "marker", "configuration", "uneven"])
def test_every_figure_equals_a_refit(arm, grouping):
    rng = np.random.default_rng(1)
    y = arm.observed(arm.errors(rng, 0.05)[0])
    labels = {
        "reading": np.arange(270),
        "marker": arm.marker,
        "configuration": arm.configuration,
        "uneven": rng.choice([3, 5, 8, 100], 270, p=[0.01, 0.04, 0.25, 0.7]),
    }[grouping]
    found = influence(arm.B, y, labels, size=3)
    assert np.array_equal(found.label, np.unique(labels))
    for k, expected in enumerate(refits(arm.B, y, labels, 3)):
        held = found.held_out[np.repeat(labels == found.label[k], 3)]
        np.testing.assert_allclose(held, expected.pop("held_out"), rtol=1e-8, atol=1e-10)
        for name, value in expected.items():
            np.testing.assert_allclose(
                getattr(found, name)[k], value, rtol=1e-7, atol=1e-11, err_msg=name
            )


def test_by_row_it_is_statsmodels():
    rng = np.random.default_rng(2)
    B = rng.normal(size=(40, 3))
    y = B @ np.ones(3) + rng.normal(size=40)
    reference = OLS(y, B).fit().get_influence()
    found = influence(B, y)
    np.testing.assert_allclose(found.dfbetas, reference.dfbetas, rtol=1e-9)
    np.testing.assert_allclose(found.cook, reference.cooks_distance[0], rtol=1e-9)
    np.testing.assert_allclose(found.covratio, reference.cov_ratio, rtol=1e-9)
    np.testing.assert_allclose(found.F, reference.resid_studentized_external**2, rtol=1e-9)


def test_p_values_of_clean_groups_are_uniform(arm):
    """Kolmogorov and Smirnov at 1 in 1000, one group from each of 300 tables."""
    rng = np.random.default_rng(3)
    p = [
        influence(arm.B, arm.observed(arm.errors(rng)[0]), arm.configuration, size=3).p_value[
            k % 15
        ]
        for k in range(300)
    ]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_a_group_that_alone_determines_a_parameter_has_no_held_out_fit(arm):
    """The first five columns are seen in three configurations each."""
    y = arm.observed(arm.errors(np.random.default_rng(4))[0])
    found = influence(arm.B, y, arm.configuration // 3, size=3)
    assert np.isinf(found.held_out).all()
    assert np.isnan(found.shift).all() and np.isnan(found.F).all()


@settings(deadline=None)
@given(size=st.integers(1, 3), n=st.integers(6, 12), groups=st.integers(1, 6))
def test_any_grouping_is_answered(size, n, groups):
    rng = np.random.default_rng(n)
    B, y = rng.normal(size=(n * size, 2)), rng.normal(size=n * size)
    labels = rng.integers(0, groups, n)
    found = influence(B, y, labels, size=size)
    assert found.rows.sum() == n * size
    known = np.isfinite(found.F)
    assert ((found.p_value[known] >= 0) & (found.p_value[known] <= 1)).all()


def test_labels_must_match():
    with pytest.raises(InputError, match="one integer label per observation"):
        influence(np.eye(6)[:, :2], np.ones(6), np.zeros(6), size=1)
