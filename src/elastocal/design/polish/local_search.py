"""IPOPT on one pose: joint limits as bounds, clearances as constraints, any smooth goal."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.design.polish.objective import Goal, SymbolicBlocks

Array = NDArray[np.float64]

OPTIONS: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "show_eval_warnings": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.max_iter": 80,
    "ipopt.tol": 1e-7,
    # Six variables: second derivatives cost more than the steps they save.
    "ipopt.hessian_approximation": "limited-memory",
    "ipopt.bound_relax_factor": 0.0,
}


@dataclass(frozen=True)
class LocalSearch:
    """min f(B(q)) with lower ≤ q ≤ upper (n,) and margins(q) ≥ 0; it pickles.

    `margins` q → (m,), or None, is how far each rule of the cell is from being broken.  It is
    conservative, so a start that the exact rules allow may fall short of it: there each margin
    need only stay what it is.
    """

    blocks: SymbolicBlocks
    margins: ca.Function | None
    lower: Array
    upper: Array

    def ends(self, goal: Goal, starts: Array) -> Array:
        """Where IPOPT stops from each start (K, n); the start itself where it fails.

        IPOPT: Wächter & Biegler, Math. Program. 106 (2006) 25.
        """
        n = len(self.lower)
        f = _GoalFunction(goal, self.blocks, n)
        q = ca.MX.sym("q", n)
        problem: dict[str, Any] = {"x": q, "f": f(q)}
        if self.margins is not None:
            problem["g"] = self.margins(q)
        solver = ca.nlpsol("polish", "ipopt", problem, OPTIONS)
        return np.stack([self._end(solver, start) for start in starts])

    def _end(self, solver: ca.Function, start: Array) -> Array:
        bounds: dict[str, Any] = {"lbx": self.lower, "ubx": self.upper}
        if self.margins is not None:
            bounds |= {"lbg": np.minimum(self.margins(start).full(), 0.0), "ubg": np.inf}
        # A goal that cannot be evaluated (no equilibrium, singular information) ends a search.
        with contextlib.suppress(RuntimeError):
            end = solver(x0=start, **bounds)["x"].full().ravel()
            if np.isfinite(end).all():
                return np.asarray(np.clip(end, self.lower, self.upper))
        return start


Task = tuple[LocalSearch, Goal, Array]


def search_all(tasks: Sequence[Task], jobs: int) -> Array:
    """Where every start of every task (search, goal, starts) ended, stacked, on `jobs` processes.

    Every start is searched by itself, so the result does not depend on `jobs`.
    """
    if jobs == 1:
        return np.vstack([search.ends(goal, starts) for search, goal, starts in tasks])
    from joblib import Parallel, delayed

    single = [(search, goal, start[None]) for search, goal, starts in tasks for start in starts]
    return np.vstack(Parallel(n_jobs=jobs)(delayed(s.ends)(goal, q) for s, goal, q in single))


class _GoalFunction(ca.Callback):
    """f(B(q)) for CasADi: evaluated by numpy, so that any criterion serves, with exact slopes."""

    def __init__(self, goal: Goal, blocks: SymbolicBlocks, n: int) -> None:
        ca.Callback.__init__(self)
        self.goal, self.blocks, self.n = goal, blocks, n
        self.at: tuple[bytes, Array] = (b"", np.empty(0))
        self.construct("f", {})

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.n, 1)

    def B(self, q: Array) -> Array:
        # IPOPT asks for the value and the slope at the same point.
        if self.at[0] != q.tobytes():
            self.at = (q.tobytes(), self.blocks.at(q))
        return self.at[1]

    def eval(self, arguments: Sequence[ca.DM]) -> list:
        return [self.goal.value(self.B(arguments[0].full().ravel()))]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, inputs: Any, outputs: Any, options: Any) -> ca.Function:
        self.jacobian_function = _GoalSlope(self, name)
        return self.jacobian_function


class _GoalSlope(ca.Callback):
    """∂f/∂q (1, n) of a `_GoalFunction`, as CasADi calls it: with q and f."""

    def __init__(self, f: _GoalFunction, name: str) -> None:
        ca.Callback.__init__(self)
        self.f = f
        self.construct(name, {})

    def get_n_in(self) -> int:
        return 2

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.f.n if i == 0 else 1, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(1, self.f.n)

    def eval(self, arguments: Sequence[ca.DM]) -> list:
        q = arguments[0].full().ravel()
        slope = self.f.goal.slope(self.f.B(q))
        return [ca.DM(self.f.blocks.slope(q, slope)).T]
