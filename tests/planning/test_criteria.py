"""Every criterion: its definition, what a certificate takes for granted, who may register."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elastocal.messages import InputError
from elastocal.planning.criteria import (
    CRITERIA,
    CriterionInputs,
    SpectralCriterion,
    TraceCriterion,
    criterion_named,
    inverse,
    register,
)

P = 6
INTEREST = np.array([4, 1, 2, 5])


def criterion(name, seed=7, **change):
    rng = np.random.default_rng(seed)
    given = {
        "A": rng.normal(size=(5, 3, P)), "weights": np.array([1.0, 2.0, 0.5, 3.0, 1.0]),
        "combination": rng.normal(size=P), "unit": "mrad", "n_poses": 4, "interest": INTEREST,
    }  # fmt: skip
    return criterion_named(name).of(CriterionInputs(name, P, **(given | change)))


def information(rng, n=5):
    B = rng.normal(size=(3 * n, P)) * np.logspace(-0.5, 0.5, P)
    return B.T @ B


@pytest.mark.parametrize("name", CRITERIA)
def test_slope_and_curvature_agree_with_central_differences(name):
    rng = np.random.default_rng(1)
    phi = criterion(name).softened(6.0)
    V = inverse(information(rng))
    X = rng.normal(size=(2, P, P))
    X = 0.02 * V.mean() * (X + X.swapaxes(-1, -2))
    value, C = phi.slope(V)
    assert value == pytest.approx(float(phi.value(V)), rel=1e-12)
    h = 1e-3
    ahead, behind = phi.value(V + h * X[0]), phi.value(V - h * X[0])
    scale = np.linalg.norm(C) * np.linalg.norm(X[0])
    assert np.sum(C * X[0]) == pytest.approx(float(ahead - behind) / (2 * h), abs=1e-5 * scale)
    bent = phi.curvature(V, X)
    found = bent[0, 1] if np.ndim(bent) else 0.0
    slopes = [np.sum(phi.slope(V + s * h * X[0])[1] * X[1]) for s in (1, -1)]
    assert found == pytest.approx((slopes[0] - slopes[1]) / (2 * h), abs=1e-4 * scale)


@pytest.mark.parametrize("name", CRITERIA)
def test_the_same_criterion_in_other_parameters(name):
    rng = np.random.default_rng(2)
    phi, M = criterion(name), information(rng)
    T = rng.normal(size=(P, P))
    turned = phi.turned(T).of_information(T.T @ M @ T)
    assert float(turned) == pytest.approx(float(phi.of_information(M)), rel=1e-8)


@pytest.mark.parametrize("name", CRITERIA)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), soft=st.booleans())
def test_the_tangent_bounds_every_information(name, seed, soft):
    """Φ(M') ≥ L²/⟨G, M'⟩, Φ of degree −1 and falling: all that a certificate takes for granted."""
    rng = np.random.default_rng(seed)
    phi = criterion(name, seed=seed)
    M, other = information(rng, 3), information(rng, 6)
    tangent = (phi.softened(20.0) if soft else phi).tangent_at(inverse(M))
    value = phi.of_information
    assert tangent.value <= value(M) * (1 + 1e-8)
    for there in (M, other, M + other):
        bound = tangent.value**2 / np.sum(tangent.G * there)
        assert value(there) >= bound * (1 - 1e-8)
    assert value(4 * M) == pytest.approx(value(M) / 4, rel=1e-9)
    assert value(M + other) <= value(M) * (1 + 1e-9)


def test_singular_information_is_infinitely_bad():
    rng = np.random.default_rng(9)
    B = rng.normal(size=(12, P))
    B[..., 3] = B[..., 0] - 2 * B[..., 5]  # singular only to rounding
    for name in CRITERIA:
        for M in (information(rng, 1), B.T @ B, np.zeros((P, P))):
            assert criterion(name).of_information(M) == np.inf


def singular_values(rows):
    """Of the regressor of interest, what the nuisance columns explain taken out by QR."""
    Q, _ = np.linalg.qr(rows[:, np.setdiff1d(np.arange(P), INTEREST)])
    own = rows[:, INTEREST]
    return np.linalg.svd(own - Q @ (Q.T @ own), compute_uv=False)


def test_every_criterion_is_what_its_definition_says():
    rows = np.random.default_rng(1).normal(size=(12, P))
    V, s, rng = np.linalg.inv(rows.T @ rows), singular_values(rows), np.random.default_rng(7)
    own, A, c = V[np.ix_(INTEREST, INTEREST)], rng.normal(size=(5, 3, P)), rng.normal(size=P)
    w, errors = np.array([1.0, 2.0, 0.5, 3.0, 1.0]) / 7.5, np.einsum("tri,ij,trj->t", A, V, A)
    expected = {
        "test_pose": (1e6 * np.sqrt(w @ errors), "µm"),
        "I": (1e6 * np.sqrt(errors.mean()), "µm"),
        "G": (1e6 * np.sqrt(errors.max()), "µm"),
        "c": (np.sqrt(c @ V @ c), "mrad"),
        "A": (np.sqrt(np.diag(own).mean()), "typical sizes"),
        "D": (np.linalg.slogdet(own)[1], "log det"),
        "E": (np.sqrt(np.linalg.eigvalsh(own).max()), "typical sizes"),
        "O1": (np.prod(s) ** (1 / len(s)) / np.sqrt(4), ""),
        "O3": (s.min(), ""),
        "O5": (1 / np.sum(1 / s), ""),
    }
    assert list(expected) == sorted(expected, key=list(expected).index)
    assert set(expected) == set(CRITERIA)
    for name, (figure, unit) in expected.items():
        phi = criterion(name)
        told = phi.figure(float(phi.of_information(rows.T @ rows)))
        assert told == pytest.approx(figure, rel=1e-9) and phi.unit == unit, name


A = np.ones((2, 3, P))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("robust", {}, "robust is gone: take test_pose; .* next, or diagnose"),
        ("test_pose", {"A": None}, "test_pose needs test poses"),
        ("G", {"A": 0 * A}, "no target depends on the parameters"),
        ("c", {"combination": None}, "c needs a parameter or combination"),
        ("c", {"combination": np.zeros(P)}, "F of the c criterion is zero"),
    ],
)
def test_what_is_missing_or_wrong_is_named(name, change, message):
    with pytest.raises(InputError, match=message):
        criterion(name, **change)


@pytest.fixture
def forgotten():
    before = dict(CRITERIA)
    yield
    CRITERIA.clear()
    CRITERIA.update(before)


class Named(TraceCriterion):
    @classmethod
    def of(cls, inputs):
        return cls(np.eye(inputs.parameters))


OWN = {
    "name": "own",
    "phi": lambda self, lam: lam[..., -1],
    "phi_slope": lambda self, lam: lam,
    "figure": lambda self, value: value,
    "certifiable": True,
}


@pytest.mark.parametrize(
    ("parents", "content", "message"),
    [
        ((Named,), {"name": "D"}, "the name 'D' is taken by DeterminantCriterion"),
        ((Named,), {}, 'has no name that a cell file can state; add one, as in name = "my_'),
        ((Named,), {"name": "two\nlines"}, "has no name that a cell file can state"),
        ((TraceCriterion,), {"name": "own"}, r"\('own'\) is not complete: define of$"),
        ((SpectralCriterion,), {"name": "own"}, "not complete: define phi, phi_slope"),
        ((SpectralCriterion,), OWN, "is certifiable but states no curvature"),
        ((), {"name": "own"}, "takes a class derived from ScenarioCriterion"),
    ],
)
def test_what_is_no_whole_criterion_is_refused(forgotten, parents, content, message):
    with pytest.raises(InputError, match=message):
        register(type("Own", parents, content))
    assert "own" not in CRITERIA
