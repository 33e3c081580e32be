"""What a diagnosis looks at: readings, their noise, and the columns of all possible additions, with
a name or without."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from elastocal.diagnosis.baseline import Baseline, Blocks, NoisyData, from_centre, prior_deviations
from elastocal.diagnosis.hypotheses import (
    KEPT,
    NO_SETTINGS,
    UNSIZED_SCALES,
    Columns,
    EntryKey,
    Hypothesis,
    Moments,
    RegressorDirection,
    SettingsGrid,
    compute_columns,
    grid_of,
    moments_of_change,
    possible,
    recorded,
    times_of,
)
from elastocal.identification.noise_structure import CONFIGURATION, TIME, stated_deviations
from elastocal.identification.start import as_placed
from elastocal.measurements import Measurements, first_of_visit
from elastocal.messages import InsufficientDataError
from elastocal.model.effects.base import Arm, Setting, Stage
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.effects.geometry import BaseFrame
from elastocal.model.effects.statics import PayloadError
from elastocal.model.manipulator import Model
from elastocal.model.observations import subset
from elastocal.units import Array, BoolArray, IntArray

# The load hangs on a flange frame that the markers' freedom leaves undetermined to millimetres.
LOAD_POINT_TOLERANCE = 2e-3
UNSIZED_SIGNAL = 2e-4  # m rms; what a parameter of unknown typical size moves the readings by


@dataclass(frozen=True)
class DiagnosisData:
    """A baseline with the columns of all hypotheses, packed by configuration.

    `data` holds the residual at the prior's centre, linearised at the fit, the fitted columns
    (scaled to their prior deviations) and noise shapes; `fitted` names the parameter of each of
    these columns, of the load point's the effect, of a stated drift's that of the base.
    `load_point` (C, m, 3) is what a shift of the load point does, per m, None without a load.
    `other_backlash` is the probability that play follows another backlash model than the base's."""

    base: Baseline
    columns: Columns
    hypotheses: tuple[Hypothesis, ...]
    data: NoisyData
    fitted: tuple[str, ...]
    load_point: Array | None = None
    other_backlash: float = 0.0

    @property
    def blocks(self) -> Blocks:
        return self.data.blocks

    @property
    def drift(self) -> float:
        """The drift in m that the cell states, and that is noise here; of distances none is."""
        return self.base.model.cell.noise.drift if self.blocks.size > 1 else 0.0

    @property
    def common(self) -> float:
        """The deviation in m, per axis, that the cell states as common to a configuration."""
        shown = self.base.observed.kind in ("position", "pose")
        return self.base.model.cell.noise.configuration if shown else 0.0

    @property
    def table(self) -> Measurements:
        return self.base.observed.table

    @property
    def of_any_size(self) -> DiagnosisData:
        """The same with effects of any size that may be."""
        wide = (replace(h, any_size=h.effect.any_size) for h in self.hypotheses)
        return replace(self, hypotheses=tuple(wide))

    @property
    def lead(self) -> IntArray:
        """Row (N,) of the table that each observation stands in first."""
        return self.base.observed.lead

    @cached_property
    def visit_table(self) -> Measurements:
        """One row for each visit (C·v), the first of its readings."""
        return self.table.take(self.lead[np.maximum(self.blocks.example, 0)].ravel())

    @property
    def present(self) -> BoolArray:
        """Which of the visits' places (C, v) hold one."""
        return self.blocks.example >= 0

    @cached_property
    def visits(self) -> Measurements:
        """The same of the visits that there are."""
        return self.visit_table.take(self.present.ravel())

    def pack(self, rows: Array) -> Array:
        """Per table row (n_rows, size, k) → packed (C, m, k)."""
        return self.blocks.pack(self.base.observed.apply(rows))

    def entry(self, key: EntryKey) -> Array:
        """Packed columns (C, m, d) of an entry; not to be written to."""
        known = self.columns.packed
        if key not in known:
            known[key] = self.pack(self.columns.entry(key))
        return known[key]

    @cached_property
    def sizes(self) -> dict[tuple[str, str], Array]:
        return {
            h.key: np.array([p.typical or 0.0 for p in h.parameters]) if h.driven
            else self.sizes_in(h, self.columns.of(h))
            for h in self.hypotheses
        }  # fmt: skip

    def sizes_in(self, h: Hypothesis, rows: Array) -> Array:
        """Prior standard deviations (k,): typical sizes, else the values whose signal in its
        columns (n_rows, size, k) is UNSIZED_SIGNAL rms, what is only planned not counted."""
        columns = self.base.observed.apply(rows)[: self.base.n_measured]
        flat = columns.reshape(-1, columns.shape[-1])
        rms = np.sqrt((flat**2).sum(axis=0) / max(int(flat.any(axis=1).sum()), 1))
        signal = np.divide(UNSIZED_SIGNAL, rms, out=np.zeros(len(rms)), where=rms > 0)
        both = zip(signal, h.parameters, strict=True)
        return np.array([s if p.typical is None else p.typical for s, p in both])

    @cached_property
    def directions(self) -> dict[tuple[str, str], RegressorDirection]:
        arm = Arm(self.base.model.chain, as_placed(self.base.model, self.base.x))
        known, driven = self.columns.regressors, [h for h in self.hypotheses if h.driven]
        for h in driven:
            if h.key not in known:
                known[h.key] = RegressorDirection(h, arm)
        return {h.key: known[h.key] for h in driven}

    @cached_property
    def grids(self) -> dict[tuple[str, str], SettingsGrid]:
        grids = {h.key: grid_of(h, self.visits, self.moments) for h in self.hypotheses if h.driven}
        for key, share in self.columns.shares.items():
            grids[key] = replace(NO_SETTINGS, log_prior=np.array([share]))
        return grids

    @cached_property
    def moments(self) -> Moments:
        table, lead = self.table, self.lead
        return moments_of_change(times_of(table)[lead], first_of_visit(table)[lead])

    def direction(self, h: Hypothesis, settings: Array) -> Array:
        """D (C, v, d, G, k) at each visit, per typical size, at `settings` (G, …); (C, 1, d, G, k)
        where it is the same in all visits of a configuration."""
        key = *h.key, settings.tobytes()
        known = self.columns.directions
        if key in known:
            return known[key]
        visits, present = self._driven_visits[h.key]
        D = self.directions[h.key](visits, settings)
        D = D.reshape(*present.shape, *D.shape[1:]).transpose(0, 1, 3, 2, 4)
        D = np.multiply(D, self.sizes[h.key], order="C")
        D[~present] = 0.0
        if D.size + sum(other.size for other in known.values()) <= KEPT:
            known[key] = D
        return D

    @cached_property
    def _driven_visits(self) -> dict[tuple[str, str], tuple[Measurements, BoolArray]]:
        """Of each driven hypothesis the visits (C·v) that its direction is evaluated at and which
        of them there are (C, v): one of each configuration where it is the same in the others,
        which saves a fifth of the time where a pose is read under five loads."""
        every, present = self.visit_table, self.present
        first = np.zeros_like(present)
        first[:, 0] = True
        one_each = every.take(first.ravel())
        out = {}
        for key, direction in self.directions.items():
            asked = direction.asked(every).reshape(*present.shape, -1)
            same = (asked == asked[:, :1]) | ~present[:, :, None]
            out[key] = (one_each, present[:, :1]) if same.all() else (every, present)
        return out

    def packed(self, h: Hypothesis | Generic, settings: Array = NO_SETTINGS.values[0]) -> Array:
        """Columns (C, m, k) of a hypothesis at one value of its `settings` (…,), scaled, or of a
        block; not to be written to."""
        if isinstance(h, Generic):
            if h.columns is not None:
                return h.columns
            assert h.entry is not None
            direction = np.einsum("cmv,cvdk->cmdk", self.blocks.in_visit, h.direction)
            return np.asarray(np.einsum("cmd,cmdk->cmk", self.entry(h.entry), direction))
        size = self.sizes[h.key]
        if not h.driven:
            known = self.columns.packed
            if h.key not in known:
                known[h.key] = self.pack(self.columns.of(h)) * size
            return known[h.key]
        D = self.directions[h.key](self.table, settings[None])[:, 0]
        return self.pack(self.columns.entry(h.entry_key(self.base.model)) @ D) * size

    @cached_property
    def moment(self) -> Array:
        """When each observation (N,) was made; its row in the table where no times are recorded."""
        time = self.table.time
        return self.lead.astype(float) if time is None else time[self.lead]

    def without(self, faulty: BoolArray) -> DiagnosisData:
        """The same with the observations where `faulty` (N,) holds left out."""
        if (faulty == self.data.faulty).all():
            return self
        return replace(self, data=self.data.without(faulty))


