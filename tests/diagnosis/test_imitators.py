"""How far a rival is from a found effect, against dense matrices."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from support.diagnosis_data import campaign, dense_noise, used_rows

from elastocal.diagnosis import (
    DiagnosisData,
    Item,
    ModelSet,
    diagnosis_data_of,
    distances,
    fit_baseline,
    fit_set,
    packed_columns,
    possible,
    signal_of,
)
from elastocal.diagnosis.model_set import PLAUSIBLE

RIVALS = ("gear_eccentricity", "encoder_scale", "link_mass_error")


@lru_cache
def found() -> tuple[DiagnosisData, ModelSet, np.ndarray]:
    """Eccentricity of joint 2 in a set of two, and S of the data without it."""
    model, table = campaign("gear_eccentricity:joint2", n=16)
    hypotheses = [h for h in possible(model, table)[0] if h.name in RIVALS]
    dataset = diagnosis_data_of(fit_baseline(model, table), hypotheses)
    chosen = {(h.name, h.where): h for h in dataset.hypotheses}
    keys = [("encoder_scale", "joint5"), ("gear_eccentricity", "joint2")]
    grids = dataset.grids
    items = tuple(Item(chosen[k], grids[k].values[0], 0.0) for k in keys)
    both = fit_set(dataset, items)
    rows = used_rows(dataset.data)
    X = dataset.data.X.reshape(-1, dataset.data.X.shape[2])[rows]
    other = packed_columns(dataset, items[0]).reshape(-1, 1)[rows] * both.scales[0]
    S = dense_noise(dataset.data, both.noise) + X / dataset.data.precision @ X.T + other @ other.T
    return dataset, both, S


def dense(dataset: DiagnosisData, packed: np.ndarray) -> np.ndarray:
    return packed.reshape(-1, packed.shape[2])[used_rows(dataset.data)]


def test_distances_are_what_no_rival_and_no_fitted_parameter_explains() -> None:
    """d² = vᵀ(S + s²CCᵀ)⁻¹v: everything that may follow integrated out at its prior."""
    dataset, both, S = found()
    v = dense(dataset, signal_of(dataset, both, 1)[..., None])[:, 0]
    nothing, each = distances(dataset, both, 1)
    assert nothing == pytest.approx(np.sqrt(v @ np.linalg.solve(S, v)), rel=1e-3)
    assert both.items[1].what not in [h for h in dataset.hypotheses if (h.name, h.where) in each]
    for h in dataset.hypotheses:
        if h is both.items[1].what or h.name == "link_mass_error":
            continue
        item = Item(h, dataset.grids[h.name, h.where].values[0], 0.0)
        C = PLAUSIBLE * 3.0 * dense(dataset, packed_columns(dataset, item))
        expected = np.sqrt(v @ np.linalg.solve(S + C @ C.T, v))
        assert each[h.name, h.where] == pytest.approx(expected, rel=1e-3)
