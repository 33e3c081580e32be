"""What of a calibrated model a file can hold, what leaving the rest out costs, and the best that
the file can do instead.

Rigid formats (URDF, DH table) hold geometry; MJCF also holds linear springs and weights.  The full
model less what a file cannot hold is again a `Model`, so a cost is the difference of two
predictions of one and the same machinery.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import lsq_linear

from elastocal.cell_tables import EffectChoice, Tool
from elastocal.files import read_text
from elastocal.measurements import NEVER_YET, Measurements
from elastocal.messages import InputError, InsufficientDataError, option, require
from elastocal.model import calibrated, rigid
from elastocal.model.calibrated import CalibratedArm, Conditions, Valued
from elastocal.model.chain import Chain, LinkMass, finite_ranges, joint_index, joint_limits
from elastocal.model.effects.base import Format, Spring, row_inputs
from elastocal.model.effects.catalogue import CATALOGUE, effect_of
from elastocal.model.effects.geometry import JointOffset, Jump, LinkGeometry
from elastocal.model.effects.statics import JointCompliance
from elastocal.model.evaluate import BatchFunction
from elastocal.model.manipulator import Model
from elastocal.tables import csv_text
from elastocal.units import Array, microns

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
    """One thing that the file cannot hold; `without` is the full model without it, None where its
    cost cannot be stated, and `note` says why; `difference` is what leaving it out changes, once
    that is found."""

    effect: str
    note: str
    without: Valued | None
    difference: Difference | None = None


@dataclass(frozen=True)
class Kept:
    """`full`: the calibrated arm; `exported`: what the file holds of it; `omissions` between.
    `of_the_measurement`: effects of the instrument, which neither has."""

    full: Valued
    exported: Valued
    conditions: Conditions
    omissions: tuple[Omission, ...]
    of_the_measurement: tuple[str, ...]


def keep(arm: CalibratedArm, elastic: bool, conditions: Conditions) -> Kept:
    """Springs follow the load's torque at the deflected pose, whatever `[model] torque` says: a
    file has no column of measured torques."""
    instrument = tuple(name for name in arm.effects if CATALOGUE[name].of_the_measurement)
    unstated = calibrated.unstated_needs(arm, conditions)
    if arm.model.cell.model.clock == "rows":  # what changed between two lines has changed
        unstated |= {name: [] for name in unstated if isinstance(CATALOGUE[name], Jump)}
    stated = {name for name, needs in unstated.items() if not needs}
    full, omissions = calibrated.arm_with(arm, stated), list[Omission]()
    format: Format = "elastic" if elastic else "rigid"
    said = calibrated.RECORDED | {need: option(name) for need, name in OPTIONS.items()}
    for name, needs in unstated.items():
        if needs:
            missing = " and ".join(said[need] for need in needs)
            omissions.append(Omission(name, f"no cost without {missing}", None))
            continue
        # Values that no physical spring or body has stay out, with the reason.
        args = full.values, full.model.chain, full.model.cell
        reason = CATALOGUE[name].unphysical(*args) if elastic else ""
        if reason or format not in CATALOGUE[name].formats:
            omissions.append(Omission(name, reason, calibrated.arm_with(arm, stated - {name})))
    lost = stated & {omission.effect for omission in omissions}
    exported = calibrated.arm_with(arm, stated - lost) if lost else full
    if elastic:
        exported, changed = _as_springs(exported)
        omissions += [Omission(e, told, _as_springs(full, e)[0]) for e, told in changed]
    return Kept(full, exported, conditions, tuple(omissions), instrument)


def _as_springs(part: Valued, only: str | None = None) -> tuple[Valued, list[tuple[str, str]]]:
    """One spring of positive stiffness per joint, and (effect, sentence) for what that changes.  A
    joint split into levels gets their mean; a negative compliance becomes rigid; deflections are
    those at the deflected pose.  `only` makes the change of one of them alone."""
    cell, values = part.model.cell, dict(part.values)
    changed, spec = list[tuple[str, str]](), cell.model
    if spec.compliance_levels and JointCompliance.name in part.effects and only in (None, LEVELS):
        told = []
        for joint, levels in spec.compliance_levels.items():
            names = [f"{joint}.compliance_level{k + 1}" for k in range(len(levels))]
            if names[0] in values:
                values[f"{joint}.compliance"] = float(np.mean([values[name] for name in names]))
                told += [f"one spring with the mean compliance of {joint}'s {len(names)} levels"]
        changed += [(LEVELS, "; ".join(told))] if told else []
        spec = replace(spec, compliance_levels={})
    if spec.deflection_model == "linear" and only in (None, LINEAR):
        spec = replace(spec, deflection_model="equilibrium")
        changed += [(LINEAR, "springs settle under the load at the deflected pose, eq. (3) not")]
    model = Model.assembled(part.model.chain, replace(cell, model=spec))
    negative = [p.name for p in model.parameters if p.lower == 0.0 and values[p.name] < 0.0]
    if negative and only in (None, NEGATIVE):
        values |= dict.fromkeys(negative, 0.0)
        changed += [(NEGATIVE, f"rigid, as no spring yields so: {', '.join(negative)}")]
    return Valued(model, np.array([values[name] for name in model.names])), changed


PAYLOAD = ("load.payload_scale", *(f"load.load_point_{k}" for k in "xyz"))


@dataclass(frozen=True)
class ExportNumbers:
    """The expressions of the symbolic arm, evaluated, in SI units.

    `links`: per link the frame (4, 4) at its distal end in its joint's frame; `offsets` (n,) of the
    joints; `T_tracker_base` (4, 4); `markers`: name → T_flange_marker (4, 4); `load_point` (3,) in
    the flange frame; `load_scale`: what acts per newton declared; `springs`: those that yield, with
    their compliances in rad/(N m) or m/N; `masses`: as in Chain, empty where no weights act;
    `compensator`: values of `gravity_compensator` by name."""

    chain: Chain
    links: tuple[Array, ...]
    offsets: Array
    T_tracker_base: Array
    markers: dict[str, Array]
    load_point: Array
    load_scale: float
    springs: dict[Spring, float]
    masses: tuple[LinkMass, ...]
    compensator: dict[str, float]

    def offset_motion(self, i: int) -> Array:
        """Motion (4, 4) of joint i (0-based) by its offset: what stands at encoder zero."""
        joint = self.chain.joints[i]
        return rigid.moved(joint.kind, joint.axis, float(self.offsets[i]))

    def springs_at(self, site: str) -> dict[Spring, float]:
        return {s: k for s, k in self.springs.items() if s.site == site}

    @property
    def points(self) -> Array:
        """(1 + markers, 3) m in the flange frame: its origin and the markers."""
        return np.array([np.zeros(3), *(T[:3, 3] for T in self.markers.values())])

    def error(self, i: int) -> Array:
        """E (4, 4) of link i (0-based): calibrated = nominal distal frame · E."""
        nominal, own = self.chain.link_ends[i], self.links[i]
        same = np.array_equal(nominal, own)
        return np.eye(4) if same else np.asarray(np.linalg.solve(nominal, own))

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
    model, symbolic = part.model, part.model.symbolic
    arm = symbolic.arm
    given = {"time": conditions.time, "temperature": conditions.temperature}
    given["moment"] = NEVER_YET if model.cell.model.clock == "rows" else conditions.time
    inputs = [np.full(s.shape[0], given.get(name) or 0.0) for name, s in arm.inputs.items()]
    expressions = [
        ca.vertcat(*arm.q),
        arm.T_tracker_base,
        ca.vertcat(ca.SX.zeros(0, 1), *[spring.law(ca.SX(1.0)) for spring in arm.springs]),
        *arm.links,
        *(rigid.transform(arm.marker_rotation[name], at) for name, at in arm.markers.items()),
    ]
    function = ca.Function("pieces", [*arm.inputs.values(), symbolic.p], expressions)
    found = (value.full() for value in function.call([*inputs, part.x]))
    offsets, T_tracker_base, compliance, *placed = found
    n, values = model.chain.n_joints, part.values
    scale, *shift = (values.get(name, 0.0) for name in PAYLOAD)

    return ExportNumbers(
        chain=model.chain,
        links=tuple(placed[:n]),
        offsets=offsets[:, 0],
        T_tracker_base=T_tracker_base,
        markers=dict(zip(arm.markers, placed[n:], strict=True)),
        load_point=model.cell.tool.load_point + np.array(shift),
        load_scale=1.0 + scale,
        springs={
            s: k for s, k in zip(arm.springs, compliance[:, 0].tolist(), strict=True) if k > 0
        },
        masses=_masses(model.chain, values, model.cell.model.link_gravity),
        compensator={name: v for name, v in values.items() if ".compensator_" in name},
    )


def _masses(chain: Chain, values: dict[str, float], link_gravity: bool) -> tuple[LinkMass, ...]:
    """With what `link_mass_error` found missing: mass and first moment add up."""
    if not link_gravity and not any(name.endswith(".mass_error") for name in values):
        return ()
    bodies = []
    for i, body in enumerate(chain.masses, start=1):
        nominal = body.mass if link_gravity else 0.0
        mass = nominal + values.get(f"link{i}.mass_error", 0.0)
        moment = nominal * body.com + [values.get(f"link{i}.moment_{k}", 0.0) for k in "xyz"]
        bodies.append(LinkMass(mass, moment / mass if mass > 0 else body.com))
    return tuple(bodies)


@dataclass(frozen=True)
class Cost:
    """`total` between the full model and the file's, `effects` one by one, over `poses`.  Effects
    interact, so the total need not be their sum.  `unsettled`: poses without a static equilibrium
    under the load, left out.  `forces` (L, 3) N act in turn; poses are within the joints'
    `measured` ranges, else within their limits."""

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
            "force_N": self.forces[0] if len(self.forces) == 1 else None,
            "forces_N": self.forces,
            "total": self.total,
            "effects": [
                {"effect": e.effect, "note": e.note, "difference": e.difference}
                for e in self.effects
            ],
        }


def cost_of(kept: Kept, poses: int, seed: int) -> Cost:
    """A joint split into compliance levels stands at one of its levels, for which alone the full
    model is identified.  Raises InsufficientDataError where no pose has an equilibrium."""
    table = calibrated.random_table(kept.full.model, kept.conditions, poses, seed)
    # No omission touches the tool, so one set of markers serves every model.
    markers = evaluate_pieces(kept.exported, kept.conditions).points
    full = points_of(kept.full, table, markers)
    exported = points_of(kept.exported, table, markers)
    settled = np.isfinite(full).all(axis=(1, 2)) & np.isfinite(exported).all(axis=(1, 2))
    if not settled.any():
        told = f"none of {poses} random poses has a static equilibrium under the load"
        remedy = f"check {option('load')} and the compliances of the result"
        raise InsufficientDataError(f"{told} {table.force[0].tolist()} N; {remedy}")

    def apart(other: Array) -> Difference:
        distance = np.linalg.norm(full[settled] - other[settled], axis=2)
        sizes = ((np.sqrt(np.mean(d**2)), d.max()) for d in (distance[:, :1], distance[:, 1:]))
        return Difference(*(float(v) for both in sizes for v in both))

    effects = [
        replace(o, difference=apart(points_of(o.without, table, markers))) if o.without else o
        for o in kept.omissions
    ]
    effects.sort(key=lambda e: -np.inf if e.difference is None else -e.difference.marker_rms)
    forces, measured = np.unique(table.force, axis=0), kept.conditions.visits is not None
    return Cost(apart(exported), tuple(effects), poses, int((~settled).sum()), forces, measured)


def points_of(part: Valued, table: Measurements, points: Array) -> Array:
    """Points (k, 3) of the flange frame in the tracker frame (poses, k, 3); NaN: no equilibrium."""
    T = part.model.flange_poses(table, part.x)
    return np.asarray(T[:, None, :3, :3] @ points[..., None])[..., 0] + T[:, None, :3, 3]


# What a file holds, fitted to all that the arm does where it was measured.
#
# A calibration estimates geometry and springs beside the effects that a format lacks, so that
# without these they are no longer the best.  With p the positions of flange origin and markers at
# the visits measured and at more poses within their ranges, y base, geometry and springs of the
# file, and c the coefficients of a joint correction f (`JointCorrection`) where one is asked for,
#
#     min over y, c of  Σ |p_file(y, f(q; c)) − p_arm(q)|²/σ² + Σ ((y − x)/size)² + Σ (c/size)²
#
# x the values identified and σ the rms that is left: what the positions do not show stays as it is.

HEADER = ("joint", "follows", "position", "delta")
JOINT, SIDE = "joint", "approach"
MOST_BYTES = 50_000_000
SEEN = 1e-7  # rad or m: a curve that stays below moves a tool by 0.1 µm in a metre

# Joint (0-based), what it follows, positions (k,) of that and deltas (k,) of the joint.
Curve = tuple[int, str, Array, Array]


@dataclass(frozen=True)
class JointCorrection:
    """q_effective,j = q_j + Σ_i g_ji(q_i) + Σ_i s_ji a_i, a_i = ±1 the direction of joint i's last
    motion: where an exported arm is to be commanded so that it stands where the real one does when
    commanded to q.  Curves are linear between their rows and constant beyond.

    `curves`: joint (0-based) and what it follows, "joint2" in rad or m, or "approach2", -1 or 1 →
    positions (k,) of that, and deltas (k,) in rad or m that the joint stands beyond its command.

    Examples:
        >>> from elastocal.export.exportable import read_joint_correction
        >>> effective = read_joint_correction("joints.csv")
        >>> effective([0.4, -1.0, 1.0, 0.0, 0.5, 0.0]).round(3)
        array([ 0.4, -1. ,  1. ,  0. ,  0.5,  0. ])
    """

    curves: Mapping[tuple[int, str], tuple[Array, Array]] = field(default_factory=dict)

    def __call__(self, q: ArrayLike, approach: ArrayLike | None = None) -> NDArray:
        """Joints to command (joints,) or (n, joints); without `approach`, like q, no curve that
        follows it counts."""
        given = np.asarray(q, dtype=float)
        sides = np.zeros_like(given) if approach is None else np.asarray(approach, dtype=float)
        found = given.copy()
        for (joint, follows), curve in self.curves.items():
            at = (sides if follows.startswith(SIDE) else given)[..., joint_index(follows)]
            found[..., joint] += np.interp(at, *curve)
        return found

    def plus(self, more: Iterable[Curve]) -> JointCorrection:
        """With these curves added, without those too small to be seen."""
        alike = {key: [curve] for key, curve in self.curves.items()}
        for joint, follows, position, delta in more:
            alike.setdefault((joint, follows), []).append((position, delta))
        found = {}
        for key, parts in sorted(alike.items()):
            x = np.unique(np.concatenate([position for position, _ in parts]))
            total = sum((np.interp(x, *part) for part in parts), np.zeros(len(x)))
            if np.abs(total).max() > SEEN:
                found[key] = x, total
        return JointCorrection(found)

    def csv(self, comments: Sequence[str] = ()) -> str:
        """The table as text; positions and deltas in rad, of prismatic joints in m."""
        rows = [
            (f"{JOINT}{joint + 1}", follows, f"{position:.6g}", f"{delta + 0.0:.4e}")
            for (joint, follows), curve in self.curves.items()
            for position, delta in zip(*curve, strict=True)
        ]
        return csv_text(HEADER, rows, comments)


def read_joint_correction(path: str | Path) -> JointCorrection:
    """The correction that `export --joint-correction` wrote."""
    text = read_text(path, "joint correction", MOST_BYTES)
    lines = [line for line in text.splitlines() if line[:1] != "#"]
    told = f"its columns are not {', '.join(HEADER)}; give the file that export wrote"
    require(lines and lines[0] == ",".join(HEADER), f"{path}: {told}")
    rows: dict[tuple[int, str], list[tuple[float, float]]] = {}
    for number, line in enumerate(lines[1:], start=2):
        try:
            name, follows, position, delta = line.split(",")
            _, key = joint_index(follows), (joint_index(name), follows)
            rows.setdefault(key, []).append((float(position), float(delta)))
        except ValueError:
            told = "is no joint, what it follows and two numbers; export it anew"
            raise InputError(f"{path}, row {number}: '{line}' {told}") from None
    return JointCorrection({key: tuple(np.array(pairs).T) for key, pairs in rows.items()})


GEOMETRY = (JointOffset.name, LinkGeometry.name)  # which every format holds
STEPS = 4  # errors of millimetres are nearly linear
SMALLEST = 1e-9  # m
# Poses besides the visits, where the arm is as well known and the file has as much freedom: of few
# visits alone the fit would follow each.  The curves of a correction have several hundred
# coefficients.
MORE, MORE_OF_CURVES = 300, 700
MOVED = 0.01  # rad or m: a joint that was held still has no curve
KNOTS = 13  # of what goes with another joint's angle, over its range measured
FINE = np.radians(0.5)  # steps of what the gears of a joint do: 6 to a wave of 120 per turn
SLOPPY = 3e-4  # rad (an arc minute) or m: typical size of a joint's correction


@dataclass(frozen=True)
class Refit:
    """Distance in m, rms over the markers, from the calibrated arm: of the file as identified
    (`before`), of the file that was written (`after`), of the nominal arm with base and tool
    placed, of the file with its joint `correction` (None where there is none); at `poses` random
    poses within the ranges of the `visits` measured, under their loads."""

    before: float
    after: float
    nominal: float
    correction: float | None
    poses: int
    visits: int

    @property
    def taken(self) -> bool:
        """Whether the file has what was fitted, as it must beside a correction that was fitted with
        it; else nothing is better than what was identified."""
        return self.correction is not None or self.after < self.before

    def to_json(self) -> dict[str, Any]:
        names = ("before", "after", "nominal", "with_correction")
        sizes = zip(names, (self.before, self.after, self.nominal, self.correction), strict=True)
        told = {f"marker_rms_{name}_um": microns(size) for name, size in sizes}
        return {"taken": self.taken, **told, "poses": self.poses, "visits": self.visits}


def refitted(
    kept: Kept, poses: int, seed: int, correct: bool = False
) -> tuple[Kept, Refit | None, JointCorrection]:
    """`kept` with what the file holds fitted at the visits of its conditions, the errors, and with
    `correct` what joints are to be commanded besides; `kept` as it is, and no errors, where no
    visits are known, or where the file holds all of the arm, or where no geometry was calibrated
    and no correction is asked for."""
    conditions, part = kept.conditions, kept.exported
    own, visits = part.model.cell.model.effects, conditions.visits
    lacks = any(omission.without is not None for omission in kept.omissions)
    geometry = bool({choice.name for choice in own} & set(GEOMETRY))
    if visits is None or not lacks or not (geometry or correct):
        return kept, None, JointCorrection()
    rng, model = np.random.default_rng(seed), kept.full.model
    check = calibrated.random_table(model, conditions, poses, seed)
    more = calibrated.random_table(model, conditions, MORE_OF_CURVES if correct else MORE, seed + 1)
    q, force = np.vstack([visits.q, more.q]), np.vstack([visits.force, more.force])
    table = calibrated.table_at(model, conditions, q, force, rng)
    others = [choice for choice in own if choice.name not in GEOMETRY]
    whole = _with(part, [*others, *map(EffectChoice, GEOMETRY)])
    start = _gears(kept) if correct else JointCorrection()
    best, curves = _fitted(kept, table, whole, start, geometry, correct)
    placed = _with(part, [choice for choice in own if effect_of(choice.name).registered])
    nominal, _ = _fitted(kept, table, placed, JointCorrection(), False, False, tool=True)
    before, alone, worst = (_rms(kept, each, check, check) for each in (part, best, nominal))
    corrected = _rms(kept, best, check, _commanded(check, curves)) if correct else None
    after = alone if correct else min(before, alone)
    found = Refit(before, after, worst, corrected, poses, len(visits.q))
    return (replace(kept, exported=best) if found.taken else kept), found, curves


def _with(part: Valued, effects: Iterable[EffectChoice], tool: Tool | None = None) -> Valued:
    cell, values, chosen = part.model.cell, part.values, tuple(effects)
    spec = replace(cell.model, effects=chosen)
    if not any(effect_of(choice.name).elastic for choice in chosen):
        spec = replace(spec, compliance_levels={})
    model = Model.assembled(part.model.chain, replace(cell, model=spec, tool=tool or cell.tool))
    return Valued(model, np.array([values.get(p.name, p.nominal) for p in model.parameters]))


def _commanded(table: Measurements, correction: JointCorrection) -> Measurements:
    return replace(table, q=correction(table.q, table.approach))


def _rms(kept: Kept, part: Valued, table: Measurements, commanded: Measurements) -> float:
    own, its = (evaluate_pieces(a, kept.conditions).points[1:] for a in (kept.exported, part))
    off = points_of(part, commanded, its) - points_of(kept.full, table, own)
    apart = np.linalg.norm(off, axis=2)
    return float(np.sqrt(np.mean(apart[np.isfinite(apart).all(axis=1)] ** 2)))


def _gears(kept: Kept) -> JointCorrection:
    """What the transmissions that the file lacks add to each joint, against each joint's angle, the
    others in the middle of what was measured: the whole of it but for what goes with a load."""
    full, conditions = kept.full, kept.conditions
    held = {choice.name for choice in kept.exported.model.cell.model.effects}
    lost = (c for c in full.model.cell.model.effects if c.name not in held)
    part = _with(full, (c for c in lost if effect_of(c.name).stage == "transmission"))
    chain, symbolic = part.model.chain, part.model.symbolic
    arm = symbolic.arm
    motion = ca.vertcat(*arm.q) - arm.q_commanded
    function = BatchFunction([*arm.inputs.values(), symbolic.p], [motion])
    assert conditions.visits is not None
    middle = np.median(conditions.visits.q, axis=0)
    curves = []
    ranges = zip(*finite_ranges(chain, *joint_limits(part.model.cell, chain)), strict=True)
    for i, (low, high) in enumerate(ranges):
        x = np.linspace(low, high, int(np.ceil((high - low) / FINE)) + 1)
        q = np.tile(middle, (len(x) + 1, 1))
        q[1:, i] = x
        rng = np.random.default_rng(0)
        table = calibrated.table_at(part.model, conditions, q, np.zeros(3), rng)
        still = np.zeros(q.shape)  # of no direction, though the joints have moved before
        table = replace(table, approach=still, direction=still + 1e-12, move=still)
        moved = np.broadcast_to(function(*row_inputs(arm, table), part.x)[0][..., 0], q.shape)
        own = moved[1:] - moved[0] * (np.arange(len(middle)) != i)
        curves += [(j, f"{JOINT}{i + 1}", x, own[:, j]) for j in range(len(middle))]
    return JointCorrection().plus(curves)


def _fitted(
    kept: Kept, table: Measurements, part: Valued, start: JointCorrection, geometry: bool,
    correct: bool, tool: bool = False,
) -> tuple[Valued, JointCorrection]:  # fmt: skip
    """`part` and its joint correction, fitted to where `kept.full` has points of its tool at the
    poses of a table: base and springs, with `geometry` that, with `tool` the markers, with
    `correct` more than `start` of the correction.  The flange's origin counts as a marker where the
    tool is not fitted."""
    pieces = evaluate_pieces(part, kept.conditions)
    places = {name: T[:3, 3] for name, T in pieces.markers.items()}
    free = part
    if not tool:  # it is the same in both: its points are fixed in the flange frame
        places = {"flange": np.zeros(3)} | places
        own = [c for c in part.model.cell.model.effects if effect_of(c.name).stage != "tool"]
        free = _with(part, own, Tool(part.model.cell.tool.load_point, places))
    target = points_of(kept.full, table, np.array(list(places.values())))
    model, x, names = free.model, free.x.copy(), tuple(free.model.cell.tool.markers)
    settled = np.isfinite(target).all(axis=(1, 2))
    settled &= np.isfinite(model.flange_poses(_commanded(table, start), x)).all(axis=(1, 2))
    poses = np.flatnonzero(settled)
    rows = table.take(np.repeat(poses, len(names)))
    marker = np.tile(np.arange(len(names)), len(poses))
    rows = replace(rows, marker=marker, marker_names=names, position=np.zeros((len(marker), 3)))
    effects = [p.effect for p in model.parameters]
    yields = [effect_of(e).registered or effect_of(e).elastic for e in effects]
    fit = [k for k, e in enumerate(effects) if (geometry if e in GEOMETRY else yields[k])]
    turns = [k for k, e in enumerate(effects) if e == JointOffset.name and correct]
    assert kept.conditions.visits is not None
    sided = not {SIDE, "direction", "move"}.isdisjoint(kept.full.model.symbolic.arm.inputs)
    basis = _basis(kept.conditions.visits.q, sided) if correct else []
    bent = [JointCorrection({(j, of): (at, by)})(rows.q, rows.approach)[:, j] - rows.q[:, j]
            for j, of, at, by in basis]  # fmt: skip
    least = np.array([*(model.parameters[k].lower for k in fit), *[-np.inf] * len(basis)])
    u = np.concatenate([x[fit], np.zeros(len(basis))])
    first, sizes, correction = u.copy(), np.zeros(0), start
    for _ in range(STEPS):
        regression = model.regressor(_commanded(rows, correction), x)
        B, r = regression.B[:, fit], target[settled].ravel() - regression.prediction
        if not sizes.size:
            sizes = np.append(model.sizes(regression.B)[fit], np.full(len(basis), SLOPPY))
        if basis:
            turned = regression.B[:, turns][:, [j for j, *_ in basis]]
            B = np.hstack([B, turned * np.repeat(np.transpose(bent), 3, axis=0)])
        sigma = max(float(np.sqrt(np.mean(r**2))), SMALLEST)
        # The step d that minimises |B d − r|²/σ² + Σ ((d + u − first) / size)², with u + d no less
        # than `least`: a spring that would yield the wrong way is rigid.
        A = np.vstack([B / sigma * sizes, np.eye(len(sizes))])
        b = np.concatenate([r / sigma, (first - u) / sizes])
        step = lsq_linear(A, b, ((least - u) / sizes, np.inf), method="bvls")
        # At its bound to the last bit.
        u = u + np.where(step.active_mask < 0, least - u, step.x * sizes)
        x[fit] = u[: len(fit)]
        sized = zip(basis, u[len(fit) :], strict=True)
        correction = start.plus((j, of, at, c * by) for (j, of, at, by), c in sized)
    values = part.values | dict(zip(model.names, x, strict=True))
    return replace(part, x=np.array([values[n] for n in part.model.names])), correction


def _basis(measured: Array, sided: bool) -> list[Curve]:
    """Curves of every joint against every joint's angle, linear between KNOTS places, and where the
    arm is `sided` with the side that it came from, each with the coefficient one."""
    places = np.linspace(measured.min(axis=0), measured.max(axis=0), KNOTS)
    moving = np.flatnonzero(np.ptp(measured, axis=0) > MOVED)
    joints, ends = range(measured.shape[1]), np.array([-1.0, 1.0])
    bent = [(j, f"{JOINT}{i + 1}", places[:, i], hat)
            for j in joints for i in moving for hat in np.eye(KNOTS)]  # fmt: skip
    return [*bent, *((j, f"{SIDE}{j + 1}", ends, ends) for j in joints if sided)]
