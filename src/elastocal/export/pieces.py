"""The numbers of an exported model: joint placements, markers, springs, masses.

All of them are the expressions of the symbolic arm, evaluated; nothing is derived here a second
time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from elastocal.export.kept import Conditions, Valued
from elastocal.manipulator import rigid
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Array, Chain, LinkMass
from elastocal.manipulator.symbolic import SymbolicArm

PAYLOAD = ("load.payload_scale", *(f"load.load_point_{k}" for k in "xyz"))


@dataclass(frozen=True)
class SpringValue:
    """A spring of the arm with its compliance in rad/(N m) or m/N; the rest as in Spring."""

    name: str
    site: str
    kind: str
    axis: tuple[float, float, float]
    compliance: float


@dataclass(frozen=True)
class Pieces:
    """The arm in numbers, in SI units.

    `links`: per link the frame (4, 4) at its distal end in its joint's frame; `offsets` (n,) of
    the joints; `T_tracker_base` (4, 4); `markers`: name → T_flange_marker (4, 4); `load_point`
    (3,) in the flange frame; `load_scale`: what acts per newton declared; `masses`: as in Chain,
    empty where no weights act.
    """

    chain: Chain
    links: tuple[Array, ...]
    offsets: Array
    T_tracker_base: Array
    markers: dict[str, Array]
    load_point: Array
    load_scale: float
    springs: tuple[SpringValue, ...]
    masses: tuple[LinkMass, ...]

    def offset_motion(self, i: int) -> Array:
        """Motion (4, 4) of joint i (0-based) by its offset: what stands at encoder zero."""
        joint = self.chain.joints[i]
        return ca.DM(rigid.joint_motion(joint.kind, joint.axis, float(self.offsets[i]))).full()

    def placement(self, i: int) -> Array:
        """Joint i's frame (0-based) in the frame before it, without its offset."""
        return self.chain.joints[0].placement if i == 0 else self.links[i - 1]

    def calibrated_chain(self) -> Chain:
        """The chain whose nominal motion is the calibrated one: offsets are in its placements."""
        joints = tuple(
            replace(joint, placement=self.placement(i) @ self.offset_motion(i))
            for i, joint in enumerate(self.chain.joints)
        )
        return replace(
            self.chain, joints=joints, flange_placement=self.links[-1], masses=self.masses
        )


def evaluate_pieces(part: Valued, conditions: Conditions) -> Pieces:
    """The pieces of an exported model at its values, at the stated time and temperature."""
    model = part.model
    symbolic = SymbolicArm(model.chain, model.cell)
    arm = symbolic.arm
    given = {"time": conditions.time, "temperature": conditions.temperature}
    inputs = [np.full(s.shape[0], given.get(name) or 0.0) for name, s in arm.inputs.items()]
    expressions = [
        *arm.links,
        ca.vertcat(*arm.q),
        arm.T_tracker_base,
        *arm.markers.values(),
        *arm.marker_rotation.values(),
        ca.vertcat(ca.SX.zeros(0, 1), *[spring.law(ca.SX(1.0)) for spring in arm.springs]),
    ]
    function = ca.Function("pieces", [*arm.inputs.values(), symbolic.p], expressions)
    numbers = [value.full() for value in function.call([*inputs, part.x])]
    n = model.chain.n_joints
    links, (offsets, T_tracker_base), rest = numbers[:n], numbers[n : n + 2], numbers[n + 2 :]
    values = part.values
    scale, *shift = (values.get(name, 0.0) for name in PAYLOAD)
    return Pieces(
        chain=model.chain,
        links=tuple(links),
        offsets=offsets[:, 0],
        T_tracker_base=T_tracker_base,
        markers=_markers(arm, rest),
        load_point=model.cell.tool.load_point + np.array(shift),
        load_scale=1.0 + scale,
        springs=tuple(
            SpringValue(s.name, s.site, s.kind, s.axis, float(k))
            for s, k in zip(arm.springs, rest[-1][:, 0], strict=True)
        ),
        masses=_masses(model.chain, values, model.cell.model.link_gravity),
    )


def _markers(arm: Arm, numbers: list[Array]) -> dict[str, Array]:
    placed = {}
    for k, name in enumerate(arm.markers):
        T = np.eye(4)
        T[:3, 3], T[:3, :3] = numbers[k][:, 0], numbers[len(arm.markers) + k]
        placed[name] = T
    return placed


def _masses(chain: Chain, values: dict[str, float], link_gravity: bool) -> tuple[LinkMass, ...]:
    """Nominal masses with what `link_mass_error` found missing: mass and first moment add up."""
    errors = [name for name in values if name.endswith(".mass_error")]
    if not link_gravity and not errors:
        return ()
    bodies = []
    for i, body in enumerate(chain.masses, start=1):
        nominal = body.mass if link_gravity else 0.0
        mass = nominal + values.get(f"link{i}.mass_error", 0.0)
        moment = nominal * body.com + [values.get(f"link{i}.moment_{k}", 0.0) for k in "xyz"]
        bodies.append(LinkMass(mass, moment / mass if mass > 0 else body.com))
    return tuple(bodies)
