"""How many poses: the criterion and its bound against N, and the fewest that meet a target."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from elastocal.design.exact.exchange import IMPROVEMENT
from elastocal.design.exact.plan import ExactPlan, Progress, exact_plan
from elastocal.design.problem import DesignProblem
from elastocal.errors import InsufficientDataError, require
from elastocal.planning.relaxation import Relaxed, relax

ProblemOf = Callable[[int], DesignProblem]


@dataclass(frozen=True)
class SizePoint:
    """The best plan found of `n_poses` poses, its Φ `value`, and the certified lower `bound` on Φ
    of every plan of so many; None where the criterion has none."""

    n_poses: int
    value: float
    bound: float | None
    plan: ExactPlan


@dataclass(frozen=True)
class SizeCurve:
    """All sizes tried, ascending.

    `smallest`: the fewest poses with a plan found that meets the target, None if none does or no
    target was given.  `excluded`: the certified bound excludes the target for every plan of so
    many poses or fewer; with `smallest` − 1 = `excluded` the answer is proved on the pool.
    """

    points: tuple[SizePoint, ...]
    smallest: int | None
    excluded: int


def size_curve(
    problem_of: ProblemOf,
    numbers: Iterable[int],
    target: float | None = None,
    *,
    between: tuple[int, int] = (1, 100),
    starts: int = 10,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress = lambda message: None,
) -> SizeCurve:
    """The best plans found of the given `numbers` of poses, and the fewest with Φ ≤ `target`.

    `problem_of(n)` states the problem of n poses, on the same candidates for all n.  Where no
    group's share falls with n, Φ of the points does not rise: the smaller plan, extended, is one
    of the starts of the larger (O2 and O4, which more information may raise, excepted).  The
    bound falls with n too; bisection finds the first n in `between` at which it allows the target.
    From there plans are sought with doubled steps, then between the last that failed and the
    first that met it.

    Raises InputError for no number and no target, an empty range, or a target that is not
    positive; InsufficientDataError where no plan of one of `numbers` determines all parameters.
    """
    wanted = sorted(set(numbers))
    require(bool(wanted) or target is not None, "a size curve needs numbers of poses or a target")
    sizes = _Sizes(problem_of, starts, seed, jobs, progress)
    for n in wanted:
        sizes.point(n)
    if target is None:
        return SizeCurve(sizes.points(), None, 0)
    low, high = between
    require(1 <= low <= high, f"no number of poses lies between {low} and {high}")
    require(target > 0, f"the target must be positive, got {target}")
    allowed = _first_with(lambda n: (sizes.bound(n) or 0.0) <= target, low, high + 1)
    _seek(sizes, target, allowed, high)
    points = sizes.points()
    smallest = min((p.n_poses for p in points if p.value <= target), default=None)
    return SizeCurve(points, smallest, allowed - 1)


def _seek(sizes: _Sizes, target: float, low: int, high: int) -> None:
    """Plans until the fewest poses that meet the target, or `high`, are among them."""

    def meets(n: int) -> bool:
        try:
            return sizes.point(n).value <= target
        except InsufficientDataError:
            if n == high:
                raise
            return False

    n, step, failed = min(low, high), 1, low - 1
    while not meets(n):
        if n == high:
            return
        failed, n, step = n, min(n + step, high), 2 * step
    _first_with(meets, failed + 1, n)


def _first_with(holds: Callable[[int], bool], low: int, high: int) -> int:
    """The smallest n in [low, high] where a monotone condition holds, taken to hold at high."""
    while low < high:
        middle = (low + high) // 2
        if holds(middle):
            high = middle
        else:
            low = middle + 1
    return low


@dataclass(frozen=True)
class _Sizes:
    """Plans and relaxations by number of poses, each begun from the next smaller one."""

    problem_of: ProblemOf
    starts: int
    seed: int
    jobs: int
    progress: Progress
    found: dict[int, SizePoint] = field(default_factory=dict)
    relaxed: dict[int, Relaxed] = field(default_factory=dict)

    def points(self) -> tuple[SizePoint, ...]:
        return tuple(self.found[n] for n in sorted(self.found))

    def bound(self, n: int) -> float | None:
        relaxed = self._relaxation(n, self.problem_of(n))
        return None if relaxed is None else relaxed.bound

    def point(self, n: int) -> SizePoint:
        if n not in self.found:
            self._plan(n)
            for larger in sorted(m for m in self.found if m > n):
                # Found before a smaller one that turns out better: extend that one instead.
                smaller = self.found[max(m for m in self.found if m < larger)]
                if self.found[larger].value > smaller.value * (1 + IMPROVEMENT):
                    self._plan(larger)
        return self.found[n]

    def _plan(self, n: int) -> None:
        problem = self.problem_of(n)
        relaxed = self._relaxation(n, problem)
        smaller = [m for m in self.found if m < n]
        plan = exact_plan(
            problem,
            relaxed_weights=None if relaxed is None else relaxed.weights,
            tangent=None if relaxed is None else relaxed.tangent,
            warm=self.found[max(smaller)].plan.chosen if smaller else None,
            starts=self.starts,
            seed=self.seed,
            jobs=self.jobs,
        )
        bound = None if relaxed is None else relaxed.bound
        self.found[n] = SizePoint(n, plan.value, bound, plan)
        told = "" if bound is None else f", bound {bound:.6g}"
        self.progress(f"{n} poses: {plan.value:.6g}{told}")

    def _relaxation(self, n: int, problem: DesignProblem) -> Relaxed | None:
        if not problem.criterion.certifiable:
            return None
        if n not in self.relaxed:
            near = min(self.relaxed, key=lambda m: abs(m - n), default=None)
            start = None if near is None else self.relaxed[near].weights
            self.relaxed[n] = relax(problem, start=start)
        return self.relaxed[n]
