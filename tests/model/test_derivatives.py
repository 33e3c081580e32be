"""B is the derivative of the prediction: every effect, every observation, both deflection models.

The reference knows nothing of CasADi's derivatives: it evaluates `Model.predict` at disturbed
parameter values.  Position, deflection and distance are analytic, so a complex step gives their
derivatives to rounding; a pose passes through atan2, which numpy has for real numbers only, and
is differenced (central, fourth order).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.cells import COMPENSATOR, COMPLIANCE, MARKERS, kr270_cell, kr270_chain, random_table
from support.robots import random_chain_urdf

from elastocal.cell_tables import Nominal
from elastocal.measurements import Measurements, with_moves
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model
from elastocal.model.observations import COMPONENTS, observe
from elastocal.model.urdf import read_urdf

TOLERANCE = 1e-7  # relative to the largest entry of the column
EPS = float(np.finfo(float).eps)
# What changes once does so in the middle of `random_table`'s two hours; lines and smooth functions
# have no parameters where no setting asks for any.
SMOOTH = {"field_joint3_size": 1e-4, "field_time_size": 1e-4, "field_time_length": 2000.0}
ONCE, OF_JOINTS = {"jump_time_s": 4000.0}, {
    "jump_time_s": 3000.0, "order_1": 7.3, "order_3": 90.5, "order_sd_3": 0.1,
    "torque_response_Nm": 1e4, "approach_response_Nm": 1e4,
}  # fmt: skip
CHANGES = {f"joint{i}": OF_JOINTS for i in range(1, 7)} | {f"link{i}": ONCE for i in range(1, 6)}
CHANGES |= {f"marker:{name}": {"slip_time_s": 3500.0} for name in MARKERS}
CHANGES |= {"base": SMOOTH, "link2": ONCE | SMOOTH, "tracker": ONCE, "tool": ONCE}
CHANGES["joint2"] = OF_JOINTS | SMOOTH
for place in CATALOGUE["residual_step"].places(kr270_chain(), kr270_cell()):
    CHANGES[place] = CHANGES.get(place, {}) | {"step_time_s": 3200.0}
SPRING = Nominal(COMPLIANCE, gravity_compensator=COMPENSATOR, settings=CHANGES)
OBSERVED = tuple(COMPONENTS)


def full_cell(effects: Sequence[str], observe: str = "position", **model):
    model = {"nominal": SPRING, "link_gravity": True, "gear_ripple_orders": (8.0,)} | model
    return kr270_cell(effects, observe, **model)


def with_parameters(observed: str = "position") -> list[str]:
    """The effects of the catalogue that have parameters where this is observed."""
    chain, cell = kr270_chain(), full_cell((), observed)
    return [
        name
        for name, effect in CATALOGUE.items()
        if any(effect.parameters(place, chain, cell) for place in effect.places(chain, cell))
    ]


def second(name: str) -> str:
    """An effect at joint (link, marker) 2 only, at all its places where it has no such one."""
    places = CATALOGUE[name].places(kr270_chain(), full_cell(()))
    return next((f"{name}:{place}" for place in places if place[-1] == "2"), name)


@dataclass(frozen=True)
class Case:
    """A model with its table, parameter values off their nominal ones, and B there."""

    model: Model
    table: Measurements
    x: NDArray
    sizes: NDArray
    B: NDArray
    prediction: NDArray

    def columns(self, effect: str) -> list[int]:
        return [k for k, p in enumerate(self.model.parameters) if p.effect == effect]

    @cached_property
    def largest(self) -> NDArray:
        """The largest entry of each column, whose rounding B has.

        A deflection is a difference of two positions: its rounding is that of their derivatives.
        """
        B = self.B
        if self.model.observe == "deflection":
            every_row = observe(self.table, "position")
            B = self.model.regressor(self.table, self.x, observations=every_row).B
        return np.abs(B).max(axis=0)


def case(model: Model, table: Measurements, disturbed: bool = True) -> Case:
    sizes = model.sizes(model.regressor(table).B)
    x = model.nominal
    if disturbed:
        rng = np.random.default_rng(7)
        step = 0.3 * sizes * rng.uniform(0.5, 1.0, len(x)) * rng.choice([-1.0, 1.0], len(x))
        lower = np.array([p.lower for p in model.parameters])
        x = np.where(x + step < lower, x - step, x + step)
    regression = model.regressor(table, x)
    return Case(model, table, x, sizes, regression.B, regression.prediction)


@lru_cache
def with_everything(observed: str, deflection_model: str) -> Model:
    effects = [second(name) for name in with_parameters(observed)]
    effects += [f"joint_compliance:joint{i}" for i in (1, 3, 4, 5, 6)]
    cell = full_cell(effects, observed, deflection_model=deflection_model)
    return Model.assembled(kr270_chain(), cell)


@lru_cache
def everything(observed: str, deflection_model: str, disturbed: bool = True) -> Case:
    """All effects together, so that each acts on the others' derivatives."""
    table = with_moves(random_table(kr270_chain(), 4, seed=3))
    return case(with_everything(observed, deflection_model), table, disturbed)


