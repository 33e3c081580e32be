"""What is known of the parameters besides the readings: constraints, physics, priors, a file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
import scipy
from pydantic import Field
from scipy import linalg

from elastocal.config import (
    AnyFloat,
    Key,
    Many,
    Positive,
    Record,
    Spot,
    Table,
    Text,
    checked,
    key,
    keyed,
    read_toml,
)
from elastocal.engine import least_norm
from elastocal.messages import (
    InputError,
    InsufficientDataError,
    check_known,
    listed,
    option,
    quoted,
    require,
    said_of,
)
from elastocal.model.manipulator import Model
from elastocal.units import Array, IntArray

# Constraints as numbers: bounds, linear equalities and matrix inequalities on a vector.

# A constraint may be missed by this fraction of the numbers in it: round-off only.
ROUND_OFF = 1e-12


@dataclass(frozen=True)
class Matrix:
    """M(x) = constant + Σ x_i slopes_i ⪰ 0; constant (n, n), slopes (p, n, n), all symmetric.
    `balance` (n,) is d where the matrix stands for diag(d) M diag(d): a congruence changes no sign
    of an eigenvalue, and brings rows of different units to one size."""

    label: str
    constant: Array
    slopes: Array
    balance: Array

    def at(self, x: Array) -> Array:
        return self.constant + np.tensordot(x, self.slopes, axes=1)

    def moved(self, centre: Array, unit: Array) -> Matrix:
        """M of z, where x = centre + unit · z, with diagonal entries that change by about 1 per
        unit of z."""
        constant, slopes = self.at(centre), self.slopes * unit[:, None, None]
        largest = np.abs(np.diagonal(slopes, axis1=1, axis2=2)).max(axis=0, initial=0.0)
        d = 1 / np.sqrt(np.where(largest > 0, largest, 1.0))
        both = np.outer(d, d)
        return Matrix(self.label, constant * both, slopes * both, self.balance * d)


@dataclass(frozen=True)
class System:
    """lower ≤ x ≤ upper, A x = b, and every matrix ⪰ 0, for x (p,) with `names`."""

    names: tuple[str, ...]
    lower: Array
    upper: Array
    A: Array
    b: Array
    equality_labels: tuple[str, ...]
    matrices: tuple[Matrix, ...]

    def moved(self, centre: Array, unit: Array) -> System:
        """The same constraints on z, where x = centre + unit · z (unit positive)."""
        return replace(
            self, lower=(self.lower - centre) / unit, upper=(self.upper - centre) / unit,
            A=self.A * unit, b=self.b - self.A @ centre,
            matrices=tuple(m.moved(centre, unit) for m in self.matrices),
        )  # fmt: skip

    def restricted(self, columns: IntArray, x: Array) -> System:
        """The constraints on x[columns], all other parameters held at x (p,); InputError where the
        held values alone break one."""
        rest = x.astype(float)
        rest[columns] = 0.0
        held = np.ones(len(x), dtype=bool)
        held[columns] = False
        slack = ROUND_OFF * np.abs(x)
        for c in np.flatnonzero(held & ((x < self.lower - slack) | (x > self.upper + slack))):
            raise InputError(
                f"{self.names[c]} is held at {x[c]:.6g}, outside its bounds "
                f"[{self.lower[c]:.6g}, {self.upper[c]:.6g}]; free it, move it or widen them"
            )
        b, size = self.b - self.A @ rest, np.abs(self.A) @ np.abs(rest) + np.abs(self.b)
        free = (self.A[:, columns] != 0).any(axis=1)
        for k in np.flatnonzero(~free & (np.abs(b) > ROUND_OFF * size)):
            raise InputError(
                f"'{self.equality_labels[k]}' does not hold ({b[k]:+.3g} is missing), and every "
                "parameter in it is held; free one of them or drop the equality"
            )
        matrices = []
        for m in self.matrices:
            constant, slopes = m.at(rest), m.slopes[columns]
            if slopes.any():
                matrices.append(replace(m, constant=constant, slopes=slopes))
            elif -np.linalg.eigvalsh(constant)[0] > ROUND_OFF * np.abs(constant).max(initial=0.0):
                raise InputError(
                    f"'{m.label}' is not positive semidefinite, and every parameter in it is held; "
                    "free one of them or drop the matrix"
                )
        return System(
            tuple(self.names[c] for c in columns), self.lower[columns], self.upper[columns],
            self.A[np.ix_(free, columns)], b[free],
            tuple(s for s, keep in zip(self.equality_labels, free, strict=True) if keep),
            tuple(matrices),
        )  # fmt: skip


# Constraints as people state them: by the names of parameters.

# An entry of a matrix: a parameter, a linear combination of parameters, or a number.
Entry = str | float | Mapping[str, float]
NUMBER = "a finite number in SI units"
FACTORS = (
    "factors by parameter, with names in quotes, as in "
    '{ "joint2.compliance" = 1.0, "joint3.compliance" = -1.0 }'
)


class Bounds(Record):
    """lower ≤ x ≤ upper for one parameter, in its unit; equal bounds fix it."""

    name: str = keyed(
        "parameter", takes='the name of a parameter, as in "joint2.compliance"', form=Text
    )
    lower: AnyFloat = keyed(takes=f"{NUMBER}; without one, none", form=float, default=-math.inf)
    upper: AnyFloat = keyed(takes=f"{NUMBER}; without one, none", form=float, default=math.inf)

    @classmethod
    def from_keys(cls, table: Mapping[str, Any], spot: Spot) -> dict[str, float]:
        name = quoted(table["parameter"])
        told = f"the bounds of {name} state neither lower nor upper; state one"
        require({"lower", "upper"} & {*table}, told)
        return {}

    def __post_init__(self) -> None:
        require(
            self.lower <= self.upper and self.lower < math.inf and self.upper > -math.inf,
            f"the bounds of {quoted(self.name)} leave no value: "
            f"found lower = {self.lower}, upper = {self.upper}",
        )


class LinearEquality(Record):
    """Σ coefficient · x = value over the named parameters: a symmetry, a known sum."""

    terms: Annotated[dict[Text, float], Field(min_length=1)] = keyed(takes=FACTORS)
    value: float = keyed(takes=NUMBER, default=0.0)
    label: str = keyed(default="")

    def __post_init__(self) -> None:
        require(
            any(self.terms.values()), f"equality '{self}' needs at least one non-zero coefficient"
        )

    def __str__(self) -> str:
        left = " + ".join(n if c == 1 else f"{c:g}·{n}" for n, c in self.terms.items())
        return self.label or f"{left} = {self.value:.6g}".replace("+ -1·", "- ").replace(
            "+ -", "- "
        )


class SemidefiniteMatrix(Record):
    """A symmetric matrix of parameters that is positive semidefinite: no load gains energy.

    `entries` are its rows; an entry is a parameter's name, {name: coefficient, …}, or a number.
    """

    label: str = keyed(required=False)
    entries: Many[Many[Entry]] = keyed(
        takes="rows of parameter names, numbers or factors by parameter, as in "
        '[["a", "b"], ["b", "c"]]',
        form=Annotated[list[list[str | float | dict[str, float]]], Field(min_length=1)],
        into=lambda rows, *_: tuple(map(tuple, rows)), required=True,
    )  # fmt: skip

    @classmethod
    def from_keys(cls, table: Mapping[str, Any], spot: Spot) -> dict[str, str]:
        return {"label": table.get("label") or f"matrix {int(spot.keys[-1]) + 1}"}

    def __post_init__(self) -> None:
        n = len(self.entries)
        require(
            n > 0 and all(len(row) == n for row in self.entries),
            f"matrix '{self.label}' is not square: rows of {[len(row) for row in self.entries]}",
        )
        cells = [[combination(entry) for entry in row] for row in self.entries]
        require(
            any(n for row in cells for cell in row for n in cell),
            f"matrix '{self.label}' needs at least one parameter",
        )
        for j, i in combinations(range(n), 2):
            require(
                cells[i][j] == cells[j][i],
                f"matrix '{self.label}' is not symmetric: entry ({i + 1}, {j + 1}) is "
                f"{self.entries[i][j]!r}, entry ({j + 1}, {i + 1}) is {self.entries[j][i]!r}",
            )


@dataclass(frozen=True)
class Constraints:
    """Any number of each kind, and for messages where they were stated; `a + b` holds both."""

    bounds: tuple[Bounds, ...] = ()
    equalities: tuple[LinearEquality, ...] = ()
    matrices: tuple[SemidefiniteMatrix, ...] = ()
    source: str = field(default="constraints", compare=False)

    def __add__(self, other: Constraints) -> Constraints:
        return Constraints(
            self.bounds + other.bounds, self.equalities + other.equalities,
            self.matrices + other.matrices, self.source,
        )  # fmt: skip

    def resolve(self, names: Sequence[str]) -> System:
        """The constraints as numbers on the vector (p,) of these parameters.

        Several bounds of one parameter all hold.  Raises InputError for a name that is not a
        parameter, and where the bounds of one parameter exclude each other.
        """
        position = {name: i for i, name in enumerate(names)}
        p = len(position)
        lower, upper = np.full(p, -np.inf), np.full(p, np.inf)
        for bound in self.bounds:
            i = _index(bound.name, position, "bounds")
            lower[i], upper[i] = max(lower[i], bound.lower), min(upper[i], bound.upper)
            require(
                bool(lower[i] <= upper[i]),
                f"the bounds of {bound.name} contradict each other: at least {lower[i]:.6g} and "
                f"at most {upper[i]:.6g}; drop one of them",
            )
        # Equal bounds have no inside, which an inequality solver needs; they are an equality.
        met = lower == upper
        at = np.flatnonzero(met).tolist()
        pinned = (LinearEquality({names[i]: 1.0}, float(lower[i])) for i in at)
        equalities = (*self.equalities, *pinned)
        rows = [_row(e.terms, position, f"equality '{e}'")[0] for e in equalities]
        matrices = list[Matrix]()
        for stated in self.matrices:
            n = len(stated.entries)
            constant, slopes = np.zeros((n, n)), np.zeros((p, n, n))
            for i, j in product(range(n), repeat=2):
                where = f"matrix '{stated.label}', entry ({i + 1}, {j + 1})"
                terms = combination(stated.entries[i][j])
                slopes[:, i, j], constant[i, j] = _row(terms, position, where)
            matrices.append(Matrix(stated.label, constant, slopes, np.ones(n)))
        return System(
            tuple(names), np.where(met, -np.inf, lower), np.where(met, np.inf, upper),
            np.array(rows).reshape(len(rows), p), np.array([e.value for e in equalities]),
            tuple(map(str, equalities)), tuple(matrices),
        )  # fmt: skip


def combination(entry: Entry) -> dict[str, float]:
    if isinstance(entry, str):
        return {entry: 1.0}
    terms = dict(entry) if isinstance(entry, Mapping) else {"": float(entry)}
    return {name: float(c) for name, c in terms.items() if c}


def _index(name: str, position: Mapping[str, int], where: str) -> int:
    check_known(name, position, f"{where}: {quoted(name)} is not a parameter")
    return position[name]


def _row(
    terms: Mapping[str, float], position: Mapping[str, int], where: str
) -> tuple[Array, float]:
    row = np.zeros(len(position))
    for name in filter(None, terms):
        row[_index(name, position, where)] += terms[name]
    return row, terms.get("", 0.0)


@dataclass(frozen=True)
class ActiveConstraint:
    """A constraint that holds with equality at the solution.  `value` is the bound or the
    equality's right-hand side (0 for a matrix), in the parameter's unit; `multiplier` the shadow
    price ∂(minimum of the objective)/∂value: ≥ 0 at a lower bound, ≤ 0 at an upper one; for a
    matrix tr Z, the price of M ⪰ t·I per unit of t."""

    label: str
    kind: Literal["lower", "upper", "equality", "semidefinite"]
    names: tuple[str, ...]
    value: float
    multiplier: float


# Prior knowledge of parameters: data sheets, an earlier calibration, a sister robot.


class PriorTable(Table):
    mean: float = key(NUMBER, ...)
    std: Positive = key("a positive number in SI units", ...)


@dataclass(frozen=True)
class GaussianPrior:
    """x[names] ~ N(mean, covariance): mean (k,) and covariance (k, k) in the parameters' units.

    Raises InputError where the numbers are not finite or the covariance not positive definite.
    """

    names: tuple[str, ...]
    mean: Array
    covariance: Array

    def __post_init__(self) -> None:
        k = len(self.names)
        require(len(set(self.names)) == k, f"the prior names a parameter twice: {self.names}")
        require(
            self.mean.shape == (k,) and self.covariance.shape == (k, k),
            f"a prior of {k} parameters needs {k} means and a {k} × {k} covariance; found shapes "
            f"{self.mean.shape} and {self.covariance.shape}",
        )
        finite = np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()
        require(bool(finite), "the prior's means and covariance must be finite")
        self._root()

    @classmethod
    def independent(
        cls, names: Sequence[str], mean: Sequence[float] | Array, std: Sequence[float] | Array
    ) -> GaussianPrior:
        """x_i ~ N(mean_i, std_i²), independent of each other."""
        return cls(tuple(names), np.asarray(mean, dtype=float), np.diag(np.square(std)))

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> GaussianPrior:
        """From {"joint2.compliance": {"mean": 2.9e-7, "std": 3e-8}, …}, in SI units."""
        require(bool(table), "the prior is empty; name at least one parameter")
        stated = {k: dict(v) if isinstance(v, Mapping) else v for k, v in table.items()}
        known = checked(Knowledge, {"prior": stated}, option("prior")).prior
        assert known is not None
        return known

    def rows(self, names: Sequence[str]) -> tuple[Array, Array]:
        """P (k, p) and target (k,) with |target − P x|² = (x − mean)ᵀ covariance⁻¹ (x − mean).

        Raises InputError for a name that is not among the parameters `names` (p,).
        """
        position = {name: i for i, name in enumerate(names)}
        root = self._root()
        P = np.zeros((len(self.names), len(position)))
        for name in self.names:
            check_known(name, position, f"the prior names {quoted(name)}, which is not a parameter")
        P[:, [position[name] for name in self.names]] = root
        return P, root @ self.mean

    def _root(self) -> Array:
        """L⁻¹ of the Cholesky factor; by standardised parameters, whose units are alike."""
        std = np.sqrt(np.abs(np.diag(self.covariance)))
        try:
            require(bool((std > 0).all()), "")
            L = linalg.cholesky(self.covariance / np.outer(std, std), lower=True)
        except (linalg.LinAlgError, InputError):
            raise InputError(
                "the prior's covariance is not positive definite; leave out parameters that are "
                "known exactly (fix them) or that repeat another one"
            ) from None
        return linalg.solve_triangular(L, np.diag(1 / std), lower=True)


def share_of_prior(cofactor: Array, P: Array) -> Array:
    """Share (p,) of each estimate's information that the prior gave, 0 to 1; NaN where constraints
    fix it.

    With V = (H_data + H_prior)⁻¹ (on the active face), V = V H_data V + V H_prior V: the posterior
    variance splits into what the noise and what the prior's uncertainty pass on, and the share is
    (V H_prior V)_ii / V_ii; for a single parameter τ⁻²/(τ⁻² + σ⁻²).
    """
    passed = ((P @ cofactor) ** 2).sum(axis=0)
    variance = np.diag(cofactor)
    return np.divide(passed, variance, out=np.full(len(variance), np.nan), where=variance > 0)


def _stated_prior(tables: Mapping[str, PriorTable], spot: Spot, _: str) -> GaussianPrior | None:
    means, std = ([getattr(p, key) for p in tables.values()] for key in ("mean", "std"))
    return GaussianPrior.independent(tuple(tables), means, std) if tables else None


class Knowledge(Record):
    """What is known of the parameters besides the readings, in SI units.

    Attributes:
        physical: Adds the constraints that physics puts on the model: no negative compliance.
        constraints: Bounds, equalities and matrices.
        prior: A Gaussian prior.
        source: Where it was stated, for messages.

    Examples:
        >>> fit = ec.identify("cell.toml", "data.csv", knowledge=ec.Knowledge(physical=True))
        >>> fit["joint3.compliance"].ci95[0] > 0
        True
    """

    physical: bool = keyed(default=False)
    constraints: Constraints = keyed(
        keys=(
            Key("bounds", "[[bounds]] tables", list[Bounds]),
            Key("equality", "[[equality]] tables", list[LinearEquality]),
            Key("semidefinite", "[[semidefinite]] tables", list[SemidefiniteMatrix]),
        ),
        default_factory=Constraints,
    )
    prior: GaussianPrior | None = keyed(
        takes='tables by parameter, as in [prior."joint2.compliance"]', form=dict[Text, PriorTable],
        into=_stated_prior, default=None,
    )  # fmt: skip
    source: str = field(default="knowledge", compare=False)

    @classmethod
    def from_keys(cls, table: Mapping[str, Any], spot: Spot) -> dict[str, Any]:
        kinds = ("bounds", "equality", "semidefinite")
        bounds, equalities, matrices = (tuple(table.get(kind, ())) for kind in kinds)
        found = Constraints(bounds, equalities, matrices)
        return {"constraints": found, "source": str(spot.path)}

    def of(self, model: Model) -> tuple[Constraints, GaussianPrior | None]:
        """Constraints and prior on the model's parameters.

        Raises InputError where a name is no parameter of the model, or bounds exclude each other.
        """
        constraints = self.constraints
        if self.physical:
            # A spring cannot give energy away, so a compliance matrix K, θ = K M, has xᵀKx ≥ 0.  No
            # effect has coupling terms: its matrix is diagonal, which is semidefinite exactly where
            # its entries are non-negative, and bounds say that (`ParameterSpec.lower`).
            finite = (p for p in model.parameters if np.isfinite([p.lower, p.upper]).any())
            own = tuple(Bounds(p.name, p.lower, p.upper) for p in finite)
            constraints = Constraints(own) + constraints
        with said_of(self.source):
            constraints.resolve(model.names)
            if self.prior is not None:
                self.prior.rows(model.names)
        return replace(constraints, source=self.source), self.prior


def read_knowledge(path: str | Path) -> Knowledge:
    """What a knowledge file states (docs: file formats); names are checked by `Knowledge.of`.

    Raises InputError that names file, key, what the key takes and the nearest valid key.
    """
    path = Path(path)
    return checked(Knowledge, read_toml(path, "knowledge file"), path)


# Linear least squares under constraints: the minimum, its prices, and how far a value can go.
#
# After the equalities and the free minimum are taken out, x = unit · (centre + T u) with the sum of
# squares rest + |u|², so that the constrained minimum is the point of a convex region nearest to
# u = 0.  Under bounds, rows u ≥ least, the nearest point is a problem of non-negative least
# squares, its multipliers the prices (Lawson and Hanson 1974, chapter 23).  A matrix M(u) ⪰ 0 is as
# many bounds as there are directions w, wᵀM(u)w ≥ 0: those that the nearest point breaks are added
# until it breaks none (cutting planes; Kelley 1960).

RANK = 1e-10  # of unit rows or columns: what is smaller is taken for round-off


def equality_space(A: Array, b: Array) -> tuple[Array, Array, Array]:
    """All x with A x = b (k, p), or the least-squares ones where the rows contradict each other:
    the shortest (p,), an orthonormal basis (p, q) of the way to the others, and b − A x (k,)."""
    norms = np.linalg.norm(A, axis=1)
    unit = np.where(norms > 0, norms, 1.0)
    # With a row of zeros, which leaves every way open: LAPACK takes no matrix without rows.
    rows, values = np.vstack([A / unit[:, None], np.zeros(A.shape[1])]), np.append(b / unit, 0.0)
    origin = least_norm(rows, values, cond=RANK)
    return origin, linalg.null_space(rows, RANK), (values - rows @ origin)[:-1]


ON_BOUND = 1e-7  # in standard deviations: what is closer to a bound lies on it
CONTRADICTION = 1e-9  # what equalities may miss each other by, of the size of x
UNDETERMINED = 1e-11  # singular value of unit columns, of the largest
MISSED = 1e-9  # of its distance: what the nearest point may break a matrix inequality by
MOST_CUTS = 200  # rounds of them
APART = 1e-12  # 1/(1 + d²): d times as far as the farthest bound there is no point any more
ENDLESS = 1e6  # times as far as without constraints: a value that the region ends stays there
MATTERS = 1e-6  # of the largest multiplier


@dataclass(frozen=True)
class Minimum:
    """Minimiser x (p,) of |t − J x|² under constraints, the objective there, what is active.  In
    the coordinates of `Reduced` it is u (q,), and does not move along `holding` (·, q)."""

    x: Array
    objective: float
    active: tuple[ActiveConstraint, ...]
    u: Array
    holding: Array


class Reduced:
    """|t − J x|² = constant + |u|² on x = unit · (centre + T u), all x that the equalities allow,
    where rows u ≥ least.

    `unit` (p,) makes the columns of J unit length, so that tolerances do not depend on a
    parameter's physical unit; `limits` are the constraints on x/unit − centre.  The rows (k, q) are
    of unit length, `lengths` (k,) what they were divided by: first the finite bounds, lower ones
    first, `sides` 1 for a lower bound and −1 for an upper one of parameter `of_row`, then the
    `cuts` wᵀM(u)w ≥ 0 found so far, by number of the matrix and w.  Raises InputError where
    equalities contradict each other, and InsufficientDataError where they and J (rows, p) leave a
    direction undetermined.
    """

    def __init__(self, J: Array, t: Array, system: System) -> None:
        self.J, self.t, self.system = J, t, system
        norms = np.linalg.norm(J, axis=0)
        self.unit = unit = 1 / np.where(norms > 0, norms, 1.0)
        zero = np.zeros(len(unit))
        self.limits = limits = system.moved(zero, unit)
        origin, basis, missed = equality_space(limits.A, limits.b)
        most = CONTRADICTION * max(1.0, float(np.max(np.abs(origin), initial=0.0)))
        if np.max(np.abs(missed), initial=0.0) > most:
            _refuse(limits.equality_labels, missed)
        # The least-squares point among origin + basis · w, and T (p, q) with |J T u| = |u|.
        centre, T = origin, basis
        if basis.shape[1]:
            Q, R = linalg.qr(J * unit @ basis, mode="economic")
            singular, right = linalg.svd(R)[1:]
            tiny = UNDETERMINED * float(np.max(singular, initial=0.0))
            loose = right[int((singular > tiny).sum()) :]
            if len(loose):
                moved = np.abs(loose @ basis.T).max(axis=0)
                each = zip(system.names, moved, strict=True)
                free = [name for name, m in each if m > 1e-3 * moved.max()]
                raise InsufficientDataError(
                    f"data, prior and equalities do not determine {listed(free)}: values can "
                    "change together without moving a reading; hold some of them, or state a prior"
                )
            T = linalg.solve_triangular(R, basis.T, trans="T").T
            centre = origin + T @ (Q.T @ (t - J * unit @ origin))
        self.centre, self.T = centre, T
        # About the free minimum numbers are as small as the constraints allow.
        self.limits = limits = limits.moved(centre, zero + 1)
        below, above = (np.flatnonzero(np.isfinite(b)) for b in (limits.lower, limits.upper))
        of, sides = np.append(below, above), np.repeat([1.0, -1.0], [len(below), len(above)])
        rows, least = sides[:, None] * T[of], np.append(limits.lower[below], -limits.upper[above])
        lengths = np.linalg.norm(rows, axis=1)
        # What the equalities pin does not move; a bound on it holds, or nothing can meet it.
        pinned = lengths <= RANK * np.max(np.linalg.norm(T, axis=1), initial=0.0)
        rows[pinned], lengths[pinned] = 0.0, 1.0
        told = ~pinned | (least > RANK)
        self.lengths, self.of_row, self.sides = lengths[told], of[told], sides[told]
        self.rows, self.least = rows[told] / self.lengths[:, None], least[told] / self.lengths
        self.matrices = [
            replace(m, slopes=np.tensordot(T.T, m.slopes, axes=1)) for m in limits.matrices
        ]
        self.cuts: list[tuple[int, Array]] = []

    def nearest(self, target: Array) -> tuple[Array, Array]:
        """The point (q,) of the region nearest to the target, which is target + Σ prices · rows,
        and the prices; InputError where constraints contradict each other."""
        for _ in range(MOST_CUTS):
            u, prices = self._nearest_of_rows(target)
            known = len(self.cuts)
            for k, matrix in enumerate(self.matrices):
                values, vectors = np.linalg.eigh(matrix.at(u))
                rows = np.einsum("ai,pab,bi->ip", vectors, matrix.slopes, vectors)
                lengths = np.linalg.norm(rows, axis=1)
                lengths[lengths == 0] = 1.0
                far = MISSED * np.linalg.norm(u) * lengths
                broken = values < -np.maximum(far, ROUND_OFF * np.abs(values).max())
                self.cuts += [(k, w) for w in vectors.T[broken]]
                rows, lengths = rows[broken] / lengths[broken, None], lengths[broken]
                self.rows = np.vstack([self.rows, rows])
                self.least = np.append(self.least, rows @ u - values[broken] / lengths)
                self.lengths = np.append(self.lengths, lengths)
            if len(self.cuts) == known:
                break
        return u, prices

    def _nearest_of_rows(self, target: Array) -> tuple[Array, Array]:
        least, prices = self.least - self.rows @ target, np.zeros(len(self.least))
        size = float(np.max(least, initial=0.0))
        if size <= 0:
            return target, prices
        # With y ≥ 0 of the least |rowsᵀ y|² + |1 − leastᵀ y|² the prices are y / (1 − leastᵀ y).
        wanted = np.append(np.zeros(len(target)), 1.0)
        y = scipy.optimize.nnls(np.vstack([self.rows.T, least / size]), wanted)[0]
        if 1 - least @ y / size < APART:
            self._contradiction(y)
        # Once more, of those that are active alone, good to rounding.
        held = y > 0
        way = equality_space(self.rows[held], least[held])[0]
        prices[held] = scipy.optimize.nnls(self.rows[held].T, way)[0]
        return target + way, prices

    def _told(self, prices: Array) -> tuple[Array, list[Array], Array]:
        """Prices of the bounds and of each matrix, Σ price · w wᵀ over its cuts, and the slopes
        (p,) on x/unit that they are of."""
        bounds, each = np.split(prices / self.lengths, [len(self.sides)])
        found = [np.zeros_like(m.constant) for m in self.matrices]
        for (k, w), price in zip(self.cuts, each, strict=True):
            found[k] += price * np.outer(w, w)
        pull = np.zeros(len(self.unit))
        np.add.at(pull, self.of_row, self.sides * bounds)
        for matrix, Z in zip(self.limits.matrices, found, strict=True):
            pull += np.tensordot(matrix.slopes, Z, axes=2)
        return bounds, found, pull

    def _contradiction(self, prices: Array) -> NoReturn:
        """Bounds and matrices have prices with Σ prices · rows = 0, Σ prices · least > 0."""
        limits, (bounds, matrices, pull) = self.limits, self._told(prices)
        shares = least_norm(limits.A.T, pull) if len(limits.b) else np.zeros(0)
        shares *= np.linalg.norm(limits.A, axis=1)
        sides = ("lower" if side > 0 else "upper" for side in self.sides)
        of = (limits.names[i] for i in self.of_row)
        labels = [f"the {side} bound of {name}" for side, name in zip(sides, of, strict=True)]
        each = [*shares, *bounds, *(np.trace(Z) for Z in matrices)]
        _refuse([*limits.equality_labels, *labels, *(m.label for m in limits.matrices)], each)

    def minimum(self, stated: System | None = None) -> Minimum:
        """The minimum under all constraints; `active` in the terms of `stated`, if given, where x
        is a step and `stated` the constraints on the parameters themselves: equalities, then
        bounds, then matrices, with prices in the units of x.  InputError names constraints that
        contradict each other."""
        u, prices = self.nearest(np.zeros(self.T.shape[1]))
        bounds, matrices, pull = self._told(prices)
        limits, stated, n = self.limits, stated or self.system, len(self.sides)
        x = self.unit * (self.centre + self.T @ u)
        held, above = self.of_row[bounds > 0], self.sides[bounds > 0] > 0
        x[held] = np.where(above, self.system.lower[held], self.system.upper[held])
        left = self.t - self.J @ x
        # What they leave of the gradient of half the objective is the equalities'.
        pull = -self.unit * (self.J.T @ left) - pull
        shares = least_norm(limits.A.T, pull) if len(limits.b) else np.zeros(0)
        noise = ROUND_OFF * float(np.linalg.norm(self.t))  # columns of J · unit are of length 1
        shares[np.abs(shares) * np.linalg.norm(limits.A, axis=1) <= noise] = 0.0

        def names(chosen: Array) -> tuple[str, ...]:
            return tuple(stated.names[i] for i in np.flatnonzero(chosen))

        active = [
            ActiveConstraint(label, "equality", names(row), float(b), 2 * float(price))
            for row, label, b, price in zip(
                stated.A, stated.equality_labels, stated.b, shares, strict=True
            )
        ]
        slack = (self.rows[:n] @ u - self.least[:n]) * self.lengths[:n]
        touched = np.flatnonzero((bounds > 0) | (slack <= ON_BOUND))
        for k in touched:
            i, low = self.of_row[k], self.sides[k] > 0
            name, value = stated.names[i], float((stated.lower if low else stated.upper)[i])
            price = 2 * float(self.sides[k] * bounds[k] / self.unit[i])
            label = f"{name} {'>=' if low else '<='} {value:.6g}"
            side: Literal["lower", "upper"] = "lower" if low else "upper"
            active.append(ActiveConstraint(label, side, (name,), value, price))
        holding = [self.rows[touched]]
        for matrix, of_x, Z in zip(self.matrices, limits.matrices, matrices, strict=True):
            # M and its price Z share eigenvectors and M Z = 0, so that the negative eigenvalues of
            # M − Z are those of −Z: M is zero along N.
            values, vectors = np.linalg.eigh(matrix.at(u) - Z)
            N = vectors[:, values <= ON_BOUND]
            if N.shape[1]:
                of = names(np.abs(of_x.slopes).sum(axis=(1, 2)))
                price = 2 * float(matrix.balance**2 @ Z.diagonal())
                active.append(ActiveConstraint(matrix.label, "semidefinite", of, 0.0, price))
            i, j = np.tril_indices(N.shape[1])
            holding.append((N.T @ matrix.slopes @ N)[:, i, j].T)
        return Minimum(x, float(left @ left), tuple(active), u, np.vstack(holding))

    def face(self, at: Minimum) -> Array:
        """Orthonormal directions (q, ·) in which the constraints that the point lies on let u
        go."""
        return equality_space(at.holding, np.zeros(len(at.holding)))[1]

    def farthest(self, index: int, found: Minimum, rise: float, side: int) -> Array:
        """x (p,) with the least (side −1) or largest (1) x[index] where the objective is at most
        `rise` above its minimum `found`: the ends of the profile interval {v: S(v) − Ŝ ≤ rise},
        S(v) the least objective with the parameter at v.  They are nearest to a target in that
        direction, whose distance decides how far the objective rises."""
        c, s = side * self.T[index], float(np.sqrt(rise))
        length = float(np.linalg.norm(c))
        if s == 0 or length <= RANK * float(np.max(np.linalg.norm(self.T, axis=1), initial=0.0)):
            return found.x  # equalities leave a single value

        def way(far: float) -> Array:
            return self.nearest(far * s / length * c)[0] - found.u

        def excess(far: float) -> float:
            v = way(far)
            return float(v @ v + 2 * found.u @ v) - rise

        near, far = 0.0, 1.0
        while (beyond := excess(far)) < -MISSED * rise and far < ENDLESS:
            near, far = far, 10 * far
        if beyond > MISSED * rise:
            far = scipy.optimize.brentq(excess, near, far, xtol=MISSED * far)
        x = self.unit * (self.centre + self.T @ (found.u + way(far)))
        bound = (self.system.lower if side < 0 else self.system.upper)[index]
        if side * (bound - x[index]) <= ON_BOUND * self.unit[index] * length * s:
            x[index] = bound
        return x if side * (x[index] - found.x[index]) > 0 else found.x


def _refuse(labels: Sequence[str], prices: Sequence[float] | Array) -> NoReturn:
    """InputError that names the constraints which no x satisfies together: those with a multiplier
    prove it (Farkas); the others could be dropped and it would remain."""
    matter = MATTERS * np.abs(prices).max()
    guilty = [f"'{k}'" for k, p in zip(labels, prices, strict=True) if abs(p) > matter]
    raise InputError(
        f"the constraints contradict each other: no values satisfy {listed(guilty)} together; "
        "relax or drop one of them"
    )


def minimise(J: Array, t: Array, system: System) -> Minimum:
    """Minimise |t − J x|² over the system's x; errors as in `Reduced`."""
    return Reduced(J, t, system).minimum()
