"""Gaussian priors given in Python: what they refuse."""

import numpy as np
import pytest

from elastocal.errors import InputError
from elastocal.identification.knowledge import GaussianPrior


@pytest.mark.parametrize(
    ("covariance", "says"),
    [
        (np.array([[1.0, 1.0], [1.0, 1.0]]), "not positive definite"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not positive definite"),
        (np.diag([1.0, 0.0]), "not positive definite"),
        (np.eye(3), "2 × 2 covariance"),
        (np.diag([1.0, np.nan]), "finite"),
    ],
)
def test_an_impossible_covariance_is_refused(covariance, says):
    with pytest.raises(InputError, match=says):
        GaussianPrior(("a", "b"), np.zeros(2), covariance)
