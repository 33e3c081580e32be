"""Constraints as people state them: by the names of parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import require
from elastocal.identification.constrained.system import Matrix, System
from elastocal.text import did_you_mean, listed, quoted

Array = NDArray[np.float64]
# An entry of a matrix: a parameter, a linear combination of parameters, or a number.
Entry = str | float | Mapping[str, float]


@dataclass(frozen=True)
class Bounds:
    """lower ≤ x ≤ upper for one parameter, in its unit; equal bounds fix it."""

    name: str
    lower: float = -math.inf
    upper: float = math.inf

    def __post_init__(self) -> None:
        require(
            self.lower <= self.upper and self.lower < math.inf and self.upper > -math.inf,
            f"the bounds of {quoted(self.name)} leave no value: "
            f"found lower = {self.lower}, upper = {self.upper}",
        )


@dataclass(frozen=True)
class LinearEquality:
    """Σ coefficient · x = value over the named parameters: a symmetry, a known sum."""

    terms: Mapping[str, float]
    value: float = 0.0
    label: str = ""

    def __post_init__(self) -> None:
        numbers = [*self.terms.values(), self.value]
        require(
            bool(np.isfinite(numbers).all()) and any(self.terms.values()),
            f"equality '{self}' needs finite numbers and at least one non-zero coefficient",
        )

    def __str__(self) -> str:
        left = " + ".join(n if c == 1 else f"{c:g}·{n}" for n, c in self.terms.items())
        return self.label or f"{left} = {self.value:.6g}".replace("+ -1·", "- ").replace(
            "+ -", "- "
        )


@dataclass(frozen=True)
class SemidefiniteMatrix:
    """A symmetric matrix of parameters that is positive semidefinite: no load gains energy.

    `entries` are its rows; an entry is a parameter's name, {name: coefficient, …}, or a number.
    """

    label: str
    entries: tuple[tuple[Entry, ...], ...]

    def __post_init__(self) -> None:
        n = len(self.entries)
        require(
            n > 0 and all(len(row) == n for row in self.entries),
            f"matrix '{self.label}' is not square: rows of {[len(row) for row in self.entries]}",
        )
        cells = [[combination(entry) for entry in row] for row in self.entries]
        numbers = [c for row in cells for cell in row for c in cell.values()]
        require(
            bool(np.isfinite(numbers).all())
            and any(n for row in cells for cell in row for n in cell),
            f"matrix '{self.label}' needs finite numbers and at least one parameter",
        )
        for i in range(n):
            for j in range(i):
                require(
                    cells[i][j] == cells[j][i],
                    f"matrix '{self.label}' is not symmetric: entry ({i + 1}, {j + 1}) is "
                    f"{self.entries[i][j]!r}, entry ({j + 1}, {i + 1}) is {self.entries[j][i]!r}",
                )


@dataclass(frozen=True)
class Constraints:
    """Any number of each kind; `a + b` holds both."""

    bounds: tuple[Bounds, ...] = ()
    equalities: tuple[LinearEquality, ...] = ()
    matrices: tuple[SemidefiniteMatrix, ...] = ()

    def __add__(self, other: Constraints) -> Constraints:
        return Constraints(
            self.bounds + other.bounds,
            self.equalities + other.equalities,
            self.matrices + other.matrices,
        )

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
        rows, values, labels = [], [], []
        for equality in self.equalities:
            row, _ = _row(equality.terms, position, f"equality '{equality}'")
            rows.append(row)
            values.append(equality.value)
            labels.append(str(equality))
        # Equal bounds have no inside, which an inequality solver needs; they are an equality.
        for i in np.flatnonzero(lower == upper).tolist():
            rows.append(np.eye(p)[i])
            values.append(lower[i])
            labels.append(f"{names[i]} = {lower[i]:.6g}")
            lower[i], upper[i] = -np.inf, np.inf
        return System(
            tuple(names),
            lower,
            upper,
            np.array(rows).reshape(-1, p),
            np.array(values, dtype=float),
            tuple(labels),
            tuple(_matrix(m, position) for m in self.matrices),
        )


def non_negative(*names: str) -> Constraints:
    """x ≥ 0 for each of the named parameters."""
    return Constraints(bounds=tuple(Bounds(name, lower=0.0) for name in names))


def equal(first: str, *others: str) -> Constraints:
    """All named parameters have one value: two drives of one type, a symmetric wrist."""
    return Constraints(equalities=tuple(LinearEquality({first: 1.0, o: -1.0}) for o in others))


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
    """Coefficients (p,) and the constant of a combination."""
    row, constant = np.zeros(len(position)), 0.0
    for name, coefficient in terms.items():
        if name:
            row[_index(name, position, where)] += coefficient
        else:
            constant += coefficient
    return row, constant


def _matrix(stated: SemidefiniteMatrix, position: Mapping[str, int]) -> Matrix:
    n = len(stated.entries)
    constant, slopes = np.zeros((n, n)), np.zeros((len(position), n, n))
    for i, row in enumerate(stated.entries):
        for j, entry in enumerate(row):
            where = f"matrix '{stated.label}', entry ({i + 1}, {j + 1})"
            slopes[:, i, j], constant[i, j] = _row(combination(entry), position, where)
    return Matrix(stated.label, constant, slopes, np.ones(n))
