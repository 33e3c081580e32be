"""The test poses: where position must be right, under which load, at which point of the tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from elastocal.cell import Cell, TargetBox, TargetPath
from elastocal.config import place
from elastocal.design.checks import beyond_limits, check_posture
from elastocal.design.target_path import PathTable, read_path
from elastocal.design.target_reach import (
    Places,
    Rules,
    how_near,
    preferred,
    reach,
    remedy,
    working_loads,
)
from elastocal.errors import InputError, InsufficientDataError
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.limits import finite_ranges, joint_index, joint_limits

Array = NDArray[np.float64]

DEFAULT_COUNT = 20
DRAWN = 4096  # postures among which the default test poses are sought, where a cell has rules


@dataclass(frozen=True)
class TargetPoses:
    """T test poses: `q` (T, n) rad or m, `force` (T, 3) N in the data's frame, `weight` (T,) of
    sum 1, `point` (T, 3) m in the flange frame, `stated` (T,) by the user or else the default;
    `source` says where they come from."""

    q: Array
    force: Array
    weight: Array
    point: Array
    stated: NDArray[np.bool_]
    source: str


@dataclass(frozen=True)
class _Group:
    """Poses of one source: q (N, n), force (N, 3) or None for the cell's loads, weight (N,)."""

    q: Array
    force: Array | None
    weight: Array
    point: Array
    told: str
    stated: bool


def test_poses(
    cell: Cell, chain: Chain, feasibility: Rules | None = None, seed: int = 0
) -> TargetPoses:
    """The test poses of the cell: [[design.test_pose]], [design.test_path], [design.test_box].

    Several sources add up.  A pose without a force of its own is taken under each of the
    design's loads that is not zero, which share its weight.  Places are reached by the posture
    nearest to the home posture, or the middle of the joint ranges; with `feasibility` by the
    first that its rules allow.  Without any source 20 poses are drawn over the joint limits.

    Raises InputError where a pose lies beyond the joint limits or out of reach, a table is wrong,
    and InsufficientDataError where the cell allows none of the drawn poses.
    """
    spec, groups = cell.design, []
    point = _default_point(cell)
    for k, pose in enumerate(spec.test_poses):
        key = place("design", "test_pose", k, "q_deg" if pose.degrees else "q_si")
        check_posture(cell, chain, key, pose.q, pose.degrees)
        own = point if pose.point is None else pose.point
        force = None if pose.force is None else pose.force[None]
        groups.append(
            _Group(pose.q[None], force, np.array([pose.weight]), own, "", pose.point is not None)
        )
    told = [f"{len(groups)} of [[design.test_pose]]"] if groups else []
    if spec.test_path is not None:
        groups.append(_along_path(cell, chain, spec.test_path, point, feasibility, seed))
    if spec.test_box is not None:
        groups.append(_in_box(cell, chain, spec.test_box, point, feasibility, seed))
    if not groups:
        groups.append(_drawn(cell, chain, point, feasibility, seed))
    return _together(groups, working_loads(cell), [*told, *(g.told for g in groups if g.told)])


def _default_point(cell: Cell) -> Array:
    """The load point where the cell states one, else the mean over the markers."""
    if cell.tool.load_point.any() or not cell.tool.markers:
        return cell.tool.load_point
    return np.asarray(np.mean(list(cell.tool.markers.values()), axis=0))


def _together(groups: Sequence[_Group], loads: Array, told: Sequence[str]) -> TargetPoses:
    q, force, weight, point, stated = [], [], [], [], []
    for group in groups:
        each = loads if group.force is None else np.zeros((1, 3))
        q.append(np.repeat(group.q, len(each), axis=0))
        force.append(np.tile(loads, (len(group.q), 1)) if group.force is None else group.force)
        weight.append(np.repeat(group.weight / len(each), len(each)))
        point.append(np.broadcast_to(group.point, (len(q[-1]), 3)))
        stated.append(np.full(len(q[-1]), group.stated))
    all_weights = np.concatenate(weight)
    # First by the largest, so that no sum overflows.
    all_weights = all_weights / all_weights.max()
    return TargetPoses(
        np.vstack(q),
        np.vstack(force),
        all_weights / all_weights.sum(),
        np.vstack(point),
        np.concatenate(stated),
        "test poses: " + ", ".join(told),
    )


