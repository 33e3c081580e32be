"""From a table to a verdict: effects put into an arm are named, and nothing else is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from support.cells import kr270_chain
from support.diagnosis_data import (
    FAULTS,
    SIGMA,
    VISIT_TIME,
    Fault,
    campaign,
    cell,
    diagnosed,
    measured,
    plan,
)
from support.registered import forgotten, write_example

import elastocal as ec
from elastocal import Diagnosis
from elastocal.cell_tables import CartesianNoise, Nominal
from elastocal.diagnosis.baseline import fit_baseline
from elastocal.files import load_plugins
from elastocal.identification.scrutiny import gap_budget
from elastocal.model.manipulator import Model

# Effects that others imitate in any poses, and those others.
IMITATED = {"gear_eccentricity:joint2": ("link_mass_error", "link2"),
            "payload_error:load": ("link_mass_error", "link3"),
            "off_axis_compliance:joint3": ("link_bending", "link2")}  # fmt: skip
RIPPLE, DRIVEN = "gear_ripple:joint5", "thermal_expansion:link2"
PLAIN = [k for k in FAULTS if k not in (*IMITATED, RIPPLE)]


def sometimes(names: Iterable[str], always: str) -> list[object]:
    return [pytest.param(n, marks=() if n == always else pytest.mark.long) for n in names]


def named(d: Diagnosis) -> set[tuple[str, str]]:
    return {(e.effect, e.where) for e in d.effects}


@pytest.mark.parametrize("name", sometimes(PLAIN, DRIVEN))
def test_an_effect_is_named_with_its_place_size_and_time(name: str) -> None:
    """And the gap falls step by step to the noise; no reading is taken for faulty beside it."""
    d, fault = diagnosed(name), FAULTS[name]
    assert d.verdict == "explained"
    (found,) = d.effects
    assert (found.effect, found.where) == fault.key
    assert found.probability > 0.9 and d.p_value <= 0.05 and d.probability_nothing < 1e-6
    assert d.candidates[0].effect == fault.effect and d.location.where == fault.where
    for p in found.parameters:
        true = fault.values.get(p.name.removeprefix(f"{fault.where}."), 0.0)
        assert abs(p.value - true) < 4 * p.std
    if "time_constant_s" in fault.settings:
        assert found.settings["time_constant_s"] == pytest.approx(1200, rel=0.3)
    for key in set(fault.settings) - {"time_constant_s"}:
        assert found.settings[key] == pytest.approx(fault.settings[key], abs=30.0)
    low, high = found.gap_reduction_ci90
    assert 0.5 < low <= found.gap_reduction <= high < 1.0
    steps, rms = [s.step for s in d.budget], [s.heldout_rms for s in d.budget]
    assert steps[0] == "base_frame" and steps[-2:] == [name, "noise_floor"]
    assert rms == sorted(rms, reverse=True) and rms[-2] < 1.25 * rms[-1] < 1.25 * rms[-3] / 1.2
    assert all(s.ci95[0] <= s.heldout_rms <= s.ci95[1] for s in d.budget)
    gap = d.gap.nominal, d.gap.calibrated, d.gap.explained, d.gap.noise_floor
    assert gap == (rms[0], *rms[-3:])
    # Three axes of tracker noise, and what the joints' scatter adds.
    assert np.sqrt(3) * SIGMA < 1.1 * rms[-1] and rms[-1] < 3 * np.sqrt(3) * SIGMA
    assert d.noise.faulty == ()


def test_geometry_alone_has_no_part_in_the_sag_of_soft_joints() -> None:
    """Of diagnosis, page and parameter sets, as a model without compliances has it."""
    fitted = ("base_frame", "joint_offset", "marker_position", "link_geometry")
    stiff, soft = (
        Model.assembled(kr270_chain(), cell(names, nominal=Nominal(), link_gravity=False))
        for names in (fitted, (*fitted, "joint_compliance"))
    )
    values = {f"joint{j}.compliance": 4e-6 for j in (4, 5, 6)}
    table = ec.simulate(soft, plan(soft.chain, 40, 1), draw=1.0, values=values, seed=1)
    true = ec.identify(stiff, table, outliers="keep").heldout_rms
    fit = ec.identify(soft, table)
    for steps in (ec.diagnose(soft, table).budget, gap_budget(fit).steps, fit.parameter_sets()):
        assert steps[1].heldout_rms == pytest.approx(true, rel=0.01)


def test_an_interval_holds_the_values_at_other_likely_time_constants() -> None:
    (model, table), (found,) = campaign(DRIVEN), diagnosed(DRIVEN).effects
    (p,) = found.parameters
    for tau in found.settings["time_constant_s"] * np.array([0.8, 1.25]):
        spec = model.cell.model.with_effect(*FAULTS[DRIVEN].key, {"time_constant_s": tau})
        fit = fit_baseline(Model.assembled(model.chain, replace(model.cell, model=spec)), table)
        assert abs(fit.x[fit.model.names.index(p.name)] - p.value) < 1.96 * p.std


def test_a_cause_far_larger_than_usual_is_named_and_to_be_confirmed() -> None:
    """A gear of 51 teeth for 50: so large that it is not linear."""
    fault = Fault("encoder_scale", "joint3", {"encoder_scale": 0.02})
    model, _ = campaign()
    table = measured(model.chain, model.cell, [fault], plan(model.chain, 24, 1), 1)
    why = ec.diagnose(model, table)
    (found,) = why.effects
    assert (found.effect, found.where) == fault.key and why.gap.explained < 2 * why.gap.noise_floor
    assert abs(found.parameters[0].value - 0.02) < 4 * found.parameters[0].std
    assert any("joint3.encoder_scale (67 times)" in told for told in why.warnings)


def test_a_ripple_is_named_with_its_order_and_amplitude() -> None:
    """Order and phase go together; amplitude does not go with either."""
    (found,), fault = diagnosed(RIPPLE).effects, FAULTS[RIPPLE]
    assert (found.effect, found.where) == fault.key
    assert found.settings["ripple_order"] == pytest.approx(fault.settings["ripple_order"], abs=0.2)
    both = [p.value for p in found.parameters], fault.values.values()
    size, true = (np.hypot(*v) for v in both)
    assert size == pytest.approx(true, abs=4 * max(p.std for p in found.parameters))


@pytest.mark.parametrize("name", sometimes(IMITATED, "gear_eccentricity:joint2"))
def test_where_another_effect_looks_the_same_the_answer_is_both(name: str) -> None:
    d = diagnosed(name)
    assert d.verdict == "ambiguous" and d.noise.faulty == ()
    (alike,) = d.indistinguishable
    found = [(e.effect, e.where) for e in alike]
    assert {FAULTS[name].key, IMITATED[name]} <= set(found) and len(found) <= 3
    probability = {(c.effect, c.where): c.probability for c in d.candidates}
    assert all(probability[key] <= 0.9 for key in found)
    assert sum(probability[key] for key in found) > 0.9
    # The effect of the set that the gap is measured with is its likeliest.
    assert (d.effects[0].effect, d.effects[0].where) == found[0]


WITHHELD = {"gear_eccentricity:joint4": ("transmission", "joint4 angle"),
            "marker_slip:marker:M2": ("tool", "time"),
            "hysteresis:joint3": ("transmission", "approach of joint3"),
            "encoder_jump:joint4": ("transmission", "time")}  # fmt: skip


@pytest.mark.parametrize("name", sometimes(WITHHELD, "gear_eccentricity:joint4"))
def test_an_effect_that_the_catalogue_lacks_is_unknown_but_located(name: str) -> None:
    fault, (stage, covariate) = FAULTS[name], WITHHELD[name]
    d = diagnosed(name, without=(fault.effect,))
    assert d.verdict == "unknown_effect" and d.effects == ()
    assert d.probability_unknown > 0.9
    assert (d.location.stage, d.location.where) == (stage, fault.where)
    assert max(c.probability for c in d.candidates) < 0.1
    assert fault.effect not in {c.effect for c in d.candidates}
    shown = {t.driver: t.p_family for t in d.structure}
    assert shown[covariate] <= 0.05


def test_the_shape_of_an_unknown_dependence_is_drawn() -> None:
    """The eccentricity's sine, up to what the joint's fitted offset takes of it."""
    fault = FAULTS["gear_eccentricity:joint4"]
    d = diagnosed("gear_eccentricity:joint4", without=("gear_eccentricity",))
    (curve,) = d.curves
    assert (curve.driver, curve.x_unit, curve.y_unit) == ("joint4 angle", "rad", "rad")
    x, y, sd = (np.array(v) for v in (curve.x, curve.y, curve.sd))
    a, b = fault.values.values()
    true = a * np.sin(x) + b * np.cos(x)
    away = (y - true) - np.average(y - true, weights=1 / sd**2)
    assert np.sqrt(np.mean(away**2)) < 0.25 * np.std(true)
    assert np.mean(np.abs(away) < 3 * sd) > 0.85


@pytest.mark.long
def test_hysteresis_without_loads_shrinks_the_gap() -> None:
    """Where nobody states the motors' ratings friction that grows with the load has no size."""
    chain, fault = kr270_chain(), FAULTS["hysteresis:joint3"]
    plain = cell(("base_frame", "joint_offset", "marker_position"), link_gravity=False)
    table = plan(chain, 40, 1, np.zeros(3))
    table = table.take(np.arange(0, len(table), 2))
    d = ec.diagnose(Model.assembled(chain, plain), measured(chain, plain, [fault], table, 1))
    (found,) = d.effects
    assert (found.effect, found.where) == fault.key
    low, high = found.gap_reduction_ci90
    assert 0.8 < low <= found.gap_reduction <= high < 1.0


