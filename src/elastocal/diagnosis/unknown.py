"""Dependences without a name: any place moves smoothly with anything that was recorded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.hypotheses import UNSIZED_SCALES, EntryKey, recorded
from elastocal.model.arm import Setting
from elastocal.model.effects.base import Stage
from elastocal.units import Array

UNKNOWN_EFFECT = "unknown_effect"  # the name of all that has none

# What an unknown effect may depend on: angles, time, torque, load, direction, force, view.

WAVES, FEW_WAVES = 8, 3  # functions of a smooth dependence, and of one in a product


@dataclass(frozen=True)
class Covariate:
    """Smooth functions (C, v, f) of what a visit was like; `values` (C, v) in `unit` where they
    are functions of one number.  Where `joint` is given, no other joint is moved."""

    kind: str
    name: str
    functions: Array
    values: Array | None = None
    unit: str = ""
    joint: int | None = None


def covariates(dataset: DiagnosisData) -> Iterator[Covariate]:
    """Every covariate that was recorded and is one number per visit, and every product of two."""
    table, present = dataset.table, dataset.present

    def of_visits(values: Array) -> Array:
        return dataset.blocks.of_visits(values[dataset.lead])

    def if_recorded(name: str) -> Array | None:
        return of_visits(getattr(table, name)) if recorded(table, name) else None

    q, torque = of_visits(table.q), of_visits(dataset.columns.torques())
    time, approach = if_recorded("time"), if_recorded("approach")
    joints = range(q.shape[2])
    loaded = [i for i in joints if np.ptp(torque[:, :, i][present]) > 0]
    few = [waves(q[:, :, i], present, FEW_WAVES) for i in joints]
    slow = None if time is None else waves(time, present, FEW_WAVES)
    for i in joints:
        angle = q[:, :, i]
        yield Covariate("angle", f"joint{i + 1} angle", waves(angle, present, WAVES), angle, "rad")
    for i in loaded:
        tau = torque[:, :, i]
        u = tau / max(float(np.abs(tau[present]).max()), 1e-12)
        odd_and_even = np.stack([u, u**3, np.tanh(u / 0.05), np.abs(u), u**2], axis=2)
        odd_and_even *= present[:, :, None]
        yield Covariate("torque", f"joint{i + 1} torque", odd_and_even, tau, "N m")
    if time is not None:
        yield Covariate("time", "time", waves(time, present, WAVES), time, "s")
    if (warmth := if_recorded("temperature")) is not None:
        functions = waves(warmth, present, FEW_WAVES)
        yield Covariate("temperature", "temperature", functions, warmth, "°C")
    load: Array | None = None
    if recorded(table, "load"):
        force = np.linalg.norm(table.force, axis=1)
        load = of_visits(force / force.max())
        levels = len(np.unique(load[present].round(6)))
        both = np.stack([load] if levels < 3 else [load, load**2], axis=2) * present[:, :, None]
        yield Covariate("load", "load", both, load, "of the largest load")
        for i in joints:
            by_angle = few[i] * load[:, :, None]
            yield Covariate("load × angle", f"load × joint{i + 1} angle", by_angle)
        if slow is not None:
            yield Covariate("load × time", "load × time", slow * load[:, :, None])
    for i in joints:
        if approach is None:
            break
        a = approach[:, :, i]
        by = [a] if load is None else [a, a * load]
        size = np.abs(torque[:, :, i])
        if size.max() > 0:
            by.append(a * size / size.max())
        yield Covariate("approach", f"approach of joint{i + 1}", np.stack(by, axis=2), joint=i)
    yield from _of_stiffness(q, {i: torque[:, :, i] for i in loaded}, present, slow)
    for i in joints:
        if slow is None:
            break
        product = few[i][:, :, :, None] * slow[:, :, None, :]
        both = product.reshape(*product.shape[:2], -1)
        yield Covariate("time × angle", f"time × joint{i + 1} angle", both)


def _of_stiffness(
    q: Array, torque: Mapping[int, Array], present: NDArray[np.bool_], slow: Array | None
) -> Iterator[Covariate]:
    """A stiffness that changes with the joint's own angle, or with time."""
    for i, own in torque.items():
        name, tau = f"joint{i + 1} torque", (own / np.abs(own[present]).max())[:, :, None]
        by_angle = waves(q[:, :, i], present, WAVES - FEW_WAVES) * tau
        yield Covariate("torque × angle", f"{name} × its angle", by_angle, joint=i)
        if slow is not None:
            yield Covariate("torque × time", f"{name} × time", slow * tau, joint=i)


