"""Sums over an entry's columns against the columns formed one by one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp
from support.diagnosis_data import random_blocks, random_data

from elastocal.diagnosis import EntrySums, Flips, NoiseValues, VisitPlaces, direct, project

NOISE = NoiseValues(1.1, np.array([4e-6, 9e-6, 1e-5]), np.full(3, 0.5))
SEEDS = range(4)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_observation_stands_in_the_place_of_its_visit(seed: int) -> None:
    blocks = random_blocks(seed)
    places = VisitPlaces.of(blocks)
    assert (places.example >= 0).sum() == len(np.unique(blocks.visit))
    for c, member in enumerate(blocks.member):
        for a, i in enumerate(member):
            hot = places.one_hot[c, 3 * a]
            if i == blocks.n:
                assert (hot == 0).all()
            else:
                assert hot.sum() == 1
                assert blocks.visit[places.example[c, hot.argmax()]] == blocks.visit[i]


def test_a_visit_gathers_what_its_observations_share_and_nothing_where_there_is_none() -> None:
    blocks = random_blocks(2)
    places = VisitPlaces.of(blocks)
    gathered = places.gather(1.0 + blocks.visit)
    assert (gathered[places.example < 0] == 0).all()
    at = places.one_hot @ gathered[..., None]
    packed = blocks.pack(np.repeat(1.0 + blocks.visit[:, None, None], 3, axis=1))
    np.testing.assert_array_equal(at, packed)


@pytest.mark.parametrize(("d", "k"), [(1, 1), (1, 2), (3, 2), (6, 4)])
@pytest.mark.parametrize("seed", SEEDS)
def test_driven_groups_are_groups_of_the_columns_they_stand_for(seed: int, d: int, k: int) -> None:
    data = random_data(seed)
    places, at = VisitPlaces.of(data.blocks), project(data, NOISE)
    rng = np.random.default_rng((seed, 5))
    E = data.masked(1e-5 * rng.normal(size=(*data.r.shape, d)))
    C, v = places.example.shape
    D = rng.normal(size=(C, v, d, 5, k))
    D[:, :, :, 3] = 0.0
    D[:, :, :, 4] = D[:, :1, :, 4]
    turned = Flips(rng.choice([-1.0, 1.0], (4, C)), at.scattered)
    entry = EntrySums.of(E, places, at, turned)
    found = entry.driven(D)
    flips = found.flipped(np.zeros((5, 1)))
    weights = rng.normal(size=5)
    together = logsumexp(flips + weights[:, None], axis=0)
    np.testing.assert_allclose(found.flipped(weights[None])[0], together, atol=1e-9)
    for g in range(5):
        columns = np.einsum("cmd,cmv,cvdk->cmk", E, places.one_hot, D[:, :, :, g])
        expected = direct(columns, at, turned)
        np.testing.assert_allclose(
            found.lam[g], expected.lam[0], rtol=1e-8, atol=1e-9 * found.lam[g].max()
        )
        np.testing.assert_allclose(found.evidence()[g], expected.evidence()[0], atol=1e-8)
        np.testing.assert_allclose(flips[g], expected.flipped(np.zeros((1, 1)))[0], atol=1e-8)
    # Visits of a configuration that are driven alike may be given as one.
    alike = entry.driven(D[:, :1, :, 4:])
    np.testing.assert_allclose(alike.evidence()[0], found.evidence()[4], atol=1e-8)
    np.testing.assert_allclose(alike.flipped(np.zeros((1, 1)))[0], flips[4], atol=1e-8)


@pytest.mark.parametrize("d", [1, 3])
@pytest.mark.parametrize("seed", SEEDS)
def test_no_directions_explain_more_than_motions_free_at_every_visit(seed: int, d: int) -> None:
    """By the pseudo-inverse of all of them as columns; some are zero, where a visit is absent."""
    data = random_data(seed)
    places, at = VisitPlaces.of(data.blocks), project(data, NOISE)
    rng = np.random.default_rng((seed, 6))
    E = data.masked(1e-5 * rng.normal(size=(*data.r.shape, d)))
    C, v = places.example.shape
    entry = EntrySums.of(E, places, at)
    free = np.zeros((C, data.r.shape[1], C, v, d))
    free[np.arange(C), :, np.arange(C)] = np.einsum("cmd,cmv->cmvd", E, places.one_hot)
    columns = free.reshape(C, -1, C * v * d)
    b = np.einsum("cmk,cm->k", columns, at.u)
    H = np.einsum("cmk,cmp->kp", columns, at.H)
    A = np.einsum("cmk,cmn,cnl->kl", columns, at.inverse, columns) - H @ H.T
    expected = b @ np.linalg.pinv(A, rcond=1e-10, hermitian=True) @ b
    assert entry.most_explained == pytest.approx(expected, rel=1e-5)
    found = entry.driven(rng.normal(size=(C, v, d, 20, 2)))
    assert (found.explained(1e9) <= entry.most_explained * (1 + 1e-9)).all()