def diagnosis_data_of(
    base: Baseline, hypotheses: list[Hypothesis], around: Model | None = None,
    x: Array | None = None, apart: bool = False,
) -> DiagnosisData:  # fmt: skip
    """All columns at the baseline's fit, gathered by configuration.  `around` is the base's model
    with some of the hypotheses in it, at its values x: columns are those there, and the residual is
    the baseline's.  `apart`: those of the base's own parameters are without them."""
    model, observed, blocks = base.model, base.observed, base.blocks
    # The load's own error, whose load point has a tolerance in any case.
    acting = model.cell.model.torque != "measured"
    others = CATALOGUE.keys() - {PayloadError.name}
    loads = possible(model, observed.table, others)[0] if acting else []
    together = (h for h in possible(model, observed.table, together=True)[0] if not h.driven)
    asked = list({h.key: h for h in (*loads, *together, *hypotheses)}.values())
    if around is None or x is None:
        around, x = model, base.x
    columns = compute_columns(base, asked, dict(zip(around.names, x, strict=True)))
    if apart:
        around, x = model, base.x
    own = np.array([around.names.index(name) for name in model.names], dtype=np.int64)
    at = around.regressor(observed.table, x, own, observed)
    width = prior_deviations(base)
    names = list(model.names)
    B = at.B.reshape(len(observed.lead), observed.size, -1) * width
    residual = base.residual.reshape(-1, observed.size) + B @ (from_centre(base) / width)
    load_point = None
    for h in loads:
        keys = [k for k, p in enumerate(h.parameters) if p.key.startswith("load_point")]
        shift = observed.apply(columns.of(h)[:, :, keys])
        load_point = blocks.pack(shift)
        B = np.concatenate([B, shift * LOAD_POINT_TOLERANCE], axis=2)
        names += [h.name] * len(keys)
    drift, common = _stated_in_common(base)
    B = np.concatenate([B, drift], axis=2)
    names += [BaseFrame.name] * drift.shape[2]
    used = np.abs(B).max(axis=(0, 1), initial=0.0) > 0
    if not used.any():
        raise InsufficientDataError(
            f"{observed.table.source}: these readings show nothing that the model has: no "
            "parameter moves a marker in any pose under these loads; check robot, poses and loads, "
            "or measure others"
        )
    B = B[:, :, used]
    joints = tuple(f"joint{i + 1}" for i in range(model.chain.n_joints))
    data = NoisyData(
        blocks, r=blocks.pack(residual[:, :, None])[:, :, 0],
        X=blocks.pack(B), precision=np.ones(B.shape[2]),
        covariance=blocks.pack_square(base.covariance) + common,
        G=blocks.pack(columns.entry(("joint_motion", joints))[observed.lead]),
        left_out=blocks.absent, stated=base.stated is not None,
    )  # fmt: skip
    fitted = tuple(n for n, u in zip(names, used, strict=True) if u)
    return DiagnosisData(base, columns, tuple(hypotheses), data, fitted, load_point)


