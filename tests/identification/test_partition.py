"""A table cut into parts: complete, within the limit, and nothing correlated cut through."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from support.parts import deflections, positions

from elastocal.identification import weighted_problem as partition
from elastocal.identification.weighted_problem import Weights, weights_for
from elastocal.model.observations import observe

UNIT = Weights("none", None, False, "")
UNIT_TABLE = positions()


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 120), configurations=st.integers(1, 40), run=st.integers(1, 6),
    limit=st.integers(1, 50), seed=st.integers(0, 99),
)  # fmt: skip
def test_partition(n, configurations, run, limit, seed):
    """Every observation once; correlated ones in one span, a configuration in one group; spans
    within the limit unless a block alone is larger."""
    rng = np.random.default_rng(seed)
    model, table = UNIT_TABLE
    table = replace(
        table.take(rng.integers(0, len(table), n)), configuration=rng.integers(0, configurations, n)
    )
    observed = observe(table, "position")
    block = np.sort(np.arange(n) // run)[rng.permutation(n)]
    linked = np.kron((block[:, None] == block) & np.tri(n, dtype=bool), np.tri(3))
    weights = Weights("covariance", sparse.csr_array(linked), True, "")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(partition, "LARGE", 0)
        patch.setattr(partition, "PART", limit * 3 * len(model.parameters))
        parts = partition.partition(observed, weights, len(model.parameters))
    of_group = [[parts.part(span) for span in group] for group in parts.groups]
    every = [part for group in of_group for part in group]
    index = np.concatenate([part.index for part in every])
    assert np.array_equal(np.sort(index), np.arange(n))
    span_of, group_of = np.empty(n, dtype=int), np.empty(n, dtype=int)
    for g, group in enumerate(of_group):
        for part in group:
            group_of[part.index] = g
    for k, part in enumerate(every):
        span_of[part.index] = k
        assert np.array_equal(part.observations.value, observed.value[part.rows])
        assert len(part.index) <= limit or len(np.unique(block[part.index])) == 1
        dense = weights.whiten.toarray()[np.ix_(part.rows, part.rows)]
        assert np.array_equal(part.weights.whiten.toarray(), dense)
    for labels, places in ((block, span_of), (table.configuration, group_of)):
        for label in np.unique(labels):
            assert len(np.unique(places[labels == label])) == 1


def test_a_table_of_ordinary_size_stays_whole():
    model, table = positions()
    observed = observe(table, "position")
    parts = partition.partition(observed, UNIT, len(model.parameters))
    assert parts.spans == [(0, 60)] and parts.part((0, 60)).observations is observed


def test_a_sample_takes_correlated_observations_together(monkeypatch):
    """12 of 80 observations in 20 blocks of four, and two of the only marker."""
    monkeypatch.setattr(partition, "OF_A_MARKER", 2)
    model, table = deflections()
    observed = observe(table, "deflection")
    weights = weights_for(observed, model.cell.tracker)
    parts = partition.partition(observed, weights, 4)
    assert parts.blocks is not None and len(np.unique(parts.blocks)) == 20
    part = partition.sample(parts, 12)
    assert 12 <= len(part.index) <= 20
    outside = np.setdiff1d(np.arange(len(observed.lead)), part.index)
    assert not set(parts.blocks[part.index]) & set(parts.blocks[outside])
