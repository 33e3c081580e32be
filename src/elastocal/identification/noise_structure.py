"""The parts that noise is made of: what single readings scatter by, and deviations that they share.

    V = Σ_k θ_k K_k

A `NoiseModel` says how the noise of a single reading is built, a `Deviation` what readings have in
common besides; a `Kind` is one of the former with some of the latter.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
from scipy import sparse, special

from elastocal.cell_tables import Unsteadiness
from elastocal.files import check_registered, same_class
from elastocal.measurements import Measurements, numbered, poses_in_turn, visits
from elastocal.messages import InputError, did_you_mean, option, quoted, require
from elastocal.model.effects.base import JointMotion
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.units import Array, BoolArray, IntArray

# The visits behind each reading: what a joint that settles elsewhere there, or a base that has
# drifted by then, would do to it.

# Correlation times of a drift that are tried, as shares of the campaign; whether there is any is
# tested with the first.
LASTING = (0.2, 0.1, 0.4, 0.05, 0.8)
LONGEST = max(LASTING)
FEWEST_BLOCKS, MOST_BLOCKS = 5, 10  # of time


@dataclass(frozen=True)
class VisitRecord:
    """The rows of the table behind each of N readings: m of them, one but for deflections.

    `visit` (N, m) numbers the arm's visits to a pose (−1: no such row), `motion` (N, m, size,
    joints) is ∂(reading)/∂q there, `share` (N, m) the row's factor in the reading, `place` (N, m)
    its time as a share of the campaign's `span` in s, by the order of the rows where the table has
    no times (`timed`).  `turning` (joints,) says which joints are revolute.  `lasting`: the
    correlation times of a drift that may be, as shares of the span; the cell's own alone, where it
    states a drift and the table has times.  None are where the model itself has what changes with
    time, and, unless the cell states one, where poses follow neighbouring poses: such readings err
    alike because of what the model lacks, and a drift in its place would leave the base as
    uncertain as it is large.
    """

    visit: IntArray
    motion: Array
    share: Array
    place: Array
    turning: BoolArray
    timed: bool
    span: float
    lasting: tuple[float, ...] = LASTING

    def take(self, chosen: BoolArray | IntArray) -> VisitRecord:
        names = ("visit", "motion", "share", "place")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def waves(self, lasting: float) -> Array:
        """Loadings (N, k) on independent deviations of variance 1, which add up to a random course
        of correlation exp(−|t − t′|/`lasting`), times as shares of the span."""
        return np.asarray(np.einsum("nm,nmk->nk", self.share, self._each(lasting)))

    def faster(self, lasting: float) -> Array:
        """Loadings (N, m) on what the waves leave of the course's variance at each row's time."""
        left = 1 - (self._each(lasting) ** 2).sum(axis=2)
        return self.share * np.sqrt(np.maximum(left, 0.0))

    def blocks(self, configuration: IntArray, lasting: float) -> IntArray:
        """Blocks (N,) of whole configurations that follow each other in time, as long as what
        drifts is `lasting`, if that makes neither too few nor too many."""
        number = int(np.clip(round(1 / lasting), FEWEST_BLOCKS, MOST_BLOCKS))
        _, code = np.unique(configuration, return_inverse=True)
        when = np.bincount(code, self.place[:, 0]) / np.bincount(code)
        rank = np.argsort(np.argsort(when, kind="stable"))
        return np.asarray((rank * min(number, len(when)) // len(when))[code], dtype=np.int64)

    def _each(self, lasting: float) -> Array:
        return course_waves(self.place.ravel(), lasting).reshape(*self.place.shape, -1)


def visit_record(model: Model, observed: Observations, x: Array) -> VisitRecord | None:
    table, n = observed.table, len(observed.lead)
    if not model.chain.n_joints:
        return None
    combine = observed.combine
    count = np.diff(combine.indptr)
    m = int(count.max(initial=1))
    place = np.arange(m) < count[:, None]
    row, share = np.zeros((n, m), dtype=np.int64), np.zeros((n, m))
    row[place], share[place] = combine.indices, combine.data
    # ∂(reading)/∂q (rows, size, joints) of the nominal arm, base and markers where x has them.
    moving, at = model.moving, dict(zip(model.names, x.tolist(), strict=True))
    here = np.array([at.get(p.name, p.nominal) for p in moving.parameters])
    joints = np.flatnonzero([p.effect == JointMotion.name for p in moving.parameters])
    motion = moving.regressor(table, here, joints).B.reshape(len(table), -1, len(joints))
    when, span, timed = _when(table)
    turning = np.array([kind != "prismatic" for kind in model.chain.kinds])
    visit = np.where(place, visits(table)[row], -1)
    noise = model.cell.noise
    lasting: tuple[float, ...] = LASTING
    if noise.drift > 0 and timed:
        lasting = (noise.lasting / span,)
    elif not (noise.drift > 0 or in_random_order(table.take(np.argsort(when, kind="stable")))):
        lasting = ()
    motion = motion[row] * share[:, :, None, None]
    return VisitRecord(visit, motion, share, when[row], turning, timed, span, lasting)


SYSTEMATIC = 0.01


def in_random_order(table: Measurements) -> bool:
    """Whether poses that follow each other in the table are no nearer than chance allows at 1 %.  Σ
    |q_i+1 − q_i|² / Σ |q_i − q̄|² has the mean 2 and the variance 4 (n − 2)/(n² − 1) for each joint
    (von Neumann 1941)."""
    q = poses_in_turn(table)
    n, spread = len(q), q.std(axis=0)
    q = q[:, spread > 0] / spread[spread > 0]
    if n < 3 or not q.shape[1]:
        return False
    ratio = (np.diff(q, axis=0) ** 2).sum(axis=0) / n
    deviation = np.sqrt(4 * (n - 2) / (n**2 - 1) / q.shape[1])
    return bool(ratio.mean() - 2 > special.ndtri(SYSTEMATIC) * deviation)


def _when(table: Measurements) -> tuple[Array, float, bool]:
    """Time (rows,) of each row as a share of the campaign, its length, and whether it was recorded:
    without times the visits, in the order of the rows, take equally long."""
    if table.time is not None and np.isfinite(table.time).all() and np.ptp(table.time) > 0:
        span = float(np.ptp(table.time))
        return (table.time - table.time.min()) / span, span, True
    _, first, visit = np.unique(visits(table), return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))[visit.ravel()].astype(float)
    span = max(float(order.max(initial=0.0)), 1.0)
    return order / span, span, False


# A course in time as a sum of waves.
#
# The eigenfunctions φ of the correlation exp(−|t − t′|/lasting) on [0, 1], of eigenvalues λ
# (Karhunen and Loève; Ghanem and Spanos 1991, section 2.3), on the middles of GRID intervals and
# from there by √λ φ(t) = ∫ exp(−|t − s|/lasting) φ(s) ds/√λ (Nyström).  Those left out are what
# changes faster than the k-th wave: noise of single visits, of the same variance
# (`VisitRecord.faster`).  Without it a long course and a deviation of each configuration look more
# likely than the short course that there is.

GRID, MOST_WAVES = 400, 20
# Of the variance.  A course that lasts longer than the campaign is nearly a constant, which the
# base takes over, and varies about it by little more than the inverse of how much longer.
LEFT = 0.03


def course_waves(t: Array, lasting: float) -> Array:
    """Waves (n, k) at t (n,) in 0 … 1, their products summing to nearly exp(−|t − t′|/lasting)."""
    middles, loading = _eigenfunctions(lasting)
    return np.asarray(np.exp(-np.abs(t[:, None] - middles) / lasting) @ loading)


@lru_cache(maxsize=16)
def _eigenfunctions(lasting: float) -> tuple[Array, Array]:
    middles = (np.arange(GRID) + 0.5) / GRID
    value, vector = np.linalg.eigh(np.exp(-np.abs(middles[:, None] - middles) / lasting) / GRID)
    value, vector = value[::-1], vector[:, ::-1]
    left = 1 - np.cumsum(value)
    k = int(np.argmax(left < LEFT * min(1 / lasting, 1.0))) + 1
    own = slice(0, min(k, MOST_WAVES))
    return middles, vector[:, own] / np.sqrt(GRID * value[own])


ROWS_PER_VARIANCE = 5  # degrees of freedom that a variance needs before it is worth trying


@dataclass(frozen=True)
class Readings:
    """N readings of `size` components, linearised: e = B Δx + noise, shared and per reading.

    `B` (N, size, p); `e` (N, size) in m, and rad from the fourth component on.  Readings of one
    `configuration`, `load` and `marker` (N,) are repeats.  `sight` (N, 3, 3), where the tracker's
    position is known, holds the unit vectors along and across the line of sight as rows and
    `reach` (N,) its length in m; `stated` (N, size, size), where noise is stated, its covariance.
    `lead` (N,) are the readings' rows in the `table`.  `visits` says at which visits of the arm
    they were made.
    """

    B: Array
    e: Array
    configuration: IntArray
    load: IntArray
    marker: IntArray
    sight: Array | None = None
    reach: Array | None = None
    stated: Array | None = None
    table: Measurements | None = None
    lead: IntArray | None = None
    visits: VisitRecord | None = None

    def __len__(self) -> int:
        return len(self.e)

    @property
    def size(self) -> int:
        return int(self.e.shape[1])

    @property
    def n_parameters(self) -> int:
        return int(self.B.shape[2])

    @cached_property
    def rows(self) -> Measurements:
        """The rows (N,) of the table that the readings are from: joints, force, time and so on."""
        require(self.table is not None, "these readings are not from a table")
        assert self.table is not None and self.lead is not None
        return self.table.take(self.lead)

    @property
    def spare(self) -> int:
        return (self.e.size - self.n_parameters) // ROWS_PER_VARIANCE

    def take(self, chosen: BoolArray) -> Readings:
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        parts = {k: v[chosen] for k, v in parts.items() if isinstance(v, np.ndarray)}
        own = None if self.visits is None else self.visits.take(chosen)
        return replace(self, **parts, visits=own)

    def sample(self, n: int) -> Readings:
        """Those of whole configurations at random, about n of them; all where they are no more."""
        if len(self) <= n:
            return self
        _, code, count = np.unique(self.configuration, return_inverse=True, return_counts=True)
        order = np.random.default_rng(0).permutation(len(count))
        return self.take(np.isin(code, order[: np.searchsorted(np.cumsum(count[order]), n) + 1]))


# What single readings scatter by: one variance, or several.


Terms = Iterable[tuple[IntArray | int, Array]]


class Structure:
    """Covariance of reading i alone: Σ_l θ[index[i, l]] · matrix[i, l], `index` (N, L) into the
    `names` of the variances θ, in m² (rad²); `matrix` (N, L, size, size).  Each of the L `terms` is
    which variance a reading has, and S, for each reading or all."""

    def __init__(self, readings: Readings, names: Iterable[str], terms: Terms) -> None:
        n, size = readings.e.shape
        index, matrix = zip(*terms, strict=True)
        self.names = tuple(names)
        self.index = np.stack([np.broadcast_to(own, n) for own in index], axis=1)
        self.matrix = np.stack([np.broadcast_to(S, (n, size, size)) for S in matrix], axis=1)

    def covariance(self, theta: Array) -> Array:
        return np.einsum("nl,nlij->nij", theta[self.index], self.matrix)


class NoiseModel:
    """A noise model of one's own: the variances that the noise of a reading is made of.

    The covariance of reading i is Σ_l θ_l S_l,i with unknown variances θ_l ≥ 0, which restricted
    likelihood finds, and what `components` says of S_l.  It is tried with and without deviations
    that the readings of a configuration share, and taken where the information criterion is smaller
    than those of the built-in models.
    """

    name: ClassVar[str]
    description: ClassVar[str]
    words: ClassVar[str] = ""  # in a list of others, where the description is too long
    shrunk: ClassVar[bool] = False  # whether the variances are many, and share a prior

    def components(self, readings: Readings) -> Mapping[str, Array]:
        """The name of each variance → S, (N,) times the identity or (N, size, size), of N readings.

        θ is in m² (rad² of rotations) where S is a plain number.  A group of readings with a
        variance of its own has S = 1 for its members and 0 for the others.  Repeats of a reading
        share one S, the mean of theirs.  The names are the same for any part of the readings.
        """
        raise NotImplementedError

    def supports(self, readings: Readings) -> bool:
        """Whether these readings have what the model needs; where not, it is not tried."""
        return True

    def structure(self, readings: Readings, names: Sequence[str] = ()) -> Structure:
        """The model for the likelihood, of the variances `names` where it may have several sets;
        InputError where `components` are not as they should be, or readings lack what it needs."""
        found = self.components(readings)
        require(bool(found), f"the noise model '{self.name}' has no components")
        each, (n, size) = list[Array](), readings.e.shape
        for name, stated in found.items():
            S = np.asarray(stated, dtype=np.float64)
            where = f"component '{name}' of the noise model '{self.name}'"
            require(
                S.shape in ((n,), (n, size, size)),
                f"{where} is {S.shape}; a number per reading, ({n},), or a matrix, "
                f"({n}, {size}, {size}), is needed",
            )
            full = S[:, None, None] * np.eye(size) if S.ndim == 1 else S
            same = np.isfinite(S).all() and np.allclose(full, full.transpose(0, 2, 1))
            require(bool(same), f"{where} is not finite and symmetric")
            smallest, largest = np.linalg.eigvalsh(full)[:, [0, -1]].T
            lower = (smallest < -1e-9 * largest).any()
            require(not lower, f"{where} has a negative variance in some direction")
            each.append(full)
        require(
            bool((np.linalg.eigvalsh(np.sum(each, axis=0))[:, 0] > 0).all()),
            f"the noise model '{self.name}' leaves a reading without noise in some direction: its "
            "components add up to a singular matrix",
        )
        return Structure(readings, found, enumerate(each))


def _axes(size: int) -> Array:
    """E_a (size, size, size), 1 at a, a and 0 elsewhere."""
    return np.eye(size)[:, :, None] * np.eye(size)[:, None, :]


class Independent(NoiseModel):
    """One variance for positions, and one for rotations."""

    name, words = "independent", "equal noise"
    description = "one variance for all readings"

    def structure(self, readings: Readings, names: Sequence[str] = ()) -> Structure:
        own = ("distance",) if readings.size == 1 else ("position", "rotation")
        which = np.arange(readings.size) // 3
        parts = [np.diag(1.0 * (which == k)) for k in range(which[-1] + 1)]
        return Structure(readings, own[: len(parts)], enumerate(parts))


class ByAxis(NoiseModel):
    """One variance for each component of a reading."""

    name, description, words = "axis", "one variance per axis", "one size per axis"

    def supports(self, readings: Readings) -> bool:
        return 1 < readings.size <= readings.spare

    def structure(self, readings: Readings, names: Sequence[str] = ()) -> Structure:
        own = ("x", "y", "z", "rx", "ry", "rz") if readings.size > 1 else ("distance",)
        return Structure(readings, own[: readings.size], enumerate(_axes(readings.size)))


class ByMarker(NoiseModel):
    name, description, words = "marker", "one variance per marker", "one size per marker"

    def supports(self, readings: Readings) -> bool:
        return readings.size == 3 and 1 < len(np.unique(readings.marker)) <= readings.spare

    def structure(self, readings: Readings, names: Sequence[str] = ()) -> Structure:
        require(readings.size == 3, "variances per marker are for positions and deflections")
        labels, number = np.unique(readings.marker, return_inverse=True)
        return Structure(readings, [f"marker {m}" for m in labels], [(number.ravel(), np.eye(3))])


class ByGroup(NoiseModel):
    """One variance for each configuration (under each load) in each direction.

    The group of Klimchik et al. 2013, section 4: its markers and repeats share one σ.
    """

    name, shrunk = "groups", True
    description = "a variance per configuration and direction, shrunk towards the others"
    words = "one size per configuration and direction"

    def supports(self, readings: Readings) -> bool:
        groups = int(numbered(readings.configuration, readings.load).max(initial=-1)) + 1
        left = len(readings) - readings.n_parameters / readings.size
        return 3 <= groups <= MOST_GROUPS and 3 * groups <= left

    def structure(self, readings: Readings, names: Sequence[str] = ()) -> Structure:
        size = readings.size
        key = np.column_stack([readings.configuration, readings.load])
        groups, number = np.unique(key, axis=0, return_inverse=True)
        own = [
            f"configuration {c}, load {load}, component {a}"
            for c, load in groups for a in range(size)
        ]  # fmt: skip
        terms = [(size * number.ravel() + a, E) for a, E in enumerate(_axes(size))]
        return Structure(readings, own, terms)


MOST_GROUPS = 1000  # configurations: their information matrix has (3 · 1000)² entries


class Polar(NoiseModel):
    """Variances along the line of sight, across it, and across it growing with the distance.

    Σ = θ_r u uᵀ + (θ_t + θ_a d²)(I − u uᵀ) with u the line of sight and d its length in m: range
    noise, transverse noise of the target, angular noise of the tracker.  θ_a is there where the
    distances differ enough to tell it from θ_t.
    """

    name, description = "polar", "range and transverse variances of the tracker"
    words = "range and transverse sizes of the tracker"

    def supports(self, readings: Readings) -> bool:
        return readings.size == 3 and readings.sight is not None and readings.spare >= 3

    def structure(self, readings: Readings, names: Sequence[str] = ()) -> Structure:
        require(
            readings.sight is not None and readings.size == 3,
            "polar noise needs positions and the tracker's position",
        )
        u, d = np.asarray(readings.sight)[:, 0, :], np.asarray(readings.reach)
        along = u[:, :, None] * u[:, None, :]
        own = {"range": along, "transverse": np.eye(3) - along}
        if "angular" in names if names else np.ptp(d) > 0.2 * d.mean():
            own["angular"] = own["transverse"] * d[:, None, None] ** 2
        return Structure(readings, own, enumerate(own.values()))


class AsStated(NoiseModel):
    """The stated noise times one factor, which the residuals tell."""

    name, description = "stated", "the stated noise times one factor"
    words = "stated noise × factor"

    def supports(self, readings: Readings) -> bool:
        # What is one number for all readings is nothing else than equal noise.
        S, size = readings.stated, readings.size
        return S is not None and not (
            size <= 3 and np.allclose(S, S[0, 0, 0] * np.eye(size), rtol=1e-9, atol=0)
        )

    def structure(self, readings: Readings, names: Sequence[str] = ()) -> Structure:
        require(readings.stated is not None, "no noise is stated that could be used")
        return Structure(readings, ["factor"], [(0, np.asarray(readings.stated))])


STRUCTURES: dict[str, NoiseModel] = {
    model.name: model
    for model in (Independent(), ByAxis(), ByMarker(), ByGroup(), Polar(), AsStated())
}
# Names of the variances whose square roots are in rad, where not of a joint or a rotation.
TURNED = ("rx", "ry", "rz", "rotation", "angular")


def register(model: NoiseModel) -> None:
    """Add a noise model to STRUCTURES; the same class takes the place of its former self.
    InputError where it is none, says too little, or has the name of another one."""
    check_registered(model, NoiseModel, "a noise model", "by_day")
    kind, name, text = type(model), model.name, getattr(model, "description", None)
    require(isinstance(text, str) and bool(text), f"{kind.__name__}.description takes a short text")
    require(kind.components is not NoiseModel.components, f"{kind.__name__} lacks components")
    known = STRUCTURES.get(name)
    require(
        name != "auto" and (known is None or same_class(known, model)),
        f"there is a noise model '{name}' already; choose another name",
    )
    STRUCTURES[name] = model


# What readings have in common besides.


@dataclass(frozen=True)
class Deviation:
    """A deviation common to all readings of one `unit` (N, m), −1 for none: covariance τ² Σ ℓ ℓᵀ of
    those that share it, with the loadings ℓ of each reading on its units, `loading` (N, m, size,
    r).

    A joint that settles elsewhere at each visit is the deviation of a visit with ℓ = ∂(reading)/∂q
    of the `joints`.  What all readings have in common, as a drift, are loadings on coefficients of
    the same variance besides, the `waves` (N, size, k).  `part` names what it is one of; τ is in
    rad where it `turns`, else in m.
    """

    part: str
    name: str
    unit: IntArray
    loading: Array
    joints: tuple[int, ...] = ()
    waves: Array | None = None
    turns: bool = False

    def columns(self) -> sparse.csr_array:
        """Z (N·size, units·r) of the loadings: the covariance of all is τ² Z Zᵀ."""
        n, m, size, r = self.loading.shape
        units, unit = np.unique(self.unit, return_inverse=True)
        column = unit.reshape(n, m, 1, 1) * r + np.arange(r)
        row = np.arange(n)[:, None, None, None] * size + np.arange(size)[:, None]
        row, column = np.broadcast_arrays(row, column)
        value = np.where(self.unit[:, :, None, None] >= 0, self.loading, 0.0)
        place = (value.ravel(), (row.ravel(), column.ravel()))
        Z = sparse.csr_array(place, shape=(n * size, len(units) * r))
        Z.eliminate_zeros()
        return Z

    def mean_square(self, components: int) -> float:
        """What τ = 1 adds to the variance of a reading's first components together, at the mean."""
        own = self.loading[:, :, :components] * (self.unit >= 0)[:, :, None, None]
        waves = 0.0 if self.waves is None else (self.waves[:, :components] ** 2).sum()
        return float((own**2).sum() + waves) / len(self.unit)

    def packed(self, members: IntArray) -> Array:
        """Loadings (C, M·size, units·r) of the readings `members` (C, M), −1 for none, on the units
        of each cluster."""
        here = members >= 0
        unit = np.where(here[..., None], self.unit[members], -1)
        loading = np.where((unit >= 0)[..., None, None], self.loading[members], 0.0)
        C, M, m, size, _ = loading.shape
        local = ranked_within(unit.reshape(C, -1)).reshape(C, M, m)
        mine = local[..., None] == np.arange(max(int(local.max(initial=0)) + 1, 1))
        return np.einsum("cmku,cmksr->cmsur", mine, loading).reshape(C, M * size, -1)


