"""Low-rank updates against forming every information matrix anew."""

import numpy as np
import pytest
from planning.criteria.cases import MIXED, blocks, criterion, information, random_information

from elastocal.planning.criteria import make_criterion
from elastocal.planning.criterion import candidate_sums

mixed = pytest.mark.parametrize(("name", "scenarios", "robust"), MIXED)
LOW_RANK = ("test_pose", "A", "I", "c", "G", "D", "O1")


def anew(phi, M, B):
    return np.concatenate([np.atleast_1d(phi.value(sums)) for _, sums in candidate_sums(M, B)])


@mixed
@pytest.mark.parametrize("r", [1, 9])
def test_agrees_with_the_sum(name, scenarios, robust, r):
    rng = np.random.default_rng(1)
    phi = criterion(name, scenarios, robust)
    M = random_information(rng, scenarios)
    B = blocks(rng, scenarios, 40, r)
    expected = [phi.value(M + information(B[:, [i]])) for i in range(40)]
    assert phi.after_adding(M, B) == pytest.approx(np.array(expected), rel=1e-10)


@pytest.mark.parametrize("name", LOW_RANK)
@pytest.mark.parametrize("share", [1e-1, 1e-7])
def test_agrees_where_little_is_known_of_one_direction(name, share):
    """The pose to be replaced carried nearly all that is known of a direction."""
    p = 30
    rng = np.random.default_rng(2)
    u = rng.normal(size=p) / np.sqrt(p)
    weak = np.eye(p) - (1 - share) * np.outer(u, u) / (u @ u)
    M = information(blocks(rng, 1, 40, 3, p) @ weak)
    B = blocks(rng, 1, 60, 9, p)
    B[:, :20] = B[:, :20] @ weak  # some poses mend it, some do not
    phi = make_criterion(
        name,
        parameters=p,
        interest=np.arange(p // 2),
        A=rng.normal(size=(1, 4, 3, p)),
        combination=u,
        n_poses=40,
    )
    assert phi.after_adding(M, B) == pytest.approx(anew(phi, M, B), rel=1e-9 / share**0.25)


@mixed
def test_a_pose_that_restores_the_rank_is_found(name, scenarios, robust):
    rng = np.random.default_rng(3)
    phi = criterion(name, scenarios, robust)
    plan = blocks(rng, scenarios, 2)
    # The plan less a pose, as exchange forms it: singular to rounding only.
    M = information(plan) - information(plan[:, :1])
    B = blocks(rng, scenarios, 6)
    B[:, 3:, 2] = B[:, 3:, 0] + B[:, 3:, 1]  # rank 2: one direction stays unseen
    values = phi.after_adding(M, B)
    expected = [phi.value(information(plan[:, 1:]) + information(B[:, [i]])) for i in range(3)]
    assert np.isfinite(values[:3]).all()
    assert values[:3] == pytest.approx(np.array(expected), rel=1e-9)
    assert (values[3:] == np.inf).all()
