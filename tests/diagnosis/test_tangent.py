"""A spring whose anchor is nowhere near the example's is still found."""

from __future__ import annotations

import numpy as np
import pytest
from support.diagnosis_data import FAULTS, campaign, diagnosed

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.hypotheses import compute_columns, possible

COMPENSATOR = "gravity_compensator:joint2"


@pytest.fixture(scope="module")
def remaining() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fitted columns X, the residual r, and the compensator's columns C, flat."""
    model, table = campaign(COMPENSATOR)
    base = fit_baseline(model, table)
    hypotheses = [h for h in possible(model, table)[0] if h.name == "gravity_compensator"]
    columns = compute_columns(base, hypotheses)
    C = columns.observed(columns.of(hypotheses[0])).reshape(len(base.residual), -1)
    X = model.regressor(table, base.x).B * base.sizes
    return X, base.residual, C


def left(A: np.ndarray, r: np.ndarray) -> float:
    scaled = A / np.maximum(np.abs(A).max(axis=0), 1e-30)
    return float(np.linalg.norm(r - scaled @ np.linalg.lstsq(scaled, r, rcond=1e-10)[0]))


def test_the_columns_explain_a_spring_anchored_elsewhere(remaining) -> None:
    """At the example's anchor the stiffness alone hardly does; its neighbours are zero there."""
    X, r, C = remaining
    assert left(np.hstack([X, C]), r) < 0.5 * left(X, r)


@pytest.mark.long
def test_the_spring_is_in_the_answer() -> None:
    d = diagnosed(COMPENSATOR)
    alike = {(e.effect, e.where) for group in d.indistinguishable for e in group}
    assert FAULTS[COMPENSATOR].key in alike | {(e.effect, e.where) for e in d.effects}
