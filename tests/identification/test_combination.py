"""The text of a combination is the sum that was determined, wherever its members are held."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.calibration import GEOMETRY, campaign, cell_of, combination_truth, measured, table_at
from support.cells import kr270_chain, random_poses

from elastocal.cell_tables import CartesianNoise, Nominal, Tracker
from elastocal.identification.identify import identify
from elastocal.messages import json_text
from elastocal.model.manipulator import Model

HELD = 2e-6  # rad/(N m), what the cell states for every joint


def test_the_expression_at_the_true_values_is_the_value_that_was_found():
    """With the wrist stretched under one load, axes 4 and 6 are one line."""
    chain = kr270_chain()
    q = random_poses(chain, 20, 3)
    q[:, 4] = 0.0
    nominal = Nominal(joint_compliance=(HELD,) * 6)
    cell = cell_of(("joint_compliance",), {"M1": np.array([0.2, 0.1, 0.1])}, nominal=nominal,
                   load_point=(0.2, 0.1, 0.2))  # fmt: skip
    model = Model.assembled(chain, cell)
    rng = np.random.default_rng(0)
    truth = model.nominal * rng.uniform(0.5, 1.5, len(model.nominal))
    plan = table_at(q, [[0, 0, 0], [0, 0, -2600], [900, 0, -1500]])
    result = identify(model, measured(model, plan, truth, 3e-5, rng))
    (c,) = result.combinations
    assert set(c.terms) == {"joint4.compliance", "joint6.compliance"}
    first, other = c.terms
    assert c.held == {other: HELD}
    values = dict(zip(model.names, truth, strict=True))
    text = c.expression.replace("·", "*")
    for name, value in values.items():
        text = text.replace(name, repr(float(value)))
    assert eval(text) == pytest.approx(c.value, abs=4 * c.std)
    plain = sum(f * values[name] for name, f in c.terms.items())
    assert abs(plain - c.value) > 10 * c.std
    (told,) = result.to_json()["combinations"]
    assert told["held"] == {first: 0.0, other: HELD}


def test_an_interval_without_an_end_is_null_with_the_reason():
    result = identify(*campaign(poses=9, seed=1, sigma=1e-5)[:2])
    known = result.estimates[0]
    endless = replace(known, ci95=(-np.inf, known.ci95[1]))
    endless = replace(result, estimates=(endless, *result.estimates[1:]))
    told, ends = json.loads(json_text(endless.to_json()))["parameters"][0], [None, known.ci95[1]]
    assert (told["ci95"], told["note"]) == (ends, "the data set no lower limit to it")


@pytest.mark.parametrize("large", [2_000_000, 0])
def test_intervals_of_combinations_have_room_for_what_is_not_linear(monkeypatch, large):
    """It is more than 2 µm of noise do: without it less than three quarters would hold."""
    monkeypatch.setattr("elastocal.identification.weighted_problem.LARGE", large)
    chain, sigma = kr270_chain(), 2e-6
    places = np.array([[0.25, 0, 0.05], [-0.12, 0.22, 0.1], [-0.05, -0.1, 0.25]])
    markers = {f"M{k + 1}": place for k, place in enumerate(places)}
    tracker = Tracker(noise=CartesianNoise(np.full(3, sigma)))
    model = Model.assembled(chain, cell_of(GEOMETRY, markers, tracker))
    sizes, held = np.where([p.effect == "base_frame" for p in model.parameters], 0.1, 1e-3), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth = model.nominal + sizes * rng.standard_normal(len(sizes))
        plan = table_at(random_poses(chain, 25, seed), markers=tuple(markers))
        result = identify(model, measured(model, plan, truth, sigma, rng))
        true = [combination_truth(result, truth, next(iter(c.terms))) for c in result.combinations]
        ends = zip(true, (c.ci95 for c in result.combinations), strict=True)
        held += [low <= value <= high for value, (low, high) in ends]
    assert np.mean(held) > 0.85
