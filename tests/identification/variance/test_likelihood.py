"""The reduced restricted likelihood is that of all rows, to the last term."""

import numpy as np
import pytest
from identification.variance.dense import Table, dense, readings

from elastocal.identification.noise_structure import STRUCTURES, shared_effects
from elastocal.identification.reml import evaluate, slope, stacks

TABLES = {
    "size 1": Table(size=1, configurations=5, markers=3, repeats=3, p=3),
    "size 3": Table(),
    "size 6": Table(size=6, configurations=4, markers=1, repeats=3, p=5),
    "loads": Table(configurations=4, loads=2, markers=2, repeats=3, p=5),
    "no repeats": Table(markers=3, repeats=1, unbalanced=False),
    "balanced": Table(unbalanced=False),
    "many": Table(configurations=40, repeats=1, p=1, unbalanced=False),
    "many repeated": Table(configurations=40, markers=1, repeats=2, p=1, unbalanced=False),
}
# Every table with a third of the structures in turn, half of them with what visits share.
CASES = [
    (table, name, bool(i % 2))
    for i, table in enumerate(TABLES)
    for j, name in enumerate(STRUCTURES)
    if (i + j) % 3 == 0
    and (TABLES[table].size == 3 or name not in ("marker", "polar"))
    and not (table.startswith("many") and name in ("groups", "stated"))  # nothing is alike there
]


def at_random(table, name, share, seed=0):
    """A state at random θ, and the dense model there; units are metres."""
    r = readings(TABLES[table], seed)
    structure = STRUCTURES[name](r)
    effects = shared_effects(structure.sets, r.size, share)
    rng = np.random.default_rng(seed + 1)
    theta = np.exp(rng.normal(size=len(structure.names) + len(effects)))
    theta *= 1.0 if name == "stated" else 1e-10
    theta[len(structure.names) :] = 1e-10 * np.exp(rng.normal(size=len(effects)))
    stacked = stacks(structure, effects)
    whole = dense(name, r, structure.names, [e.name for e in effects], theta)
    return structure, stacked, theta, whole


@pytest.mark.parametrize(("table", "name", "share"), CASES)
def test_score_and_information_are_those_of_all_rows(table, name, share):
    structure, stacked, theta, whole = at_random(table, name, share, seed=10)
    found = slope(structure, evaluate(structure, stacked, theta))
    size = np.sqrt(np.diag(whole.information))
    np.testing.assert_allclose(found.score / size, whole.score / size, rtol=1e-8, atol=1e-8)
    shape = np.outer(size, size)
    np.testing.assert_allclose(found.information / shape, whole.information / shape, atol=1e-9)
    np.testing.assert_allclose(found.observed / shape, whole.observed / shape, rtol=1e-8, atol=1e-8)
    assert found.told.all()


@pytest.mark.parametrize(("table", "name"), [case[:2] for case in CASES])
def test_score_is_the_slope_of_the_likelihood_and_observed_information_its_own(table, name):
    structure, stacked, theta, _ = at_random(table, name, True, seed=20)
    at = slope(structure, evaluate(structure, stacked, theta))
    size = np.sqrt(np.diag(at.information))
    for k in range(len(theta)):
        h = 1e-4 * theta[k] * np.eye(len(theta))[k]
        up, down = (evaluate(structure, stacked, theta + d) for d in (h, -h))
        gain = (up.log_likelihood - down.log_likelihood) / 2e-4
        assert gain == pytest.approx(theta[k] * at.score[k], rel=1e-5, abs=1e-5)
        change = slope(structure, up).score - slope(structure, down).score
        row = -change / 2e-4 / theta[k]
        np.testing.assert_allclose(
            row / size / size[k], at.observed[k] / size / size[k], atol=1e-5 * max(1, size[k])
        )
