"""Dependences without a name: any place moves smoothly with anything that was recorded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.hypotheses import SCALES, EntryKey, recorded
from elastocal.model.effects.base import Stage
from elastocal.units import Array

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


@dataclass(frozen=True)
class Covariates:
    """What was recorded of each visit (C, v, …)."""

    dataset: DiagnosisData
    angle: Array
    torque: Array
    time: Array | None
    temperature: Array | None
    approach: Array | None
    load: Array | None

    @classmethod
    def of(cls, dataset: DiagnosisData) -> Covariates:
        table = dataset.table

        def visits(values: Array) -> Array:
            return dataset.places.gather(values[dataset.lead])

        def if_recorded(name: str) -> Array | None:
            return visits(getattr(table, name)) if recorded(table, name) else None

        force = np.linalg.norm(table.force, axis=1)
        return cls(
            dataset, visits(table.q), visits(dataset.columns.torques()), if_recorded("time"),
            if_recorded("temperature"), if_recorded("approach"),
            visits(force / force.max()) if recorded(table, "load") else None,
        )  # fmt: skip

    def smooth(self) -> Iterator[Covariate]:
        """Every covariate that is one number per visit, and every product of two."""
        yield from self._single()
        yield from self._with_load()
        yield from self._with_approach()
        yield from self._at_own_joint()
        if self.time is not None:
            time = waves(self.time, self.dataset.present, FEW_WAVES)
            for i in range(self.n):
                both = _product(self._angle(i, FEW_WAVES), time)
                yield Covariate("time × angle", f"time × joint{i + 1} angle", both)

    @property
    def n(self) -> int:
        return self.angle.shape[2]

    def _angle(self, i: int, count: int) -> Array:
        return waves(self.angle[:, :, i], self.dataset.present, count)

    def _loaded_joints(self) -> list[int]:
        return [i for i in range(self.n) if np.ptp(self.torque[:, :, i][self.dataset.present]) > 0]

    def _single(self) -> Iterator[Covariate]:
        present = self.dataset.present
        for i in range(self.n):
            angle = self.angle[:, :, i]
            yield Covariate("angle", f"joint{i + 1} angle", self._angle(i, WAVES), angle, "rad")
        for i in self._loaded_joints():
            tau = self.torque[:, :, i]
            functions = _odd_and_even(tau, present)
            yield Covariate("torque", f"joint{i + 1} torque", functions, tau, "N m")
        if self.time is not None:
            yield Covariate("time", "time", waves(self.time, present, WAVES), self.time, "s")
        if self.temperature is not None:
            warmth = waves(self.temperature, present, FEW_WAVES)
            yield Covariate("temperature", "temperature", warmth, self.temperature, "°C")

    def _with_load(self) -> Iterator[Covariate]:
        load, present = self.load, self.dataset.present
        if load is None:
            return
        levels = len(np.unique(load[present].round(6)))
        powers = [load] if levels < 3 else [load, load**2]
        both = np.stack(powers, axis=2) * present[:, :, None]
        yield Covariate("load", "load", both, load, "of the largest load")
        for i in range(self.n):
            few = self._angle(i, FEW_WAVES) * load[:, :, None]
            yield Covariate("load × angle", f"load × joint{i + 1} angle", few)
        if self.time is not None:
            time = waves(self.time, present, FEW_WAVES)
            yield Covariate("load × time", "load × time", time * load[:, :, None])

    def _with_approach(self) -> Iterator[Covariate]:
        if self.approach is None:
            return
        for i in range(self.n):
            a = self.approach[:, :, i]
            by = [a] if self.load is None else [a, a * self.load]
            torque = np.abs(self.torque[:, :, i])
            if torque.max() > 0:
                by.append(a * torque / torque.max())
            functions = np.stack(by, axis=2)
            yield Covariate("approach", f"approach of joint{i + 1}", functions, joint=i)

    def _at_own_joint(self) -> Iterator[Covariate]:
        """A stiffness that changes with the joint's own angle, or with time."""
        present = self.dataset.present
        for i in self._loaded_joints():
            tau = self.torque[:, :, i] / np.abs(self.torque[:, :, i][present]).max()
            name = f"joint{i + 1} torque"
            by_angle = self._angle(i, WAVES - FEW_WAVES) * tau[:, :, None]
            yield Covariate("torque × angle", f"{name} × its angle", by_angle, joint=i)
            if self.time is not None:
                by_time = waves(self.time, present, FEW_WAVES) * tau[:, :, None]
                yield Covariate("torque × time", f"{name} × time", by_time, joint=i)

    def wrenches(self) -> Iterator[tuple[Array, Array]]:
        """The load's force and moment (C, v, 3) at each link's end along its axes, largest 1.

        A link's end moved by e moves every marker by R e, so the columns of its frame are R; and
        turned about e they move a marker by R e × lever, whose product with the force is the
        moment about e, the load taken at the marker.
        """
        dataset = self.dataset
        if self.load is None:
            return
        for k in range(self.n):
            E = dataset.columns.entry(("link_frame", (f"link{k + 1}",)))
            if E.shape[1] < 3:
                return
            wrench = np.einsum("nsd,ns->nd", E[:, :3], dataset.table.force)
            wrench = dataset.places.gather(wrench[dataset.lead])
            force, moment = wrench[:, :, :3], wrench[:, :, 3:]
            yield force / max(np.abs(force).max(), 1e-12), moment / max(np.abs(moment).max(), 1e-12)

    def view(self) -> Array:
        """Unit vector (n_rows, 3) from each marker to the instrument, in the flange frame."""
        base = self.dataset.base
        table = base.observed.table
        T = base.model.flange_poses(table, base.x)
        assert table.position is not None
        line = base.model.cell.tracker.position - table.position
        line = line / np.linalg.norm(line, axis=1, keepdims=True)
        return np.einsum("nij,ni->nj", T[:, :3, :3], line)


