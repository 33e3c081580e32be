"""What of a calibrated model a file can hold, and what leaving the rest out costs."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from elastocal.errors import InsufficientDataError, option
from elastocal.measurements import Measurements
from elastocal.model import rigid
from elastocal.model.calibrated import (
    RECORDED,
    CalibratedArm,
    Conditions,
    Valued,
    arm_with,
    random_table,
    unstated_needs,
)
from elastocal.model.chain import Chain, LinkMass
from elastocal.model.effects.base import Format
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.effects.compliances import JointCompliance
from elastocal.model.effects.placements import link_ends
from elastocal.model.manipulator import Model
from elastocal.model.symbolic import SymbolicArm
from elastocal.model.urdf import urdf_file
from elastocal.units import Array, rpy_from_rotation


def numbers(values: ArrayLike) -> str:
    """Numbers separated by blanks, each with the digits that give the same double back."""
    return " ".join(repr(float(value)) for value in np.asarray(values, dtype=float))


def placed_body(name: str, T: Array) -> dict[str, str]:
    """Attributes of an MJCF's body or site called `name` at T (4, 4) in its parent's frame."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"name": name, "pos": numbers(T[:3, 3]), "quat": numbers((w, x, y, z))}


def origin_attributes(T: Array) -> dict[str, str]:
    """xyz and rpy of an <origin> for a transform (4, 4)."""
    return {"xyz": numbers(T[:3, 3]), "rpy": numbers(rpy_from_rotation(T[:3, :3]))}


def nothing(T: Array) -> bool:
    """Whether T (4, 4) differs from the identity by rounding alone."""
    return bool(np.max(np.abs(T - np.eye(4))) < 4 * np.finfo(float).eps)


# What of the calibrated model a file can hold, as a model of its own beside the full one.
#
# A rigid format (URDF, DH table) holds geometry; MJCF also holds linear springs and weights.  The
# full model less what it cannot hold is again a `Model`, of the same effects, so the cost of the
# export is the difference of two predictions of one and the same machinery.

# What a spring in a file cannot follow, named like effects among the omissions.
LEVELS, LINEAR, NEGATIVE = "levels of a joint", "linear deflections", "negative compliance"
OPTIONS = {"time": "time_s", "temperature": "temperature_c"}  # which state what an effect needs


@dataclass(frozen=True)
class Difference:
    """Distance between two predictions over the poses, in m: of the flange and of the markers."""

    flange_rms: float
    flange_max: float
    marker_rms: float
    marker_max: float

    def to_json(self) -> dict[str, float]:
        return {f"{name}_um": value * 1e6 for name, value in vars(self).items()}


@dataclass(frozen=True)
class Omission:
    """One thing that the file cannot hold; `without` is the full model without it.

    `without` is None where its cost cannot be stated, and `note` says why.  `difference` is what
    leaving it out changes, once that is found.
    """

    effect: str
    note: str
    without: Valued | None
    difference: Difference | None = None


@dataclass(frozen=True)
class Kept:
    """`full`: the calibrated arm; `exported`: what the file holds of it; `omissions` between.

    `of_the_measurement`: effects of the instrument, which are no part of the arm; neither model
    has them.  `fitted`: whether the file's values are no longer those identified."""

    full: Valued
    exported: Valued
    conditions: Conditions
    omissions: tuple[Omission, ...]
    of_the_measurement: tuple[str, ...]
    fitted: bool = False


def keep(calibrated: CalibratedArm, elastic: bool, conditions: Conditions) -> Kept:
    """Split the calibrated model into what a rigid or an elastic format holds and the rest.

    Springs follow the load's torque at the deflected pose, whatever `[model] torque` says: a
    file has no column of measured torques.
    """
    chosen = calibrated.effects
    instrument = tuple(name for name in chosen if CATALOGUE[name].of_the_measurement)
    unstated = unstated_needs(calibrated, conditions)
    stated = [name for name, needs in unstated.items() if not needs]
    full = arm_with(calibrated, stated)
    format: Format = "elastic" if elastic else "rigid"
    kept, omissions = [], []
    for name in stated:
        # Values that no physical spring or body has stay out, with the reason.
        args = full.values, full.model.chain, full.model.cell
        reason = CATALOGUE[name].unphysical(*args) if elastic and name in full.effects else ""
        if format in CATALOGUE[name].formats and not reason:
            kept.append(name)
        else:
            without = arm_with(calibrated, set(stated) - {name})
            omissions.append(Omission(name, reason or "", without))
    for name, needs in unstated.items():
        if needs:
            missing = " and ".join(RECORDED.get(need) or option(OPTIONS[need]) for need in needs)
            omissions.append(Omission(name, f"no cost without {missing}", None))
    exported = full if len(kept) == len(stated) else arm_with(calibrated, kept)
    if elastic:
        exported, changed = _as_springs(exported)
        omissions += [Omission(e, told, _as_springs(full, e)[0]) for e, told in changed]
    return Kept(full, exported, conditions, tuple(omissions), instrument)


