"""Extra poses: what separates rivals is found, what nothing separates is said."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.cells import DOWN, table_of
from support.rivals import ECCENTRIC, JUMP_TIME, SCALE, campaign, diagnosis_of, measured

from elastocal.cell.workspace_rules import Workspace
from elastocal.diagnosis import (
    Location,
    Suspects,
    VisitPool,
    fit_baseline,
    load_forces,
    measuring_order,
    plan_extra,
    with_neighbours,
)
from elastocal.errors import InputError
from elastocal.measurements import Measurements, read_plan
from elastocal.model import Model, finite_ranges, joint_limits
from elastocal.simulation import expand_plan
from elastocal.simulation.simulate import simulate

NARROW = {"joint3.eccentricity_sin": 1.5e-4, "joint3.eccentricity_cos": -1e-4}


@pytest.fixture(scope="module")
def narrow() -> tuple[Model, Measurements]:
    return campaign(NARROW, 0.5)


@pytest.fixture(scope="module")
def few(narrow: tuple[Model, Measurements]) -> Any:
    return plan_extra(*narrow, diagnosis_of({ECCENTRIC: 0.5, SCALE: 0.5}))


def test_few_poses_of_a_wide_range_separate_scale_from_eccentricity(narrow, few) -> None:
    """Over ±0.5 rad a circle looks like a line; beyond, it does not."""
    _, table = narrow
    (pair,) = few.pairs
    assert pair.distance_before < 2 and few.probability_before < 0.6
    assert few.separable and few.n_poses <= 4 and few.probability_after >= 0.97
    assert pair.distance_after > 3.5
    assert np.abs(few.plan.q[:, 2]).max() > 1.0 > 2 * 0.5 - 1e-9 >= np.abs(table.q[:, 2]).max()


def test_planned_poses_beat_as_many_random_ones(few) -> None:
    assert few.probability_after > few.probability_random + 0.1


def test_one_pose_fewer_would_not_do(narrow, few) -> None:
    if few.n_poses == 1:
        pytest.skip("one pose is the fewest there is")
    less = plan_extra(*narrow, diagnosis_of({ECCENTRIC: 0.5, SCALE: 0.5}), most=few.n_poses - 1)
    assert less.n_poses == few.n_poses - 1
    assert less.probability_after < 0.97
    assert any("`poses`" in text for text in less.advice)


def test_the_plan_repeats_the_load_states_after_the_campaign(narrow, few) -> None:
    model, table = narrow
    plan, n = few.plan, few.n_poses
    lower, upper = finite_ranges(model.chain, *joint_limits(model.cell, model.chain))
    assert ((plan.q >= lower) & (plan.q <= upper)).all()
    assert (
        len(plan)
        == 2 * n
        == len({(c, *f) for c, f in zip(plan.configuration, plan.force, strict=True)})
    )
    assert {tuple(f) for f in plan.force} == {tuple(f) for f in table.force}
    assert (np.diff(plan.time) > 0).all() and plan.time[0] > table.time.max()
    assert not set(plan.configuration_labels) & set(table.configuration_labels)


def test_the_written_plan_can_be_measured(narrow, few, tmp_path) -> None:
    from elastocal.saving import save_extra_poses

    model, _ = narrow
    path = tmp_path / "extra.csv"
    save_extra_poses(path, few.plan, model.chain.kinds)
    read = read_plan(path, joint_kinds=model.chain.kinds)
    rows = expand_plan(read, tuple(model.cell.tool.markers))
    assert np.isfinite(simulate(model, rows, model.nominal, 0).position).all()
    np.testing.assert_allclose(read.q, few.plan.q, atol=1e-10)
    np.testing.assert_allclose(read.force, few.plan.force, atol=1e-9)


def test_eccentricity_and_mass_of_the_vertical_link_stay_alike() -> None:
    """A weight's torque about a horizontal axis is a sine of its angle; so is an eccentricity."""
    pair = {("gear_eccentricity", "joint2"): 0.6, ("link_mass_error", "link2"): 0.4}
    model, table = campaign(
        {"joint2.eccentricity_sin": 1e-4, "joint2.eccentricity_cos": 1e-4}, 2.0, link_gravity=True
    )
    extra = plan_extra(model, table, diagnosis_of(pair))
    assert not extra.separable and extra.plan is None and extra.n_poses == 0
    assert extra.probability_after == extra.probability_before == pytest.approx(0.6)
    assert any("no pose separates gear_eccentricity:joint2" in text for text in extra.advice)
    assert any("torque" in text for text in extra.advice)


