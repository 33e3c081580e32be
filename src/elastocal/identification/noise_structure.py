"""How the noise of readings may be built: one variance or several, and what readings share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
from scipy import sparse, special

from elastocal.cell.arm_description import Unsteadiness
from elastocal.engine.mixed import Common, Full, NoiseParts, Pack
from elastocal.errors import InputError, option, require
from elastocal.measurements import Measurements, firsts, numbered, visits
from elastocal.model.effects.base import JointMotion
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.plugin_loader import check_registered, same_class
from elastocal.text import did_you_mean, quoted
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
    its time as a share of the campaign's `span` in s; where the table has no times (`timed`), the
    order of the rows stands for them.  `turning` (joints,) says which joints are revolute.  No
    drift of the noise is looked for (`drifts`) where the model itself has what changes with time,
    and, unless the cell states one, where readings follow each other from pose to neighbouring
    pose: they err alike because of what the model lacks, and a drift in its place would leave the
    base as uncertain as it is large.  `lasting`: the correlation times of a drift that may be, as
    shares of the span; the cell's own alone, where it states a drift and the table has times.
    """

    visit: IntArray
    motion: Array
    share: Array
    place: Array
    turning: BoolArray
    timed: bool
    span: float
    drifts: bool = True
    lasting: tuple[float, ...] = LASTING

    def take(self, chosen: BoolArray | IntArray) -> VisitRecord:
        """That of the `chosen` readings."""
        names = ("visit", "motion", "share", "place")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    @cached_property
    def n_visits(self) -> int:
        return len(np.unique(self.visit[self.visit >= 0]))

    @property
    def per_visit(self) -> float:
        """Readings to a visit, at the median.  A single one tells the joints' scatter from its own
        noise by nothing but how both change from pose to pose, as the model's own errors do."""
        return float(np.median(np.unique(self.visit[self.visit >= 0], return_counts=True)[1]))

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
    """The visits of the observations of a fit at x (parameters,); None for an arm that no joint
    moves."""
    table, n = observed.table, len(observed.lead)
    if not model.chain.n_joints:
        return None
    combine = observed.combine
    count = np.diff(combine.indptr)
    m = int(count.max(initial=1))
    place = np.arange(m) < count[:, None]
    row, share = np.zeros((n, m), dtype=np.int64), np.zeros((n, m))
    row[place], share[place] = combine.indices, combine.data
    moved = _joint_motion(model, table, x)[row] * share[:, :, None, None]
    when, span, timed = _when(table)
    turning = np.array([kind != "prismatic" for kind in model.chain.kinds])
    visit = np.where(place, visits(table)[row], -1)
    noise = model.cell.noise
    stated = noise.drift > 0
    drifts = stated or in_random_order(table.take(np.argsort(when, kind="stable")))
    lasting = (noise.lasting / span,) if stated and timed else LASTING
    return VisitRecord(visit, moved, share, when[row], turning, timed, span, drifts, lasting)


SYSTEMATIC = 0.01


def in_random_order(table: Measurements) -> bool:
    """Whether poses that follow each other in the table are no nearer than chance allows at 1 %.

    Σ |q_i+1 − q_i|² / Σ |q_i − q̄|² has the mean 2 and the variance 4 (n − 2)/(n² − 1) for each
    joint (von Neumann 1941), poses that only the load or a repeat tells apart counted once.
    """
    moves = np.abs(np.diff(table.q, axis=0)).max(axis=1, initial=0.0) > 0
    q = table.q[np.concatenate([[True], moves])] if len(table) else table.q
    n, spread = len(q), q.std(axis=0)
    q = q[:, spread > 0] / spread[spread > 0]
    if n < 3 or not q.shape[1]:
        return False
    ratio = (np.diff(q, axis=0) ** 2).sum(axis=0) / n
    deviation = np.sqrt(4 * (n - 2) / (n**2 - 1) / q.shape[1])
    return bool(ratio.mean() - 2 > special.ndtri(SYSTEMATIC) * deviation)


def _joint_motion(model: Model, table: Measurements, x: Array) -> Array:
    """∂(reading)/∂q (rows, size, joints) of the nominal arm, base and markers where x has them."""
    moving = model.moving
    at = dict(zip(model.names, x.tolist(), strict=True))
    here = np.array([at.get(p.name, p.nominal) for p in moving.parameters])
    joints = np.flatnonzero([p.effect == JointMotion.name for p in moving.parameters])
    B = moving.regressor(table, here, joints).B
    return B.reshape(len(table), -1, len(joints))


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