def complex_step(c: Case, k: int) -> NDArray:
    """∂prediction/∂x_k to rounding: Im h(x + i s) / s."""
    step = 1e-20 * c.sizes[k]
    x = c.x.astype(complex)
    x[k] += 1j * step
    return c.model.predict(c.table, x).imag / step


def central_difference(c: Case, k: int) -> NDArray:
    step = difference_step(c, k)
    slope = np.zeros(len(c.prediction))
    for weight, n in ((8.0, 1), (-1.0, 2)):
        for sign in (1.0, -1.0):
            x = c.x.copy()
            x[k] += sign * n * step
            slope += sign * weight * c.model.predict(c.table, x) / (12.0 * step)
    return slope


def difference_step(c: Case, k: int) -> float:
    # Small against the torque over which backlash changes its side: where weights bring a joint
    # near that, the error of 1e-3, which falls with the fourth power, was above the tolerance.
    return 1e-4 * c.sizes[k]


def largest_excess(c: Case, columns: Sequence[int]) -> float:
    """Largest |B − derivative| as a multiple of what is allowed in its column."""
    worst = 0.0
    for k in columns:
        if c.model.observe == "pose":
            derivative = central_difference(c, k)
            floor = 10 * EPS * np.abs(c.prediction).max() / difference_step(c, k)
        else:
            derivative = complex_step(c, k)
            floor = 100 * EPS * c.largest[k]
        error = np.abs(c.B[:, k] - derivative).max()
        if error > 0:
            allowed = TOLERANCE * np.abs(derivative).max() + floor
            worst = max(worst, error / allowed)
    return worst


def spread(columns: list[int], most: int) -> list[int]:
    """At most so many of the columns: curves and spectra have hundreds of one form."""
    return [columns[k] for k in np.unique(np.linspace(0, len(columns) - 1, most).astype(int))]


@pytest.mark.parametrize("effect", with_parameters())
def test_of_every_effect(effect: str) -> None:
    c = everything("position", "equilibrium")
    assert largest_excess(c, spread(c.columns(effect), 6)) <= 1


@pytest.mark.parametrize("observed", OBSERVED)
def test_of_what_is_observed(observed: str) -> None:
    c = everything(observed, "linear")
    effects = with_parameters(observed)
    assert {effect: largest_excess(c, spread(c.columns(effect), 2)) for effect in effects} == {
        effect: pytest.approx(0.5, abs=0.5) for effect in effects
    }