def test_an_effect_with_two_settings_is_found_with_both(tmp_path) -> None:
    """A plug-in's: a joint that gave way after 900 s."""
    settings = {"settling_from_s": 900.0, "settling_time_s": 400.0}
    fault = Fault("settling_joint", "joint3", {"settled": 3e-4}, settings)
    with forgotten():
        load_plugins(None, [str(write_example(tmp_path, "settling_joint.py"))])
        chain, plain = kr270_chain(), cell()
        table = measured(chain, plain, [fault], plan(chain, 40, 1), 1)
        why = ec.diagnose(Model.assembled(chain, plain), table)
    assert why.verdict == "explained" and named(why) == {fault.key}
    (found,) = why.effects
    assert abs(found.settings["settling_from_s"] - 900.0) < 6 * VISIT_TIME
    assert found.settings["settling_time_s"] == pytest.approx(400.0, rel=0.5)
    (settled,) = found.parameters
    assert abs(settled.value - 3e-4) < 4 * settled.std


# What means nothing changes nothing.


@pytest.mark.long
def test_frame_order_of_the_rows_and_sigmas_stated_too_large_mean_little() -> None:
    """Turned about the vertical and moved, so that gravity and force stay vertical."""
    name = "gear_eccentricity:joint4"
    model, table = campaign(name)
    mixed = table.take(np.random.default_rng(3).permutation(len(table)))
    c, s = np.cos(0.7), np.sin(0.7)
    turn, shift = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([0.4, -1.0, 0.2])
    moved = replace(mixed, position=mixed.position @ turn.T + shift)
    nominal = replace(model.cell.model.nominal, base_rotation=turn, base_position=shift)
    tracker = replace(
        model.cell.tracker, position=turn @ model.cell.tracker.position + shift,
        noise=CartesianNoise(np.full(3, 1.5 * SIGMA)),
    )  # fmt: skip
    spec = replace(model.cell.model, nominal=nominal)
    other = Model.assembled(model.chain, replace(model.cell, model=spec, tracker=tracker))
    usual, found = diagnosed(name), ec.diagnose(other, moved)
    assert found.noise.stated_factor == pytest.approx(usual.noise.stated_factor / 1.5, rel=0.03)
    assert found.noise.reading_sigma == pytest.approx(usual.noise.reading_sigma, rel=0.03)
    assert found.verdict == usual.verdict and named(found) == named(usual)
    a, b = ({(e.effect, e.where): e.probability for e in d.candidates} for d in (usual, found))
    assert a.keys() == b.keys() and max(abs(a[k] - b[k]) for k in a) < 0.05