# What readings share because the arm came to them at one visit, or was read at nearby times.

# Residuals and B per reading, with the labels that say what readings have in common.


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

    def take(self, chosen: BoolArray) -> Readings:
        """Only the readings where `chosen` (N,) holds."""
        names = ("B", "e", "configuration", "load", "marker", "sight", "reach", "stated", "lead")
        parts = {name: getattr(self, name) for name in names}
        own = None if self.visits is None else self.visits.take(chosen)
        parts = {k: v[chosen] for k, v in parts.items() if v is not None}
        return replace(self, **parts, visits=own)

    def sample(self, n: int) -> Readings:
        """Those of whole configurations at random, about n of them; all where they are no more."""
        if len(self) <= n:
            return self
        _, code, count = np.unique(self.configuration, return_inverse=True, return_counts=True)
        order = np.random.default_rng(0).permutation(len(count))
        return self.take(np.isin(code, order[: np.searchsorted(np.cumsum(count[order]), n) + 1]))

    def moved(self, e: Array) -> Readings:
        """The same readings with other residuals (N, size)."""
        return replace(self, e=e)


# How the noise of a single reading may be built: one variance, or several.
#
# Besides the built-in structures there are those that a `NoiseModel` of the user's own describes.


@dataclass(frozen=True)
class Structure:
    """Covariance of reading i alone: Σ_l θ[index[i, l]] · matrix[i, l].

    `index` (N, L) into the `names` of the variances θ, in m² (rad²); `matrix` (N, L, size, size).
    `shrunk` says that the variances are many and share a prior.
    """

    name: str
    description: str
    names: tuple[str, ...]
    index: IntArray
    matrix: Array
    shrunk: bool = False

    def covariance(self, theta: Array) -> Array:
        """Of each reading (N, size, size)."""
        return np.einsum("nl,nlij->nij", theta[self.index], self.matrix)


def _alike(
    name: str, text: str, names: Sequence[str], n: int, index: IntArray, matrix: Array,
    shrunk: bool = False,
) -> Structure:  # fmt: skip
    """`index` (N, L), or (L,) the same for all readings; `matrix` likewise."""
    index = np.broadcast_to(index, (n, index.shape[-1]))
    matrix = np.broadcast_to(matrix, (n, *matrix.shape[-3:]))
    return Structure(name, text, tuple(names), index, matrix, shrunk)


def _axes(size: int) -> Array:
    return np.eye(size)[:, :, None] * np.eye(size)[:, None, :]


