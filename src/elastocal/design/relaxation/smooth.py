"""What the interior point sees of a criterion: its smooth pieces."""

from __future__ import annotations

import numpy as np

from elastocal.design.criteria.base import Array, Criterion, Gradient
from elastocal.design.criteria.determinant import DeterminantCriterion
from elastocal.design.criteria.o5 import FifthObservability
from elastocal.design.criteria.prediction_maximum import GCriterion
from elastocal.design.criteria.trace import TraceCriterion
from elastocal.design.criteria.worst import Worst
from elastocal.design.relaxation.interior_point import solve
from elastocal.design.relaxation.pieces import Pieces
from elastocal.design.relaxation.restricted import Restricted
from elastocal.design.relaxation.terms import RootDeterminant, SquaredTraceRoot, Term, Traces


def pieces_of(criterion: Criterion, scenarios: int) -> Pieces | None:
    """The criterion as a maximum of smooth pieces; None where it is none.

    These are E and its O3, whose pieces would be all directions, and the mean over several
    scenarios of a maximum.
    """
    base = criterion.base if isinstance(criterion, Worst) else criterion
    worst = isinstance(criterion, Worst) or scenarios == 1
    if isinstance(criterion, Worst) and criterion.order != np.inf:
        return None
    terms: tuple[Term, ...]
    if isinstance(base, TraceCriterion):
        terms = tuple(Traces(C[None]) for C in base.C)
    elif isinstance(base, DeterminantCriterion):
        terms = (RootDeterminant(np.asarray(base.interest)),) * scenarios
    elif isinstance(base, FifthObservability):
        terms = (SquaredTraceRoot(np.asarray(base.interest)),) * scenarios
    elif isinstance(base, GCriterion) and base.order == np.inf and worst:
        terms = tuple(Traces(A.transpose(0, 2, 1) @ A) for A in base.A)
    else:
        return None
    count = sum(term.count for term in terms)
    return Pieces(terms, np.eye(count) if worst else np.full((1, count), 1.0 / count))


class NewtonMaster:
    """The master problem by the interior point of `interior_point`."""

    def __init__(self, pieces: Pieces) -> None:
        self._pieces = pieces

    def __call__(self, task: Restricted, start: Array, accuracy: float) -> tuple[Array, Gradient]:
        w, mu = solve(self._pieces, task, start, accuracy)
        local = self._pieces.at(task.information(w))
        assert local is not None  # `solve` returns only points where it is
        return w, local.tangent(mu)
