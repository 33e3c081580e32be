"""How far a rival is from a found effect, against dense matrices."""

from __future__ import annotations

from dataclasses import replace
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
    settings_to_try,
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


def test_the_signal_is_what_the_item_does_at_its_estimate() -> None:
    """The posterior mean of the item's columns given everything else, from dense matrices."""
    dataset, both, S = found()
    C = dense(dataset, packed_columns(dataset, both.items[1])) * both.scales[1]
    r = dense(dataset, dataset.data.r[..., None])[:, 0]
    mean = C @ (C.T @ np.linalg.solve(S + C @ C.T, r))
    v = dense(dataset, signal_of(dataset, both, 1)[..., None])[:, 0]
    np.testing.assert_allclose(v, mean, atol=2e-3 * np.abs(mean).max())


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


def test_of_those_far_away_a_lower_bound_is_enough() -> None:
    """Eccentricities and lines of another joint are far, whatever their settings."""
    model, table = campaign("gear_eccentricity:joint2", n=16)
    hypotheses = [h for h in possible(model, table)[0] if h.name in (*RIVALS, "gear_ripple")]
    dataset = diagnosis_data_of(fit_baseline(model, table), hypotheses)
    ripple = next(h for h in dataset.hypotheses if h.key == ("gear_ripple", "joint2"))
    both = fit_set(dataset, (Item(ripple, dataset.grids[ripple.key].values[5], 0.0),))
    large = replace(both, data=replace(both.data, r=both.data.masked(
        50.0 * packed_columns(dataset, both.items[0])[:, :, 0]
    )))  # fmt: skip
    (_, each), (_, some) = distances(dataset, large, 0), distances(dataset, large, 0, 3.0)
    assert each.keys() == some.keys()
    bounded = [key for key in each if some[key] != each[key]]
    assert bounded and all(3.0 < some[key] <= each[key] for key in bounded)


def test_a_weight_on_the_second_link_is_near_and_other_joints_are_far() -> None:
    dataset, both, _ = found()
    nothing, each = distances(dataset, both, 1)
    assert max(each.values()) <= nothing * (1 + 1e-9)
    assert min(each, key=lambda key: each[key]) == ("link_mass_error", "link2")
    assert each["link_mass_error", "link2"] < 2.0 < each["gear_eccentricity", "joint3"]
    assert each["gear_eccentricity", "joint5"] > 0.9 * nothing


def test_a_rival_with_a_constant_of_the_same_kind_may_have_the_items_own() -> None:
    """A joint's drift at a time constant between the grid's is imitated by the base's at the same;
    a large one would be told from it by the grid alone."""
    model, table = campaign(n=16)
    hypotheses = [h for h in possible(model, table)[0] if h.name in ("joint_drift", "base_drift")]
    dataset = diagnosis_data_of(fit_baseline(model, table), hypotheses)
    known = {(h.name, h.where): h for h in dataset.hypotheses}
    base, joint = known["base_drift", "base"], known["joint_drift", "joint1"]
    grid = dataset.grids["base_drift", "base"].values
    between = np.sqrt(grid[3] * grid[4])
    item = Item(joint, between, 0.0)
    both = fit_set(dataset, (item,))
    size = 5.0
    large = replace(both, data=replace(both.data, r=both.data.masked(
        size * packed_columns(dataset, item)[:, :, 0]
    )))  # fmt: skip
    assert distances(dataset, large, 0)[1]["base_drift", "base"] < 1.0
    assert settings_to_try(dataset, base, item)[-1] == pytest.approx(between)
    np.testing.assert_array_equal(dataset.grids["base_drift", "base"].values, grid)


def test_a_constant_beyond_the_rivals_bounds_is_not_tried() -> None:
    model, table = campaign(n=16)
    known = {(h.name, h.where): h for h in possible(model, table)[0]}
    dataset = diagnosis_data_of(fit_baseline(model, table), [known["base_drift", "base"]])
    rival = dataset.hypotheses[0]
    far = Item(known["joint_drift", "joint1"], np.array([2 * rival.settings[0].upper]), 0.0)
    tried = settings_to_try(dataset, rival, far)
    np.testing.assert_array_equal(tried, dataset.grids["base_drift", "base"].values)