def independent(readings: Readings) -> Structure:
    """One variance for all readings (positions, and one for rotations)."""
    size = readings.size
    names = ("position", "rotation")[: max(size // 3, 1)] if size > 1 else ("distance",)
    parts = np.array([_axes(size)[3 * k : 3 * k + 3].sum(axis=0) for k in range(len(names))])
    return _alike(
        "independent", "one variance for all readings", names, len(readings),
        np.arange(len(names)), parts,
    )  # fmt: skip


def by_axis(readings: Readings) -> Structure:
    """One variance for each component of a reading."""
    size = readings.size
    names = ("x", "y", "z", "rx", "ry", "rz")[:size] if size > 1 else ("distance",)
    return _alike(
        "axis", "one variance per axis", names, len(readings), np.arange(size), _axes(size)
    )


def by_marker(readings: Readings) -> Structure:
    """One variance for each marker."""
    require(readings.size == 3, "variances per marker are for positions and deflections")
    labels, index = np.unique(readings.marker, return_inverse=True)
    names = [f"marker {m}" for m in labels]
    return _alike(
        "marker", "one variance per marker", names, len(readings), index.reshape(-1, 1),
        np.eye(3)[None],
    )  # fmt: skip


def by_group(readings: Readings) -> Structure:
    """One variance for each configuration (under each load) in each direction.

    The group of Klimchik et al. 2013, section 4: its markers and repeats share one σ.
    """
    size = readings.size
    key = np.column_stack([readings.configuration, readings.load])
    groups, number = np.unique(key, axis=0, return_inverse=True)
    names = [
        f"configuration {c}, load {load}, component {a}" for c, load in groups for a in range(size)
    ]
    text = "a variance per configuration and direction, shrunk towards the others"
    index = number.ravel()[:, None] * size + np.arange(size)
    return _alike("groups", text, names, len(readings), index, _axes(size), shrunk=True)


def polar(readings: Readings, angular: bool | None = None) -> Structure:
    """Variances along the line of sight, across it, and across it growing with the distance.

    Σ = θ_r u uᵀ + (θ_t + θ_a d²)(I − u uᵀ) with u the line of sight and d its length in m: range
    noise, transverse noise of the target, angular noise of the tracker.  `angular` says whether
    θ_a is there; by default where the distances differ enough to tell it from θ_t.
    """
    require(
        readings.sight is not None and readings.size == 3,
        "polar noise needs positions and the tracker's position",
    )
    u, d = np.asarray(readings.sight)[:, 0, :], np.asarray(readings.reach)
    along = u[:, :, None] * u[:, None, :]
    parts, names = [along, np.eye(3) - along], ["range", "transverse"]
    if angular if angular is not None else np.ptp(d) > 0.2 * d.mean():
        parts.append(parts[1] * d[:, None, None] ** 2)
        names.append("angular")
    text = "range and transverse variances of the tracker"
    return _alike(
        "polar", text, names, len(readings), np.arange(len(names)), np.stack(parts, axis=1)
    )


def as_stated(readings: Readings) -> Structure:
    """The stated noise times one factor, which the residuals tell."""
    require(readings.stated is not None, "no noise is stated that could be used")
    matrix = np.asarray(readings.stated)[:, None]
    text = "the stated noise times one factor"
    return _alike("stated", text, ("factor",), len(readings), np.zeros(1, np.int64), matrix)


STRUCTURES: dict[str, Callable[[Readings], Structure]] = {
    "independent": independent,
    "axis": by_axis,
    "marker": by_marker,
    "groups": by_group,
    "polar": polar,
    "stated": as_stated,
}


def like(structure: Structure, readings: Readings) -> Structure:
    """The same noise of these `readings`, be they those that it is of or others; their variances
    are numbered as they come."""
    if structure.name == "polar":
        return polar(readings, "angular" in structure.names)
    return STRUCTURES[structure.name](readings)


SHARED = "+configuration"
JOINTS, EACH, TIME = "+joints", "+each-joint", "+time"


class NoiseModel:
    """A noise model of one's own: the variances that the noise of a reading is made of.

    The covariance of reading i is Σ_l θ_l S_l,i with unknown variances θ_l ≥ 0, which restricted
    likelihood finds, and what `components` says of S_l.  It is tried with and without deviations
    that the readings of a configuration share, and taken where the information criterion is smaller
    than those of the built-in models.
    """

    name: ClassVar[str]
    description: ClassVar[str]

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

    def structure(self, readings: Readings) -> Structure:
        """The model for the likelihood; InputError where `components` are not as they should be."""
        found = self.components(readings)
        require(bool(found), f"the noise model '{self.name}' has no components")
        matrix = np.stack([self._matrices(name, S, readings) for name, S in found.items()], axis=1)
        smallest = np.linalg.eigvalsh(matrix.sum(axis=1))[:, 0]
        require(
            bool((smallest > 0).all()),
            f"the noise model '{self.name}' leaves a reading without noise in some direction: its "
            "components add up to a singular matrix",
        )
        n, names = len(readings), tuple(found)
        return _alike(self.name, self.description, names, n, np.arange(len(names)), matrix)

    def _matrices(self, name: str, S: Array, readings: Readings) -> Array:
        """S (N, size, size) of one component, checked."""
        n, size = len(readings), readings.size
        S = np.asarray(S, dtype=np.float64)
        where = f"component '{name}' of the noise model '{self.name}'"
        require(
            S.shape in ((n,), (n, size, size)),
            f"{where} is {S.shape}; a number per reading, ({n},), or a matrix, "
            f"({n}, {size}, {size}), is needed",
        )
        require(bool(np.isfinite(S).all()), f"{where} is not finite")
        full = S[:, None, None] * np.eye(size) if S.ndim == 1 else S
        require(np.allclose(full, full.transpose(0, 2, 1)), f"{where} is not symmetric")
        smallest, largest = np.linalg.eigvalsh(full)[:, [0, -1]].T
        require(
            bool((smallest >= -1e-9 * largest).all()),
            f"{where} has a negative variance in some direction",
        )
        return full


REGISTERED: dict[str, NoiseModel] = {}


def register(model: NoiseModel) -> None:
    """Add a noise model to STRUCTURES.

    Raises InputError where it is none, says too little, or has the name of another one; the same
    class takes the place of its former self.
    """
    check_registered(model, NoiseModel, "a noise model", "by_day")
    kind, name, text = type(model), model.name, getattr(model, "description", None)
    require(isinstance(text, str) and bool(text), f"{kind.__name__}.description takes a short text")
    require(kind.components is not NoiseModel.components, f"{kind.__name__} lacks components")
    known = REGISTERED.get(name)
    require(
        (known is not None and same_class(known, model)) or name not in (*STRUCTURES, "auto"),
        f"there is a noise model '{name}' already; choose another name",
    )
    REGISTERED[name] = model
    STRUCTURES[name] = model.structure


def noise_models() -> tuple[str, ...]:
    """Every name that `noise` takes: auto, the structures, and those with shared deviations.

    Those but auto may have the scatter of the joints (JOINTS or EACH) and a course in TIME added.
    """
    return ("auto", *STRUCTURES, *(name + SHARED for name in STRUCTURES))


class Kind(NamedTuple):
    """A noise model by its parts: a structure, deviations of a configuration, scatter of the joints
    at each visit (JOINTS, EACH or none), a course in time."""

    own: str
    shared: bool = False
    joints: str = ""
    time: bool = False

    @classmethod
    def parsed(cls, name: str) -> Kind:
        """The parts that a name has, as "axis+configuration+joints+time", known or not."""
        rest, time = name.removesuffix(TIME), name.endswith(TIME)
        joints = next((part for part in (EACH, JOINTS) if rest.endswith(part)), "")
        rest = rest.removesuffix(joints)
        return cls(rest.removesuffix(SHARED), rest.endswith(SHARED), joints, time)

    @classmethod
    def of(cls, name: str) -> Kind:
        """The same; InputError where there is no such noise model."""
        found = cls.parsed(name)
        rest = found.own + SHARED * found.shared
        if rest not in noise_models() or (rest == "auto" and rest != name):
            raise InputError(
                f"{option('noise')} takes one of {', '.join(noise_models())}, with {JOINTS}, "
                f"{EACH} or {TIME} after it; found {quoted(name)}"
                f"{did_you_mean(rest, noise_models())}"
            )
        return found

    @property
    def name(self) -> str:
        return self.own + SHARED * self.shared + self.joints + TIME * self.time

    def with_stated(self, noise: Unsteadiness) -> Kind:
        """With what `[noise]` of a cell states of visits."""
        joints = self.joints or JOINTS * bool(noise.joints.any())
        return self._replace(joints=joints, time=self.time or noise.drift > 0)

    @property
    def by_visit(self) -> bool:
        """Whether it matters at which visit a reading was made."""
        return bool(self.joints) or self.time


def check_supported(kind: str, readings: Readings) -> None:
    """Raise InputError where a noise model of a plug-in lacks something in these readings."""
    own = Kind.parsed(kind).own
    require(
        own not in REGISTERED or REGISTERED[own].supports(readings),
        f"{option('noise', kind)}: this table does not support the noise model '{own}'; add the "
        "columns that it needs, or take another one",
    )


# What readings have in common besides the model.

PARTITIONS = (
    ("configuration",),
    ("configuration", "load"),
    ("configuration", "marker"),
    ("configuration", "load", "marker"),
)


@dataclass(frozen=True)
class SharedEffect:
    """A deviation common to all readings of one `unit` (N, m): covariance τ² Σ ℓ ℓᵀ of those that
    share it, with the loadings ℓ of each reading on its units, `loading` (N, m, size, r).

    Readings are of one unit where they agree in the labels `by`; at an unit of −1 there is nothing.
    A joint that settles elsewhere at each visit is the deviation of a visit with ℓ = ∂(reading)/∂q
    of the `joints`; what is left of a course in time, one along the axes.
    """

    name: str
    by: tuple[str, ...]
    unit: IntArray
    loading: Array
    joints: tuple[int, ...] = ()

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


def shared_effects(readings: Readings, every: bool = False) -> tuple[SharedEffect, ...]:
    """The shared effects that these readings can tell apart; or `every` one that there may be.

    An arm does not come back to quite the same place: a deviation per configuration; per
    configuration and load; per configuration and marker; and per set, common to its repeats.
    One is left out where it would coincide with another or with the noise of single readings.
    Rotations, in rad, have variances of their own.
    """
    kept: dict[tuple[str, ...], IntArray] = {}
    by: tuple[str, ...]
    for by in PARTITIONS:
        unit = numbered(*(getattr(readings, label) for label in by))
        # Alone in its unit, a reading's own noise covers it.
        told = (np.bincount(unit) > 1).any() and not any(
            np.array_equal(unit, other) for other in kept.values()
        )
        if not (told or every):
            continue
        kept[by] = unit
    size, found = readings.size, []
    for k, kind in enumerate(("", " (rotation)")[: max(size // 3, 1)]):
        axes = np.eye(size)[:, 3 * k : 3 * k + 3]
        for by, unit in kept.items():
            name = (" and ".join([", ".join(by[:-1]), by[-1]]) if by[1:] else by[0]) + kind
            loading = np.broadcast_to(axes, (len(readings), 1, *axes.shape))
            found.append(SharedEffect(name, by, unit[:, None], loading))
    return tuple(found)


# Joints that settle anew at each visit, and a base or tracker that drifts.

VISIT = "visit"
ALIKE = 1e-9  # m per rad: joints that move no reading more than this have no scatter to be seen


def joint_effects(record: VisitRecord, each: bool) -> tuple[SharedEffect, ...]:
    """The scatter of the joints from visit to visit, as a diagnosis has it too: a standard
    deviation for each joint, or one for all that turn and one for all that slide."""
    seen = np.abs(record.motion).max(axis=(0, 1, 2), initial=0.0) > ALIKE
    groups: list[tuple[str, tuple[int, ...]]]
    if each:
        groups = [(f"joint{j + 1}", (int(j),)) for j in np.flatnonzero(seen)]
    else:
        both = ("each joint", record.turning), ("each slide", ~record.turning)
        groups = [(name, tuple(np.flatnonzero(seen & kind).tolist())) for name, kind in both]
    return tuple(
        SharedEffect(name, (VISIT,), record.visit, record.motion[..., list(joints)], joints)
        for name, joints in groups
        if joints
    )


DRIFT = "drift in time"


def drifts_of(size: int) -> tuple[tuple[str, Array], ...]:
    """Names and axes (size,) of what drifts apart: positions, and rotations."""
    both = ((DRIFT, np.arange(size) < 3), (f"{DRIFT} (rotation)", np.arange(size) >= 3))
    return tuple((name, axes.astype(float)) for name, axes in both if axes.any())


def faster_course(record: VisitRecord, lasting: float, axes: Array) -> SharedEffect:
    """What of a course in time changes faster than its waves, of deviations `axes` (size,)."""
    loading = record.faster(lasting)[:, :, None, None] * np.diag(axes)[:, axes > 0]
    return SharedEffect(DRIFT, (VISIT,), record.visit, loading)


def along_axes(waves: Array, axes: Array) -> Array:
    """Columns (N, size, k·r) of a course's coefficients, from `waves` (N, k) and its deviations
    `axes` (size,), r of which are not zero."""
    each = waves[:, None, :, None] * np.diag(axes)[:, None, axes > 0]
    return np.asarray(each.reshape(len(waves), len(axes), -1))


# The same as packs of rows.  Of R repeats the mean, times √R, holds all of Δx and of what they
# share; R − 1 contrasts between them hold their own noise alone.  Rows so turned are as good as
# those read: the turn is orthogonal.


class Sets:
    """Readings as sets of repeats: `of` (N,) the set of a reading, `root` (S,) √R, and the rows
    B (S, size, p), e (S, size) of their means times that; `contrasts` (N − S, size) of `sets`."""

    def __init__(self, readings: Readings, B: Array, apart: Sequence[IntArray]) -> None:
        labels = (readings.configuration, readings.load, readings.marker, *apart)
        self.of = numbered(*labels)
        self.n = int(self.of.max(initial=-1)) + 1
        self.first = firsts(self.of, self.n)
        repeats = np.bincount(self.of, minlength=self.n)
        self.root = np.sqrt(repeats)
        self.B = self.mean(B) * self.root[:, None, None]
        self.e = self.mean(readings.e) * self.root[:, None]
        order = np.argsort(self.of, kind="stable")
        starts = np.concatenate([[0], np.cumsum(repeats)])[:-1]
        e, set_of = readings.e[order], self.of[order]
        before = np.cumsum(e, axis=0) - e
        before -= before[starts][set_of]
        j = (np.arange(len(e)) - starts[set_of])[:, None]
        self.contrasts = ((before - j * e) / np.sqrt(np.maximum(j * (j + 1), 1)))[j[:, 0] > 0]
        self.sets = set_of[j[:, 0] > 0]

    def mean(self, values: Array) -> Array:
        """Of each set (S, …) of values (N, …)."""
        if self.n == len(self.of):
            out = np.empty_like(values)
            out[self.of] = values
            return out
        total = np.zeros((self.n, *values.shape[1:]))
        np.add.at(total, self.of, values)
        return total / (self.root**2).reshape(-1, *[1] * (values.ndim - 1))


def packs_of(
    sets: Sets, structure: Structure, shared: Sequence[SharedEffect], numbers: Sequence[int],
    together: IntArray | None, silent: BoolArray | None = None,
) -> list[tuple[IntArray, Pack]]:  # fmt: skip
    """Packs of the sets, and the sets (C, M) that their clusters are of, −1 for none.

    Sets of one label `together` (S,) are a cluster, without labels each by itself; deviations
    `shared` by the readings have the variances of these `numbers`.  Those `silent` (S,) are absent.
    """
    matrix, index = sets.mean(structure.matrix), structure.index[sets.first]
    label = np.arange(sets.n) if together is None else numbered(together)
    count = np.bincount(label)
    order, starts = np.argsort(label, kind="stable"), np.concatenate([[0], np.cumsum(count)])
    scale = sets.root[:, None, None, None]
    turned = [
        replace(e, unit=e.unit[sets.first], loading=e.loading[sets.first] * scale) for e in shared
    ]
    found = []
    # Clusters that differ by less than two in size share a pack.
    for size in np.unique(rank := np.ceil(np.log2(count)).astype(int)):
        of = np.flatnonzero(rank == size)
        place = np.arange(count[of].max())
        members = np.where(
            place < count[of][:, None],
            order[np.minimum(starts[of][:, None] + place, sets.n - 1)], -1,
        )  # fmt: skip
        out = members < 0 if silent is None else (members < 0) | silent[members]
        parts = [_own_parts(index, matrix, members)]
        for k, effect in zip(numbers, turned, strict=True):
            number = np.full((len(members), 1), k)
            parts.append(Common(number, effect.packed(members)[:, None]))
        found.append((members, _pack(sets.B, sets.e, members, parts, out)))
    return found


def contrasts_of(sets: Sets, structure: Structure) -> Pack:
    """The contrasts between repeats, which hold their own noise alone."""
    matrix = sets.mean(structure.matrix)
    own = _own_parts(structure.index[sets.first], matrix, sets.sets[:, None])
    e = sets.contrasts
    return Pack(np.zeros((*e.shape, 0)), e, (own,), np.zeros(e.shape, dtype=bool))


def _pack(B: Array, e: Array, members: IntArray, parts: list[NoiseParts], out: BoolArray) -> Pack:
    (C, M), (size, p) = members.shape, B.shape[1:]
    here = ~out[..., None]
    return Pack(
        np.where(here[..., None], B[members], 0.0).reshape(C, M * size, p),
        np.where(here, e[members], 0.0).reshape(C, M * size),
        tuple(parts), np.repeat(out, size, axis=1),
    )  # fmt: skip


def _own_parts(index: IntArray, matrix: Array, members: IntArray) -> NoiseParts:
    """The parts of single readings: those of the k-th of a cluster's different variances, each."""
    (C, M), (L, size) = members.shape, matrix.shape[1:3]
    here = members >= 0
    own = np.where(here[..., None], index[members], -1)  # (C, M, L)
    blocks = np.where(here[..., None, None, None], matrix[members], 0.0)
    place = ranked_within(own.reshape(C, -1)).reshape(C, M, L)
    numbers = int(place.max()) + 1
    mine = place == np.arange(numbers)[:, None, None, None]  # (k, C, M, L)
    of = np.where(mine, own, 0).max(axis=(2, 3)).T
    block = np.einsum("kcml,cmlij->ckmij", mine, blocks)
    K, at = np.zeros((C, numbers, M, size, M, size)), np.arange(M)
    K[:, :, at, :, at, :] = block.transpose(2, 0, 1, 3, 4)
    return Full(of, K.reshape(C, numbers, M * size, M * size))
