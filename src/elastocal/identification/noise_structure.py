"""How the noise of readings may be built: one variance or several, and what readings share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy import sparse

from elastocal.errors import InputError, option, require
from elastocal.identification.visit_record import VisitRecord
from elastocal.measurements import Measurements, firsts, numbered
from elastocal.plugin_loader import check_registered, same_class
from elastocal.text import did_you_mean, quoted
from elastocal.units import Array, BoolArray, IntArray

# Residuals and B per reading, with the labels that say what readings have in common.


@dataclass(frozen=True)
class Readings:
    """N readings of `size` components, linearised: e = B Δx + noise, shared and per reading.

    `B` (N, size, p); `e` (N, size) in m, and rad from the fourth component on.  Readings of one
    `configuration`, `load` and `marker` (N,) are repeats.  `sight` (N, 3, 3), where the tracker's
    position is known, holds the unit vectors along and across the line of sight as rows and
    `reach` (N,) its length in m; `stated` (N, size, size), where noise is stated, its covariance.
    `lead` (N,) are the readings' rows in the `table`.  `visits` says at which visits of the arm
    they were made; `apart`, that repeats of different visits are no repeats of one reading.
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
    apart: bool = False

    def __post_init__(self) -> None:
        n, size = self.e.shape
        require(
            self.B.shape[:2] == (n, size),
            f"B is {self.B.shape} where {n} readings of {size} components need ({n}, {size}, p)",
        )
        for name in ("configuration", "load", "marker"):
            found = getattr(self, name).shape
            require(found == (n,), f"{name} is {found}; one label per reading, ({n},), is needed")

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

    @cached_property
    def set_of(self) -> IntArray:
        """Number (N,) of the set of repeats that a reading belongs to."""
        labels = [self.configuration, self.load, self.marker]
        if self.apart and self.visits is not None:
            labels.append(self.visits.visit[:, 0])
        return numbered(*labels)

    @cached_property
    def sets(self) -> RepeatSets:
        """Sets of repeats with plain means; every noise model but the stated one uses them."""
        return reduce_repeats(self)

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

    def by_visit(self, apart: bool = True) -> Readings:
        """The same with repeats of different visits `apart`, or all together."""
        return self if apart == self.apart else replace(self, apart=apart)

    def of_columns(self, chosen: BoolArray) -> Readings:
        """Only the columns of B where `chosen` (p,) holds."""
        return replace(self, B=self.B[:, :, chosen])

    def moved(self, e: Array) -> Readings:
        """The same readings with other residuals (N, size)."""
        return replace(self, e=e)


@dataclass(frozen=True)
class RepeatSets:
    """Sets of repeats, reduced without loss: a mean and what scatters about it.

    With the covariance θ S_i of reading i in a set, the weighted mean ȳ = U Σ S_i⁻¹ y_i with
    U = (Σ S_i⁻¹)⁻¹ and the scatter about it are sufficient: ȳ varies by θ U plus whatever all
    repeats share, the scatter by θ alone with (repeats − 1) · size degrees of freedom.  Repeats
    are taken to have one B; where theirs differ a little, the mean stands for all.
    `B` (C, size, p), `e` (C, size), `unit` U (C, size, size), `dof` (C,) repeats − 1, `scatter`
    (C, size, size), `log_offset`: Σ log|S_i| − log|U| over all sets, which the likelihood needs.
    """

    B: Array
    e: Array
    unit: Array
    repeats: IntArray
    dof: Array
    scatter: Array
    log_offset: float
    configuration: IntArray
    load: IntArray
    marker: IntArray
    sight: Array | None
    reach: Array | None
    visits: VisitRecord | None = None

    def __len__(self) -> int:
        return len(self.e)


