"""Least squares of least norm, by whichever of LAPACK's two ways."""

import numpy as np
import pytest

from elastocal.identification import weighted_problem
from elastocal.identification.weighted_problem import least_norm


@pytest.mark.parametrize("shape", [(9, 4), (4, 9), (6, 6)])
def test_least_norm_where_divide_and_conquer_does_not_converge(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]
) -> None:
    """Full rank or not, the solution of least norm, by whichever of LAPACK's two ways."""
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=shape), rng.normal(size=(shape[0], 2))
    A[:, 1] = 2 * A[:, 0]
    expected = np.linalg.pinv(A, rcond=1e-12) @ b
    np.testing.assert_allclose(least_norm(A, b, cond=1e-12), expected, atol=1e-12)
    lstsq = weighted_problem.linalg.lstsq

    def failing(*arguments, lapack_driver=None, **options):
        if lapack_driver is None:
            raise weighted_problem.linalg.LinAlgError("SVD did not converge")
        return lstsq(*arguments, lapack_driver=lapack_driver, **options)

    monkeypatch.setattr(weighted_problem.linalg, "lstsq", failing)
    np.testing.assert_allclose(least_norm(A, b, cond=1e-12), expected, atol=1e-12)