def ranked_within(codes: IntArray) -> IntArray:
    """The place of each code among the different ones of its row (C, n); −1 where it is below 0."""
    order = np.argsort(codes, axis=1, kind="stable")
    ordered = np.take_along_axis(codes, order, axis=1)
    new = np.concatenate([ordered[:, :1] >= 0, np.diff(ordered, axis=1) > 0], axis=1)
    out = np.empty_like(codes)
    np.put_along_axis(out, order, np.cumsum(new, axis=1) - 1, axis=1)
    return np.where(codes < 0, -1, out)


PARTITIONS: tuple[tuple[str, ...], ...] = (
    ("configuration",), ("configuration", "load"), ("configuration", "marker"),
    ("configuration", "load", "marker"),
)  # fmt: skip


def of_configurations(readings: Readings, every: bool) -> Iterator[Deviation]:
    """Deviations that these readings can tell apart; or `every` one that there may be.  An arm does
    not come back to quite the same place: a deviation per configuration; per configuration and
    load; per configuration and marker; and per set, common to its repeats. One is left out where it
    would coincide with another or with the noise of single readings."""
    kept: dict[tuple[str, ...], IntArray] = {}
    for by in PARTITIONS:
        unit = numbered(*(getattr(readings, label) for label in by))
        # Alone in its unit, a reading's own noise covers it.
        same = any(np.array_equal(unit, other) for other in kept.values())
        if every or ((np.bincount(unit) > 1).any() and not same):
            kept[by] = unit
    size = readings.size
    for k, kind in enumerate(("", " (rotation)")[: max(size // 3, 1)]):
        axes = np.eye(size)[:, 3 * k : 3 * k + 3]
        for by, unit in kept.items():
            *first, last = by
            name = f"{EACH_HAS}{', '.join(first)}{' and ' if first else ''}{last}{kind}"
            yield common_to(unit, axes, name, turns=bool(k))


def common_to(unit: IntArray, axes: Array, name: str, turns: bool = False) -> Deviation:
    """A deviation along `axes` (size, r) common to the readings of each `unit` (N,)."""
    loading = np.broadcast_to(axes, (len(unit), 1, *axes.shape))
    return Deviation(CONFIGURATION, name, unit[:, None], loading, turns=turns)


ALIKE = 1e-9  # m per rad: joints that move no reading more than this have no scatter to be seen


def of_joints(readings: Readings, each: bool) -> Iterator[Deviation]:
    """The scatter of the joints from visit to visit: of all that turn and of all that slide, or of
    `each` by itself."""
    record = readings.visits
    assert record is not None
    seen = np.abs(record.motion).max(axis=(0, 1, 2), initial=0.0) > ALIKE
    groups = [("each joint", seen & record.turning), ("each slide", seen & ~record.turning)]
    if each:
        groups = [(f"joint{j + 1}", np.arange(len(seen)) == j) for j in np.flatnonzero(seen)]
    for name, joints in groups:
        if joints.any():
            yield _settling(record, EACH if each else JOINTS, name, np.flatnonzero(joints))


def _settling(record: VisitRecord, part: str, who: str, joints: IntArray) -> Deviation:
    return Deviation(
        part, f"scatter of {who} from visit to visit", record.visit, record.motion[..., joints],
        tuple(joints.tolist()), turns=bool(record.turning[joints[0]]),
    )  # fmt: skip


def _drift(record: VisitRecord, name: str, lasting: float, along: Array) -> Deviation:
    """A course in time of the deviations `along` (size,): its waves, and, common to a visit, what
    they leave of its variance."""
    axes = np.diag(along)[:, along > 0]
    faster = record.faster(lasting)[:, :, None, None] * axes
    waves = record.waves(lasting)[:, None, :, None] * axes[:, None, :]
    waves = waves.reshape(*waves.shape[:2], -1)
    return Deviation(TIME, name, record.visit, faster, waves=waves, turns=not along[:3].any())


CONFIGURATION, JOINTS, EACH, TIME = "configuration", "joints", "each-joint", "time"
DRIFT, EACH_HAS = "drift in time", "common to each "
OF_CONFIGURATION = f"{EACH_HAS}configuration"


SETTLE = "joints that settle anew at each visit"
# What readings may have in common: a clause for the description of a noise that has it, and words
# for a list of models.
PARTS = {
    CONFIGURATION: (", and a deviation {}", "deviations of a configuration"),
    JOINTS: (f", {SETTLE}", SETTLE),
    EACH: (f", {SETTLE}", f"{SETTLE}, each by its own size"),
    TIME: (", and a drift in time", "drift in time"),
}
BY_VISIT = (JOINTS, EACH, TIME)


class Kind(NamedTuple):
    """A noise model: the `own` noise of single readings, and PARTS that they share, in order."""

    own: str
    parts: tuple[str, ...] = ()

    @classmethod
    def parsed(cls, name: str) -> Kind:
        own, *parts = name.split("+")
        return cls(own, tuple(parts))

    @classmethod
    def of(cls, name: str) -> Kind:
        """The same; InputError where there is no such noise model."""
        found = cls.parsed(name)
        known = ("auto", *STRUCTURES, *(f"{own}+{CONFIGURATION}" for own in STRUCTURES))
        alone = found.own + f"+{CONFIGURATION}" * (CONFIGURATION in found.parts)
        fits = found == found.having(*found.parts) and not {JOINTS, EACH} <= {*found.parts}
        if not fits or alone not in known or (found.own == "auto" and found.parts):
            more = ", ".join(f"+{part}" for part in BY_VISIT[:-1])
            raise InputError(
                f"{option('noise')} takes one of {', '.join(known)}, with {more} or "
                f"+{TIME} after it; found {quoted(name)}{did_you_mean(alone, known)}"
            )
        return found

    @property
    def name(self) -> str:
        return "+".join((self.own, *self.parts))

    def having(self, *parts: str) -> Kind:
        return self._replace(parts=tuple(part for part in PARTS if part in parts))

    def with_part(self, part: str) -> Kind:
        return self.having(part, *(p for p in self.parts if not {p, part} <= {JOINTS, EACH}))

    def without(self, part: str) -> Kind:
        return self._replace(parts=tuple(p for p in self.parts if p != part))

    def with_stated(self, noise: Unsteadiness) -> Kind:
        found = self if EACH in self.parts or not noise.joints.any() else self.with_part(JOINTS)
        return found.with_part(TIME) if noise.drift > 0 else found

    @property
    def shrunk(self) -> bool:
        return STRUCTURES[self.own].shrunk

    @property
    def by_visit(self) -> bool:
        return any(part in BY_VISIT for part in self.parts)

    @property
    def words(self) -> str:
        model = STRUCTURES.get(self.own)
        own = self.own if model is None else model.words or model.description
        return " + ".join([own, *(PARTS[part][1] for part in self.parts if part in PARTS)])

    def deviations(
        self, readings: Readings, lasting: float | None, every: bool = False
    ) -> list[Deviation]:
        """What these readings share, where a drift is `lasting` so long; `every` one that there may
        be, or those that the readings tell apart."""
        found: list[Deviation] = []
        for part in self.parts:
            if part == CONFIGURATION:
                found += of_configurations(readings, every)
            elif part == TIME:
                assert readings.visits is not None
                position = np.arange(readings.size) < 3
                for name, along in ((DRIFT, position), (f"{DRIFT} (rotation)", ~position)):
                    if along.any():
                        own = along.astype(float)
                        found.append(_drift(readings.visits, name, lasting or 0.0, own))
            else:
                found += of_joints(readings, part == EACH)
        return found


def stated_deviations(
    model: Model, observed: Observations, x: Array, parts: Sequence[str] = tuple(PARTS)
) -> list[Deviation]:
    """What `[noise]` of the cell says that the readings share, of the `parts` asked for, each with
    τ = 1.  Without times a visit takes as long as the arm stands still, as in a simulation."""
    noise, size, found = model.cell.noise, observed.size, list[Deviation]()
    scatters = JOINTS in parts and bool(noise.joints.any())
    drifts = TIME in parts and noise.drift > 0 and size > 1
    record = visit_record(model, observed, x) if scatters or drifts else None
    if scatters and record is not None:
        settling = _settling(record, JOINTS, "joints", np.arange(model.chain.n_joints))
        scatter = noise.of_joints(model.chain.n_joints)
        found.append(replace(settling, loading=settling.loading * scatter))
    if CONFIGURATION in parts and noise.configuration and observed.kind in ("position", "pose"):
        axes = noise.configuration * np.eye(size)[:, :3]
        found.append(common_to(observed.configuration, axes, OF_CONFIGURATION))
    if drifts and record is not None:
        span = record.span * (1.0 if record.timed else model.cell.design.motion.dwell)
        along = np.where(np.arange(size) < 3, noise.drift, 0.0)
        found.append(_drift(record, DRIFT, noise.lasting / span, along))
    return found