def wrenches(dataset: DiagnosisData) -> Iterator[tuple[str, EntryKey, Array, Array]]:
    """Places that the load bends, the base and each link's end, with the entry that moves them and
    the load's force and moment (C, v, 3) there along the entry's axes.

    A frame moved by e moves every marker by R e, so the columns of its frame are R; and turned
    about e they move a marker by R e × lever, whose product with the force is the moment about e,
    the load taken at the marker.
    """
    if not recorded(dataset.table, "load"):
        return
    n = dataset.table.q.shape[1]
    links = [(f"link{k + 1}", ("link_frame", (f"link{k + 1}",))) for k in range(n)]
    for place, key in [("base", ("base_motion", ("base",))), *links]:
        E = dataset.columns.entry(key)
        if E.shape[1] < 3:
            return
        wrench = np.einsum("nsd,ns->nd", E[:, :3], dataset.table.force)
        wrench = dataset.blocks.of_visits(wrench[dataset.lead])
        yield place, key, wrench[:, :, :3], wrench[:, :, 3:]


def waves(x: Array, present: NDArray[np.bool_], count: int) -> Array:
    """cos(kπu)/k, k = 1 … count, of x (C, v) scaled to u in [0, 1]: (C, v, count).

    The fall with k makes a Gaussian prior over their weights one over continuous functions.
    """
    known = x[present]
    span = max(float(np.ptp(known)), 1e-12)
    u = (x - known.min()) / span
    k = np.arange(1, count + 1)
    return np.cos(np.pi * u[:, :, None] * k) / k * present[:, :, None]


def monomials(x: Array) -> Array:
    """The components of x (n, 3) and their products, without the constant."""
    several = range(x.shape[1])
    products = [x[:, [i]] * x[:, [j]] for i in several for j in range(i + 1)]
    return np.concatenate([x, *products], axis=1)


# Blocks: each is one covariate at one place of the chain.  Joint i's angle moves joint k or frame
# k; time, torque, load and approach direction move joints, frames, markers; the load's force and
# moment give way at a link; a field over the workspace or a marker's angle of view moves the
# reading; and products of load with time, angle and direction.  Where a block explains the
# residual better than every effect of the catalogue, the effect is unknown and the block is its
# location.

# Prior sizes of an entry's components at the largest of a smooth dependence.
MOTION, BASE_MOTION = 1e-4, 5e-5  # m or rad
FRAME_WAVES = 5
LOAD_POINT_MOTION = 1e-2


@dataclass(frozen=True)
class Generic:
    """A block: `entry` moved by smooth functions of `covariate`, or ready columns.

    `direction` (C, v, d, k) holds the functions for each component that moves; `columns` (C, m, k)
    are packed columns of blocks that vary within a visit.
    """

    kind: str
    covariate: str
    where: str
    stage: Stage
    entry: EntryKey | None = None
    direction: Array | None = None
    columns: Array | None = None
    source: Covariate | None = None

    scales: ClassVar[Array] = UNSIZED_SCALES
    known: ClassVar[bool] = False
    settings: ClassVar[tuple[Setting, ...]] = ()

    @property
    def key(self) -> tuple[str, str]:
        return UNKNOWN_EFFECT, self.where

    @property
    def label(self) -> str:
        return f"{self.covariate} → {self.where}"

    @property
    def width(self) -> int:
        functions = self.direction if self.columns is None else self.columns
        assert functions is not None
        return functions.shape[-1]


def generic_blocks(dataset: DiagnosisData) -> list[Generic]:
    return [*_driven(dataset), *_of_force(dataset), *_of_reading(dataset)]


