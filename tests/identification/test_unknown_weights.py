"""Weights that nobody knows and the compliances that they bend: a product, fitted as one."""

from __future__ import annotations

import numpy as np
from model.effects.stick import model, stick
from support.calibration import measured, table_at

from elastocal.cell.arm_description import Nominal
from elastocal.identification.identify import identify
from elastocal.measurements import Measurements
from elastocal.model import Chain, Model
from elastocal.units import Array

SIGMA = 1e-5  # m
STATED = (1e-5, 2e-5, 3e-5)  # rad/(N m)
LOADED, BARE = ((0.0, 0.0, 0.0), (0.0, 0.0, -60.0)), ((0.0, 0.0, 0.0),)


def arm(*effects: str, mass: float = 0.0) -> Model:
    chain: Chain = stick("zyy", (0.3, 0.8, 0.6), mass)
    return model(chain, "joint_offset", *effects, tip=(0.1, 0.05, 0.1),
                 nominal=Nominal(joint_compliance=STATED))  # fmt: skip


def readings(
    true: Model, x: Array, poses: int, forces: tuple, seed: int, sigma: float = SIGMA
) -> Measurements:
    rng = np.random.default_rng(seed)
    table = table_at(rng.uniform(-2.0, 2.0, (poses, 3)), forces, ("tip",))
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
    table, test = readings(m, x, 40, LOADED, 1), readings(m, x, 100, LOADED, 2, 0.0)
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
    """Masses that the functions make needless are held at nothing, and with them goes all that a
    spring moves: no unloaded reading knows it then."""
    m = arm("joint_compliance", "link_mass_error", "gravity_sag", mass=4.0)
    x = m.nominal.copy()
    x[[k for k, p in enumerate(m.parameters) if p.effect == "gravity_sag"]] = 1e-4
    found = identify(m, readings(m, x, 30, BARE, 3))
    assert found.converged
    assert np.isfinite([e.std for e in found.ordinary if e.std is not None]).all()
