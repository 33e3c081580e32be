"""Student-t maximum likelihood against a general optimiser on the density of scipy."""

import numpy as np
import pytest
from scipy import optimize, stats

from elastocal.identification.robust import design, student_t


def sample(seed, size, nu=4.0, n=200, p=3):
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(n * size, p))
    heavy = rng.normal(size=(n, size)) / np.sqrt(rng.chisquare(nu, n) / nu)[:, None]
    return B, B @ np.arange(1.0, p + 1) + 0.3 * heavy.ravel()


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("given", [True, False])
def test_it_maximises_the_likelihood(size, given):
    B, y = sample(size, size)

    def cost(theta):
        x, log_scale = theta[:3], theta[3]
        nu = 4.0 if given else np.exp(theta[4])
        e = (y - B @ x).reshape(-1, size)
        t = stats.multivariate_t(np.zeros(size), np.exp(2 * log_scale) * np.eye(size), nu)
        return -np.atleast_1d(t.logpdf(e)).sum()

    found = student_t(design(B, y, size), nu=4.0 if given else None)
    start = np.concatenate([found.x + 0.02, [np.log(0.4)], [] if given else [np.log(6.0)]])
    best = optimize.minimize(cost, start, method="BFGS", options={"gtol": 1e-5})
    own = [*found.x, np.log(found.scale), np.log(found.loss.constant)]
    assert cost(np.array(own)) <= best.fun + 1e-7
    np.testing.assert_allclose(found.x, best.x[:3], atol=2e-6)
    assert found.scale == pytest.approx(np.exp(best.x[3]), rel=1e-5)
    if not given:
        assert found.loss.constant == pytest.approx(np.exp(best.x[4]), rel=1e-4)
    assert found.converged
