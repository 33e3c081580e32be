"""Profile-likelihood intervals: how far a parameter can move before the fit becomes too bad.

With S(v) the least weighted sum of squares where the parameter is held at v and the others are
refitted, and Ŝ its minimum, the interval is

    { v : τ²(v) = (S(v) − Ŝ)/s² ≤ F_{1,dof}(level) },   s² = Ŝ/dof

(Bates & Watts 1988, chapter 6).  In a linear model it is the t interval; where the model bends,
its ends are not equally far from the estimate, and it stays the same interval under any
transformation of the parameter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from elastocal.errors import ElastocalError, require
from elastocal.identification.covariance.estimate import t_quantile
from elastocal.identification.fit import Fit, FitProblem, fit

Array = NDArray[np.float64]
Objective = Callable[[float], float]
End = Literal["crossing", "bound", "unbounded", "no_fit"]

DOUBLINGS = 10  # of t·std in search of a crossing; beyond 1000 times the interval is flat
FAR = 10.0  # τ/t beyond which its size no longer matters
JUMP = 0.01  # of τ over a step of 10 PRECISION that no continuous profile makes
PRECISION = 1e-6  # of an end, in units of t·std
LOWER_BY = 1e-3  # (Ŝ − S)/s² above which the fit was not at its minimum

SAID: dict[str, str] = {
    "crossing": "",
    "bound": "ends at the bound of the parameter",
    "unbounded": "unbounded: the sum of squares stays flat on this side",
    "no_fit": "ends where the model has no fit any more",
}


@dataclass(frozen=True)
class ProfileInterval:
    """The interval (lower, upper) in units of the parameter, and why each side ends there.

    `ends`: "crossing" (τ² reached the F quantile), "bound", "unbounded" (±inf), "no_fit".
    """

    lower: float
    upper: float
    ends: tuple[End, End]

    @property
    def notes(self) -> tuple[str, ...]:
        """What to say of sides that do not end in a crossing."""
        return tuple(
            f"{side} end {SAID[end]}"
            for side, end in zip(("lower", "upper"), self.ends, strict=True)
            if end != "crossing"
        )


def profile_interval(
    objective: Objective,
    estimate: float,
    std: float,
    dof: float,
    level: float = 0.95,
    lower: float = -np.inf,
    upper: float = np.inf,
) -> ProfileInterval:
    """Profile-likelihood interval of one parameter about `estimate`.

    objective(value) -> S: minimum of the whitened rss with the parameter at `value`; it may raise
    ElastocalError where no fit exists.  std: standard deviation of the linearised fit, which only
    scales the search.  dof: residual degrees of freedom; np.inf where the noise is known, then
    s² = 1 and F becomes χ²₁.  lower, upper: the parameter's bounds.

    Raises InputError for a std or dof that is not positive, an estimate outside the bounds or a
    bad level; ElastocalError where a value is found whose S lies below that of the estimate.
    """
    require(0 < std < np.inf, f"std must be positive and finite, got {std}")
    require(dof > 0, f"a profile needs positive degrees of freedom, got {dof}")
    require(
        lower <= estimate <= upper,
        f"the estimate {estimate:g} lies outside its bounds {lower:g} to {upper:g}",
    )
    t = float(t_quantile(level, np.asarray(dof)))
    least = objective(estimate)
    s2 = 1.0 if np.isinf(dof) else least / dof
    require(s2 > 0, "the fit leaves no residual, so there is no noise to judge its parameters by")

    def excess(value: float) -> float:
        """τ − t, cut off where it no longer matters so that the root finder is not led astray."""
        try:
            rise = (objective(value) - least) / s2
        except ElastocalError:
            return FAR * t
        if rise < -LOWER_BY:
            raise ElastocalError(
                f"held at {value:g} the fit is better than at the estimate {estimate:g}, so that"
                " was not the minimum; fit again from there"
            )
        return min(np.sqrt(max(rise, 0.0)), (1 + FAR) * t) - t if np.isfinite(rise) else FAR * t

    low, low_end = _side(excess, estimate, -t * std, lower)
    high, high_end = _side(excess, estimate, t * std, upper)
    return ProfileInterval(low, high, (low_end, high_end))


def _side(excess: Objective, estimate: float, step: float, bound: float) -> tuple[float, End]:
    """The end of the interval in the direction of `step`, whose size is that of the t interval."""
    inside = estimate
    for k in range(DOUBLINGS + 1):
        outside = estimate + step * 2.0**k
        at_bound = (outside - bound) * step >= 0
        outside = bound if at_bound else outside
        if outside == estimate:
            return estimate, "bound"
        value = excess(outside)
        if value > 0:
            break
        if at_bound or value == 0:
            return outside, "bound" if value < 0 else "crossing"
        inside = outside
    else:
        return float(np.copysign(np.inf, step)), "unbounded"
    xtol = PRECISION * abs(step)
    end = float(optimize.brentq(excess, inside, outside, xtol=xtol))
    # At a crossing τ is continuous, so a step of 10 xtol inwards still sees it close to t.
    before = excess(end - 10 * xtol * np.sign(step))
    return end, "no_fit" if before < -JUMP else "crossing"


def profile_of(problem: FitProblem, found: Fit, index: int) -> Objective:
    """S(value) of `profile_interval` for parameter `index` of the model, one of problem.columns.

    Each call holds the parameter and refits the other columns with `fit`, from the nearest fit so
    far.  It raises ElastocalError where that does not converge, InputError where the problem has
    ties (they are no data) or `index` was not fitted.
    """
    require(problem.tie is None, "a profile needs a problem without ties")
    fitted = bool(np.isin(index, problem.columns))
    require(fitted, f"parameter {index} was not fitted: columns are {problem.columns.tolist()}")
    others = problem.columns[problem.columns != index]
    known = [found.x]

    def objective(value: float) -> float:
        x = min(known, key=lambda near: abs(near[index] - value)).copy()
        x[index] = value
        if others.size == 0:
            seen = problem.observations
            rest = seen.value - problem.model.predict(seen.table, x, seen)
            whitened = problem.weights.apply(rest)
        else:
            again = fit(replace(problem, x=x, columns=others))
            if not again.converged:
                raise ElastocalError(f"no fit with parameter {index} at {value:g}: {again.reason}")
            known.append(again.x)
            whitened = again.whitened
        return float(whitened @ whitened)

    return objective
