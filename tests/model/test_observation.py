"""From rows to observations: which rows a deflection subtracts, in which order, and what lacks."""

from __future__ import annotations

import numpy as np
import pytest

from elastocal.errors import InputError
from elastocal.measurements import Measurements
from elastocal.model.observations import pair_loaded_with_unloaded

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


@pytest.mark.parametrize(
    "unloaded", [(1, 0, "M1", 0), (0, 0, "M2", 0)], ids=["other pose", "other marker"]
)
def test_a_missing_partner_is_named(unloaded: tuple) -> None:
    table = readings((0, 0, "M1", 0), unloaded, (0, 0, "M1", DOWN), (2, 0, "M1", DOWN))
    wanted = r"data\.csv, line 5: .* configuration pose 2, marker M1 has no unloaded reading"
    with pytest.raises(InputError, match=wanted):
        pair_loaded_with_unloaded(table)
