"""Every kind of table that can be read can be diagnosed, or is refused with a reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import random_chain
from support.cells import kr270_chain
from support.diagnosis_data import FAULTS, campaign, cell, measured, plan

import elastocal as ec
from elastocal import Diagnosis
from elastocal.cell_tables import EffectChoice, Nominal
from elastocal.diagnosis.baseline import thinned
from elastocal.messages import InsufficientDataError
from elastocal.model.manipulator import Model

ECCENTRIC, TILTED = "gear_eccentricity:joint4", "off_axis_compliance:joint3"
PULL = np.array([0.0, 0.0, -300.0])


def key(d: Diagnosis) -> tuple[str, str]:
    return d.effects[0].effect, d.effects[0].where


@pytest.mark.parametrize(
    ("observe", "n"), [("pose", 20), pytest.param("distance", 40, marks=pytest.mark.long)]
)
def test_a_gears_error_shows_in(observe: str, n: int) -> None:
    d = ec.diagnose(*campaign(ECCENTRIC, observe=observe, n=n))
    assert d.verdict == "explained" and key(d) == ("gear_eccentricity", "joint4")


def test_deflections_show_what_gives_way() -> None:
    d = ec.diagnose(*campaign(TILTED, observe="deflection", n=20))
    assert d.verdict == "ambiguous"
    shown = {(e.effect, e.where) for e in d.indistinguishable[0]}
    assert shown == {("off_axis_compliance", "joint3"), ("link_bending", "link2")}


def test_positions_without_load_time_approach_and_further_markers() -> None:
    _, table = campaign("encoder_scale:joint3")
    bare = table.take((table.force[:, 2] == 0) & (table.marker == 0))
    # About the origin, where no instrument stands: they were turned into another frame.
    around = bare.position - bare.position.mean(axis=0)
    bare = replace(bare, time=None, approach=None, position=around)
    plain = cell(("base_frame", "joint_offset", "marker_position:marker:M1"), link_gravity=False)
    plain = replace(plain, tracker=replace(plain.tracker, position=np.zeros(3)))
    d = ec.diagnose(Model.assembled(kr270_chain(), plain), bare)
    assert d.n_readings == d.n_configurations == 24
    advice = {u.effect: u.advice for u in reversed(d.untested)}
    assert "time_s" in advice["joint_drift"] and "payload_error" in advice
    assert "approach" in advice["hysteresis"] and "position_m" in advice["tracker_distortion"]
    # The arm's sag is missing too here: whatever the answer, it is not that all is well.
    assert d.verdict != "nothing_significant"


def test_what_weights_do_to_a_joint_or_a_marker_is_no_gear_error() -> None:
    plain = cell(("base_frame", "joint_offset", "marker_position:marker:M1"), link_gravity=False)
    model, (_, table) = Model.assembled(kr270_chain(), plain), campaign(n=60)
    bare = table.take((table.force[:, 2] == 0) & (table.marker == 0))
    sagging = model.with_effects((*plain.model.effects, EffectChoice("gravity_sag", "joint2")))
    read = ec.simulate(sagging, bare, values={"joint2.sag_1": 1e-4}, seed=0)
    d = ec.diagnose(model, read.take(read.marker == 0))
    assert any((c.effect, c.where) == ("gravity_sag", "joint2") for c in d.indistinguishable[0])
    read = ec.simulate(model, bare, seed=0).take(read.marker == 0)
    down = model.flange_poses(bare, model.nominal)
    aside = 1e-4 * np.sign(down[:, 2, :1]) * down[:, :3, 0]
    d = ec.diagnose(model, replace(read, position=read.position + aside))
    assert d.verdict == "unknown_effect" and d.location.where == "marker:M1"


def test_arms_of_other_numbers_of_joints(n_joints: int = 4) -> None:
    chain = random_chain(3, n_joints)
    plain = cell(nominal=Nominal(joint_compliance=(1e-6,) * n_joints), link_gravity=False)
    fault = replace(FAULTS[ECCENTRIC], where="joint3")
    table = measured(chain, plain, [fault], plan(chain, 20, n_joints, PULL), n_joints)
    d = ec.diagnose(Model.assembled(chain, plain), table)
    assert key(d) == fault.key and d.verdict in ("explained", "ambiguous")
    assert len(d.noise.repeatability) == n_joints


def test_too_few_configurations_are_refused_with_what_to_measure() -> None:
    model, table = campaign()
    with pytest.raises(InsufficientDataError, match=r"4 configurations .* measure 8"):
        ec.diagnose(model, table.take(np.arange(20)))


@pytest.mark.long
def test_missing_readings_and_unequal_repeats() -> None:
    model, table = campaign("encoder_scale:joint3")
    rng = np.random.default_rng(0)
    again = np.flatnonzero((table.configuration % 4 == 0) & (table.marker < 2))
    moved = table.position[again] + 1e-5 * rng.normal(size=(len(again), 3))
    both = table.take(np.concatenate([np.arange(len(table)), again]))
    repeat = np.concatenate([table.repeat, table.repeat[again] + 1])
    position = np.concatenate([table.position, moved])
    both = replace(both, row=np.arange(len(both)) + 2, repeat=repeat, position=position)
    d = ec.diagnose(model, both.take(rng.random(len(both)) > 0.2))
    assert d.verdict == "explained" and key(d) == ("encoder_scale", "joint3")
    # Repeats copy the first reading and add 10 µm: their scatter is 10/√2.
    assert d.noise.pure_error == pytest.approx(1e-5 / np.sqrt(2), rel=0.15)


def test_of_a_large_table_a_part_is_looked_at_from_its_first_hour_to_its_last() -> None:
    """Configurations stay whole and evenly spaced, and that is said."""
    _, table = campaign()
    kept, said = thinned(table, most_rows=60)
    assert len(kept) == 60 and said is not None and f"60 of {len(table)} rows" in said
    assert (np.bincount(kept.configuration)[np.unique(kept.configuration)] == 6).all()
    times = np.unique(kept.time)
    assert np.ptp(times) > 0.95 * np.ptp(table.time)
    assert np.diff(times).max() < 4 * np.ptp(table.time) / len(times)
    assert thinned(table) == (table, None)


def test_exact_distances_are_diagnosed() -> None:
    """Where the noise is nil, and a prior of base and anchor drowns in rounding."""
    spec = cell(("base_frame", "distance_sensor", "joint_offset"), observe="distance")
    unstated = replace(spec.tracker, distance_sigma=None, anchor=None)
    model = Model.assembled(kr270_chain(), replace(spec, tracker=unstated))
    q = np.random.default_rng(0).uniform(-1.2, -0.1, (60, 6))
    assert ec.diagnose(model, ec.simulate(model, q, noise=False)).verdict == "nothing_significant"
