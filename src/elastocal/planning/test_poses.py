"""The test poses: where position must be right, and how the parameters move the tool there."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Sized
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell.arm_description import EffectChoice
from elastocal.cell.plan_wishes import TargetBox, TargetPath
from elastocal.cell.work_cell import Cell
from elastocal.config import place
from elastocal.errors import InputError, InsufficientDataError, require
from elastocal.identification.prediction import NewPoses
from elastocal.identification.solve import Reduction
from elastocal.measurements import NUMBERED, Measurements, families, layout_of, rotation_column
from elastocal.model.arm import LEVEL_TOLERANCE
from elastocal.model.chain import Chain, finite_ranges, joint_index, joint_limits
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.effects.placements import MarkerPosition
from elastocal.model.inverse_kinematics import Postures, inverse_kinematics
from elastocal.model.manipulator import Model
from elastocal.planning.bodies import data_base
from elastocal.planning.candidates import told
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import Estimable, readings_at, why
from elastocal.tables import NO_UNIT, Family, Layout, read_table
from elastocal.text import listed, quoted
from elastocal.units import Array, BoolArray, IntArray

# Does what the cell asks of a plan fit the robot?  Checked once, before anything is designed.

LIMIT_SLACK = 1e-6  # rad or m: what rounding to printed digits may push over a limit


def check_cell(cell: Cell, chain: Chain) -> None:
    """Numbers of joints and joint values of [design]."""
    _check_levels(cell, chain)
    _check_motion(cell, chain)
    for k, pose in enumerate(cell.design.test_poses):
        key = place("design", "test_pose", k, "q_deg" if pose.degrees else "q_si")
        check_posture(cell, chain, key, pose.q, pose.degrees)


def check_posture(cell: Cell, chain: Chain, key: str, q: Array, degrees: bool) -> None:
    _check_count(cell, chain, key, q)
    if degrees:
        _check_revolute(cell, chain, key)
    if (beyond := beyond_limits(cell, chain, q)) is not None:
        raise InputError(
            f"{cell.path or cell.name}: key {key}: {beyond[1]}; correct the posture or the limits"
        )


def beyond_limits(cell: Cell, chain: Chain, q: Array) -> tuple[int, str] | None:
    """Which joint (0-based) of the posture q (n,) lies beyond its limits, and a sentence on it;
    None for none."""
    lower, upper = joint_limits(cell, chain)
    beyond = np.flatnonzero((q < lower - LIMIT_SLACK) | (q > upper + LIMIT_SLACK))
    if not len(beyond):
        return None
    j = int(beyond[0])
    at, low, high = (told(chain, j, value) for value in (q[j], lower[j], upper[j]))
    name = f"joint{j + 1} ({chain.joints[j].name})"
    return j, f"{name} at {at} is beyond its limits, {low} to {high}"


def _check_count(cell: Cell, chain: Chain, key: str, found: Sized, one: bool = False) -> None:
    n = chain.n_joints
    if len(found) != n and not (one and len(found) == 1):
        raise InputError(
            f"{cell.path or cell.name}: key {key} has {len(found)} numbers, but robot "
            f"'{chain.name}' has {n} joints; give {n} numbers{' or one for all' if one else ''}"
        )


def _check_revolute(cell: Cell, chain: Chain, key: str) -> None:
    sliding = [k for k, kind in enumerate(chain.kinds) if kind == "prismatic"]
    if sliding:
        other = key.replace("deg_per_s", "si").replace("_deg", "_si")
        raise InputError(
            f"{cell.path or cell.name}: key {key} gives degrees, but joint{sliding[0] + 1} "
            f"({chain.joints[sliding[0]].name}) is prismatic; use {other}, in rad and m"
        )


def _check_levels(cell: Cell, chain: Chain) -> None:
    lower, upper = joint_limits(cell, chain)
    for joint, values in cell.design.levels.items():
        i = joint_index(joint)
        split = cell.model.compliance_levels.get(joint)
        for value in values:
            require(
                lower[i] - LIMIT_SLACK <= value <= upper[i] + LIMIT_SLACK,
                f"{cell.path or cell.name}: [design.levels] has {joint} at "
                f"{told(chain, i, value)}, beyond its limits, {told(chain, i, lower[i])} to "
                f"{told(chain, i, upper[i])}; correct the level or the limits",
            )
            require(
                split is None or min(abs(value - s) for s in split) <= LEVEL_TOLERANCE,
                f"{cell.path or cell.name}: [design.levels] has {joint} at "
                f"{told(chain, i, value)}, which is none of its levels in "
                "[model.compliance_levels]; give both the same levels",
            )


def _check_motion(cell: Cell, chain: Chain) -> None:
    motion = cell.design.motion
    unit = "deg" if motion.degrees else "si"
    if motion.speed is not None:
        key = "design.motion.speed_" + ("deg_per_s" if motion.degrees else "si")
        _check_count(cell, chain, key, motion.speed, one=motion.degrees)
        if motion.degrees:
            _check_revolute(cell, chain, key)
    if motion.home is not None:
        check_posture(cell, chain, f"design.motion.home_{unit}", motion.home, motion.degrees)


# A table of test poses: a machining path in joints, or in positions of the tool's point.

TAKEN = ("q", "position", "rotation", "quaternion", "force")
WEIGHT = Family("weight", "weights", {"weight": NO_UNIT})
MOST_POSES = 10_000


def _layout(source: str, header: Sequence[str], joint_kinds: Sequence[str]) -> Layout:
    in_joints = any((m := NUMBERED.fullmatch(text)) and m[1] == "q" for text in header)
    kinds = joint_kinds if in_joints else ()
    layout = layout_of(source, header, kinds, "plan", extra=(WEIGHT,))
    columns = {n: cs for n, cs in layout.columns.items() if n in (*TAKEN, WEIGHT.name)}
    for name, family in layout.columns.items():
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
    numbers = tuple(column.header for family in columns.values() for column in family)
    return Layout(columns, (), numbers)


# Places of the data's frame reached by the arm, in postures that the work cell allows.

FEW, MANY = 16, 256  # postures per place; many where the work cell allows none of few
WRONG_UNIT = 1e5  # mm


def working_loads(cell: Cell) -> Array:
    """The forces (L, 3) N of the design's loads that are not zero, or none but zero."""
    loads = cell.design.loads
    loaded = np.zeros((0, 3)) if loads is None else loads[(loads != 0).any(axis=1)]
    return loaded if len(loaded) else np.zeros((1, 3))