def test_a_jump_of_the_first_joint_and_of_the_frame_stay_alike() -> None:
    """About a vertical first axis the joint's jump is one of the frame's."""
    pair = {("encoder_jump", "joint1"): 0.89, ("frame_jump", "tracker"): 0.11}
    at = {key: {"jump_time_s": JUMP_TIME} for key in pair}
    model, table = campaign({"joint1.jump": 1.5e-4}, 2.0)
    extra = plan_extra(model, table, diagnosis_of(pair, at))
    assert not extra.separable and extra.plan is None
    assert any("monuments" in text for text in extra.advice)


def test_rivals_that_stay_alike_are_planned_for_as_one(narrow) -> None:
    """A third rival can be told from two that cannot be told from each other."""
    trio = {
        ("gear_eccentricity", "joint2"): 0.4,
        ("link_mass_error", "link2"): 0.3,
        ("encoder_scale", "joint2"): 0.3,
    }
    model, table = campaign(
        {"joint2.eccentricity_sin": 1e-4, "joint2.eccentricity_cos": 1e-4}, 2.0, link_gravity=True
    )
    extra = plan_extra(model, table, diagnosis_of(trio), most=3)
    alike = [t for t in extra.advice if "no pose separates" in t]
    assert len(alike) == 1 and "encoder_scale" not in alike[0]
    assert extra.inseparable == (("gear_eccentricity:joint2", "link_mass_error:link2"),)
    assert extra.separable and extra.plan is not None
    assert extra.probability_before == pytest.approx(0.7)


def test_an_unlisted_rival_is_as_probable_as_the_listed_ones_are(narrow) -> None:
    """Given that there is something at all, as the probabilities of those listed are."""
    model, table = narrow
    alike = ("gear_second_harmonic", "joint3")
    diagnosis = diagnosis_of({ECCENTRIC: 0.5, SCALE: 0.4, alike: 0.05})
    diagnosis.indistinguishable = (diagnosis.indistinguishable[0][:2],)
    diagnosis.probability_nothing = 0.5
    suspects = Suspects(model, table, diagnosis)
    base = fit_baseline(model, table)
    (rivals,) = with_neighbours(base, suspects)
    np.testing.assert_allclose(rivals.probability, [0.5, 0.4, 0.1])


def test_what_may_be_none_of_the_rivals_is_counted(narrow) -> None:
    """Noise alone, an effect that is no rival, something without a name: none gets named."""
    model, table = narrow
    sure = plan_extra(model, table, diagnosis_of({ECCENTRIC: 0.5, SCALE: 0.5}), most=1)
    doubted = diagnosis_of({ECCENTRIC: 0.5, SCALE: 0.5, ("joint_hardening", "joint5"): 0.03})
    doubted.indistinguishable = (doubted.indistinguishable[0][:2],)
    doubted.probability_nothing, doubted.probability_unknown = 0.1, 0.02
    extra = plan_extra(model, table, doubted, most=1)
    for name in ("before", "after", "random"):
        each = (getattr(found, f"probability_{name}") for found in (sure, extra))
        assert next(each) * 0.85 == pytest.approx(next(each))
    assert any("0.15 none of these rivals" in text for text in extra.advice)
    assert not any("none of these rivals" in text for text in sure.advice)


def test_what_the_verdict_had_no_room_for_is_a_rival(narrow) -> None:
    """A set names three effects; a plan that knew no others would promise what they break."""
    far, alike = ("encoder_scale", "joint2"), ("gear_second_harmonic", "joint3")
    diagnosis = diagnosis_of({ECCENTRIC: 0.5, SCALE: 0.4, far: 0.05, alike: 0.001})
    named = diagnosis.indistinguishable[0][:2]
    diagnosis.indistinguishable = (named,)
    extra = plan_extra(*narrow, diagnosis, most=3)
    # Over ±0.5 rad half a wave of any length looks like any other.
    assert extra.rivals == tuple(":".join(key) for key in (ECCENTRIC, SCALE, alike))
    alone = plan_extra(*narrow, diagnosis_of({ECCENTRIC: 0.5, SCALE: 0.4}), most=3)
    assert extra.probability_after < alone.probability_after


def test_no_pose_is_asked_for_where_only_alike_rivals_are_left() -> None:
    """The third rival has lost already: what a pose could tell apart is told apart."""
    trio = {
        ("gear_eccentricity", "joint2"): 0.5,
        ("link_mass_error", "link2"): 0.49,
        ("encoder_scale", "joint2"): 0.01,
    }
    model, table = campaign(
        {"joint2.eccentricity_sin": 1e-4, "joint2.eccentricity_cos": 1e-4}, 2.0, link_gravity=True
    )
    extra = plan_extra(model, table, diagnosis_of(trio), most=3)
    assert extra.n_poses == 0 and extra.plan is None and not extra.separable
    assert any("no pose separates" in text for text in extra.advice)


