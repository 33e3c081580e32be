"""What no arm can be ends with the likely cause, however few readings the fit has left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.parts import deflections

from elastocal.errors import InsufficientDataError
from elastocal.identification.mistakes import refuse_nonsense
from elastocal.measurements import Measurements
from elastocal.model.observations import observe

MENDED = "the readings fit the nominal arm only to .* they would fit to"


def mirrored(table: Measurements) -> Measurements:
    return replace(table, position=np.asarray(table.position)[:, [0, 2, 1]])


def test_deflections_are_small_but_their_positions_tell_swapped_columns() -> None:
    model, table = deflections()
    observed = observe(table, "deflection")
    none_left = np.zeros(observed.value.size)
    refuse_nonsense(model, observed, model.nominal, none_left, table)
    with pytest.raises(InsufficientDataError, match=f"no deflections of this arm.*{MENDED}"):
        refuse_nonsense(model, observed, model.nominal, none_left, mirrored(table))