def test_every_parameter_moves_some_observation() -> None:
    """Else the comparisons above would compare zeros."""
    moves: dict[str, float] = {}
    for observed in OBSERVED:
        c = everything(observed, "equilibrium" if observed == "position" else "linear")
        for name, far in zip(c.model.names, np.abs(c.B).max(axis=0) * c.sizes, strict=True):
            moves[name] = max(far, moves.get(name, 0.0))
    assert [name for name, far in moves.items() if far <= 1e-9] == []


def test_at_the_nominal_values() -> None:
    """Where rotation vectors are exactly zero and off-axis joints are rigid."""
    c = everything("pose", "linear", disturbed=False)
    assert largest_excess(c, spread([*range(len(c.x))], 80)) <= 1


@pytest.mark.parametrize("observed", ["position", "pose"])
def test_with_measured_torques(observed: str) -> None:
    explicit = ("joint_compliance", "joint_hardening", "backlash", "hysteresis")
    effects = (*explicit, "joint_offset", "link_geometry:link3", "marker_position")
    cell = full_cell(effects, observed, torque="measured", link_gravity=False)
    c = case(Model.assembled(kr270_chain(), cell), random_table(kr270_chain(), 4, seed=6))
    assert c.model.deflection(c.table).shape[1] == 0  # nothing left to solve for
    assert largest_excess(c, range(len(c.x))) <= 1
    if observed == "position":
        for effect in explicit:
            assert np.abs(c.B[:, c.columns(effect)]).max(axis=0).min() > 0


@pytest.mark.parametrize(
    "observed, deflection_model", [("position", "equilibrium"), ("deflection", "linear")]
)
def test_with_a_compliance_per_level(observed: str, deflection_model: str) -> None:
    """k2 split as in Table 2: each level's column is that of k2 in its own rows, else zero."""
    levels = tuple(np.radians([-0.01, -25.24, -56.9]))
    cell = full_cell(("joint_compliance", "joint_offset", "gravity_compensator"), observed,
                     deflection_model=deflection_model,
                     compliance_levels={"joint2": levels})  # fmt: skip
    table = random_table(kr270_chain(), 6, seed=8)
    level = table.configuration % 3
    q = table.q.copy()
    q[:, 1] = np.array(levels)[level]
    table = replace(table, q=q)
    c = case(Model.assembled(kr270_chain(), cell), table)
    assert largest_excess(c, range(len(c.x))) <= 1
    split = [c.model.names.index(f"joint2.compliance_level{n + 1}") for n in range(3)]
    lead = observe(table, observed).lead
    moved = np.abs(c.B[:, split]).reshape(len(lead), 3, 3).max(axis=1) > 0
    np.testing.assert_array_equal(moved, level[lead][:, None] == np.arange(3))


@pytest.mark.parametrize(
    "seed, deflection_model, observed", [(1, "equilibrium", "position"), (4, "linear", "pose")]
)
def test_of_chains_with_sliding_joints(
    seed: int, observed: str, deflection_model: str, tmp_path: Path
) -> None:
    path = tmp_path / "chain.urdf"
    path.write_text(random_chain_urdf(seed, n_joints=5))
    chain = read_urdf(path, base="base", flange="flange")
    assert set(chain.kinds) == {"prismatic", "revolute"}
    turning = f"joint{chain.kinds.index('revolute') + 1}"
    nominal = Nominal(joint_compliance=(1e-6,) * chain.n_joints,
                      gravity_compensator=COMPENSATOR | {"joint": turning})  # fmt: skip
    effects = ("base_frame", "joint_offset", "encoder_scale", "gear_eccentricity", "joint_drift",
               "link_geometry:link3", "thermal_expansion:all", "joint_compliance",
               f"backlash:{turning}", "gravity_compensator", "link_mass_error:link3",
               "marker_position")  # fmt: skip
    cell = full_cell(effects, observed, nominal=nominal, deflection_model=deflection_model)
    c = case(
        Model.assembled(chain, cell), random_table(chain, 3, seed, force=np.array([300, -200, 500]))
    )
    assert largest_excess(c, range(len(c.x))) <= 1
