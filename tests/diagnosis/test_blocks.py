"""Readings in blocks and back again, whatever their number and order."""

from __future__ import annotations

import numpy as np
import pytest
from support.diagnosis_data import random_blocks

from elastocal.diagnosis import Blocks

SEEDS = range(5)


@pytest.mark.parametrize("size", [1, 3, 6])
@pytest.mark.parametrize("seed", SEEDS)
def test_packed_readings_come_back(seed: int, size: int) -> None:
    blocks = random_blocks(seed, size=size)
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(blocks.n, size, 4))
    packed = blocks.pack(rows)
    np.testing.assert_array_equal(blocks.unpack(packed), rows)
    assert (packed[blocks.absent] == 0).all()
    assert (~blocks.absent).sum() == rows.shape[0] * size


@pytest.mark.parametrize("seed", SEEDS)
def test_packed_covariances_come_back_and_stand_on_the_diagonal(seed: int) -> None:
    blocks = random_blocks(seed)
    square = np.random.default_rng(seed).normal(size=(blocks.n, 3, 3))
    packed = blocks.pack_square(square)
    np.testing.assert_array_equal(blocks.unpack_square(packed), square)
    # x'Sy over the whole blocks is the sum over single readings.
    x, y = np.random.default_rng(seed + 50).normal(size=(2, blocks.n, 3, 1))
    whole = np.einsum("cik,cij,cjk->", blocks.pack(x), packed, blocks.pack(y))
    assert whole == pytest.approx(np.einsum("nik,nij,njk->", x, square, y))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_block_holds_one_configuration_in_the_tables_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    configuration = rng.choice([3, 7, 8, 20], 25)
    blocks = Blocks.of(configuration, np.arange(25), 2)
    for member, code in zip(blocks.member, np.unique(configuration), strict=True):
        np.testing.assert_array_equal(member[member < 25], np.flatnonzero(configuration == code))


@pytest.mark.parametrize("seed", SEEDS)
def test_same_visit_says_which_rows_share_one(seed: int) -> None:
    blocks = random_blocks(seed)
    same = blocks.same_visit
    for c, member in enumerate(blocks.member):
        for a, i in enumerate(member):
            for b, j in enumerate(member):
                both = i < blocks.n and j < blocks.n
                expected = float(both and blocks.visit[i] == blocks.visit[j])
                assert (same[c, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3] == expected).all()