def test_the_side_of_approach_is_chosen_where_rivals_depend_on_it() -> None:
    """Approached from one side only, hysteresis is an offset of the joint times its load."""
    pair = {("hysteresis", "joint3"): 0.5, ("joint_hardening", "joint3"): 0.5}
    model, table = campaign({}, 2.0)
    true = {"joint3.hysteresis": 1e-4}
    sides = np.random.default_rng(5).choice([-1.0, 1.0], (30, 6))
    sides[:, 2] = 1.0
    table = replace(table, approach=sides[table.configuration])
    extra = plan_extra(model, measured(table, true, 3), diagnosis_of(pair), most=4)
    assert extra.plan is not None
    assert (extra.plan.approach[:, 2] == -1.0).any()
    assert any("side that the plan states" in text for text in extra.advice)


def test_effects_that_keep_a_chance_are_rivals_of_the_unknown(narrow) -> None:
    """The two likeliest in any case, others from one in a hundred."""
    model, table = narrow
    third, fourth = ("encoder_scale", "joint2"), ("encoder_scale", "joint4")
    unknown = diagnosis_of({ECCENTRIC: 0.002, SCALE: 0.001})
    unknown.verdict, unknown.indistinguishable, unknown.effects = "unknown_effect", (), ()
    named = {h.where for h in Suspects(model, table, unknown).hypotheses if h.name == SCALE[0]}
    assert named == {"joint3"}
    unknown.candidates = diagnosis_of(
        {ECCENTRIC: 0.1, SCALE: 0.05, third: 0.01, fourth: 0.009}
    ).candidates
    named = {h.where for h in Suspects(model, table, unknown).hypotheses if h.name == SCALE[0]}
    assert named == {"joint2", "joint3"}


def test_an_unknown_effect_is_told_from_its_likeliest_rivals(narrow) -> None:
    model, table = narrow
    unknown = diagnosis_of({ECCENTRIC: 0.002, SCALE: 0.001})
    unknown.verdict, unknown.indistinguishable, unknown.effects = "unknown_effect", (), ()
    unknown.probability_unknown = 0.997
    unknown.location = Location("transmission", "joint3", 0.9, {}, {"joint3": 0.9}, {})
    extra = plan_extra(model, table, unknown, most=2)
    assert {"gear_eccentricity:joint3", "encoder_scale:joint3"} < set(extra.rivals)
    assert len([name for name in extra.rivals if name.endswith("→ joint3")]) == 2
    assert extra.probability_after >= extra.probability_before


def test_a_cell_without_room_says_which_rule_is_in_the_way(narrow) -> None:
    model, table = narrow
    weak = replace(model.cell, workspace=Workspace(torque_limits=(1e-3,) * 6))
    pair = diagnosis_of({ECCENTRIC: 0.7, SCALE: 0.3})
    extra = plan_extra(Model.assembled(model.chain, weak), table, pair)
    assert not extra.separable and extra.plan is None
    assert extra.probability_after == pytest.approx(0.7)
    assert "torque" in extra.advice[0]


def test_a_verdict_without_rivals_is_refused(narrow) -> None:
    settled = diagnosis_of({ECCENTRIC: 1.0})
    settled.verdict = "explained"
    with pytest.raises(InputError, match="no rivals"):
        plan_extra(*narrow, settled)
    with pytest.raises(InputError, match="at least one"):
        plan_extra(*narrow, diagnosis_of({ECCENTRIC: 0.5, SCALE: 0.5}), most=0)


def test_load_states_are_those_of_the_table_or_their_mean(narrow) -> None:
    _, table = narrow
    np.testing.assert_array_equal(load_forces(table), [np.zeros(3), DOWN])
    own = table.force * np.linspace(0.9, 1.1, 30)[table.configuration, None]
    np.testing.assert_allclose(load_forces(replace(table, force=own)), [np.zeros(3), DOWN])


def test_visits_that_are_due_later_come_later(narrow) -> None:
    _, table = narrow
    q = np.array([np.full(6, 0.3), np.full(6, 0.1), np.full(6, 0.2)])
    rows = table_of(q, DOWN, both=True)
    due = np.array([5000.0, 9000.0, 5000.0])
    rows = replace(rows, time=due[rows.configuration])
    forces, seen = np.array([np.zeros(3), DOWN]), np.zeros(len(rows), dtype=bool)
    pool = VisitPool(q, None, due, forces, rows, seen)
    last = replace(table, q=np.zeros_like(table.q))
    plan = measuring_order(pool, [0, 1, 2], last)
    np.testing.assert_array_equal(plan.q[::2, 0], [0.2, 0.3, 0.1])
    np.testing.assert_allclose(plan.time, [5000, 5030, 5060, 5090, 9000, 9030])