def reduce_repeats(readings: Readings, stated: bool = False) -> RepeatSets:
    """The sets of repeats; weighted by the stated covariances if `stated`, else plainly."""
    set_of = readings.set_of
    n_sets = int(set_of.max()) + 1
    first = firsts(set_of, n_sets)
    repeats = np.bincount(set_of, minlength=n_sets)
    size = readings.size
    if stated:
        require(readings.stated is not None, "no noise is stated that could be used")
        S = np.asarray(readings.stated)
        P = np.linalg.inv(S)
        unit = np.linalg.inv(_sum(P, set_of, n_sets)).astype(np.float64)
        offset = np.linalg.slogdet(S)[1].sum() - np.linalg.slogdet(unit)[1].sum()
        share = unit[set_of] @ P
        e = _sum((share @ readings.e[:, :, None])[..., 0], set_of, n_sets)
        B = _sum(share @ readings.B, set_of, n_sets)
        deviation = readings.e - e[set_of]
        squares = np.einsum("ni,nij,nj->n", deviation, P, deviation)
        scatter = np.bincount(set_of, squares, n_sets)[:, None, None] * np.eye(size) / size
    else:
        unit = np.eye(size) / repeats[:, None, None]
        offset = size * np.log(repeats).sum()
        e = _sum(readings.e, set_of, n_sets) / repeats[:, None]
        B = _sum(readings.B, set_of, n_sets) / repeats[:, None, None]
        deviation = readings.e - e[set_of]
        scatter = _sum(deviation[:, :, None] * deviation[:, None, :], set_of, n_sets)
    return RepeatSets(
        B, e, unit, repeats, (repeats - 1).astype(float), scatter, float(offset),
        readings.configuration[first], readings.load[first], readings.marker[first],
        None if readings.sight is None else readings.sight[first],
        None if readings.reach is None else readings.reach[first],
        None if readings.visits is None else readings.visits.take(first),
    )  # fmt: skip


def _sum(values: Array, set_of: IntArray, n_sets: int) -> Array:
    total = np.zeros((n_sets, *values.shape[1:]))
    if n_sets == len(set_of):  # no repeats
        total[set_of] += values
    else:
        np.add.at(total, set_of, values)
    return total


# How the noise of a single reading may be built: one variance, or several.
#
# Besides the built-in structures there are those that a `NoiseModel` of the user's own describes.


@dataclass(frozen=True)
class Structure:
    """Covariance of one reading in set c: Σ_l θ[index[c, l]] · matrix[c, l].

    `index` (C, L) into the `names` of the variances θ, in m² (rad²); `matrix` (C, L, size, size)
    for a single reading.  The set's mean has that covariance with `mean_matrix` in its place.
    `shrunk` says that the variances are many and share a prior (see shrinkage).  Where there is a
    course in time, it is `lasting` so long (`with_drift`), its coefficients' sets come last, and
    what changes `faster`, common to a visit, has the variances of the course.
    """

    name: str
    description: str
    names: tuple[str, ...]
    sets: RepeatSets
    index: IntArray
    matrix: Array
    mean_matrix: Array
    shrunk: bool = False
    lasting: float | None = None
    faster: tuple[SharedEffect, ...] = ()

    @property
    def n_own(self) -> int:
        """How many of the variances are those of single readings."""
        return sum(not name.startswith(DRIFT) for name in self.names)


def _plain(
    name: str, text: str, names: Sequence[str], sets: RepeatSets, index: IntArray, matrix: Array
) -> Structure:
    """Where the mean of a set is the plain one; `index` (C, L), or (L,) the same in all sets."""
    index = np.broadcast_to(index, (len(sets), index.shape[-1])).copy()
    matrix = np.broadcast_to(matrix, (len(sets), *matrix.shape[-3:])).copy()
    mean = matrix / sets.repeats[:, None, None, None]
    return Structure(name, text, tuple(names), sets, index, matrix, mean)


def independent(readings: Readings) -> Structure:
    """One variance for all readings (positions, and one for rotations)."""
    size = readings.size
    kinds = [range(3), range(3, 6)] if size == 6 else [range(size)]
    names = ("position", "rotation")[: len(kinds)] if size > 1 else ("distance",)
    parts = np.array([np.diag(np.isin(np.arange(size), kind).astype(float)) for kind in kinds])
    return _plain(
        "independent", "one variance for all readings", names, readings.sets,
        np.arange(len(kinds)), parts,
    )  # fmt: skip


def by_axis(readings: Readings) -> Structure:
    """One variance for each component of a reading."""
    size = readings.size
    names = ("x", "y", "z", "rx", "ry", "rz")[:size] if size > 1 else ("distance",)
    parts = np.eye(size)[:, :, None] * np.eye(size)[:, None, :]
    return _plain("axis", "one variance per axis", names, readings.sets, np.arange(size), parts)


def by_marker(readings: Readings) -> Structure:
    """One variance for each marker."""
    require(readings.size == 3, "variances per marker are for positions and deflections")
    sets = readings.sets
    labels, index = np.unique(sets.marker, return_inverse=True)
    names = [f"marker {m}" for m in labels]
    return _plain(
        "marker", "one variance per marker", names, sets, index.reshape(-1, 1), np.eye(3)[None]
    )


