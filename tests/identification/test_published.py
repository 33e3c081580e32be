"""The published estimators against their own equations, written out."""

import numpy as np
import pytest

from elastocal.identification.published import eq14, eq14_weights, ols, wls
from elastocal.messages import InputError

RNG = np.random.default_rng(14)
B = RNG.normal(size=(90, 4))
X = np.array([1.0, -2.0, 0.5, 3.0])
SIGMA = np.exp(RNG.normal(size=90)) * 1e-2
DP = B @ X + SIGMA * RNG.normal(size=90)
GROUP = np.repeat(np.arange(5), 18)


def test_ols_is_equation_6_with_7_and_8():
    inverse = np.linalg.inv(B.T @ B)
    plain = ols(B, DP)
    np.testing.assert_allclose(plain.x, inverse @ B.T @ DP, rtol=1e-10)
    s2 = plain.residual @ plain.residual / (90 - 4)
    np.testing.assert_allclose(plain.covariance, s2 * inverse, rtol=1e-10, atol=1e-18)
    sandwich = inverse @ (B.T @ np.diag(SIGMA**2) @ B) @ inverse
    np.testing.assert_allclose(ols(B, DP, SIGMA).covariance, sandwich, rtol=1e-9, atol=1e-18)


def test_wls_is_equation_10_with_11_and_13():
    w = 1 / SIGMA
    inverse = np.linalg.inv(B.T @ np.diag(w**2) @ B)
    found = wls(B, DP, w)
    np.testing.assert_allclose(found.x, inverse @ B.T @ (w**2 * DP), rtol=1e-10)
    np.testing.assert_allclose(found.covariance, inverse, rtol=1e-9, atol=1e-18)
    # With WΣ = I, (11) is (13); with other weights it is larger.
    np.testing.assert_allclose(wls(B, DP, w, SIGMA).covariance, inverse, rtol=1e-9, atol=1e-18)
    other = wls(B, DP, np.ones(90), SIGMA)
    assert (np.diag(other.covariance) >= np.diag(inverse) * (1 - 1e-9)).all()


def test_equation_14():
    np.testing.assert_allclose(eq14_weights(np.array([0.0, 10e-6, 90e-6])), [1.0, 0.5, 0.1])
    np.testing.assert_allclose(eq14_weights(np.array([10e-6]), lam=3.0), [0.25])
    with pytest.raises(InputError, match="positive"):
        eq14_weights(np.ones(2), lam=0.0)


def test_a_fit_says_whether_it_settled_and_is_equal_to_itself_alone():
    last, short = eq14(B, DP, GROUP.astype(str))[-1], eq14(B, DP, GROUP, iterations=3)[-1]
    assert last.converged and not short.converged
    assert last == last and last != eq14(B, DP, GROUP)[-1] and len({last, short}) == 2


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: ols(B, DP[:-1]), r"^dp must have shape \(90,\).*got \(89,\)"),
        (lambda: wls(B, DP, -SIGMA), "^weights must be 90 positive"),
        (lambda: eq14(B, DP, GROUP[:-1]), r"^group takes a label per row of B, \(90,\)"),
    ],
)
def test_a_wrong_argument_is_named(call, told):
    with pytest.raises(InputError, match=told):
        call()
