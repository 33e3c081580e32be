"""Weights that nobody knows and the compliances that they bend: a product, fitted as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support.calibration import measured, table_at
from support.cells import kr270_cell, kr270_chain, random_table
from support.stick import model, stick

from elastocal.cell.arm_description import Nominal
from elastocal.identification.identify import identify
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.units import Array

SIGMA = 1e-5  # m
STATED = (1e-5, 2e-5, 3e-5)  # rad/(N m)
LOADS = ((0.0, 0.0, 0.0), (0.0, 0.0, -60.0))


def arm(*effects: str) -> Model:
    chain = stick("zyy", (0.3, 0.8, 0.6))
    return model(chain, "joint_offset", *effects, tip=(0.1, 0.05, 0.1),
                 nominal=Nominal(joint_compliance=STATED))  # fmt: skip


def readings(true: Model, x: Array, poses: int, seed: int, sigma: float = SIGMA) -> Measurements:
    rng = np.random.default_rng(seed)
    table = table_at(rng.uniform(-2.0, 2.0, (poses, 3)), LOADS, ("tip",))
    return measured(true, table, x, sigma, rng)


def sagging(m: Model) -> Array:
    """Springs off by a third, and moments of some 10 kg m."""
    x = m.nominal.copy()
    for name, factor in zip(("joint1", "joint2", "joint3"), (1.0, 1.35, 0.7), strict=True):
        x[m.names.index(f"{name}.compliance")] *= factor
    values = {"link2_moment_x": 9.0, "link2_moment_y": 0.4, "link3_moment_x": -2.5}
    for key, value in values.items():
        x[m.names.index(f"arm.{key}")] = value
    return x


def test_loads_tell_the_springs_and_these_the_moments() -> None:
    m = arm("joint_compliance", "link_weights")
    x = sagging(m)
    table, test = readings(m, x, 40, 1), readings(m, x, 100, 2, 0.0)
    found = identify(m, table, test=test)
    assert found.converged and found.test.rms < 1.5 * SIGMA
    sag = identify(arm("joint_compliance", "gravity_sag"), table, test=test)
    assert found.test.rms < sag.test.rms, "each joint's own functions have more to fit"
    for name in ("joint2.compliance", "joint3.compliance", "arm.link2_moment_x"):
        estimate = found[name]
        assert abs(estimate.value - x[m.names.index(name)]) < 4.5 * estimate.std
    (part,) = found.smooth
    assert part.group.effect == "link_weights" and part.group.units == ("kg*m",)


def test_a_compliance_whose_weights_are_held_at_zero_is_left_out() -> None:
    """Without loads a spring shows by the weights alone: where their errors are dropped it moves
    nothing, though it was chosen beside them."""
    effects = ["base_frame", "joint_offset", "joint_compliance", "link_mass_error", "gravity_sag"]
    chain, rng = kr270_chain(), np.random.default_rng(1)
    m = Model.assembled(chain, kr270_cell(effects))
    poses = random_table(chain, 12, seed=1)
    table = replace(poses, force=np.zeros_like(poses.force), distance=None)
    x = m.nominal.copy()
    for k, p in enumerate(m.parameters):
        x[k] += (p.typical or 1e-7) * rng.normal() * (0.3 if p.lower < 0 else 0.0)
    position = m.predict(table, x).reshape(-1, 3) + 3e-5 * rng.normal(size=(len(table), 3))
    found = identify(m, replace(table, position=position))
    assert found.converged
    assert found["joint5.compliance"].std is None
