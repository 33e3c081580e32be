"""Each criterion against its definition, written out with an inverse or an SVD."""

import numpy as np
import pytest
from planning.criteria.cases import INTEREST, P, blocks, criterion, information

from elastocal.planning.criteria import make_criterion


@pytest.fixture
def plan():
    """The stacked regressor (12, p) of four poses."""
    return blocks(np.random.default_rng(1), 1, 4).reshape(12, P)


def singular_values(plan):
    """Of the regressor of interest, what the nuisance columns explain taken out by QR."""
    nuisance = np.setdiff1d(np.arange(P), INTEREST)
    Q, _ = np.linalg.qr(plan[:, nuisance])
    rows = plan[:, INTEREST]
    return np.linalg.svd(rows - Q @ (Q.T @ rows), compute_uv=False)


OBSERVABILITY = {
    "O1": lambda s: np.prod(s) ** (1 / len(s)) / np.sqrt(4),
    "O2": lambda s: s.min() / s.max(),
    "O3": lambda s: s.min(),
    "O4": lambda s: s.min() ** 2 / s.max(),
    "O5": lambda s: 1 / np.sum(1 / s),
}


@pytest.mark.parametrize("name", OBSERVABILITY)
def test_observability_indices_are_those_of_the_singular_values(name, plan):
    phi = criterion(name)
    index, unit = phi.reported(float(phi.value((plan.T @ plan)[None])))
    assert index == pytest.approx(OBSERVABILITY[name](singular_values(plan)), rel=1e-10)
    assert unit == ""


def test_variance_criteria_are_those_of_the_inverse(plan):
    M = plan.T @ plan
    V = np.linalg.inv(M)
    of_interest = V[np.ix_(INTEREST, INTEREST)]
    rng = np.random.default_rng(7)  # as in `criterion`
    A, c = rng.normal(size=(5, 3, P)), rng.normal(size=P)
    w = np.array([1.0, 2.0, 0.5, 3.0, 1.0]) / 7.5
    errors = np.array([np.trace(a @ V @ a.T) for a in A])
    expected = {
        "test_pose": (w @ errors, 1e6 * np.sqrt(w @ errors), "µm"),
        "I": (errors.mean(), 1e6 * np.sqrt(errors.mean()), "µm"),
        "G": (errors.max(), 1e6 * np.sqrt(errors.max()), "µm"),
        "c": (c @ V @ c, np.sqrt(c @ V @ c), "mrad"),
        "A": (
            np.trace(of_interest),
            np.sqrt(np.diag(of_interest).mean()),
            "typical sizes",
        ),
        "D": (
            np.linalg.det(of_interest) ** (1 / 4),
            np.linalg.slogdet(of_interest)[1],
            "log det",
        ),
        "E": (
            np.linalg.eigvalsh(of_interest).max(),
            np.sqrt(np.linalg.eigvalsh(of_interest).max()),
            "typical sizes",
        ),
    }
    for name, (value, figure, unit) in expected.items():
        phi = criterion(name)
        assert phi.name == name
        assert phi.value(M[None]) == pytest.approx(value, rel=1e-10), name
        assert phi.reported(float(phi.value(M[None]))) == (pytest.approx(figure, rel=1e-10), unit)


@pytest.mark.parametrize("name", ["test_pose", "D", "E", "G", "O5"])
def test_scenarios_are_averaged_or_the_worst_is_taken(name):
    B = blocks(np.random.default_rng(3), 3, 5)
    M = information(B)
    average, worst = criterion(name, 3, "average"), criterion(name, 3, "worst")
    each = average.each(M)
    assert len(np.unique(each)) == 3
    assert average.value(M) == pytest.approx(each.mean(), rel=1e-14)
    assert worst.value(M) == each.max()
    assert worst.reported(0.5) == average.reported(0.5)
    # A scenario alone: the same criterion on copies of one arm and one set of targets.
    if name in ("D", "E", "O5"):
        alone = [float(criterion(name).value(M[[s]])) for s in range(3)]
        assert each == pytest.approx(np.array(alone), rel=1e-13)


def test_test_pose_criterion_does_not_depend_on_the_parametrisation():
    rng = np.random.default_rng(4)
    B, A = blocks(rng, 1, 5), rng.normal(size=(1, 3, 3, P))
    T = rng.normal(size=(P, P))
    for name in ("test_pose", "I", "G"):
        values = [
            make_criterion(name, parameters=P, interest=INTEREST, A=targets).value(
                information(rows)
            )
            for rows, targets in ((B, A), (B @ T, A @ T))
        ]
        assert values[1] == pytest.approx(values[0], rel=1e-9)
