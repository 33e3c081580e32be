"""Linear least squares under constraints: the minimum, its prices, and how far a value can go.

After the equalities and the free minimum are taken out, x = unit · (centre + T u) with the sum of
squares rest + |u|², so that the constrained minimum is the point of a convex region nearest to
u = 0.  Under bounds, rows u ≥ least, the nearest point is a problem of non-negative least squares,
its multipliers the prices (Lawson and Hanson 1974, chapter 23).  A matrix M(u) ⪰ 0 is as many
bounds as there are directions w, wᵀM(u)w ≥ 0: those that the nearest point breaks are added until
it breaks none (cutting planes; Kelley 1960).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NoReturn

import numpy as np
import scipy
from scipy import linalg

from elastocal.identification.knowledge import ROUND_OFF, ActiveConstraint, System
from elastocal.identification.weighted_problem import least_norm
from elastocal.messages import InputError, InsufficientDataError, listed
from elastocal.units import Array

# Linear equalities, by the space that they leave.

RANK = 1e-10  # of unit rows or columns: what is smaller is taken for round-off


def equality_space(A: Array, b: Array) -> tuple[Array, Array, Array]:
    """All x with A x = b (k, p), or the least-squares ones where the rows contradict each other:
    the shortest (p,), an orthonormal basis (p, q) of the way to the others, and b − A x (k,), of
    unit rows."""
    norms = np.linalg.norm(A, axis=1)
    unit = np.where(norms > 0, norms, 1.0)
    # With a row of zeros, which leaves every way open: LAPACK takes no matrix without rows.
    rows, values = np.vstack([A / unit[:, None], np.zeros(A.shape[1])]), np.append(b / unit, 0.0)
    origin = least_norm(rows, values, cond=RANK)
    return origin, linalg.null_space(rows, RANK), (values - rows @ origin)[:-1]


# The answer.

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
    """Minimiser x (p,) of |t − J x|² under constraints, the objective there, what is active.

    In the coordinates of `Reduced` it is u (q,), and does not move along `holding` (·, q).
    """

    x: Array
    objective: float
    active: tuple[ActiveConstraint, ...]
    u: Array
    holding: Array


class Reduced:
    """|t − J x|² = constant + |u|² on x = unit · (centre + T u), all x that the equalities allow,
    where rows u ≥ least.

    `unit` (p,) makes the columns of J unit length, so that slacks and tolerances do not depend on
    a parameter's physical unit; `limits` are the constraints on x/unit − centre.  The rows (k, q)
    are of unit length, `lengths` (k,) what they were divided by: first the finite bounds, lower
    ones first, `sides` 1 for a lower bound and −1 for an upper one of parameter `of_row`, then the
    `cuts` wᵀM(u)w ≥ 0 found so far, by number of the matrix and w.

    Raises InputError where equalities contradict each other, which it names, and
    InsufficientDataError where they and J (rows, p) leave a direction undetermined.
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
        self.centre, self.T = centre, T = _free_minimum(J * unit, t, origin, basis, system.names)
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
        and the prices.  Raises InputError where constraints contradict each other."""
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
        n = len(self.sides)
        kept = np.append(np.ones(n, dtype=bool), prices[n:] > 0)
        self.cuts = [cut for cut, own in zip(self.cuts, kept[n:], strict=True) if own]
        self.rows, self.least, self.lengths = (
            a[kept] for a in (self.rows, self.least, self.lengths)
        )
        return u, prices[kept]

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
        bounds, then matrices, with prices in the units of x.

        Raises InputError where constraints contradict each other, which it names.
        """
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
        """Orthonormal directions (q, ·) in which the constraints that the point lies on let u go:
        of a matrix those with Nᵀ dM N = 0."""
        return equality_space(at.holding, np.zeros(len(at.holding)))[1]

    def farthest(self, index: int, found: Minimum, rise: float, side: int) -> Array:
        """x (p,) with the least (side −1) or largest (1) x[index] where the objective is at most
        `rise` above its minimum `found`.

        These are the ends of the profile interval {v: S(v) − Ŝ ≤ rise}, S(v) the least objective
        with the parameter at v.  They are nearest to a target in that direction, whose distance
        decides how far the objective rises.
        """
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
    """Raise InputError that names the constraints which no x satisfies together: those with a
    multiplier prove it (Farkas); the others could be dropped and it would remain."""
    matter = MATTERS * np.abs(prices).max()
    guilty = [f"'{k}'" for k, p in zip(labels, prices, strict=True) if abs(p) > matter]
    raise InputError(
        f"the constraints contradict each other: no values satisfy {listed(guilty)} together; "
        "relax or drop one of them"
    )


def minimise(J: Array, t: Array, system: System) -> Minimum:
    """Minimise |t − J x|² over the system's x; errors as in `Reduced`."""
    return Reduced(J, t, system).minimum()


def _free_minimum(
    J: Array, t: Array, origin: Array, basis: Array, names: tuple[str, ...]
) -> tuple[Array, Array]:
    """Least-squares x (p,) among origin + basis · w, and T (p, q) with |J T u| = |u|."""
    if not basis.shape[1]:
        return origin, basis
    Q, R = linalg.qr(J @ basis, mode="economic")
    singular, right = linalg.svd(R)[1:]
    tiny = UNDETERMINED * float(np.max(singular, initial=0.0))
    loose = right[int((singular > tiny).sum()) :]
    if len(loose):
        moved = np.abs(loose @ basis.T).max(axis=0)
        free = [n for n, m in zip(names, moved, strict=True) if m > 1e-3 * moved.max()]
        raise InsufficientDataError(
            f"data, prior and equalities do not determine {listed(free)}: values can change "
            "together without moving a reading; hold some of them, or state a prior"
        )
    T = linalg.solve_triangular(R, basis.T, trans="T").T
    return origin + T @ (Q.T @ (t - J @ origin)), T