def _reached(
    cell: Cell, chain: Chain, position: Array, rotation: Array | None, point: Array,
    force: Array | None, weight: Array, stated: bool, rules: Feasibility | None, seed: int,
    source: str, missed: Callable[[int, str], str],
) -> TargetPoses:  # fmt: skip
    """Test poses with the `point` (3,) of the flange at places (T, 3) m of the data's frame, the
    flange at `rotation` (T, 3, 3), None for any, under `force` (T, 3) N or, None, the cell's loads:
    each the first posture found that the rules allow; where they allow none of many, the first."""

    def postures(some: IntArray, count: int) -> Postures:
        return inverse_kinematics(
            chain, position[some], joint_limits(cell, chain),
            rotation=None if rotation is None else rotation[some], point=point,
            T_data_base=data_base(cell), near=cell.design.motion.home, postures=count, seed=seed,
        )  # fmt: skip

    loads, stuck = working_loads(cell), np.arange(len(position))
    found = postures(stuck, FEW)
    for t in found.out_of_reach[:1]:
        far = f"{how_near(found, t)} ({len(found.out_of_reach)} of {len(position)} places)"
        raise InputError(missed(int(t), far))
    q, told = found.q[:, 0].copy(), f"{len(position)} {source}"
    under = [np.broadcast_to(load, position.shape) for load in loads] if force is None else [force]
    for count in (FEW, MANY):
        if rules is None or not len(stuck):
            break
        found = found if count == FEW else postures(stuck, count)
        T, K, n = found.q.shape
        allowed = found.reached.copy()
        for load in under:
            verdict = rules.check(found.q.reshape(T * K, n), np.repeat(load[stuck], K, 0), False)
            allowed &= np.asarray(verdict.ok).reshape(T, K)
        some = allowed.any(axis=1)
        q[stuck[some]] = found.q[some, allowed[some].argmax(axis=1)]
        stuck = stuck[~some]
    if rules is not None and len(stuck):
        told += f" ({len(stuck)} of them in no posture that the work cell allows)"
    return TargetPoses.of(q, force, weight, point, stated, loads, told)


