"""Backlash, hysteresis and hardening: deflections that follow the load's torque."""

from __future__ import annotations

import numpy as np
import pytest
from model.effects.stick import model, positions, rows, stick
from support.cells import COMPLIANCE, kr270_cell, kr270_chain

from elastocal.cell.arm_description import Nominal
from elastocal.errors import InputError
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.effects.compliances import rated_torque, torque_scale, weight_torque

BETA = 1e-3


@pytest.mark.parametrize(
    "effect, key, value, law",
    [
        ("joint_hardening", "hardening", 1e-10, lambda t: 1e-10 * t**3),
        ("backlash", "backlash", BETA, lambda t: BETA / 2 * np.tanh(t)),
        ("hysteresis", "hysteresis_per_torque", 1e-6, lambda t: 1e-6 * (np.hypot(t, 1) - 1)),
    ],
)
def test_measured_torques_drive_the_same_laws(effect, key, value, law) -> None:
    """Explicitly, with the scale of 1 N m of an arm of which nothing else is known."""
    m = model(stick("z"), effect, torque="measured")
    torque = np.array([-300.0, -0.5, 0.0, 2.0, 200.0])
    table = rows(np.zeros(5), torque=torque[:, None], approach=np.ones((5, 1)))
    assert m.deflection(table).shape[1] == 0
    y = positions(m, table, **{key: value})[:, 1]
    np.testing.assert_allclose(y, np.sin(law(torque)), atol=1e-16)


def test_a_rated_torque_comes_from_compliance_weights_or_the_strongest_joint() -> None:
    chain, cell = kr270_chain(), kr270_cell()
    assert rated_torque(chain, cell, 5) == pytest.approx(3e-3 / COMPLIANCE[5])
    unknown = kr270_cell(nominal=Nominal())
    assert rated_torque(chain, unknown, 1) == weight_torque(chain, 1)
    # A wrist carries payloads, not its own few kilograms.
    assert rated_torque(chain, unknown, 5) == pytest.approx(weight_torque(chain, 0) / 8)
    bare = stick("y")
    assert rated_torque(bare, unknown, 0) is None
    assert torque_scale(bare, unknown, 0) == 1.0


@pytest.mark.parametrize(
    "effect, computed, weighed, measured",
    [
        ("backlash", ("load",), (), ()),
        ("joint_compliance", ("load",), (), ()),
        ("off_axis_compliance", ("load",), (), ("load",)),  # of no torque that a drive measures
        ("hysteresis", ("approach",), ("approach",), ("approach",)),
        ("payload_error", ("load",), ("load",), ("load",)),
    ],
)
def test_what_the_table_must_say(effect: str, computed, weighed, measured) -> None:
    """A load, unless the links' weights are one or the joint's torque is measured."""
    needed = CATALOGUE[effect].needed
    assert needed(kr270_cell()) == computed
    assert needed(kr270_cell(link_gravity=True)) == weighed
    assert needed(kr270_cell(torque="measured")) == measured


def test_a_joint_follows_the_recorded_torques_of_the_others() -> None:
    m = model(stick("zz", (1.0, 1.0)), "torque_coupling:joint1")
    table = rows(np.zeros((3, 2)), torque=[[50.0, 0.0], [0.0, 10.0], [0.0, -20.0]])
    y = positions(m, table, coupling_joint2=1e-5)[:, 1]
    np.testing.assert_allclose(y, 2.0 * np.array([0.0, 1e-4, -2e-4]), atol=1e-8)


def test_a_link_tilts_across_the_joints_at_its_ends_by_their_torques() -> None:
    """Joints about z: the link behind joint 1 tilts about x and y, which lifts the tip 1 m on."""
    m = model(stick("zz", (1.0, 1.0)), "torque_tilt:link1")
    assert [n.partition(".")[2] for n in m.names] == [
        "tilt_own_x", "tilt_own_y", "tilt_next_x", "tilt_next_y",
    ]  # fmt: skip
    table = rows(np.zeros((2, 2)), torque=[[100.0, 0.0], [0.0, 50.0]])
    own = positions(m, table, tilt_own_y=1e-6)[:, 2]
    other = positions(m, table, tilt_next_y=1e-6)[:, 2]
    np.testing.assert_allclose(np.abs(own), [1e-4, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.abs(other), [0.0, 5e-5], atol=1e-9)


def test_torques_that_are_not_recorded_are_asked_for() -> None:
    for effect in ("torque_coupling", "torque_tilt"):
        m = model(stick("zz", (1.0, 1.0)), effect)
        with pytest.raises(InputError, match="needs the column torque_1_Nm"):
            m.predict(rows(np.zeros((2, 2))))