def _as_springs(part: Valued, only: str | None = None) -> tuple[Valued, list[tuple[str, str]]]:
    """One spring of positive stiffness per joint, and (effect, sentence) for what that changes.

    A joint split into levels gets their mean; a negative compliance becomes rigid; deflections
    are those at the deflected pose.  `only` makes the change of one of them alone.
    """
    cell, values = part.model.cell, dict(part.values)
    changed = defaultdict[str, list[str]](list)
    spec = cell.model
    if spec.compliance_levels and JointCompliance.name in part.effects and only in (None, LEVELS):
        for joint, levels in spec.compliance_levels.items():
            names = [f"{joint}.compliance_level{k + 1}" for k in range(len(levels))]
            if names[0] in values:
                values[f"{joint}.compliance"] = float(np.mean([values[name] for name in names]))
                told = f"one spring with the mean compliance of {joint}'s {len(names)} levels"
                changed[LEVELS].append(told)
        spec = replace(spec, compliance_levels={})
    if spec.deflection_model == "linear" and only in (None, LINEAR):
        spec = replace(spec, deflection_model="equilibrium")
        changed[LINEAR] = ["springs settle under the load at the deflected pose, eq. (3) not"]
    model = Model.assembled(part.model.chain, replace(cell, model=spec))
    negative = [p.name for p in model.parameters if p.lower == 0.0 and values[p.name] < 0.0]
    if negative and only in (None, NEGATIVE):
        values |= dict.fromkeys(negative, 0.0)
        changed[NEGATIVE] = [f"rigid, as no spring yields so: {', '.join(negative)}"]
    omitted = [(effect, "; ".join(sentences)) for effect, sentences in changed.items()]
    return Valued(model, np.array([values[name] for name in model.names])), omitted


# The numbers of an exported model: joint placements, markers, springs, masses.
#
# All of them are the expressions of the symbolic arm, evaluated; nothing is derived here a second
# time.

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
class ExportNumbers:
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
        return rigid.moved(joint.kind, joint.axis, float(self.offsets[i]))

    @property
    def nominal_masses(self) -> tuple[LinkMass, ...]:
        """`masses`, else those of the robot's description, where no weights act in the model."""
        return self.masses or self.chain.masses

    @property
    def yielding(self) -> list[SpringValue]:
        return [s for s in self.springs if s.compliance > 0]

    def springs_at(self, site: str) -> list[SpringValue]:
        return [s for s in self.yielding if s.site == site]

    @property
    def points(self) -> Array:
        """(1 + markers, 3) m in the flange frame: its origin and the markers."""
        return np.array([np.zeros(3), *(T[:3, 3] for T in self.markers.values())])

    def error(self, i: int) -> Array:
        """E (4, 4) of link i (0-based): calibrated = nominal distal frame · E."""
        nominal = link_ends(self.chain)[i]
        if np.array_equal(nominal, self.links[i]):
            return np.eye(4)
        return np.asarray(np.linalg.solve(nominal, self.links[i]))

    def correction(self, i: int) -> Array:
        """E_{i−1} J_i(a_i) (4, 4) of joint i (0-based)."""
        offset = self.offset_motion(i)
        return offset if i == 0 else self.error(i - 1) @ offset

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


def evaluate_pieces(part: Valued, conditions: Conditions) -> ExportNumbers:
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
    found = [value.full() for value in function.call([*inputs, part.x])]
    n, values = model.chain.n_joints, part.values
    links, (offsets, T_tracker_base), rest = found[:n], found[n : n + 2], found[n + 2 :]
    markers = {name: np.eye(4) for name in arm.markers}
    for k, T in enumerate(markers.values()):
        T[:3, 3], T[:3, :3] = rest[k][:, 0], rest[len(markers) + k]
    scale, *shift = (values.get(name, 0.0) for name in PAYLOAD)
    return ExportNumbers(
        chain=model.chain,
        links=tuple(links),
        offsets=offsets[:, 0],
        T_tracker_base=T_tracker_base,
        markers=markers,
        load_point=model.cell.tool.load_point + np.array(shift),
        load_scale=1.0 + scale,
        springs=tuple(
            SpringValue(s.name, s.site, s.kind, s.axis, float(k))
            for s, k in zip(arm.springs, rest[-1][:, 0], strict=True)
        ),
        masses=_masses(model.chain, values, model.cell.model.link_gravity),
    )


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