def _along_path(
    cell: Cell, chain: Chain, spec: TargetPath, point: Array, rules: Rules | None, seed: int
) -> _Group:
    path = read_path(spec.file, chain.kinds)
    stated = spec.point is not None
    point = point if spec.point is None else spec.point
    force = path.force
    if force is None and spec.force is not None:
        force = np.broadcast_to(spec.force, (len(path.weight), 3))
    if path.q is not None:
        _check_path_limits(cell, chain, path, path.q)
        return _Group(
            path.q, force, path.weight, point, f"{len(path.q)} of {spec.file.name}", stated
        )
    assert path.position is not None  # read_path: joints or positions
    rotation = None if path.rotation is None else Rotation.from_rotvec(path.rotation).as_matrix()
    places = Places(path.position, rotation, point, force)
    found = reach(cell, chain, places, seed)
    for t in found.out_of_reach[:1]:
        raw, headers = path.raw, path.columns("position")
        raise InputError(
            f"{raw.source}, {raw.noun} {raw.row[t]}, columns {', '.join(headers)}: the place is "
            f"out of reach, {how_near(found, t)} ({len(found.out_of_reach)} of "
            f"{len(path.weight)} places); {remedy(cell)}"
        )
    q, told = preferred(cell, chain, places, found, rules, seed)
    return _Group(q, force, path.weight, point, f"{len(q)} of {spec.file.name}{told}", stated)


def _check_path_limits(cell: Cell, chain: Chain, path: PathTable, q: Array) -> None:
    lower, upper = joint_limits(cell, chain)
    excess = np.maximum(lower - q, q - upper)
    for i in np.flatnonzero((excess > 0).any(axis=1)):
        problem = beyond_limits(cell, chain, q[i])
        if problem is not None:
            header = path.columns("q")[int(np.argmax(excess[i] > 0))]
            raise InputError(
                f"{path.raw.where(int(i), header)}: {problem}; correct the path or the limits"
            )


def _in_box(
    cell: Cell, chain: Chain, box: TargetBox, point: Array, rules: Rules | None, seed: int
) -> _Group:
    stated = box.point is not None
    point = point if box.point is None else box.point
    position = box.lower + (box.upper - box.lower) * _sobol(3, box.count, seed)
    each = (box.count, 3)
    force = None if box.force is None else np.broadcast_to(box.force, each)
    rotation = None if box.rotation is None else np.broadcast_to(box.rotation, (*each, 3))
    places = Places(position, rotation, point, force)
    found = reach(cell, chain, places, seed)
    for t in found.out_of_reach[:1]:
        x, y, z = position[t]
        raise InputError(
            f"{cell.path or cell.name}: [design.test_box]: the place [{x:.3f}, {y:.3f}, {z:.3f}] m "
            f"in it is out of reach, {how_near(found, t)} ({len(found.out_of_reach)} of "
            f"{box.count} places); make the box smaller, "
            f"{'leave out rpy_deg, ' if box.rotation is not None else ''}{remedy(cell)}"
        )
    q, told = preferred(cell, chain, places, found, rules, seed)
    return _Group(q, force, np.ones(len(q)), point, f"{len(q)} in [design.test_box]{told}", stated)


def _drawn(cell: Cell, chain: Chain, point: Array, rules: Rules | None, seed: int) -> _Group:
    low, high = finite_ranges(chain, *joint_limits(cell, chain))
    count = DEFAULT_COUNT if rules is None else DRAWN
    q = low + (high - low) * _sobol(chain.n_joints, count, seed)
    for name, levels in cell.model.compliance_levels.items():
        # Elsewhere the model has no compliance for that joint.
        q[:, joint_index(cell, chain, name, "[model.compliance_levels]")] = np.resize(levels, count)
    if rules is not None:
        loads = working_loads(cell)
        ok = np.logical_and.reduce(
            [rules.check(q, np.broadcast_to(f, (count, 3))).ok for f in loads]
        )
        q = q[ok][:DEFAULT_COUNT]
        if not len(q):
            raise InsufficientDataError(
                f"{cell.path or cell.name}: the cell states no test poses, and its rules allow "
                f"none of {count} postures drawn over the joint limits; state "
                "[[design.test_pose]], or relax the rules of [workspace]"
            )
    told = f"{len(q)} drawn over the joint limits (the cell states none)"
    return _Group(q, None, np.ones(len(q)), point, told, False)


def _sobol(dimension: int, count: int, seed: int) -> Array:
    """`count` scrambled Sobol points (count, dimension) in the unit cube."""
    sampler = qmc.Sobol(dimension, scramble=True, seed=seed)
    return np.asarray(sampler.random_base2(int(np.ceil(np.log2(count))))[:count])