def _stated_in_common(base: Baseline) -> tuple[Array, Array | float]:
    """What the cell's [noise] states that readings share: columns (N, size, k) of the drift,
    coefficients of variance one, and the covariance (C, m, m) of what changes faster than its waves
    and of what is common to a configuration.  It is noise: left out, it passes for an effect that
    goes with time or with the joints' angles."""
    observed, member, n = base.observed, base.blocks.member, len(base.observed.lead)
    some = subset(observed, np.arange(n) < base.n_measured)
    waves = np.zeros((n, observed.size, 0))
    common: Array | float = 0.0
    of_all = stated_deviations(base.model, observed, base.x, (CONFIGURATION,))
    for found in (*of_all, *stated_deviations(base.model, some, base.x, (TIME,))):
        if found.waves is not None:
            rest = np.zeros((n - base.n_measured, *found.waves.shape[1:]))
            waves = np.concatenate([found.waves, rest])
        loading = found.packed(np.where(member < len(found.unit), member, -1))
        common = common + loading @ loading.transpose(0, 2, 1)
    return waves, common


UNKNOWN_EFFECT = "unknown_effect"  # the name of all that has none

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
    for i, a in enumerate(() if approach is None else np.moveaxis(approach, 2, 0)):
        size = np.abs(torque[:, :, i])
        by = [a] if load is None else [a, a * load]
        if size.max() > 0:
            by.append(a * size / size.max())
        yield Covariate("approach", f"approach of joint{i + 1}", np.stack(by, axis=2), joint=i)
    # A stiffness that changes with the joint's own angle, or with time.
    for i in loaded:
        name, own = f"joint{i + 1} torque", torque[:, :, i, None]
        tau = own / np.abs(own[present]).max()
        by_angle = waves(q[:, :, i], present, WAVES - FEW_WAVES) * tau
        yield Covariate("torque × angle", f"{name} × its angle", by_angle, joint=i)
        if slow is not None:
            yield Covariate("torque × time", f"{name} × time", slow * tau, joint=i)
    products = () if slow is None else [own[..., None] * slow[:, :, None] for own in few]
    for i, product in enumerate(products):
        both = product.reshape(*product.shape[:2], -1)
        yield Covariate("time × angle", f"time × joint{i + 1} angle", both)


