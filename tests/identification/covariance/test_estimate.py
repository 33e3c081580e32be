"""The t intervals of an estimated covariance."""

import numpy as np
import pytest
from scipy import stats

from elastocal.identification.covariance import Covariance


def test_each_parameter_has_its_own_t():
    matrix = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 1.0]])
    found = Covariance("x", matrix, np.array([5.0, np.inf, 0.0]), "")
    x = np.array([1.0, 2.0, 3.0])
    t, z = stats.t.ppf(0.95, 5), stats.norm.ppf(0.95)
    expected = [[1 - 2 * t, 1 + 2 * t], [2 - 3 * z, 2 + 3 * z], [-np.inf, np.inf]]
    np.testing.assert_allclose(found.interval(x, 0.9), expected, rtol=1e-12)
    np.testing.assert_array_equal(found.std, [2.0, 3.0, np.inf])


@pytest.mark.parametrize("sizes", [(1.0, 1.0, 1.0), (0.5, 1.0, 2.0), (0.3, 1.0, 4.0)])
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
