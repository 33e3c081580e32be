"""Which parameters a fit with constraints and a prior has, and its constraints on these alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InsufficientDataError, option, require
from elastocal.identification.constrained.constraints import (
    Bounds,
    Constraints,
    Entry,
    LinearEquality,
    SemidefiniteMatrix,
    combination,
)
from elastocal.identification.constrained.prior import GaussianPrior
from elastocal.identification.selection import WORTH_A_COLUMN
from elastocal.identification.solve import Solution
from elastocal.text import listed, quoted

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Share of a column that others must leave over: B is exact to 1e-15, but a base that is tilted by
# some µrad already tells its turn from that of joint 1.
TOLD_APART = 1e-6


def fitted_columns(
    solution: Solution, std: Array, constraints: Constraints, prior: GaussianPrior | None
) -> IntArray:
    """Indices of the parameters to fit under the constraints and the prior, ascending.

    These are the kept parameters of the solution (and those that bounds held); the free ones that
    the prior or an equality names, for that is knowledge of themselves; and, of the parameters
    that are known only together with one of these, as many as can now be told apart from it: with
    a prior on k, readings of k + d are knowledge of d.  Told apart is what readings, prior and
    equalities determine better than its typical size, as in the choice of the kept parameters.
    Bounds and matrices make nothing known: they act on the fitted parameters, with all others
    held where the fit held them.

    `std` (kept,) is that of the solution's estimates.  Raises InputError for a name that is no
    parameter, or a prior on a parameter that is held fixed; InsufficientDataError where an
    equality names a parameter that stays undetermined.
    """
    problem, reduction = solution.problem, solution.reduction
    names, free = problem.model.names, set(problem.free.tolist())
    constraints.resolve(names)
    tied = {name for e in constraints.equalities for name, factor in e.terms.items() if factor}
    priors = set() if prior is None else set(prior.names)
    if prior is not None:
        prior.rows(names)
    fixed = [quoted(n) for n in sorted(priors) if names.index(n) not in free]
    require(
        not fixed,
        f"a prior is stated for {listed(fixed)}, which is held fixed; drop the prior or the fixing",
    )
    named = {names.index(n) for n in tied | priors} & free
    columns = {*reduction.kept.tolist(), *reduction.at_bound.tolist(), *named}

    def told_apart(c: int) -> bool:
        return _told_apart(solution, [*sorted(columns - {c}), c], constraints, prior)

    new = {names.index(n) for n in tied - priors} & free - set(reduction.kept.tolist())
    unknown = [quoted(names[c]) for c in sorted(new) if not told_apart(c)]
    if unknown:
        raise InsufficientDataError(
            f"readings, prior and equalities do not determine {listed(unknown)}, which an equality "
            f"names; hold it ({option('fixed')}) or state a prior for it, or drop the equality"
        )
    partners: dict[int, None] = {}
    for k, c in enumerate(reduction.kept.tolist()):
        if c in named:
            partners |= dict.fromkeys(reduction.terms(k, solution.sizes, std[k]))
    for d in partners:
        if d not in columns and told_apart(d):
            columns.add(d)
    return np.array(sorted(columns), dtype=np.int64)


def _told_apart(
    solution: Solution, columns: list[int], constraints: Constraints, prior: GaussianPrior | None
) -> bool:
    """Whether readings, prior and equalities tell the last of the columns from the others."""
    problem, seen, e = solution.problem, solution.problem.observations, solution.fit.whitened
    chosen = np.array(columns)
    size, names = solution.sizes[chosen], problem.model.names
    at = problem.model.regressor(seen.table, solution.fit.x, chosen, seen)
    sigma = max(float(np.sqrt(e @ e / len(e))), 1e-12)
    J = problem.weights.apply(at.B) * size / sigma
    if prior is not None:
        J = np.vstack([J, prior.rows(names)[0][:, chosen] * size])
    A = constraints.resolve(names).A[:, chosen] * size
    A = A[A.any(axis=1)]
    # An equality is exact: it counts as much as the most that anything else tells.
    A *= np.linalg.norm(J, axis=0).max() / np.linalg.norm(A, axis=1)[:, None]
    J = np.vstack([J, A])
    lengths = np.linalg.norm(J, axis=0)
    J = J / np.where(lengths > 0, lengths, 1.0)
    left = J[:, -1] - J[:, :-1] @ np.linalg.lstsq(J[:, :-1], J[:, -1], rcond=None)[0]
    off = float(np.linalg.norm(left))
    return off > TOLD_APART and off * lengths[-1] > WORTH_A_COLUMN


def own_bounds(solution: Solution) -> Constraints:
    """The bounds that the effects of a bounded problem state themselves."""
    if not solution.problem.bounded:
        return Constraints()
    parameters = solution.problem.model.parameters
    return Constraints(
        tuple(
            Bounds(p.name, p.lower, p.upper)
            for p in parameters
            if np.isfinite(p.lower) or np.isfinite(p.upper)
        )
    )


def on_columns(stated: Constraints, held: Mapping[str, float]) -> Constraints:
    """The constraints on the other parameters where those in `held` have these values.

    A constraint on held parameters alone is left out; `constrained_fit` has checked that it holds.
    """
    equalities = []
    for e in stated.equalities:
        terms = {n: c for n, c in e.terms.items() if n not in held}
        if any(terms.values()):
            value = e.value - sum(c * held[n] for n, c in e.terms.items() if n in held)
            equalities.append(LinearEquality(terms, value, str(e)))
    matrices = []
    for m in stated.matrices:
        rows = tuple(tuple(_entry(entry, held) for entry in row) for row in m.entries)
        if any(name for row in rows for entry in row for name in combination(entry)):
            matrices.append(SemidefiniteMatrix(m.label, rows))
    bounds = tuple(b for b in stated.bounds if b.name not in held)
    return Constraints(bounds, tuple(equalities), tuple(matrices))


def _entry(entry: Entry, held: Mapping[str, float]) -> Entry:
    terms = combination(entry)
    constant = terms.pop("", 0.0) + sum(c * held[n] for n, c in terms.items() if n in held)
    return {n: c for n, c in terms.items() if n not in held} | {"": constant}
