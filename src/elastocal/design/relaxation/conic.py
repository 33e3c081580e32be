"""The master problem as a conic program for cvxpy and clarabel.

Written independently of the Newton master, so that each checks the other; the master of E, and
of the mean over scenarios of a maximum.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from elastocal.design.criteria.base import Array, Criterion, Gradient
from elastocal.design.criteria.scenarios import ScenarioCriterion
from elastocal.design.criteria.worst import Worst
from elastocal.design.relaxation.cones import Cone, cone_of
from elastocal.design.relaxation.restricted import Restricted
from elastocal.errors import InsufficientDataError

# Of clarabel on the scaled program, whose optimum is near 1; the second where the first fails.
TOLERANCES = (1e-10, 1e-8)


class ConicMaster:
    """Σ_s Φ_s/S or max_s Φ_s over the weights, solved by clarabel to its own accuracy."""

    def __init__(self, criterion: Criterion) -> None:
        self._worst = isinstance(criterion, Worst)
        base = criterion.base if isinstance(criterion, Worst) else criterion
        assert isinstance(base, ScenarioCriterion)
        self._base = base
        import cvxpy as cp

        self._cp = cp

    def __call__(self, task: Restricted, start: Array, accuracy: float) -> tuple[Array, Gradient]:
        """w (k,) and a tangent; `start` sets the units of the program and nothing else.

        Raises InsufficientDataError where clarabel finds no solution.
        """
        cp = self._cp
        M = task.information(start)
        values = self._base.each(M)
        w = cp.Variable(len(start), nonneg=True)
        members = (task.level == np.arange(len(task.shares))[:, None]).astype(float)
        constraints = [members @ w == task.shares, w <= task.most]
        cones: list[Cone] = []
        for s, root in enumerate(np.linalg.inv(np.linalg.cholesky(M))):
            A = root @ task.A[s] @ root.T
            information = cp.reshape(A.reshape(len(A), -1).T @ w, root.shape, order="C")
            information = information + root @ task.base[s] @ root.T
            cones.append(cone_of(cp, self._base, s, information, root, float(values[s])))
            constraints += cones[-1].constraints
        relative = [
            float(v / values.max()) * cone.value for v, cone in zip(values, cones, strict=True)
        ]
        total = cp.Variable()
        if self._worst:
            limit = [value <= total for value in relative]
        else:
            limit = [sum(relative) / len(relative) <= total]
        self._solve(cp.Problem(cp.Minimize(total), [*constraints, *limit]))
        if self._worst:
            share = np.maximum([float(c.dual_value) for c in limit], 0.0)
        else:
            share = np.ones(len(cones))
        found = task.inside(np.maximum(w.value, 0.0), 0.0)
        return found, self._tangent(task.information(found), cones, share / share.sum())

    def _tangent(self, M: Array, cones: list[Cone], share: Array) -> Gradient:
        """v = Σ c_s v_s and G = (c_s G_s), c = `share` (S,): Φ ≥ Σ c_s v_s²/⟨G_s, M'_s⟩ is at least
        v²/⟨G, M'⟩ by Cauchy and Schwarz."""
        values, G = self._base.each_gradient(M)
        for s, cone in enumerate(cones):
            if cone.tangent is not None:
                values[s], G[s] = cone.tangent(M[s])
        return Gradient(float(share @ values), share[:, None, None] * G)

    def _solve(self, program: Any) -> None:
        """Solved in place; an inexact answer is used, since its bound shows what it is worth."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for tolerance in TOLERANCES:
                options = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), tolerance)
                try:
                    program.solve(solver=self._cp.CLARABEL, **options)
                except self._cp.SolverError:
                    continue
                if program.status in ("optimal", "optimal_inaccurate"):
                    return
        raise InsufficientDataError(
            f"the conic solver stopped with status {program.status!r} on the relaxation; the "
            "information may be nearly singular: add prior knowledge or poses"
        )
