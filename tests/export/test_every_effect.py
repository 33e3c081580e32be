"""Every effect of the catalogue is held by a file, left out with its cost, or not the arm's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.cells import COMPENSATOR, SLANTED, kr270_cell
from support.exports import write_result
from support.robots import KR270

from elastocal.cell_tables import Nominal
from elastocal.export.export import Wish, export
from elastocal.export.exportable import Conditions, cost_of, evaluate_pieces, keep
from elastocal.model.calibrated import CalibratedArm, read_calibrated
from elastocal.model.effects.base import Arm, Spring
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model
from elastocal.model.urdf import read_urdf

ROBOT = f'urdf = "{KR270}"'
CONDITIONS = Conditions(SLANTED, time=1800.0, temperature=30.0)
# Without parameters of their own they act through the others.
ALWAYS = ("payload", "link_gravity")
# Geometry, the last three of it constant once time and temperature are.
RIGID = {
    "base_frame", "joint_offset", "link_geometry", "marker_position", "marker_orientation",
    "thermal_expansion", "joint_drift", "encoder_jump", "link_jump",
}  # fmt: skip
SPRINGS = {
    "joint_compliance", "off_axis_compliance", "link_bending", "base_compliance",
    "gravity_compensator", "link_gravity", "link_mass_error", "payload", "payload_error",
}  # fmt: skip
# What has no parameters unless a setting asks for some.
SHOWN = {"gear_spectrum": {"order_1": 9.5}, "residual_field": {"field_joint1_size": 1e-4}}
# What has no cost, for nobody states what it follows.
UNSTATED = ("torque_coupling", "torque_tilt")
INSTRUMENT = {
    name
    for name, effect in CATALOGUE.items()
    if (effect.stage == "tracker" and name != "base_frame") or name in ("marker_slip", "tool_jump")
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
@pytest.mark.parametrize("elastic", [False, True])
def test_it_is_accounted_for(name: str, elastic: bool) -> None:
    arm = calibrated(name)
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


def test_a_spring_whose_axis_is_a_list_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    def add(arm: Arm, spring: Spring) -> None:
        axis: Any = list(spring.axis)  # as an effect of a plug-in may state it
        arm.springs.append(replace(spring, axis=axis))

    monkeypatch.setattr(Arm, "add_spring", add)
    kept = keep(calibrated("off_axis_compliance"), True, CONDITIONS)
    assert len(evaluate_pieces(kept.exported, CONDITIONS).springs) > 6


def test_linear_deflections_are_held_at_the_deflected_pose_and_that_costs() -> None:
    arm = calibrated("joint_offset")
    spec = replace(arm.model.cell.model, deflection_model="linear")
    linear = Model.assembled(arm.model.chain, replace(arm.model.cell, model=spec))
    kept = keep(replace(arm, model=linear), True, CONDITIONS)
    (omission,) = kept.omissions
    assert omission.effect == "linear deflections"
    # Second order: the deflection of some millimetres times that over the metres of the arm.
    assert 1e-8 < cost_of(kept, 8, seed=0).total.flange_max < 1e-4


def test_temperature_is_frozen_into_the_lengths_where_it_is_stated(tmp_path: Path) -> None:
    model = 'thermal_driver = "temperature"'
    written = write_result(tmp_path, ROBOT, ["thermal_expansion:all"], model, value=lambda p: 12e-6)
    arm = read_calibrated(*written)
    (entry,) = export(arm, Wish(tmp_path / "a.urdf", poses=20)).cost.effects
    assert entry.difference is None and "`temperature_c`" in entry.note
    warm = export(arm, Wish(tmp_path / "a.urdf", temperature_c=30.0, poses=20))
    assert not warm.cost.effects and warm.cost.total.flange_max == 0.0
    (tmp_path / "warm.urdf").write_text(warm.text)
    forearm = read_urdf(tmp_path / "warm.urdf").joints[2].placement
    assert forearm[0, 3] == pytest.approx(1.25 * (1 + 12e-6 * 10), rel=1e-15)
    assert "at 30 °C" in warm.text