def wrenches(dataset: DiagnosisData) -> Iterator[tuple[str, tuple[EntryKey, Array]]]:
    """Places that the load bends, the base and each link's end, with the entry that moves them and
    the load's force and moment (n_rows, 6) there along the entry's axes, of a visit's first row.  A
    frame moved by e moves every marker by R e, so the columns of its frame are R; and turned about
    e they move a marker by R e × lever, whose product with the force is the moment about e, the
    load taken at the marker."""
    if not recorded(dataset.table, "load"):
        return
    n, begun = dataset.table.q.shape[1], first_of_visit(dataset.table)
    links = [(f"link{k + 1}", ("link_frame", (f"link{k + 1}",))) for k in range(n)]
    for place, key in [("base", ("base_motion", ("base",))), *links]:
        E = dataset.columns.entry(key)
        if E.shape[1] < 3:
            return
        wrench = np.einsum("nsd,ns->nd", E[:, :3], dataset.table.force)
        yield place, (key, wrench[begun])


def waves(x: Array, present: BoolArray, count: int) -> Array:
    """cos(kπu)/k, k = 1 … count, of x (C, v) scaled to u in [0, 1]: (C, v, count).  The fall with k
    makes a Gaussian prior over their weights one over continuous functions."""
    known = x[present]
    span = max(float(np.ptp(known)), 1e-12)
    u = (x - known.min()) / span
    k = np.arange(1, count + 1)
    return np.cos(np.pi * u[:, :, None] * k) / k * present[:, :, None]


