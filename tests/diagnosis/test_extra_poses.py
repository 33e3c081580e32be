"""Extra poses: what separates rivals is found, what nothing separates is said."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain, table_of
from support.diagnosis_data import FITTED, Fault, cell, measured

from elastocal.cell import Workspace
from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.diagnosis import Candidate, EffectAt, NoiseFloor
from elastocal.diagnosis.extra_poses import plan_extra
from elastocal.diagnosis.hypotheses import with_recorded_drivers
from elastocal.measurements import Measurements, read_measurements
from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.model.manipulator import Model
from elastocal.saving import save_extra_poses

Key = tuple[str, str]

SIGMA, REPEATABILITY = 20e-6, 6e-6
ECCENTRIC: Key = ("gear_eccentricity", "joint3")
SCALE: Key = ("encoder_scale", "joint3")


def planned(model: Model, table: Measurements, rivals: Mapping[Key, float], most: int = 10) -> Any:
    """The plan for an ambiguous verdict on these rivals with their probabilities."""
    return plan_extra(diagnosis_of(model, table, rivals), most)


def diagnosis_of(model: Model, table: Measurements, rivals: Mapping[Key, float]) -> Any:
    each = (Candidate(*key, "transmission", p, 0.0, 5.0, {}) for key, p in rivals.items())
    return SimpleNamespace(
        calibrated=fit_baseline(with_recorded_drivers(model, table), table),
        verdict="ambiguous",
        effects=(EffectAt(*next(iter(rivals))),),
        groups=(),
        candidates=tuple(each),
        indistinguishable=(tuple(EffectAt(*key) for key in rivals),),
        location=None,
        noise=NoiseFloor(True, 1, 1, SIGMA, (REPEATABILITY,) * 6, 0.2 * table.force.any(), None),
        probability_unknown=0.0,
        probability_nothing=0.0,
    )


def campaign(
    half_range: float, *faults: Fault, seed: int = 0, n: int = 30, link_gravity: bool = False
) -> tuple[Model, Measurements]:
    """The plain model and readings of an arm with `faults`, joint 3 within ± `half_range` rad."""
    chain, plain = kr270_chain(), cell(FITTED, sigma=SIGMA, link_gravity=link_gravity)
    rng = np.random.default_rng((seed, 1))
    q = rng.uniform(*finite_ranges(chain, *joint_limits(plain, chain)), (n, 6))
    q[:, 2] = rng.uniform(-half_range, half_range, n)
    table = table_of(q, DOWN, both=True)
    table = replace(table, time=30.0 * (np.arange(len(table)) // 3))
    return Model.assembled(chain, plain), measured(chain, plain, faults, table, seed)


def eccentric(joint: str, sine: float, cosine: float = 0.0) -> Fault:
    return Fault("gear_eccentricity", joint, {"eccentricity_sin": sine, "eccentricity_cos": cosine})


CIRCLE = eccentric("joint3", 1.5e-4, -1e-4)


@pytest.fixture(scope="module")
def narrow() -> tuple[Model, Measurements]:
    return campaign(0.5, CIRCLE)


@pytest.fixture(scope="module")
def few(narrow: tuple[Model, Measurements]) -> Any:
    return planned(*narrow, {ECCENTRIC: 0.5, SCALE: 0.5})


def test_few_poses_of_a_wide_range_separate_scale_from_eccentricity(narrow, few) -> None:
    """Over ±0.5 rad a circle looks like a line; beyond, it does not."""
    model, table = narrow
    (pair,) = few.pairs
    assert pair.distance_before < 2 and few.probability_before < 0.6
    assert few.separable and few.n_poses <= 4 and few.probability_after >= 0.97
    assert pair.distance_after > 3.5 and few.probability_after > few.probability_random + 0.1
    assert np.abs(few.plan.q[:, 2]).max() > 1.0 > 2 * 0.5 - 1e-9 >= np.abs(table.q[:, 2]).max()
    # Once they are measured the rivals are about as far apart as was said.
    both = table_of(np.vstack([table.q[::6], few.plan.q[::2]]), DOWN, both=True)
    both = measured(model.chain, model.cell, [CIRCLE], both, 0)
    (then,) = planned(model, both, {ECCENTRIC: 0.5, SCALE: 0.5}).pairs
    assert then.distance_before > pair.distance_after / 2


def test_the_written_plan_repeats_the_load_states_after_the_campaign(narrow, few, tmp_path) -> None:
    model, table = narrow
    path, kinds = tmp_path / "extra.csv", model.chain.kinds
    save_extra_poses(path, few.plan, kinds)
    plan = read_measurements(path, joint_kinds=kinds, observe="plan")
    np.testing.assert_allclose(plan.q, few.plan.q, atol=1e-10)
    lower, upper = finite_ranges(model.chain, *joint_limits(model.cell, model.chain))
    assert ((plan.q >= lower) & (plan.q <= upper)).all()
    visits = {(c, *f) for c, f in zip(plan.configuration, plan.force, strict=True)}
    assert len(plan) == 2 * few.n_poses == len(visits)
    assert {tuple(f) for f in plan.force} == {tuple(f) for f in table.force}
    assert (np.diff(plan.time) > 0).all() and plan.time[0] > table.time.max()
    assert not set(plan.configuration_labels) & set(table.configuration_labels)


def test_rivals_that_stay_alike_are_planned_for_as_one() -> None:
    """A third rival can be told from two that cannot be told from each other: a weight's torque
    about a horizontal axis is a sine of its angle, and so is an eccentricity."""
    trio = {("gear_eccentricity", "joint2"): 0.4, ("link_mass_error", "link2"): 0.3,
            ("encoder_scale", "joint2"): 0.3}  # fmt: skip
    model, table = campaign(2.0, eccentric("joint2", 1e-4, 1e-4), n=16, link_gravity=True)
    extra = planned(model, table, trio, 3)
    alike = [t for t in extra.advice if "no pose separates" in t]
    assert len(alike) == 1 and "encoder_scale" not in alike[0]
    assert extra.inseparable == (("gear_eccentricity:joint2", "link_mass_error:link2"),)
    assert extra.separable and extra.plan is not None
    assert extra.probability_before == pytest.approx(0.7)
    del trio[("encoder_scale", "joint2")]
    extra = planned(model, table.take(table.force[:, 2] == 0), trio)  # once each
    assert not extra.separable and extra.plan is None and extra.n_poses == 0
    assert extra.probability_after == extra.probability_before
    assert any("torque" in text for text in extra.advice)


def test_the_side_of_approach_is_planned_where_rivals_depend_on_it() -> None:
    pair = {("hysteresis", "joint3"): 0.5, ("joint_hardening", "joint3"): 0.5}
    model, table = campaign(2.0)
    true = Fault("hysteresis", "joint3", {"hysteresis": 1e-4})
    sides = np.random.default_rng(5).choice([-1.0, 1.0], (30, 6))
    table = replace(table, approach=sides[table.configuration])
    extra = planned(model, measured(model.chain, model.cell, [true], table, 3), pair, 4)
    assert extra.plan is not None and set(extra.plan.approach.ravel()) == {-1.0, 1.0}
    assert any("side that the plan states" in text for text in extra.advice)


def test_a_horizontal_pull_is_advised_where_it_helps() -> None:
    """A weight turns joint 2 about one axis; a pull bends it across that axis too."""
    model, table = campaign(2.0, eccentric("joint2", 1e-4))
    bent, base = ("off_axis_compliance", "joint2"), ("base_compliance", "base")
    hard = ("joint_hardening", "joint2")

    def told(*rivals: tuple[str, str]) -> list[str]:
        pair = dict(zip(rivals, (0.6, 0.4), strict=True))
        return [t for t in planned(model, table, pair, 2).advice if "pull" in t]

    (apart,), (more,) = told(bent, base), told(hard, bent)
    assert "would separate off_axis_compliance:joint2 and base_compliance:base" in apart
    low, high = map(float, re.findall(r"from (0\.\d+) to (0\.\d+)", more)[0])
    assert more.startswith("pull horizontally: 2 poses") and high > low + 0.1
    assert not told(SCALE, ECCENTRIC)
    # More readings tell more, whatever the pull: what no load moves needs none.
    assert not told(("encoder_scale", "joint2"), ("encoder_scale", "joint3"))


def test_a_cell_without_room_says_which_rule_is_in_the_way(narrow) -> None:
    model, table = narrow
    weak = replace(model.cell, workspace=Workspace(torque_limits=(1e-3,) * 6))
    extra = planned(Model.assembled(model.chain, weak), table, {ECCENTRIC: 0.7, SCALE: 0.3})
    assert not extra.separable and extra.plan is None
    assert extra.probability_after == pytest.approx(0.7)
    assert "torque" in extra.advice[0]


def test_a_gap_that_is_nowhere_located_is_looked_for_everywhere(narrow) -> None:
    """A verdict may rest on what is left alone: unknown, though no block was found for it."""
    nowhere = diagnosis_of(*narrow, {ECCENTRIC: 0.1})
    nowhere.verdict, nowhere.effects, nowhere.indistinguishable = "unknown_effect", (), ()
    nowhere.probability_unknown = 0.9
    extra = plan_extra(nowhere, 2)
    places = {rival.partition(":")[2] for p in extra.pairs for rival in (p.first, p.second)}
    assert len(places) > 1, extra.pairs