def how_near(found: Postures, t: int) -> str:
    distance, turn = found.miss[t, 0] * 1e3, np.degrees(found.turn[t, 0])
    # A place missed by this much is given in another unit than its column says.
    near = f"{distance:.4g} mm" if distance < WRONG_UNIT else f"{distance:.0f} mm, wrong unit?"
    also = f" and {turn:.3g}° from its rotation" if turn > 0.01 else ""
    return f"the arm gets no nearer than {near}{also}"


def remedy(cell: Cell) -> str:
    if cell.model.nominal.base_position is None:
        return (
            "move it, or state where the arm stands in the data's frame ([model.nominal] "
            "base_position_m, base_rpy_deg)"
        )
    return "move it, or check base_position_m and base_rpy_deg of [model.nominal], and [limits]"


# The test poses: where position must be right, under which load, at which point of the tool.

# Where the user states none: fewer, and the plan serves just these, and harms what is between them.
DEFAULT_COUNT = 100
ELSEWHERE = 200  # postures that stand for all of the joint ranges
APART = 1  # added to the seed: not the postures that are drawn as test poses
# Postures among which the default test poses are sought where a cell has rules, so many at a time.
DRAWN, LOT = 4096, 512


@dataclass(frozen=True)
class TargetPoses(NewPoses):
    """T test poses, of `point` (T, 3) m in the flange frame, `stated` (T,) by the user or else the
    default."""

    point: Array
    stated: BoolArray

    @classmethod
    def of(
        cls, q: Array, force: Array | None, weight: Array, point: Array, stated: bool, loads: Array,
        source: str,
    ) -> TargetPoses:  # fmt: skip
        """Poses q (n, joints) of one source; those without a `force` (n, 3) of their own are taken
        under each of the `loads` (L, 3), which share their weight (n,)."""
        each = 1 if force is not None else len(loads)
        n = each * len(q)
        return cls(
            np.repeat(q, each, axis=0),
            np.tile(loads, (len(q), 1)) if force is None else np.asarray(force),
            np.repeat(weight / each, each),
            source,
            np.broadcast_to(point, (n, 3)),
            np.full(n, stated),
        )

    @classmethod
    def together(cls, groups: Sequence[TargetPoses], source: str) -> TargetPoses:
        q, force, weight, point, stated = (
            np.concatenate([getattr(group, name) for group in groups])
            for name in ("q", "force", "weight", "point", "stated")
        )
        weight = weight / weight.max()  # so that no sum overflows
        return cls(q, force, weight / weight.sum(), source, point, stated)

    def with_others(self, others: TargetPoses, share: float) -> TargetPoses:
        """Both, of which `others` have `share` of the weight."""
        both = TargetPoses.together([self, others], self.source)
        weight = np.concatenate([(1 - share) * self.weight, share * others.weight])
        return replace(both, weight=weight)


def test_poses(
    cell: Cell, chain: Chain, feasibility: Feasibility | None = None, seed: int = 0
) -> TargetPoses:
    """The test poses of the cell: [[design.test_pose]], [design.test_path] and [design.test_box]
    together, or 100 poses drawn over the joint limits.  A pose without a force of its own is taken
    under each of the design's loads that is not zero, which share its weight.  Places are reached
    by the posture nearest to home, or the middle of the joint ranges, that the rules allow."""
    spec, loads = cell.design, working_loads(cell)
    point = _point_of(cell)
    groups = []
    for k, pose in enumerate(spec.test_poses):
        key = place("design", "test_pose", k, "q_deg" if pose.degrees else "q_si")
        check_posture(cell, chain, key, pose.q, pose.degrees)
        own = point if pose.point is None else pose.point
        force = None if pose.force is None else pose.force[None]
        weight, stated = np.array([pose.weight]), pose.point is not None
        groups.append(TargetPoses.of(pose.q[None], force, weight, own, stated, loads, ""))
    sources = [f"{len(groups)} of [[design.test_pose]]"] if groups else []
    if spec.test_path is not None:
        groups.append(_along_path(cell, chain, spec.test_path, point, feasibility, seed))
    if spec.test_box is not None:
        groups.append(_in_box(cell, chain, spec.test_box, point, feasibility, seed))
    if not groups:
        groups.append(_drawn(cell, chain, point, feasibility, seed))
    sources += [g.source for g in groups if g.source]
    return TargetPoses.together(groups, ", ".join(sources))