def by_group(readings: Readings) -> Structure:
    """One variance for each configuration (under each load) in each direction.

    The group of Klimchik et al. 2013, section 4: its markers and repeats share one σ.
    """
    sets = readings.sets
    size = readings.size
    key = np.column_stack([sets.configuration, sets.load])
    groups, number = np.unique(key, axis=0, return_inverse=True)
    index = number.ravel()[:, None] * size + np.arange(size)
    parts = np.eye(size)[:, :, None] * np.eye(size)[:, None, :]
    names = [
        f"configuration {c}, load {load}, component {a}" for c, load in groups for a in range(size)
    ]
    text = "a variance per configuration and direction, shrunk towards the others"
    return replace(_plain("groups", text, names, sets, index, parts), shrunk=True)


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
    sets = readings.sets
    u, d = np.asarray(sets.sight)[:, 0, :], np.asarray(sets.reach)
    along = u[:, :, None] * u[:, None, :]
    across = np.eye(3) - along
    matrix = np.stack([along, across], axis=1)
    names: tuple[str, ...] = ("range", "transverse")
    if angular is None:
        angular = bool(np.ptp(d) > 0.2 * d.mean())
    if angular:
        matrix = np.concatenate([matrix, (across * d[:, None, None] ** 2)[:, None]], axis=1)
        names = (*names, "angular")
    text = "range and transverse variances of the tracker"
    return _plain("polar", text, names, sets, np.arange(len(names)), matrix)


def as_stated(readings: Readings) -> Structure:
    """The stated noise times one factor, which the residuals tell."""
    sets = reduce_repeats(readings, stated=True)
    matrix = np.tile(np.eye(readings.size), (len(sets), 1, 1, 1))
    return Structure(
        "stated", "the stated noise times one factor", ("factor",), sets,
        np.zeros((len(sets), 1), dtype=np.int64), matrix, sets.unit[:, None],
    )  # fmt: skip


STRUCTURES: dict[str, Callable[[Readings], Structure]] = {
    "independent": independent,
    "axis": by_axis,
    "marker": by_marker,
    "groups": by_group,
    "polar": polar,
    "stated": as_stated,
}


def of_readings(
    structure: Structure, readings: Readings
) -> tuple[tuple[str, ...], IntArray, Array]:
    """Names, `index` (N, L) and `matrix` (N, L, size, size) of such a structure for each of the
    `readings`, be they those that it is of or others."""
    if structure.name == "stated":  # whatever their sets
        matrix = np.asarray(readings.stated)[:, None]
        return structure.names[:1], np.zeros((len(readings), 1), dtype=np.int64), matrix
    whole = (
        polar(readings, "angular" in structure.names)
        if structure.name == "polar"
        else STRUCTURES[structure.name](readings)
    )
    return whole.names, whole.index[readings.set_of], whole.matrix[readings.set_of]


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
        whole = np.stack([self._matrices(name, S, readings) for name, S in found.items()], axis=1)
        sets, set_of = readings.sets, readings.set_of
        matrix = np.zeros((len(sets), *whole.shape[1:]))
        np.add.at(matrix, set_of, whole)
        matrix /= sets.repeats[:, None, None, None]
        smallest = np.linalg.eigvalsh(matrix.sum(axis=1))[:, 0]
        require(
            bool((smallest > 0).all()),
            f"the noise model '{self.name}' leaves a reading without noise in some direction: its "
            "components add up to a singular matrix",
        )
        return _plain(self.name, self.description, list(found), sets, np.arange(len(found)), matrix)

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

    @property
    def by_visit(self) -> bool:
        """Whether it matters at which visit a reading was made."""
        return bool(self.joints) or self.time


# Random effects: what readings of a configuration have in common besides the model.

PARTITIONS = (
    ("configuration",),
    ("configuration", "load"),
    ("configuration", "marker"),
    ("configuration", "load", "marker"),
)