def monomials(x: Array) -> Array:
    """The components of x (n, 3) and their products, without the constant."""
    products = [x[:, [i]] * x[:, [j]] for i in range(x.shape[1]) for j in range(i + 1)]
    return np.concatenate([x, *products], axis=1)


# Blocks: each is one covariate at one place of the chain.  Where a block explains the residual
# better than every effect of the catalogue, the effect is unknown and the block is its location.

# Prior sizes of an entry's components at the largest of a smooth dependence.
MOTION, BASE_MOTION = 1e-4, 5e-5  # m or rad
FRAME_WAVES = 5
LOAD_POINT_MOTION = 1e-2


@dataclass(frozen=True)
class Generic:
    """A block: each of an entry's `components` moved by the same smooth `functions` (C, v, f) of
    `covariate`, or ready packed `columns` (C, m, k)."""

    kind: str
    covariate: str
    where: str
    stage: Stage
    entry: EntryKey | None = None
    functions: Array | None = None
    components: int = 1
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
        given = self.columns if self.functions is None else self.functions
        assert given is not None
        return int(given.shape[-1]) * self.components

    @property
    def direction(self) -> Array:
        """The functions for each component that moves (C, v, d, k), written out."""
        assert self.functions is not None
        D = np.einsum("de,cvf->cvdef", np.eye(self.components), self.functions)
        return D.reshape(*D.shape[:3], -1)


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
        key = entry, (place,)
        return Generic(by.kind, by.name, place, stage, key, some * size, d, source=by)

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
    for place, (key, wrench) in wrenches(dataset):
        # Beyond the last link there is only the tool and its markers.
        where, axes = "tool" if place == last else place, np.eye(3)
        force, moment = (
            np.kron(axes, part[:, None] / max(np.abs(part).max(), 1e-12) * MOTION)
            for part in np.split(wrench, 2, axis=1)
        )
        E = dataset.columns.entry(key)
        columns = dataset.pack(np.concatenate([E[:, :, :3] @ force, E[:, :, 3:] @ moment], axis=2))
        yield Generic("force", f"force at {where}", where, "compliance", columns=columns)


def _of_reading(dataset: DiagnosisData) -> Iterator[Generic]:
    """What differs from marker to marker in one visit: a field in space, the angle of view."""
    table, base = dataset.table, dataset.base
    if table.position is None or base.observed.size < 3:
        return
    cell, n = base.model.cell, len(table)
    offset = table.position - cell.tracker.position
    middle, half = (offset.max(axis=0) + offset.min(axis=0)) / 2, np.ptp(offset, axis=0) / 2
    field = monomials((offset - middle) / np.maximum(half, 1e-9)) * MOTION
    shift = np.broadcast_to(np.eye(base.observed.size, 3), (n, base.observed.size, 3))

    def of_rows(columns: Array, functions: Array) -> Array:
        rows = np.einsum("nsd,nf->nsdf", columns, functions)
        return dataset.pack(rows.reshape(*columns.shape[:2], -1))

    columns = of_rows(shift, field)
    yield Generic("field", "position in the workspace", "tracker", "tracker", columns=columns)
    # Where instrument and weight draw each marker, in the flange frame.
    R = base.model.flange_poses(table, base.x)[:, :3, :3]
    line = -offset / np.linalg.norm(offset, axis=1, keepdims=True)
    for name, way in (
        ("angle of view", line),
        ("weight's direction", np.tile([0.0, 0.0, -1.0], (n, 1))),
    ):
        along = monomials(np.einsum("nij,ni->nj", R, way)) * MOTION
        for marker in cell.tool.markers:
            place = f"marker:{marker}"
            columns = of_rows(dataset.columns.entry(("marker_motion", (place,))), along)
            yield Generic("view", f"{name} of {marker}", place, "tool", columns=columns)