def where_used(model: Model) -> NewPoses | None:
    stated = model.cell.design.states_test_poses
    return test_poses(model.cell, model.chain) if stated else None


def everywhere(
    cell: Cell, chain: Chain, feasibility: Feasibility | None = None, seed: int = 0
) -> TargetPoses | None:
    """Postures drawn over the joint limits that the rules allow, under each of the cell's loads:
    what an arm may be used for besides the test poses.  None where none was found."""
    point = _point_of(cell)
    try:
        group = _drawn(cell, chain, point, feasibility, seed + APART, ELSEWHERE)
    except InsufficientDataError:
        return None
    return TargetPoses.together([group], "")


def _point_of(cell: Cell) -> Array:
    if cell.tool.load_point.any() or not cell.tool.markers:
        return cell.tool.load_point
    return np.asarray(np.mean(list(cell.tool.markers.values()), axis=0))


def _along_path(
    cell: Cell, chain: Chain, spec: TargetPath, point: Array, rules: Feasibility | None, seed: int
) -> TargetPoses:
    """The poses of a table: q1_deg … for all joints, or x_mm, y_mm, z_mm with rx_deg … or qw …
    where the rotation is prescribed; force_x_N … and weight may be added."""
    raw = read_table(spec.file, lambda header: _layout(str(spec.file), header, chain.kinds))
    columns, n, loads = raw.layout.columns, len(raw.row), working_loads(cell)
    require(
        n <= MOST_POSES,
        f"{raw.source}: {n} poses; a path takes at most {MOST_POSES}; thin it out: neighbouring "
        "poses say the same",
    )
    weight = np.ones((n, 1))
    if (stated_weight := raw.si(WEIGHT.name)) is not None:
        weight = stated_weight
        raw.check(WEIGHT.name, weight > 0, "a weight must be positive")
    stated = spec.point is not None
    point = point if spec.point is None else spec.point
    force = raw.si("force")
    if force is None and spec.force is not None:
        force = np.broadcast_to(spec.force, (n, 3))
    q, position, turn = raw.si("q"), raw.si("position"), rotation_column(raw)
    if q is not None:
        for i, posture in enumerate(q):
            if (beyond := beyond_limits(cell, chain, posture)) is not None:
                where = raw.where(i, columns["q"][beyond[0]].header)
                raise InputError(f"{where}: {beyond[1]}; correct the path or the limits")
        source = f"{n} of {spec.file.name}"
        return TargetPoses.of(q, force, weight[:, 0], point, stated, loads, source)
    assert position is not None  # _layout: joints or positions
    rotation = None if turn is None else Rotation.from_rotvec(turn).as_matrix()

    def missed(t: int, near: str) -> str:
        headers = ", ".join(column.header for column in columns["position"])
        return (
            f"{raw.source}, {raw.noun} {raw.row[t]}, columns {headers}: the place is out of reach, "
            f"{near}; {remedy(cell)}"
        )

    source = f"of {spec.file.name}"
    return _reached(
        cell, chain, position, rotation, point, force, weight[:, 0], stated, rules, seed, source,
        missed,
    )  # fmt: skip


def _in_box(
    cell: Cell, chain: Chain, box: TargetBox, point: Array, rules: Feasibility | None, seed: int
) -> TargetPoses:
    stated = box.point is not None
    point = point if box.point is None else box.point
    position = box.lower + (box.upper - box.lower) * _sobol(3, box.count, seed)
    each = (box.count, 3)
    force = None if box.force is None else np.broadcast_to(box.force, each)
    rotation = None if box.rotation is None else np.broadcast_to(box.rotation, (*each, 3))

    def missed(t: int, near: str) -> str:
        x, y, z = position[t]
        turned = "" if box.rotation is None else "leave out rpy_deg, "
        return (
            f"{cell.path or cell.name}: [design.test_box]: the place [{x:.3f}, {y:.3f}, {z:.3f}] m "
            f"in it is out of reach, {near}; make the box smaller, {turned}{remedy(cell)}"
        )

    weight, source = np.ones(box.count), "in [design.test_box]"
    return _reached(
        cell, chain, position, rotation, point, force, weight, stated, rules, seed, source, missed
    )


