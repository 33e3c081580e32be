"""From rows to observations: which rows a deflection subtracts, in which order, and what lacks."""

from __future__ import annotations

import numpy as np
import pytest
from support.cells import kr270_cell, kr270_chain, random_table

from elastocal.errors import InputError
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.model.observations import pair_loaded_with_unloaded, subset

DOWN = -2600.0


def readings(*rows: tuple[int, int, str, float]) -> Measurements:
    """A table of (configuration, repeat, marker, vertical force); row i reads (i, 10 i, 100 i)."""
    configuration, repeat, marker, force = zip(*rows, strict=True)
    markers = tuple(sorted(set(marker)))
    n = len(rows)
    return Measurements(
        source="data.csv",
        row=np.arange(n) + 2,
        q=np.zeros((n, 6)),
        configuration=np.array(configuration),
        configuration_labels=tuple(f"pose {k}" for k in range(max(configuration) + 1)),
        repeat=np.array(repeat),
        marker=np.array([markers.index(m) for m in marker]),
        marker_names=markers,
        force=np.outer(force, [0.0, 0.0, 1.0]),
        position=np.outer(np.arange(n), [1.0, 10.0, 100.0]),
    )


# --- pairing -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "unloaded", [(1, 0, "M1", 0), (0, 0, "M2", 0)], ids=["other pose", "other marker"]
)
def test_a_missing_partner_is_named(unloaded: tuple) -> None:
    table = readings((0, 0, "M1", 0), unloaded, (0, 0, "M1", DOWN), (2, 0, "M1", DOWN))
    wanted = r"data\.csv, line 5: .* configuration pose 2, marker M1 has no unloaded reading"
    with pytest.raises(InputError, match=wanted):
        pair_loaded_with_unloaded(table)


# --- predictions and B ---------------------------------------------------------------------


def shuffled(n: int = 4, seed: int = 2) -> Measurements:
    table = random_table(kr270_chain(), n, seed)
    return table.take(np.random.default_rng(seed).permutation(len(table)))


# --- subset --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["deflection", "pose"])
def test_a_subset_keeps_the_rows_it_needs(kind: str) -> None:
    model = Model.assembled(kr270_chain(), kr270_cell(("joint_offset", "joint_compliance"), kind))
    whole = model.regressor(shuffled())
    observed = whole.observations
    chosen = np.random.default_rng(5).random(len(observed.lead)) < 0.4
    part = subset(observed, chosen)
    rows = np.repeat(chosen, observed.size)
    np.testing.assert_array_equal(part.value, whole.observations.value[rows])
    assert len(part.table) == chosen.sum() * (2 if kind == "deflection" else 1)
    np.testing.assert_array_equal(
        part.table.row[part.lead], observed.table.row[observed.lead[chosen]]
    )
    np.testing.assert_array_equal(part.configuration, observed.configuration[chosen])
    found = model.regressor(part.table, observations=part)
    np.testing.assert_allclose(found.prediction, whole.prediction[rows], rtol=0, atol=1e-15)
    np.testing.assert_allclose(found.B, whole.B[rows], rtol=1e-9, atol=1e-15)