def waves(x: Array, present: NDArray[np.bool_], count: int) -> Array:
    """cos(kπu)/k, k = 1 … count, of x (C, v) scaled to u in [0, 1]: (C, v, count).

    The fall with k makes a Gaussian prior over their weights one over continuous functions.
    """
    known = x[present]
    span = max(float(np.ptp(known)), 1e-12)
    u = (x - known.min()) / span
    k = np.arange(1, count + 1)
    return np.cos(np.pi * u[:, :, None] * k) / k * present[:, :, None]


def _product(a: Array, b: Array) -> Array:
    """Products of the functions a (C, v, f) and b (C, v, g): (C, v, f·g)."""
    return np.asarray((a[:, :, :, None] * b[:, :, None, :]).reshape(*a.shape[:2], -1))


def monomials(x: Array, degree: int) -> Array:
    """Products of the components of x (n, 3) up to `degree`, without the constant."""
    out = [x[:, [i]] for i in range(x.shape[1])]
    if degree > 1:
        out += [x[:, [i]] * x[:, [j]] for i in range(x.shape[1]) for j in range(i + 1)]
    return np.concatenate(out, axis=1)


def _odd_and_even(x: Array, present: NDArray[np.bool_]) -> Array:
    """x, x³, sign and size of a torque, x scaled to its largest."""
    u = x / max(float(np.abs(x[present]).max()), 1e-12)
    functions = np.stack([u, u**3, np.tanh(u / 0.05), np.abs(u), u**2], axis=2)
    return functions * present[:, :, None]


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

    scales: ClassVar[Array] = SCALES

    @property
    def label(self) -> str:
        return f"{self.covariate} → {self.where}"

    @property
    def width(self) -> int:
        """Number of columns."""
        functions = self.direction if self.columns is None else self.columns
        assert functions is not None
        return functions.shape[-1]


def generic_blocks(dataset: DiagnosisData) -> list[Generic]:
    """Every block that the recorded columns allow."""
    covariates = Covariates.of(dataset)
    return [
        *_driven(dataset, covariates),
        *_of_force(dataset, covariates),
        *_of_reading(dataset, covariates),
    ]


