"""The test poses: where position must be right, and how the parameters move the tool there."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell import Cell
from elastocal.cell_tables import EffectChoice, TargetBox, TargetPath, TargetPose
from elastocal.identification.prediction import NewPoses
from elastocal.measurements import NUMBERED, Measurements, columns_of, families, rotation_column
from elastocal.messages import (
    InputError,
    InsufficientDataError,
    listed,
    quoted,
    require,
    rounded,
    wish,
)
from elastocal.model.chain import (
    LIMIT_SLACK,
    Chain,
    beyond_limits,
    finite_ranges,
    joint_index,
    joint_limits,
    told,
)
from elastocal.model.effects.base import LEVEL_TOLERANCE
from elastocal.model.effects.catalogue import choose_effects
from elastocal.model.effects.geometry import MarkerPosition
from elastocal.model.manipulator import Model
from elastocal.model.rigid import Postures, inverse_kinematics
from elastocal.planning.candidates import sobol
from elastocal.planning.collision import data_base
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import Estimable
from elastocal.tables import NO_UNIT, Columns, Family, read_table
from elastocal.units import Array, BoolArray, IntArray

# Does what the cell asks of a plan fit the robot?  Checked once, before anything is designed.


def check_cell(cell: Cell, chain: Chain) -> None:
    where, motion = cell.source, cell.design.motion
    lower, upper = joint_limits(cell, chain)
    levels = wish("levels", f"{where}: [design.levels]")
    for joint, values in cell.design.levels.items():
        i, split = joint_index(joint), cell.model.compliance_levels.get(joint)
        for value in values:
            found = f"{levels} has {joint} at {told(chain, i, value)}"
            require(
                lower[i] - LIMIT_SLACK <= value <= upper[i] + LIMIT_SLACK,
                f"{found}, beyond its limits, {told(chain, i, lower[i])} to "
                f"{told(chain, i, upper[i])}; correct the level or the limits",
            )
            require(
                split is None or min(abs(value - s) for s in split) <= LEVEL_TOLERANCE,
                f"{found}, which is none of its levels in [model.compliance_levels]; give both "
                "the same levels",
            )
    if motion.speed is not None:
        key = f"{where}: key design.motion.speed_" + ("deg_per_s" if motion.degrees else "si")
        _check_numbers(chain, key, motion.speed, motion.degrees, one=motion.degrees)
    if motion.home is not None:
        key = f"{where}: key design.motion.home_{'deg' if motion.degrees else 'si'}"
        _check_posture(cell, chain, key, motion.home, motion.degrees)


def _check_posture(cell: Cell, chain: Chain, key: str, q: Array, degrees: bool) -> None:
    _check_numbers(chain, key, q, degrees)
    if (beyond := beyond_limits(cell, chain, q[None])) is not None:
        raise InputError(f"{key}: {beyond[2]}; correct the posture or the limits")


def _check_numbers(chain: Chain, key: str, found: Sized, degrees: bool, one: bool = False) -> None:
    n, own = chain.n_joints, key.rpartition(": key ")[2]
    require(
        len(found) == n or (one and len(found) == 1),
        f"{key} has {len(found)} numbers, but robot '{chain.name}' has {n} joints; "
        f"give {n} numbers{' or one for all' if one else ''}",
    )
    for k, kind in enumerate(chain.kinds if degrees else ()):
        require(
            kind != "prismatic",
            f"{key} gives degrees, but joint{k + 1} ({chain.joints[k].name}) is prismatic; use "
            f"{own.replace('deg_per_s', 'si').replace('_deg', '_si')}, in rad and m",
        )


# A table of test poses: a machining path in joints, or in positions of the tool's point.

TAKEN = ("q", "position", "rotation", "quaternion", "force")
WEIGHT = Family("weight", "weights", {"weight": NO_UNIT})
MOST_POSES = 10_000
Spec = TargetPose | TargetPath | TargetBox | None


def _columns(source: str, header: Sequence[str], joint_kinds: Sequence[str]) -> Columns:
    in_joints = any((m := NUMBERED.fullmatch(text)) and m[1] == "q" for text in header)
    kinds = joint_kinds if in_joints else ()
    every = columns_of(source, header, kinds, "plan", extra=(WEIGHT,))
    columns = {n: cs for n, cs in every.items() if n in (*TAKEN, WEIGHT.name)}
    for name, family in every.items():
        if name not in columns and name != "configuration":
            raise InputError(
                f"{source}: column {quoted(family[0].header)} has no meaning in a path; drop it, "
                "or start its name with '#', '_' or 'note' to have it ignored"
            )
    others = [columns[name][0].header for name in TAKEN[1:4] if in_joints and name in columns]
    if others:
        raise InputError(
            f"{source}: {columns['q'][0].header} … and {others[0]} … say the same in two ways; "
            "keep the joints or the positions"
        )
    if not in_joints and "position" not in columns:
        joints = next(iter(families(joint_kinds)["q"].units), "q1")
        raise InputError(
            f"{source}: the columns {joints}_deg … or x_mm,y_mm,z_mm are missing; a path needs "
            f"the joints or the positions of its poses; found {listed(header, 12)}"
        )
    return columns


# The test poses: where position must be right, under which load, at which point of the tool.

# Where the user states none: fewer, and the plan serves just these, and harms what is between them.
DEFAULT_COUNT = 100
ELSEWHERE = 200  # postures that stand for all of the joint ranges
APART = 1  # added to the seed: not the postures that are drawn as test poses
# Postures among which the default test poses are sought where a cell has rules, so many at a time.
DRAWN, LOT = 4096, 512


@dataclass(frozen=True)
class TargetPoses(NewPoses):
    """Of `point` (T, 3) m in the flange frame, `stated` (T,) by the user or else the default."""

    point: Array
    stated: BoolArray

    @classmethod
    def together(cls, groups: Sequence[TargetPoses], source: str) -> TargetPoses:
        q, force, weight, point, stated = (
            np.concatenate([getattr(group, name) for group in groups])
            for name in ("q", "force", "weight", "point", "stated")
        )
        weight = weight / weight.max()  # so that no sum overflows
        return cls(q, force, weight / weight.sum(), source, point, stated)


def test_poses(
    cell: Cell, chain: Chain, feasibility: Feasibility | None = None, seed: int = 0
) -> TargetPoses:
    """The test poses of the cell: [[design.test_pose]], [design.test_path] and [design.test_box]
    together, or 100 poses drawn over the joint limits.  A pose without a force of its own is taken
    under each of the design's loads that is not zero, which share its weight.  Places are reached
    by the posture nearest to home, or the middle of the joint ranges, that the rules allow."""
    spec, of = cell.design, _Sources(cell, chain, feasibility, seed)
    groups = []
    for k, pose in enumerate(spec.test_poses):
        unit = "deg" if pose.degrees else "si"
        key = wish("test_poses", f"{cell.source}: key q_{unit} of [[design.test_pose]]")
        _check_posture(cell, chain, f"{key} no. {k + 1}", pose.q, pose.degrees)
        groups.append(of.poses(pose.q[None], "", pose, weight=np.array([pose.weight])))
    sources = [f"{len(groups)} of [[design.test_pose]]"] if groups else []
    groups += [] if spec.test_path is None else [of.path(spec.test_path)]
    groups += [] if spec.test_box is None else [of.box(spec.test_box)]
    groups = groups or [of.drawn(DEFAULT_COUNT)]
    return TargetPoses.together(
        groups, ", ".join([*sources, *(g.source for g in groups if g.source)])
    )


def everywhere(
    cell: Cell, chain: Chain, feasibility: Feasibility | None = None, seed: int = 0
) -> TargetPoses | None:
    """Postures drawn over the joint limits that the rules allow, under each of the cell's loads:
    what an arm may be used for besides the test poses.  None where none was found."""
    with suppress(InsufficientDataError):
        group = _Sources(cell, chain, feasibility, seed + APART).drawn(ELSEWHERE)
        return TargetPoses.together([group], "")
    return None


# Postures per place; many where the work cell allows none of few.
FEW, MANY = 16, 256
WRONG_UNIT = 1e5  # mm


@dataclass(frozen=True)
class _Sources:
    cell: Cell
    chain: Chain
    rules: Feasibility | None
    seed: int

    @property
    def loads(self) -> Array:
        """The forces (L, 3) N of the design's loads that are not zero, or none but zero."""
        loads = self.cell.design.loads
        loaded = np.zeros((0, 3)) if loads is None else loads[(loads != 0).any(axis=1)]
        return loaded if len(loaded) else np.zeros((1, 3))

    def point(self, spec: Spec = None) -> Array:
        tool = self.cell.tool
        if spec is not None and spec.point is not None:
            return spec.point
        if tool.load_point.any() or not tool.markers:
            return tool.load_point
        return np.asarray(np.mean(list(tool.markers.values()), axis=0))

    def poses(
        self, q: Array, source: str, spec: Spec = None, force: Array | None = None,
        weight: Array | None = None,
    ) -> TargetPoses:  # fmt: skip
        """Poses q (n, joints) of one source with their own `force` (n, 3), else that of the `spec`,
        else under each of the loads, which share the `weight` (n,)."""
        if force is None and spec is not None and spec.force is not None:
            force = np.broadcast_to(spec.force, (len(q), 3))
        each = len(self.loads) if force is None else 1
        n = each * len(q)
        return TargetPoses(
            np.repeat(q, each, axis=0),
            np.tile(self.loads, (len(q), 1)) if force is None else force,
            np.repeat((np.ones(len(q)) if weight is None else weight) / each, each),
            source,
            np.broadcast_to(self.point(spec), (n, 3)),
            np.full(n, spec is not None and spec.point is not None),
        )

    def path(self, spec: TargetPath) -> TargetPoses:
        """The poses of a table: q1_deg … for all joints, or x_mm, y_mm, z_mm with rx_deg … or qw …
        where the rotation is prescribed; force_x_N … and weight may be added."""
        file = str(spec.file)
        raw = read_table(spec.file, lambda header: _columns(file, header, self.chain.kinds))
        columns, n, weight = raw.columns, len(raw.row), raw.si(WEIGHT.name)
        require(
            n <= MOST_POSES,
            f"{raw.source}: {n} poses; a path takes at most {MOST_POSES}; thin it out: "
            "neighbouring poses say the same",
        )
        if weight is not None:
            raw.check(WEIGHT.name, weight > 0, "a weight must be positive")
            weight = weight[:, 0]
        force, q, position = raw.si("force"), raw.si("q"), raw.si("position")
        turn, source = rotation_column(raw), f"{n} of {spec.file.name}"
        if q is not None and (beyond := beyond_limits(self.cell, self.chain, q)) is not None:
            rows, joint, why = beyond
            where = raw.where(int(rows[0]), columns["q"][joint].header)
            raise InputError(f"{where}: {why}; correct the path or the limits")
        if q is None:
            assert position is not None  # _columns: joints or positions
            rotation = None if turn is None else Rotation.from_rotvec(turn).as_matrix()
            headers = ", ".join(column.header for column in columns["position"])
            lines = [f"{raw.noun} {number}" for number in raw.row]
            q, more = self.reached(
                position, rotation, spec, force,
                lambda t: f"{raw.source}, {lines[t]}, columns {headers}: the place", lines,
            )  # fmt: skip
            source += more
        return self.poses(q, source, spec, force, weight)

    def box(self, box: TargetBox) -> TargetPoses:
        position = box.lower + (box.upper - box.lower) * self.drawn_in(3, box.count)
        turned = box.rotation
        rotation = None if turned is None else np.broadcast_to(turned, (box.count, 3, 3))

        where = f"{self.cell.source}: [design.test_box]: the place"
        q, more = self.reached(
            position, rotation, box, None,
            lambda t: "{} [{:.3f}, {:.3f}, {:.3f}] m in it".format(where, *position[t]),
            remedy=f"make the box smaller, {'' if turned is None else 'leave out rpy_deg, '}",
        )  # fmt: skip
        return self.poses(q, f"{box.count} in [design.test_box]{more}", box)

    def reached(
        self, position: Array, rotation: Array | None, spec: TargetPath | TargetBox,
        force: Array | None, place_of: Callable[[int], str],
        lines: Sequence[str] = (), remedy: str = "",
    ) -> tuple[Array, str]:  # fmt: skip
        """Postures (T, n) with the point at places (T, 3) m of the data's frame, the flange at
        `rotation` (T, 3, 3), None for any, each the first one found that the rules allow under
        `force` (T, 3) N, else that of the spec, else all loads; where they allow none of many, the
        first, and what to say of it."""
        cell, stuck = self.cell, np.arange(len(position))
        q = np.zeros((len(position), self.chain.n_joints))
        under = [force] if force is not None else [
            np.broadcast_to(load, position.shape)
            for load in (self.loads if spec.force is None else [spec.force])
        ]  # fmt: skip
        for count in (FEW, MANY):
            found = inverse_kinematics(
                self.chain, position[stuck], joint_limits(cell, self.chain),
                rotation=None if rotation is None else rotation[stuck], point=self.point(spec),
                T_data_base=data_base(cell), near=cell.design.motion.home, postures=count,
                seed=self.seed,
            )  # fmt: skip
            if count == FEW:
                for t in found.out_of_reach[:1]:
                    raise InputError(self._far(found, int(t), place_of(int(t)), remedy))
                q = found.q[:, 0].copy()
            if self.rules is None:
                return q, ""
            T, K, n = found.q.shape
            allowed = found.reached.copy()
            for load in under:
                each = np.repeat(load[stuck], K, axis=0)
                allowed &= self.rules.check(found.q.reshape(T * K, n), each, False).ok.reshape(T, K)
            some = allowed.any(axis=1)
            q[stuck[some]] = found.q[some, allowed[some].argmax(axis=1)]
            stuck = stuck[~some]
            if not len(stuck):
                return q, ""
        which = f": {listed(lines[int(t)] for t in stuck)}" if lines else ""
        return q, f" ({len(stuck)} of them in no posture that the work cell allows{which})"

    def _far(self, found: Postures, t: int, at: str, remedy: str) -> str:
        distance, turn = found.miss[t, 0] * 1e3, np.degrees(found.turn[t, 0])
        # A place missed by this much is given in another unit than its column says.
        near = f"{rounded(distance, 4)} mm" + ", wrong unit?" * bool(distance >= WRONG_UNIT)
        also = f" and {rounded(turn)}° from its rotation" if turn > 0.01 else ""
        check = "check base_position_m and base_rpy_deg of [model.nominal], and [limits]"
        if self.cell.model.nominal.base_position is None:
            check = (
                "state where the arm stands in the data's frame ([model.nominal] base_position_m, "
                "base_rpy_deg)"
            )
        return (
            f"{at} is out of reach, the arm gets no nearer than {near}{also} "
            f"({len(found.out_of_reach)} of {len(found.q)} places); {remedy}move it, or {check}"
        )

    def drawn(self, most: int) -> TargetPoses:
        cell, chain, rules = self.cell, self.chain, self.rules
        low, high = finite_ranges(chain, *joint_limits(cell, chain))
        count = most if rules is None else DRAWN
        q = low + (high - low) * self.drawn_in(chain.n_joints, count)
        for name, levels in cell.model.compliance_levels.items():
            # Elsewhere the model has no compliance for that joint.
            q[:, joint_index(name)] = np.resize(levels, count)
        if rules is not None:
            found = [q[:0]]
            for part in np.split(q, range(LOT, count, LOT)):
                found.append(part[rules.under(part, self.loads).ok])
                if sum(map(len, found)) >= most:
                    break
            if not any(map(len, found)):
                raise InsufficientDataError(
                    f"{cell.source}: the cell states no test poses, and its rules allow no posture "
                    f"drawn over the joint limits: {rules.advice(rules.every(q, self.loads))}; or "
                    "state [[design.test_pose]]"
                )
            q = np.concatenate(found)[:most]
        return self.poses(q, f"{len(q)} drawn over the joint limits (the cell states none)")

    def drawn_in(self, dimension: int, count: int) -> Array:
        drawn = sobol(dimension, self.seed).random_base2(int(np.ceil(np.log2(count))))
        return np.asarray(drawn[:count])


