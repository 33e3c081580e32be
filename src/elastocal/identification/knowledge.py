"""What is known of the parameters besides the readings: constraints, physics, priors, a file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from scipy import linalg

from elastocal.config import (
    AnyFloat,
    Key,
    Many,
    Positive,
    Spot,
    Table,
    Text,
    checked,
    key,
    keyed,
    read_toml,
    record,
)
from elastocal.messages import InputError, did_you_mean, listed, option, quoted, require, said_of
from elastocal.model.manipulator import Model
from elastocal.units import Array, IntArray

# Constraints as numbers: bounds, linear equalities and matrix inequalities on a vector.

# A constraint may be missed by this fraction of the numbers in it: round-off only.
ROUND_OFF = 1e-12


@dataclass(frozen=True)
class Matrix:
    """M(x) = constant + Σ x_i slopes_i ⪰ 0; constant (n, n), slopes (p, n, n), all symmetric.

    `balance` (n,) is d where the matrix stands for diag(d) M diag(d): a congruence changes no
    sign of an eigenvalue, and brings rows of different units to one size.
    """

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
        """The constraints on x[columns], all other parameters held at x (p,).

        Raises InputError where the held values alone break a constraint.
        """
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


@record
class Bounds:
    """lower ≤ x ≤ upper for one parameter, in its unit; equal bounds fix it."""

    name: str = keyed(
        'the name of a parameter, as in "joint2.compliance"', "parameter", form=Text, required=True
    )
    lower: AnyFloat = keyed(f"{NUMBER}; without one, none", form=float, default=-math.inf)
    upper: AnyFloat = keyed(f"{NUMBER}; without one, none", form=float, default=math.inf)

    @classmethod
    def from_keys(cls, table: Mapping[str, Any], spot: Spot) -> dict[str, float]:
        name = quoted(table["parameter"])
        told = f"the bounds of {name} state neither lower nor upper; state one"
        spot.require({"lower", "upper"} & {*table}, told)
        return {}

    def __post_init__(self) -> None:
        require(
            self.lower <= self.upper and self.lower < math.inf and self.upper > -math.inf,
            f"the bounds of {quoted(self.name)} leave no value: "
            f"found lower = {self.lower}, upper = {self.upper}",
        )


@record
class LinearEquality:
    """Σ coefficient · x = value over the named parameters: a symmetry, a known sum."""

    terms: Annotated[dict[Text, float], Field(min_length=1)] = keyed(FACTORS, required=True)
    value: float = keyed(NUMBER, default=0.0)
    label: str = keyed("a text", default="")

    def __post_init__(self) -> None:
        require(
            any(self.terms.values()), f"equality '{self}' needs at least one non-zero coefficient"
        )

    def __str__(self) -> str:
        left = " + ".join(n if c == 1 else f"{c:g}·{n}" for n, c in self.terms.items())
        return self.label or f"{left} = {self.value:.6g}".replace("+ -1·", "- ").replace(
            "+ -", "- "
        )


@record
class SemidefiniteMatrix:
    """A symmetric matrix of parameters that is positive semidefinite: no load gains energy.

    `entries` are its rows; an entry is a parameter's name, {name: coefficient, …}, or a number.
    """

    label: str = keyed("a text")
    entries: Many[Many[Entry]] = keyed(
        "rows of parameter names, numbers or factors by parameter, as in "
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
        pinned = (
            LinearEquality({names[i]: 1.0}, float(lower[i])) for i in np.flatnonzero(met).tolist()
        )
        equalities = (*self.equalities, *pinned)
        rows = [_row(e.terms, position, f"equality '{e}'")[0] for e in equalities]
        return System(
            tuple(names), np.where(met, -np.inf, lower), np.where(met, np.inf, upper),
            np.array(rows).reshape(len(rows), p), np.array([e.value for e in equalities]),
            tuple(map(str, equalities)), tuple(_matrix(m, position) for m in self.matrices),
        )  # fmt: skip


def combination(entry: Entry) -> dict[str, float]:
    """An entry as {name: coefficient}, its constant under the empty name; zeros left out."""
    if isinstance(entry, str):
        return {entry: 1.0}
    terms = dict(entry) if isinstance(entry, Mapping) else {"": float(entry)}
    return {name: float(c) for name, c in terms.items() if c}


def _index(name: str, position: Mapping[str, int], where: str) -> int:
    require(
        name in position,
        f"{where}: {quoted(name)} is not a parameter{did_you_mean(name, position)}; "
        f"there are {listed(position)}",
    )
    return position[name]


def _row(
    terms: Mapping[str, float], position: Mapping[str, int], where: str
) -> tuple[Array, float]:
    row = np.zeros(len(position))
    for name in filter(None, terms):
        row[_index(name, position, where)] += terms[name]
    return row, terms.get("", 0.0)


def _matrix(stated: SemidefiniteMatrix, position: Mapping[str, int]) -> Matrix:
    n = len(stated.entries)
    constant, slopes = np.zeros((n, n)), np.zeros((len(position), n, n))
    for i, j in product(range(n), repeat=2):
        where = f"matrix '{stated.label}', entry ({i + 1}, {j + 1})"
        terms = combination(stated.entries[i][j])
        slopes[:, i, j], constant[i, j] = _row(terms, position, where)
    return Matrix(stated.label, constant, slopes, np.ones(n))


# What a fit makes of them.


@dataclass(frozen=True)
class ActiveConstraint:
    """A constraint that holds with equality at the solution.

    `value` is the bound or the equality's right-hand side (0 for a matrix), in the parameter's
    unit; `multiplier` the shadow price ∂(minimum of the objective)/∂value: ≥ 0 at a lower bound,
    ≤ 0 at an upper one; for a matrix tr Z, the price of M ⪰ t·I per unit of t.
    """

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
            require(
                name in position,
                f"the prior names {quoted(name)}, which is not a parameter"
                f"{did_you_mean(name, position)}; there are {listed(position)}",
            )
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
    """Share (p,) of each estimate's information that the prior gave, 0 to 1.

    With V = (H_data + H_prior)⁻¹ (on the active face), V = V H_data V + V H_prior V: the posterior
    variance splits into what the noise and what the prior's uncertainty pass on, and the share is
    (V H_prior V)_ii / V_ii; for a single parameter τ⁻²/(τ⁻² + σ⁻²).  NaN where V_ii = 0: a value
    that the constraints fix.
    """
    passed = ((P @ cofactor) ** 2).sum(axis=0)
    variance = np.diag(cofactor)
    share = np.full(len(variance), np.nan)
    return np.divide(passed, variance, out=share, where=variance > 0)


# All of it, and the file (TOML) that states it.


def _stated_prior(tables: Mapping[str, PriorTable], spot: Spot, _: str) -> GaussianPrior | None:
    means, std = ([getattr(p, key) for p in tables.values()] for key in ("mean", "std"))
    with said_of(spot.path):
        return GaussianPrior.independent(tuple(tables), means, std) if tables else None


@record
class Knowledge:
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
        'tables by parameter, as in [prior."joint2.compliance"]', form=dict[Text, PriorTable],
        into=_stated_prior, default=None,
    )  # fmt: skip
    source: str = field(default="knowledge", compare=False)

    @classmethod
    def from_keys(cls, table: Mapping[str, Any], spot: Spot) -> dict[str, Any]:
        kinds = ("bounds", "equality", "semidefinite")
        bounds, equalities, matrices = (tuple(table.get(kind, ())) for kind in kinds)
        constraints = Constraints(bounds, equalities, matrices)
        return {"constraints": constraints, "source": str(spot.path)}

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