def _drawn(
    cell: Cell, chain: Chain, point: Array, rules: Feasibility | None, seed: int,
    most: int = DEFAULT_COUNT,
) -> TargetPoses:  # fmt: skip
    low, high = finite_ranges(chain, *joint_limits(cell, chain))
    count = most if rules is None else DRAWN
    q = low + (high - low) * _sobol(chain.n_joints, count, seed)
    for name, levels in cell.model.compliance_levels.items():
        # Elsewhere the model has no compliance for that joint.
        q[:, joint_index(name)] = np.resize(levels, count)
    if rules is not None:
        found = [q[:0]]
        for part in np.split(q, range(LOT, count, LOT)):
            found.append(part[rules.feasible(part, working_loads(cell))])
            if sum(map(len, found)) >= most:
                break
        q = np.concatenate(found)[:most]
        if not len(q):
            raise InsufficientDataError(
                f"{cell.path or cell.name}: the cell states no test poses, and its rules allow "
                f"none of {count} postures drawn over the joint limits; state "
                "[[design.test_pose]], or relax the rules of [workspace]"
            )
    source = f"{len(q)} drawn over the joint limits (the cell states none)"
    return TargetPoses.of(q, None, np.ones(len(q)), point, False, working_loads(cell), source)


def _sobol(dimension: int, count: int, seed: int) -> Array:
    from scipy.stats import qmc  # slow to import, seldom asked for

    sampler = qmc.Sobol(dimension, scramble=True, seed=seed)
    return np.asarray(sampler.random_base2(int(np.ceil(np.log2(count))))[:count])


# Where position must be right: A_t, how the parameters move the tool at the test poses.

# Share of a test point's motion that may lie outside what the poses show: rounding, not physics.
OUTSIDE = 1e-6


def prediction_rows(model: Model, targets: TargetPoses, x: Array, carried: bool = False) -> Array:
    """A (T, r, parameters): ∂(position at the test pose)/∂X in m per unit, at arm values x.

    The position is that of the test point under load in the data's frame.  Where the markers' own
    places are fitted and no point was stated, it is that of the M markers, each divided by √M, as
    only they can be known.  A stated point may be `carried` by the markers, as a body that they are
    fixed to, instead of the flange.
    """
    by_marker = ~targets.stated & fitted_markers(model)
    bodies = targets.stated & carried
    n, T = len(model.cell.tool.markers), len(targets.q)
    A = np.zeros((T, n if by_marker.any() else 1, 3, len(model.parameters)))
    if (which := np.flatnonzero(by_marker)).size:
        A[which] = _marker_rows(model, targets, which, x)[0] / np.sqrt(n)
    if (which := np.flatnonzero(bodies)).size:
        B, R = _marker_rows(model, targets, which, x)
        J = R[:, None] @ _carrying(model.cell, targets.point[which]) @ R[:, None].swapaxes(-1, -2)
        A[which, 0] = np.einsum("tmij,tmjp->tip", J, B)
    if (which := np.flatnonzero(~by_marker & ~bodies)).size:
        points, code = np.unique(targets.point[which], axis=0, return_inverse=True)
        names = tuple(f"test point {k + 1}" for k in range(len(points)))
        arm = _with_points(model, dict(zip(names, points, strict=True)))
        table = _table(targets, which, code.ravel(), names)
        A[which, 0] = arm.regressor(table, x).B.reshape(len(which), 3, -1)
    return A.reshape(T, -1, len(model.parameters))


def _marker_rows(
    model: Model, targets: TargetPoses, which: IntArray, x: Array
) -> tuple[Array, Array]:
    """∂(position of each marker)/∂X (T, M, 3, parameters) at some of the test poses, and how the
    flange is turned there (T, 3, 3)."""
    markers = tuple(model.cell.tool.markers)
    own = replace(model.cell.model, observe="position")
    arm = Model.assembled(model.chain, replace(model.cell, model=own))
    n, T = len(markers), len(which)
    table = _table(targets, np.repeat(which, n), np.tile(np.arange(n), T), markers)
    turned = arm.flange_poses(replace(table, rotation=np.zeros((n * T, 3))), x)[::n, :3, :3]
    return arm.regressor(table, x).B.reshape(T, n, 3, -1), turned


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
            f"{cell.path or cell.name}: point_m of the test poses is not known where the places of "
            "the markers are fitted, as fewer than three, or three in line, hold no point; leave "
            "out point_m, so that the markers themselves count, or measure a third marker"
        )
    cross = np.cross(np.eye(3)[None], (point - places.mean(axis=0))[:, None])  # [s]×
    turned = np.linalg.inv(inertia) @ np.cross(np.eye(3)[None], -r[:, None])
    return np.eye(3) / len(places) + cross[:, None] @ turned[None]