def link_inertias(path: Path, chain: Chain) -> tuple[Array, ...]:
    """(3, 3) kg m² per joint about the centre of mass of all that it carries, in its frame's axes.

    Joints beside the chain are held at zero, as when the chain was read.  Empty where the file
    states no inertia that pinocchio can read.
    """
    import pinocchio as pin

    file, moving = urdf_file(path), {joint.name for joint in chain.joints}
    for joint in file.root.all("joint"):
        if joint.get("name").strip() not in moving:
            file.set(joint, {"type": "fixed"})
    try:
        model = pin.buildModelFromXML(file.result().removeprefix("\ufeff"))
    except (ValueError, RuntimeError):
        return ()
    tensors = [np.array(inertia.inertia) for inertia in model.inertias[1:]]
    return tuple(tensors) if len(tensors) == chain.n_joints else ()


# What an export costs: how far the file's arm is from the calibrated one, effect by effect.


@dataclass(frozen=True)
class Cost:
    """`total` between the full model and the file's, `effects` one by one, over `poses`.

    Effects interact, so the total need not be their sum.  `unsettled`: poses without a static
    equilibrium under the load, left out.  `forces` (L, 3) N act in turn; poses are
    within the joints' `measured` ranges, else within their limits.
    """

    total: Difference
    effects: tuple[Omission, ...]
    poses: int
    unsettled: int
    forces: Array
    measured: bool

    def to_json(self) -> dict[str, Any]:
        return {
            "poses": self.poses,
            "poses_without_equilibrium": self.unsettled,
            "force_N": self.forces[0].tolist() if len(self.forces) == 1 else None,
            "forces_N": self.forces.tolist(),
            "total": self.total.to_json(),
            "effects": [
                {"effect": e.effect, "note": e.note,
                 "difference": None if e.difference is None else e.difference.to_json()}
                for e in self.effects
            ],
        }  # fmt: skip


def cost_of(kept: Kept, poses: int, seed: int) -> Cost:
    """Differences at `poses` random poses inside the joint limits, under the stated conditions.

    A joint split into compliance levels stands at one of its levels, for which alone the full
    model is identified.  Raises InsufficientDataError where no pose has an equilibrium.
    """
    table = random_table(kept.full.model, kept.conditions, poses, seed)
    # No omission touches the tool, so one set of markers serves every model.
    markers = evaluate_pieces(kept.exported, kept.conditions).points
    full = points_of(kept.full, table, markers)
    exported = points_of(kept.exported, table, markers)
    settled = np.isfinite(full).all(axis=(1, 2)) & np.isfinite(exported).all(axis=(1, 2))
    if not settled.any():
        raise InsufficientDataError(
            f"none of {poses} random poses has a static equilibrium under the load "
            f"{table.force[0].tolist()} N; check {option('load')} and the "
            "compliances of the result"
        )

    def apart(other: Array) -> Difference:
        distance = np.linalg.norm(full[settled] - other[settled], axis=2)
        sizes = ((np.sqrt(np.mean(d**2)), d.max()) for d in (distance[:, :1], distance[:, 1:]))
        return Difference(*(float(v) for both in sizes for v in both))

    effects = [
        o
        if o.without is None
        else replace(o, difference=apart(points_of(o.without, table, markers)))
        for o in kept.omissions
    ]
    effects.sort(key=lambda e: -np.inf if e.difference is None else -e.difference.marker_rms)
    return Cost(
        total=apart(exported),
        effects=tuple(effects),
        poses=poses,
        unsettled=int((~settled).sum()),
        forces=np.unique(table.force, axis=0),
        measured=kept.conditions.visits is not None,
    )


def points_of(part: Valued, table: Measurements, points: Array) -> Array:
    """Points (k, 3) of the flange frame in the tracker frame (poses, k, 3); NaN: no equilibrium."""
    T = part.model.flange_poses(table, part.x)
    return np.asarray(T[:, None, :3, :3] @ points[..., None])[..., 0] + T[:, None, :3, 3]