@dataclass(frozen=True)
class SharedEffect:
    """A deviation common to all sets of one `unit` (C, m): covariance τ² Σ ℓ ℓᵀ of those that share
    it, with the loadings ℓ of each set on its units, `loading` (C, m, size, r).

    Sets are of one unit where they agree in the labels `by`; at an unit of −1 there is nothing.  A
    joint that settles elsewhere at each visit is the deviation of a visit with ℓ = ∂(reading)/∂q of
    the `joints`; what is left of a course so long `lasting`, one along the axes.
    """

    name: str
    by: tuple[str, ...]
    unit: IntArray
    loading: Array
    axes: Array
    joints: tuple[int, ...] = ()
    lasting: float = 0.0

    def of(self, readings: Readings) -> SharedEffect:
        """The same deviation for single readings (N in the place of C)."""
        if self.joints:
            return _of_joints(self.name, readings, self.joints)
        if self.lasting:
            return faster_course(self.name, readings.visits, self.lasting, self.axes)
        return _common(self.name, self.by, readings, self.axes)

    def columns(self) -> sparse.csr_array:
        """Z (C·size, units·r) of the loadings: the covariance of all is τ² Z Zᵀ."""
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

    def padded(self, k: int) -> SharedEffect:
        """The same with k more sets that have no part in it."""
        unit = np.concatenate([self.unit, np.full((k, self.unit.shape[1]), -1)])
        loading = np.concatenate([self.loading, np.zeros((k, *self.loading.shape[1:]))])
        return replace(self, unit=unit, loading=loading)

    def product(self, members: IntArray, other: SharedEffect, others: IntArray) -> Array:
        """Σ ℓ ℓᵀ (G, n, size, k, size) of the sets `members` (G, n) and `others` (G, k)."""
        mine, theirs = self.unit[members], other.unit[others]
        a, b = self.loading[members], other.loading[others]
        (G, n, own, size, r), (k, units) = a.shape, theirs.shape[1:]
        out = np.zeros((G, n, size, k, size))
        # Products of matrices for the one or two units of a set: einsum took twenty times as long.
        for i, j in np.ndindex(own, units):
            unit = mine[:, :, None, i]
            same = (unit == theirs[:, None, :, j]) & (unit >= 0)
            rows = a[:, :, i].reshape(G, n * size, r)
            columns = b[:, :, j].reshape(G, k * size, r)
            each = (rows @ columns.transpose(0, 2, 1)).reshape(out.shape)
            out += np.multiply(each, same[:, :, None, :, None], out=each)
        return out


def _common(
    name: str, by: tuple[str, ...], labelled: RepeatSets | Readings, axes: Array
) -> SharedEffect:
    """Sets or readings that agree in the labels `by` share a deviation of covariance diag(axes)."""
    unit = np.zeros(len(labelled), dtype=np.int64)
    for label in PARTITIONS[-1]:
        unit = unit * LABELS + (getattr(labelled, label) + 1 if label in by else 0)
    loading = np.diag(np.sqrt(axes))[:, axes > 0]
    return SharedEffect(name, by, unit[:, None], np.tile(loading, (len(labelled), 1, 1, 1)), axes)


LABELS = 2**20  # that a table may have of each kind, so that three of them make one number


def shared_effects(sets: RepeatSets, size: int, wanted: bool = True) -> tuple[SharedEffect, ...]:
    """The shared effects that these readings can tell apart.

    An arm does not come back to quite the same place: a deviation per configuration; per
    configuration and load; per configuration and marker; and per set, common to its repeats.
    One is left out where it would coincide with another or with the noise of single readings.
    Rotations, in rad, have variances of their own.
    """
    if not wanted:
        return ()
    kept: dict[tuple[str, ...], IntArray] = {}
    for by in PARTITIONS:
        unit = numbered(*(getattr(sets, label) for label in by))
        # Alone in its unit and not repeated, a reading's own noise covers it.
        observed = np.bincount(unit, sets.repeats)
        if (observed < 2).all() or any(np.array_equal(unit, other) for other in kept.values()):
            continue
        kept[by] = unit
    position = np.where(np.arange(size) < 3, 1.0, 0.0)
    names = {by: " and ".join([", ".join(by[:-1]), by[-1]] if by[1:] else by) for by in kept}
    found = [_common(names[by], by, sets, position) for by in kept]
    if size == 6:
        found += [_common(f"{names[by]} (rotation)", by, sets, 1.0 - position) for by in kept]
    return tuple(found)


# Joints that settle anew at each visit, and a base or tracker that drifts.

VISIT = "visit"
ALIKE = 1e-9  # m per rad: joints that move no reading more than this have no scatter to be seen