def _driven(dataset: DiagnosisData, covariates: Covariates) -> Iterator[Generic]:
    model = dataset.base.model
    numbers = range(1, model.chain.n_joints + 1)

    def block(by: Covariate, entry: str, place: str, stage: Stage) -> Generic:
        # Six components each: fewer functions do, since the components share their shape.
        some = by.functions if entry == "joint_motion" else by.functions[:, :, :FRAME_WAVES]
        direction = _each_component(dataset, entry, place, some)
        return Generic(by.kind, by.name, place, stage, (entry, (place,)), direction, source=by)

    for by in covariates.smooth():
        under_load = by.kind.startswith(("torque", "load"))
        for k in numbers:
            if by.joint is None or by.joint == k - 1:
                stage: Stage = "compliance" if under_load else "transmission"
                yield block(by, "joint_motion", f"joint{k}", stage)
        if by.kind in ("angle", "time", "load", "temperature"):
            for k in numbers:
                yield block(
                    by, "link_frame", f"link{k}", "compliance" if under_load else "geometry"
                )
        if by.kind in ("angle", "time", "load", "temperature", "approach"):
            yield block(by, "base_motion", "base", "tracker")
        if by.kind in ("time", "temperature", "load"):
            for marker in model.cell.tool.markers:
                yield block(by, "marker_motion", f"marker:{marker}", "tool")
        if by.kind in ("angle", "time") and dataset.load_point is not None:
            yield _of_load_point(dataset, by)


def _of_load_point(dataset: DiagnosisData, by: Covariate) -> Generic:
    """The load point moves: few functions for each of its directions, under load only."""
    assert dataset.load_point is not None
    few = by.functions[:, :, :FEW_WAVES]
    W = np.einsum("cmv,cvf->cmf", dataset.places.one_hot, few) * LOAD_POINT_MOTION
    columns = np.einsum("cmd,cmf->cmdf", dataset.load_point, W)
    packed = columns.reshape(*columns.shape[:2], -1)
    return Generic(f"{by.kind} → load", by.name, "load", "load", columns=packed)


def _each_component(dataset: DiagnosisData, entry: str, place: str, W: Array) -> Array:
    """Each of the functions W (C, v, f) moves each component of the entry: (C, v, d, d·f)."""
    span = dataset.columns.places[entry, place]
    d = span.stop - span.start
    size = BASE_MOTION if entry == "base_motion" else MOTION
    return np.einsum("de,cvf->cvdef", size * np.eye(d), W).reshape(*W.shape[:2], d, -1)


def _of_force(dataset: DiagnosisData, covariates: Covariates) -> Iterator[Generic]:
    """Force and moment at a link's end, each moving or turning it along any axis."""
    for k, (force, moment) in enumerate(covariates.wrenches()):
        C, v, _ = force.shape
        direction = np.zeros((C, v, 6, 18))
        for a in range(3):
            direction[:, :, a, 3 * a : 3 * a + 3] = MOTION * force
            direction[:, :, 3 + a, 9 + 3 * a : 12 + 3 * a] = MOTION * moment
        link = f"link{k + 1}"
        # Beyond the last link there is only the tool and its markers.
        where = "tool" if k == dataset.base.model.chain.n_joints - 1 else link
        yield Generic("force", f"force at {where}", where, "compliance", ("link_frame", (link,)),
                      direction)  # fmt: skip


def _of_reading(dataset: DiagnosisData, covariates: Covariates) -> Iterator[Generic]:
    """What differs from marker to marker in one visit: a field in space, the angle of view."""
    table, size = dataset.table, dataset.base.observed.size
    if table.position is None or size < 3:
        return
    offset = table.position - dataset.base.model.cell.tracker.position
    field = monomials(_standard(offset), 2) * MOTION
    shift = np.zeros((len(table), size, 3))
    shift[:, :3] = np.eye(3)
    rows = np.einsum("nsd,nf->nsdf", shift, field).reshape(len(table), size, -1)
    yield Generic("field", "position in the workspace", "tracker", "tracker",
                  columns=dataset.pack(rows))  # fmt: skip
    view = covariates.view()
    for marker in dataset.base.model.cell.tool.markers:
        place = f"marker:{marker}"
        E = dataset.columns.entry(("marker_motion", (place,)))
        rows = np.einsum("nsd,nf->nsdf", E, monomials(view, 2) * MOTION)
        yield Generic("view", f"angle of view of {marker}", place, "tool",
                      columns=dataset.pack(rows.reshape(len(table), size, -1)))  # fmt: skip


def _standard(values: Array) -> Array:
    spread = np.maximum(np.ptp(values, axis=0) / 2, 1e-9)
    return (values - (values.max(axis=0) + values.min(axis=0)) / 2) / spread
