"""Every effect of the catalogue is held by a file, left out with its cost, or not the arm's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import COMPENSATOR, SLANTED, kr270_cell

from elastocal.cell.arm_description import Nominal
from elastocal.export.exportable import Conditions, cost_of, evaluate_pieces, keep
from elastocal.model.calibrated import CalibratedArm
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model

CONDITIONS = Conditions(SLANTED, time=1800.0, temperature=30.0)
# Without parameters of their own they act through the others.
ALWAYS = ("payload", "link_gravity")
# Geometry, the last three of it constant once time and temperature are.
RIGID = {
    "base_frame",
    "joint_offset",
    "link_geometry",
    "marker_position",
    "marker_orientation",
    "thermal_expansion",
    "joint_drift",
    "encoder_jump",
}
SPRINGS = {
    "joint_compliance",
    "off_axis_compliance",
    "link_bending",
    "base_compliance",
    "gravity_compensator",
    "link_gravity",
    "link_mass_error",
    "payload",
    "payload_error",
}
# What has no parameters unless a setting asks for some.
SHOWN = {"gear_spectrum": {"order_1": 9.5}, "residual_field": {"field_joint1_size": 1e-4}}
# What has no cost, for nobody states what it follows.
UNSTATED = ("torque_coupling", "torque_tilt")
INSTRUMENT = {
    name
    for name, effect in CATALOGUE.items()
    if (effect.stage == "tracker" and name != "base_frame") or name == "marker_slip"
}


def calibrated(name: str) -> CalibratedArm:
    """A KR 270 with soft joints, its weights, and one effect at a place of its own."""
    observe = "distance" if name == "distance_sensor" else "position"
    nominal = Nominal(joint_compliance=(3e-7,) * 6, gravity_compensator=COMPENSATOR)
    cell = kr270_cell((), observe, nominal=nominal, link_gravity=True)
    chain = Model(cell).chain
    effect = CATALOGUE[name]
    # Upright, no weight would turn joint 1.
    place = effect.places(chain, cell)[1 if name == "gravity_sag" else 0]
    keys = {s.key for s in effect.settings(place, chain, cell) if s.default is None}
    settings = {place: {key: 20.0 if "order" in key else 900.0 for key in keys}} if keys else {}
    settings |= {place: SHOWN[name]} if name in SHOWN else {}
    cell = kr270_cell(
        [f"{name}:{place}", *(() if name == "joint_compliance" else ["joint_compliance"])],
        observe,
        nominal=replace(nominal, settings=settings),
        link_gravity=True,
    )
    model = Model(cell)
    x = model.nominal.copy()
    for i, p in enumerate(model.parameters):
        if p.effect == name and name != "joint_compliance":
            x[i] += abs(p.typical or 1e-7)
    return CalibratedArm(model, x, (), np.zeros((0, 0)), "result.json")


@pytest.mark.parametrize("name", [name for name in CATALOGUE if name not in ALWAYS])
def test_it_is_accounted_for(name: str) -> None:
    arm = calibrated(name)
    for elastic in (False, True):
        check_kept(arm, name, elastic)


def check_kept(arm: CalibratedArm, name: str, elastic: bool) -> None:
    kept = keep(arm, elastic, CONDITIONS)
    held = RIGID | (SPRINGS if elastic else set())
    left_out = {omission.effect for omission in kept.omissions}
    assert (name in kept.of_the_measurement) == (name in INSTRUMENT)
    if name in INSTRUMENT:
        assert name not in left_out and name not in kept.full.effects
        return
    assert (name in left_out) == (name not in held)
    assert (name in kept.exported.effects) == (name in held)
    if elastic:
        cost = cost_of(kept, 8, seed=0)
        (entry,) = cost.effects if name not in held else (None,)
        if name in UNSTATED:
            assert entry is not None and "recorded torques" in entry.note
            return
        assert (cost.total.flange_max > 1e-9) == (entry is not None)
        if entry is not None:
            assert entry.difference == cost.total
    assert evaluate_pieces(kept.exported, CONDITIONS).chain.n_joints == 6


def test_linear_deflections_are_held_at_the_deflected_pose_and_that_costs() -> None:
    arm = calibrated("joint_offset")
    spec = replace(arm.model.cell.model, deflection_model="linear")
    linear = Model.assembled(arm.model.chain, replace(arm.model.cell, model=spec))
    kept = keep(replace(arm, model=linear), True, CONDITIONS)
    (omission,) = kept.omissions
    assert omission.effect == "linear deflections"
    # Second order: the deflection of some millimetres times that over the metres of the arm.
    assert 1e-8 < cost_of(kept, 8, seed=0).total.flange_max < 1e-4