def _table(
    targets: TargetPoses, pose: IntArray, marker: IntArray, names: tuple[str, ...]
) -> Measurements:
    n, force = len(pose), targets.force[pose]
    # The arm as it is at first, its joints come from either side.
    return replace(
        readings_at(targets.q, pose, force, marker, names, "test poses"),
        position=np.zeros((n, 3)),
        time=np.zeros(n),
        approach=np.zeros((n, targets.q.shape[1])),
    )


def _with_points(model: Model, points: dict[str, Array]) -> Model:
    """The same arm with the test points as markers whose place on the flange is known."""
    cell = model.cell
    # Effects act where they do on the model as it is, without the test points.
    effects = tuple(
        EffectChoice(choice.name, where)
        for choice in cell.model.effects
        for where in (
            CATALOGUE[choice.name].places(model.chain, cell)
            if choice.where is None
            else (choice.where,)
        )
    )
    spec = replace(cell.model, effects=effects, observe="position")
    tool = replace(cell.tool, markers=cell.tool.markers | points)
    return Model.assembled(model.chain, replace(cell, model=spec, tool=tool))


def known_rows(
    model: Model, at_work: Model, targets: TargetPoses, x: Array, found: Estimable
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
                f"{cell.path or cell.name}: test pose {k + 1}: {joint} at "
                f"{told(chain, j, targets.q[k, j])} is none of its levels in "
                f"[model.compliance_levels], {listed([told(chain, j, v) for v in levels])}; "
                "elsewhere its compliance is not known: state test poses at these, or add the level"
            )
    rows = prediction_rows(at_work, targets, x)
    stated = rows[targets.stated]
    if not len(stated) or not fitted_markers(model) or unpredictable(stated, found) is None:
        return rows, ()
    fixed = (
        "point_m of the test poses is taken to be fixed to the markers as they stand in the cell: "
        "their places are fitted, and the readings cannot tell where the flange is"
    )
    return prediction_rows(at_work, targets, x, carried=True), (fixed,)


def on_kept(model: Model, A: Array, found: Estimable) -> Array:
    """A (T, r, kept) on the kept parameters, scaled by their sizes.  A test point is predictable
    where its motion by the dropped parameters is that by the kept ones they combine with,
    A_D = A_K · mixing; where it is not, no number of poses would make that position certain."""
    lost = unpredictable(A, found)
    if lost is not None:
        pose, index = lost
        raise InsufficientDataError(
            f"{model.cell.path or model.cell.name}: the position at test pose {pose + 1} depends "
            f"on {model.names[index]}; {why(model, found, index)}; or ask for parameters instead "
            'of test poses (criterion = "D")'
        )
    kept = found.reduction.kept
    return np.asarray(A[..., kept] * found.sizes[kept])


def unpredictable(A: Array, found: Estimable) -> tuple[int, int] | None:
    """A row of A (T, r, parameters) and a parameter by which no plan can predict it, if any."""
    r, sizes = found.structure, found.sizes
    off = np.abs(_unexplained(A, r, sizes)).max(axis=1)
    if off.max(initial=0.0) <= OUTSIDE * float(np.abs(A * sizes).max()):
        return None
    dropped = int(off.max(axis=0).argmax())
    return int(off[:, dropped].argmax()), int(r.dropped[dropped])


def remaining_bias(A: Array, weight: Array, found: Estimable) -> float:
    """Rms in m of what typical deviations of held parameters, which the poses show below their
    noise, move the test points by, A (T, r, parameters) with `weight` (T,)."""
    off = _unexplained(A, found.reduction, found.sizes)
    return float(np.sqrt(weight @ (off**2).sum(axis=(1, 2))))


def _unexplained(A: Array, r: Reduction, sizes: Array) -> Array:
    """(T, r, dropped): A_D − A_K · mixing, times the sizes."""
    return np.asarray((A[..., r.dropped] - A[..., r.kept] @ r.mixing) * sizes[r.dropped])