# Where position must be right: A_t, how the parameters move the tool at the test poses.


def prediction_rows(model: Model, targets: TargetPoses, x: Array, carried: bool = False) -> Array:
    """A (T, r, parameters): ∂(position at the test pose)/∂X in m per unit, at arm values x.

    The position is that of the test point under load in the data's frame, as the instrument reads
    it: where it distorts, no plan could tell where the tool is besides, as its scale and the arm's
    lengths move readings in the same way.  Where the markers' own places are fitted and no point
    was stated, it is that of the M markers, each divided by √M, as only they can be known.  A
    stated point may be `carried` by the markers, as a body that they are fixed to, instead of the
    flange.
    """
    by_marker = ~targets.stated & fitted_markers(model)
    bodies = targets.stated & carried
    lone = ~by_marker & ~bodies
    own, T = len(model.cell.tool.markers), len(targets.q)
    points, code = np.unique(targets.point[lone], axis=0, return_inverse=True)
    arm = _with_points(model, points)

    def table(which: BoolArray, marker: IntArray) -> Measurements:
        pose = np.repeat(np.flatnonzero(which), len(marker) // which.sum())
        n, names = len(pose), tuple(arm.cell.tool.markers)
        # The arm as it is at first, its joints come from either side.
        return Measurements.of_poses(
            "test poses", targets.q[pose], targets.force[pose], marker=marker, marker_names=names,
            position=np.zeros((n, 3)), rotation=np.zeros((n, 3)), time=np.zeros(n),
            approach=np.zeros((n, targets.q.shape[1])),
        )  # fmt: skip

    A = np.zeros((T, own if by_marker.any() else 1, 3, len(model.parameters)))
    if lone.any():
        rows = arm.regressor(table(lone, own + code.ravel()), x).B
        A[lone, 0] = rows.reshape(lone.sum(), 3, -1)
    for which in (by_marker, bodies):
        if not which.any():
            continue
        every = table(which, np.tile(np.arange(own), which.sum()))
        B = arm.regressor(every, x).B.reshape(which.sum(), own, 3, -1)
        if which is by_marker:
            A[which] = B / np.sqrt(own)
        else:
            R = arm.flange_poses(every, x)[::own, None, :3, :3]
            J = R @ _carrying(model.cell, targets.point[which]) @ R.swapaxes(-1, -2)
            A[which, 0] = np.einsum("tmij,tmjp->tip", J, B)
    return A.reshape(T, -1, len(model.parameters))


def fitted_markers(model: Model) -> bool:
    return any(p.effect == MarkerPosition.name for p in model.parameters)


def _carrying(cell: Cell, point: Array) -> Array:
    """J (T, M, 3, 3): δp_t = Σ_m J_tm δ_m of points p (T, 3) on the body that M markers are fixed
    to, whose motion is the least-squares one of theirs: with r from the markers' mean c,

        δp = mean δ + ω × (p − c),   (Σ |r|² 1 − r rᵀ) ω = Σ r_m × δ_m

    Raises InsufficientDataError where the markers do not hold a body: fewer than three, or in line.
    """
    places = np.array(list(cell.tool.markers.values()))
    r = places - places.mean(axis=0)
    inertia = (r**2).sum() * np.eye(3) - r.T @ r
    if len(places) < 3 or np.linalg.matrix_rank(inertia, tol=1e-6 * np.trace(inertia)) < 3:
        raise InsufficientDataError(
            f"{cell.source}: point_m of the test poses is not known where the places of "
            "the markers are fitted, as fewer than three, or three in line, hold no point; leave "
            "out point_m, so that the markers themselves count, or measure a third marker"
        )
    cross = np.cross(np.eye(3)[None], (point - places.mean(axis=0))[:, None])  # [s]×
    turned = np.linalg.inv(inertia) @ np.cross(np.eye(3)[None], -r[:, None])
    return np.eye(3) / len(places) + cross[:, None] @ turned[None]


def _with_points(model: Model, points: Array) -> Model:
    """The same arm with test points (k, 3) as markers whose place on the flange is known."""
    cell = model.cell
    # Effects act where they do on the model as it is, without the test points.
    active = choose_effects(model.chain, cell)
    effects = tuple(EffectChoice(effect.name, where) for effect, where in active)
    spec = replace(cell.model, effects=effects, observe="position")
    named = {f"test point {k + 1}": point for k, point in enumerate(points)}
    tool = replace(cell.tool, markers=cell.tool.markers | named)
    return Model.assembled(model.chain, replace(cell, model=spec, tool=tool))


def known_rows(
    at_work: Model, targets: TargetPoses, x: Array, found: Estimable
) -> tuple[Array, tuple[str, ...]]:
    """The rows of `prediction_rows` of the arm `at_work`, and what to say of them: where the
    markers' places are fitted and the readings cannot tell where the flange is, points that are
    stated are taken to be fixed to the markers."""
    cell, chain = at_work.cell, at_work.chain
    for joint, levels in cell.model.compliance_levels.items():
        j = joint_index(joint)
        off = np.abs(targets.q[:, [j]] - np.array(levels)).min(axis=1) > LEVEL_TOLERANCE
        if off.any():
            k = int(off.argmax())
            raise InputError(
                f"{cell.source}: test pose {k + 1}: {joint} at "
                f"{told(chain, j, targets.q[k, j])} is none of its levels in "
                f"[model.compliance_levels], {listed([told(chain, j, v) for v in levels])}; "
                "elsewhere its compliance is not known: state test poses at these, or add the level"
            )
    rows = prediction_rows(at_work, targets, x)
    stated = rows[targets.stated]
    if not len(stated) or not fitted_markers(found.model) or not found.unpredictable(stated):
        return rows, ()
    fixed = (
        "point_m of the test poses is taken to be fixed to the markers as they stand in the cell: "
        "their places are fitted, and the readings cannot tell where the flange is"
    )
    return prediction_rows(at_work, targets, x, carried=True), (fixed,)