def _driven(dataset: DiagnosisData) -> Iterator[Generic]:
    model = dataset.base.model
    numbers = range(1, model.chain.n_joints + 1)

    def block(by: Covariate, entry: str, place: str, stage: Stage) -> Generic:
        # Six components each: fewer functions do, since the components share their shape.
        some = by.functions if entry == "joint_motion" else by.functions[:, :, :FRAME_WAVES]
        span = dataset.columns.places[entry, place]
        d, size = span.stop - span.start, BASE_MOTION if entry == "base_motion" else MOTION
        direction = np.einsum("de,cvf->cvdef", size * np.eye(d), some)
        direction = direction.reshape(*some.shape[:2], d, -1)
        return Generic(by.kind, by.name, place, stage, (entry, (place,)), direction, source=by)

    for by in covariates(dataset):
        under_load = by.kind.startswith(("torque", "load"))
        for k in numbers:
            if by.joint is None or by.joint == k - 1:
                stage: Stage = "compliance" if under_load else "transmission"
                yield block(by, "joint_motion", f"joint{k}", stage)
        if by.kind in ("angle", "time", "load", "temperature"):
            stage = "compliance" if under_load else "geometry"
            yield from (block(by, "link_frame", f"link{k}", stage) for k in numbers)
        if by.kind in ("angle", "time", "load", "temperature", "approach"):
            yield block(by, "base_motion", "base", "tracker")
        if by.kind in ("time", "temperature", "load"):
            for marker in model.cell.tool.markers:
                yield block(by, "marker_motion", f"marker:{marker}", "tool")
        if by.kind in ("angle", "time") and dataset.load_point is not None:
            # The load point moves: few functions for each of its directions, under load only.
            few = by.functions[:, :, :FEW_WAVES]
            W = np.einsum("cmv,cvf->cmf", dataset.blocks.in_visit, few) * LOAD_POINT_MOTION
            moved = np.einsum("cmd,cmf->cmdf", dataset.load_point, W)
            columns = moved.reshape(*moved.shape[:2], -1)
            yield Generic(f"{by.kind} → load", by.name, "load", "load", columns=columns)


def _of_force(dataset: DiagnosisData) -> Iterator[Generic]:
    last = f"link{dataset.table.q.shape[1]}"
    for place, key, *wrench in wrenches(dataset):
        # Beyond the last link there is only the tool and its markers.
        where = "tool" if place == last else place
        force, moment = (part / max(np.abs(part).max(), 1e-12) * MOTION for part in wrench)
        direction = np.zeros((*force.shape[:2], 6, 18))
        for a in range(3):
            direction[:, :, a, 3 * a : 3 * a + 3] = force
            direction[:, :, 3 + a, 9 + 3 * a : 12 + 3 * a] = moment
        yield Generic("force", f"force at {where}", where, "compliance", key, direction)


def _of_reading(dataset: DiagnosisData) -> Iterator[Generic]:
    """What differs from marker to marker in one visit: a field in space, the angle of view."""
    table, base = dataset.table, dataset.base
    if table.position is None or base.observed.size < 3:
        return
    cell, n = base.model.cell, len(table)
    offset = table.position - cell.tracker.position
    middle, half = (offset.max(axis=0) + offset.min(axis=0)) / 2, np.ptp(offset, axis=0) / 2
    field = monomials((offset - middle) / np.maximum(half, 1e-9)) * MOTION
    shift = np.zeros((n, base.observed.size, 3))
    shift[:, :3] = np.eye(3)

    def of_rows(columns: Array, functions: Array) -> Array:
        rows = np.einsum("nsd,nf->nsdf", columns, functions)
        return dataset.pack(rows.reshape(*columns.shape[:2], -1))

    yield Generic("field", "position in the workspace", "tracker", "tracker",
                  columns=of_rows(shift, field))  # fmt: skip
    # The unit vector from each marker to the instrument, in the flange frame.
    R = base.model.flange_poses(table, base.x)[:, :3, :3]
    line = cell.tracker.position - table.position
    line = line / np.linalg.norm(line, axis=1, keepdims=True)
    view = monomials(np.einsum("nij,ni->nj", R, line)) * MOTION
    for marker in cell.tool.markers:
        place = f"marker:{marker}"
        E = dataset.columns.entry(("marker_motion", (place,)))
        yield Generic("view", f"angle of view of {marker}", place, "tool",
                      columns=of_rows(E, view))  # fmt: skip
