"""What the certificate takes for granted, checked on every criterion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.criteria.cases import (
    CERTIFIABLE,
    MIXED,
    P,
    blocks,
    criterion,
    information,
    random_information,
    subsets,
)

from elastocal.errors import InsufficientDataError
from elastocal.planning.criteria import CRITERIA

every_criterion = pytest.mark.parametrize("name", CRITERIA)
mixed = pytest.mark.parametrize(("name", "scenarios", "robust"), MIXED)
mixed_certifiable = pytest.mark.parametrize(
    ("name", "scenarios", "robust"), [case for case in MIXED if case[0] in CERTIFIABLE]
)


@mixed
@pytest.mark.parametrize("order", [np.inf, 4.0])
def test_gradient_agrees_with_central_differences(name, scenarios, robust, order):
    rng = np.random.default_rng(1)
    phi = criterion(name, scenarios, robust)
    if order < np.inf:
        phi = phi.softened(order)
    for _ in range(5):
        M = random_information(rng, scenarios)
        found = phi.gradient(M)
        assert found.value == pytest.approx(float(phi.value(M)), rel=1e-12)
        np.testing.assert_allclose(found.G, found.G.swapaxes(-1, -2), rtol=1e-12)
        step = rng.normal(size=M.shape)
        step += step.swapaxes(-1, -2)
        h = 1e-5 * np.linalg.eigvalsh(M).min() / np.abs(np.linalg.eigvalsh(step)).max()
        slope = (phi.value(M + h * step) - phi.value(M - h * step)) / (2 * h)
        scale = np.linalg.norm(found.G) * np.linalg.norm(step)
        assert -np.sum(found.G * step) == pytest.approx(float(slope), abs=1e-6 * scale)


@mixed
def test_degree_in_information(name, scenarios, robust):
    phi = criterion(name, scenarios, robust)
    M = random_information(np.random.default_rng(2), scenarios)
    factor = 1.0 if name == "O2" else 0.25
    assert phi.value(4.0 * M) == pytest.approx(factor * phi.value(M), rel=1e-12)
    # Euler: ⟨G, M⟩ = −∂Φ(cM)/∂c = Φ, or 0 for degree 0.
    found = phi.gradient(M)
    degree = 0.0 if name == "O2" else 1.0
    assert np.sum(found.G * M) == pytest.approx(degree * found.value, abs=1e-10 * found.value)


@mixed_certifiable
def test_more_information_never_hurts(name, scenarios, robust):
    rng = np.random.default_rng(3)
    phi = criterion(name, scenarios, robust)
    M = random_information(rng, scenarios)
    before = phi.value(M)
    assert (phi.after_adding(M, blocks(rng, scenarios, 50, r=1)) <= before * (1 + 1e-12)).all()
    assert (np.linalg.eigvalsh(phi.gradient(M).G) >= -1e-12 * before).all()


@mixed_certifiable
@pytest.mark.parametrize("order", [np.inf, 3.0])
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), t=st.floats(0.0, 1.0))
def test_reciprocal_is_concave(name, scenarios, robust, order, seed, t):
    rng = np.random.default_rng(seed)
    phi = criterion(name, scenarios, robust, seed=seed)
    if order < np.inf:
        phi = phi.softened(order)
    # Few rows on one side, so that the segment passes near the edge of the cone.
    M0, M1 = random_information(rng, scenarios, 2), random_information(rng, scenarios, 6)
    M0 += 1e-6 * np.eye(P)
    ends = (1 - t) / phi.value(M0) + t / phi.value(M1)
    between = 1 / phi.value((1 - t) * M0 + t * M1)
    assert between >= ends * (1 - 1e-8)


@pytest.mark.parametrize("name", ["O2", "O4"])
def test_no_bound_is_claimed_for_indices_that_have_none(name):
    """A pose that makes the index worse exists, so Φ is no decreasing function of M."""
    rng = np.random.default_rng(4)
    phi = criterion(name)
    assert not phi.certifiable
    assert not criterion(name, 3, "worst").certifiable
    M = random_information(rng, 1)
    assert (phi.after_adding(M, 30 * blocks(rng, 1, 50, r=1)) > phi.value(M)).any()


@mixed_certifiable
def test_tangent_bound_holds_on_every_plan(name, scenarios, robust):
    """Φ(w)/(1 + gap/Φ(w)) against all plans of 3 in 9 candidates, with and without a prior."""
    for seed, size in ((5, 0.0), (6, 0.3)):
        rng = np.random.default_rng(seed)
        phi = criterion(name, scenarios, robust, seed=seed)
        B = blocks(rng, scenarios, 9)
        prior = size * np.tile(np.eye(P), (scenarios, 1, 1))
        plans = [phi.value(prior + information(B[:, chosen])) for chosen in subsets(9, 3)]
        for _ in range(5):
            w = rng.dirichlet(np.ones(9)) * 3
            found = phi.gradient(prior + information(B * np.sqrt(w)[:, None, None]))
            d = np.einsum("snri,sij,snrj->n", B, found.G, B)
            gap = np.sort(d)[-3:].sum() - w @ d
            assert min(plans) >= found.value / (1 + gap / found.value) * (1 - 1e-12)


@mixed
def test_singular_information_is_infinitely_bad(name, scenarios, robust):
    rng = np.random.default_rng(9)
    phi = criterion(name, scenarios, robust)
    good = random_information(rng, scenarios)
    short = information(blocks(rng, scenarios, 1))
    B = blocks(rng, scenarios, 8)
    B[..., 3] = B[..., 0] - 2 * B[..., 5]  # singular only to rounding
    stack = np.array([good, short, information(B), -good, np.zeros_like(good)])
    for values in (phi.value(stack), phi.softened(4.0).value(stack)):
        assert np.isfinite(values[0])
        assert (values[1:] == np.inf).all()
    with pytest.raises(InsufficientDataError, match="leave a combination of parameters unseen"):
        phi.gradient(short)


@every_criterion
def test_one_singular_scenario_makes_a_plan_useless(name):
    rng = np.random.default_rng(10)
    M = random_information(rng, 3)
    M[1] = information(blocks(rng, 1, 1))[0]
    for robust in ("average", "worst"):
        phi = criterion(name, 3, robust)
        assert phi.value(M) == np.inf
        with pytest.raises(InsufficientDataError, match="scenario 2 of 3"):
            phi.gradient(M)