def joint_effects(sets: RepeatSets, each: bool) -> tuple[SharedEffect, ...]:
    """The scatter of the joints from visit to visit, as a diagnosis has it too: a standard
    deviation for each joint, or one for all that turn and one for all that slide."""
    record = sets.visits
    if record is None:
        return ()
    seen = np.abs(record.motion).max(axis=(0, 1, 2), initial=0.0) > ALIKE
    groups: list[tuple[str, tuple[int, ...]]]
    if each:
        groups = [(f"joint{j + 1}", (int(j),)) for j in np.flatnonzero(seen)]
    else:
        both = ("each joint", record.turning), ("each slide", ~record.turning)
        groups = [(name, tuple(np.flatnonzero(seen & kind).tolist())) for name, kind in both]
    return tuple(_of_joints(name, sets, joints) for name, joints in groups if joints)


def _of_joints(name: str, labelled: RepeatSets | Readings, joints: tuple[int, ...]) -> SharedEffect:
    record = labelled.visits
    assert record is not None
    loading = record.motion[..., list(joints)]
    return SharedEffect(name, (VISIT,), record.visit, loading, np.zeros(0), joints)


DRIFT = "drift in time"


def faster_course(
    name: str, record: VisitRecord | None, lasting: float, axes: Array
) -> SharedEffect:
    """What of a course in time changes faster than its waves, of deviations `axes` (size,)."""
    assert record is not None
    loading = record.faster(lasting)[:, :, None, None] * np.diag(axes)[:, axes > 0]
    return SharedEffect(name, (VISIT,), record.visit, loading, axes, lasting=lasting)


def with_drift(structure: Structure, lasting: float) -> Structure:
    """The structure with a course in time common to all readings, of unknown variance.

    The course's coefficients (`VisitRecord.waves`) are columns of
    B, along x, y and z (and of rotations), which readings of zero with the unknown variance hold:
    restricted likelihood is then the same as that of the course taken for noise (Henderson 1975),
    and nothing that is as large as the table squared is formed.  What changes faster than these
    waves is a deviation of each visit.
    """
    sets = structure.sets
    assert sets.visits is not None
    waves = sets.visits.waves(lasting)
    (C, size, p), k = sets.B.shape, waves.shape[1]
    kinds = [np.arange(3), np.arange(3, 6)] if size == 6 else [np.arange(size)]
    names = (DRIFT, f"{DRIFT} (rotation)")[: len(kinds)]
    more = along_axes(waves, np.ones(size))
    held = np.concatenate([np.zeros((k, size, p)), np.eye(k * size).reshape(k, size, -1)], axis=2)
    none = np.zeros((k, size, size))

    def tailed(values: Any, tail: Any) -> Any:
        return np.concatenate([values, tail])

    # A new configuration for each, so that it is correlated with nothing.
    fresh = int(sets.configuration.max()) + 1 + np.arange(k)
    zero = np.zeros(k, dtype=np.int64)
    grown = replace(
        sets, B=tailed(np.concatenate([sets.B, more], axis=2), held),
        e=tailed(sets.e, np.zeros((k, size))), unit=tailed(sets.unit, none + np.eye(size)),
        repeats=tailed(sets.repeats, zero + 1), dof=tailed(sets.dof, np.zeros(k)),
        scatter=tailed(sets.scatter, none), configuration=tailed(sets.configuration, fresh),
        load=tailed(sets.load, zero), marker=tailed(sets.marker, zero), sight=None, reach=None,
        visits=None,
    )  # fmt: skip
    L, K = max(structure.index.shape[1], len(kinds)), len(structure.names)
    index = np.zeros((C + k, L), dtype=np.int64)
    index[:C, : structure.index.shape[1]] = structure.index
    index[C:, : len(kinds)] = K + np.arange(len(kinds))
    along = [np.isin(np.arange(size), kind).astype(float) for kind in kinds]
    parts = np.array([np.diag(axes) for axes in along])
    faster = [
        faster_course(name, sets.visits, lasting, axes).padded(k)
        for name, axes in zip(names, along, strict=True)
    ]

    def padded(matrix: Array) -> Array:
        out = np.zeros((C + k, L, size, size))
        out[:C, : matrix.shape[1]] = matrix
        out[C:, : len(kinds)] = parts
        return out

    return replace(
        structure, names=(*structure.names, *names), sets=grown, index=index,
        matrix=padded(structure.matrix), mean_matrix=padded(structure.mean_matrix),
        lasting=lasting, faster=tuple(faster),
    )  # fmt: skip


def along_axes(waves: Array, axes: Array) -> Array:
    """Columns (N, size, k·r) of a course's coefficients, from `waves` (N, k) and its deviations
    `axes` (size,), r of which are not zero."""
    each = waves[:, None, :, None] * np.diag(axes)[:, None, axes > 0]
    return np.asarray(each.reshape(len(waves), len(axes), -1))
