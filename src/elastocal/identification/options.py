"""What a method is asked for, its standard deviations and 95 % intervals, what it ends with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from elastocal.errors import InputError, option
from elastocal.identification.knowledge import ActiveConstraint, Constraints, GaussianPrior
from elastocal.identification.least_squares import LEVEL, Covariance, drawing_root, t_quantile
from elastocal.identification.noise_choice import NoiseFit
from elastocal.identification.noise_structure import Kind
from elastocal.identification.solve import Solution
from elastocal.identification.weighted_problem import WeightKind
from elastocal.model.manipulator import SmoothGroup
from elastocal.text import did_you_mean, quoted
from elastocal.units import Array, BoolArray, IntArray, Progress

IntervalKind = Literal[
    "auto", "classical", "hc0", "hc1", "hc2", "hc3", "cr0", "cr1", "cr2", "cr3",
    "profile",
]  # fmt: skip
KINDS = get_args(IntervalKind)


# What an identification says of a smooth function: its size, and how sure.

PLACES = 500
DRAWS = 400


@dataclass(frozen=True)
class SmoothPart:
    """A smooth function as it was fitted.

    Attributes:
        group: Its parameters and what it follows.
        scale: By how much the variance of its coefficients is larger than the prior that the cell
            states; 0 where it was left out.
        effective: How many coefficients' worth of it the readings determine.
        value: Coefficients (components, waves).
        covariance: Theirs, (components · waves, components · waves).
        places: What it follows in the readings fitted (n,), in rad or s.
    """

    group: SmoothGroup
    scale: float
    effective: float
    value: Array
    covariance: Array
    places: Array

    @property
    def coefficients(self) -> int:
        """How many parameters it has."""
        return int(self.value.size)

    def refitted(self, x: Array, columns: IntArray, covariance: Array) -> SmoothPart:
        """The same function at other parameters x (parameters,), the covariance that of the
        `columns` fitted."""
        mine = self.group.columns
        place = {int(c): k for k, c in enumerate(columns)}
        at = np.array([place.get(int(c), -1) for c in mine.ravel()])
        there, matrix = np.flatnonzero(at >= 0), np.zeros((mine.size, mine.size))
        matrix[np.ix_(there, there)] = covariance[np.ix_(at[there], at[there])]
        return replace(self, value=x[mine], covariance=matrix)

    def _own_waves(self, x: Array) -> Array:
        """The waves at x (n,) without their mean and their wave of one period per turn (of a time,
        its slope), for which offsets, lengths and tilts of the arm can stand."""
        assert self.group.basis is not None
        alike = [np.ones(len(x)), *((np.cos(x), np.sin(x)) if self.group.lasting else (x - x[0],))]
        Q, _ = np.linalg.qr(np.column_stack(alike))
        waves = self.group.basis(x)
        return np.asarray(waves - Q @ (Q.T @ waves))

    @cached_property
    def sizes(self) -> dict[str, tuple[float, tuple[float, float], float]]:
        """By unit, over all components and the places of the readings: rms of what is left of the
        function without what the arm can stand for, the 95 % interval of that, and the rms half
        width of its 95 % band.

        Of parameters that are no function of one quantity, the root of their sum of squares.
        """
        basis = self.group.basis
        found = {}
        for unit in dict.fromkeys(self.group.units):
            own = [c for c, u in enumerate(self.group.units) if u == unit]
            if basis is None:
                waves = np.eye(self.value.shape[1]) * np.sqrt(self.value.shape[1])
            else:
                places = np.sort(self.places)
                even = np.linspace(0, len(places) - 1, min(len(places), PLACES)).astype(int)
                waves = self._own_waves(places[even])
            mean = self.value[own] @ waves.T
            rng = np.random.default_rng(0)
            k = waves.shape[1]
            total, spread = np.zeros(DRAWS), 0.0
            for c, m in zip(own, mean, strict=True):
                mine = slice(c * k, (c + 1) * k)
                covariance = self.covariance[mine, mine]
                drawn = rng.normal(size=(DRAWS, k)) @ drawing_root(covariance).T @ waves.T
                total += ((m + drawn) ** 2).mean(axis=1)
                spread += float(((waves @ covariance) * waves).sum(axis=1).mean())
            rms = np.sqrt(total / (1 if basis is None else len(own)))
            low, high = np.quantile(rms, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
            half = float(t_quantile(LEVEL, np.array(np.inf))) * np.sqrt(spread / len(own))
            found[unit] = (float(np.median(rms)), (float(low), float(high)), float(half))
        return found

    def to_json(self) -> list[dict[str, Any]]:
        """An entry for each unit that the function has, in SI."""
        g = self.group
        return [
            {
                "effect": g.effect, "where": g.where, "follows": g.follows or None, "unit": unit,
                "size": g.size, "length": g.length, "low": g.low, "high": g.high,
                "scale": self.scale, "coefficients": self.coefficients,
                "effective": self.effective, "rms": rms, "rms_ci95": ci95, "band95": half,
            }
            for unit, (rms, ci95, half) in self.sizes.items()
        ]  # fmt: skip


# What a method ends with.


NO_MATTER = 1e-4  # one over degrees of freedom that make no difference to an interval


@dataclass(frozen=True)
class MethodResult:
    """The final fit, its `spread`, and the noise where it was estimated.

    Readings that are not `good` (N,) lie beyond the noise, whether or not they had a part in the
    fit.  What constraints and a prior add: `active` constraints, `prior_share` by parameter, how
    many parameters the readings paid for (`effective`; in a fit to readings alone all fitted), and
    `warnings` where the readings contradict them.  `smooth` are the smooth functions, `beside`
    which σ of a whitened row and its degrees of freedom were found, and `standard` (N, size) the
    residuals of all readings free of the fit's part in them.  `limits` are the 95 % intervals of
    the parameters that the readings `hardly_shown`, by their index.
    """

    method: str
    solution: Solution
    spread: Covariance
    noise: NoiseFit | None
    good: BoolArray
    active: tuple[ActiveConstraint, ...] = ()
    prior_share: dict[str, float] = field(default_factory=dict)
    effective: int | None = None
    warnings: tuple[str, ...] = ()
    smooth: tuple[SmoothPart, ...] = ()
    beside: tuple[float, float] | None = None
    standard: Array | None = None
    limits: dict[int, tuple[float, float]] = field(default_factory=dict)

    @cached_property
    def ci95(self) -> Array:
        """The 95 % intervals (fitted, 2)."""
        return self.spread.interval(self.solution.fit.x[self.solution.fit.columns])

    def told(
        self, k: int, bent: float = 0.0, unsure: float = 0.0
    ) -> tuple[dict[int, float], float, float, tuple[float, float]]:
        """Of kept parameter number k the parameters combined with it and their factors, its
        standard deviation with degrees of freedom, and its interval.

        A dropped parameter d is combined with it where its typical deviation s_d would shift the
        estimate by more than its standard deviation σ.  The others widen it to
        √(σ² + Σ_d (m_kd s_d)²), their typical deviations being a prior N(0, s_d²), as does what a
        combination leaves out by being linear (`bent`, its square known with the relative variance
        `unsure`: degrees of freedom by Welch and Satterthwaite); bounds cut the interval off.
        """
        chosen, std = self.solution.reduction, float(self.spread.std[k])
        shift = np.abs(chosen.mixing[k]) * self.solution.problem.sizes[chosen.dropped]
        terms = {int(chosen.dropped[j]): float(chosen.mixing[k, j])
                 for j in np.flatnonzero(shift > std)}  # fmt: skip
        left = np.append(shift[shift <= std], bent)
        wide = float(np.sqrt(1 + ((left / std) ** 2).sum())) if std > 0 else 1.0
        dof, share = float(self.spread.dof[k]), (bent / (wide * std)) ** 2 if std > 0 else 0.0
        value, system = self.solution.fit.x[chosen.kept[k]], self.solution.fit.known.system
        ends = value + wide * (self.ci95[k] - value)
        if (unknown := share**2 * unsure / 2) > NO_MATTER:
            own = 1 / ((1 - share) ** 2 / dof + unknown)
            wider, usual = t_quantile(LEVEL, np.array([own, dof]))
            ends, dof = value + wider / usual * (ends - value), own
        if system is not None:
            ends = np.clip(ends, system.lower[k], system.upper[k])
        return terms, wide * std, dof, (float(ends[0]), float(ends[1]))


# How to identify: method, noise, what is held, what becomes of faulty readings, where it starts.

Method = Literal["auto", "reml", "ols", "wls", "eq14", "eq14-residual", "huber", "l1"]
FaultyReadings = Literal["auto", "drop", "keep"]
METHODS = get_args(Method)
ROBUST = ("huber", "l1")
WITH_KNOWLEDGE = ("auto", "profile")
# What there was once, or is looked for by this name: what does the same.
SUCCESSORS = {
    "method": dict.fromkeys(
        ("lts", "s", "mm", "tukey", "student-t"),
        "the default method, which excludes what the fit of the majority contradicts, or huber",
    ),
    "intervals": {
        "wild": "cr2, which allows any correlation within a configuration as well",
        "hc4": "hc3, which is nearly the jackknife over rows",
        "bootstrap": "profile, which is lopsided where the model bends as well",
    },
}


@dataclass(frozen=True)
class Options:
    """How to identify.

    `method`: auto is reml, weights estimated by restricted likelihood, unless `weights` names
    stated ones; ols is eq. (6), wls eq. (10) with stated noise, eq14 and eq14-residual the
    published weights with σ by group or from each residual; huber and l1 are robust.  `noise`: the
    model whose variances reml estimates (structure.noise_models).
    `weights`: auto, none, rows, axis, polar or covariance (then `covariance` (rows, rows) in m²).
    `intervals`: auto goes with the method.  `fixed`: names of parameters held at their start.
    `constraints` and `prior`: a
    constrained or regularised fit on top of the method's weights (`knowledge_fit`).  `faulty`:
    readings beyond the noise are set apart (auto: unless they are too many to be reading errors),
    always, or never; they are listed in the result in any case.  `seed`: of multi-start and
    searches.
    """

    method: Method = "auto"
    noise: str = "auto"
    weights: WeightKind = "auto"
    covariance: Array | None = None
    intervals: IntervalKind = "auto"
    fixed: tuple[str, ...] = ()
    constraints: Constraints | None = None
    prior: GaussianPrior | None = None
    faulty: FaultyReadings = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, valid in (
            ("method", self.method, METHODS),
            ("weights", self.weights, get_args(WeightKind)),
            ("intervals", self.intervals, KINDS),
            ("outliers", self.faulty, get_args(FaultyReadings)),
        ):
            if successor := SUCCESSORS.get(name, {}).get(str(value)):
                raise InputError(f"there is no {option(name, value)}: use {successor}")
            if value not in valid:
                raise InputError(
                    f"{option(name)} takes one of {', '.join(valid)}; found {quoted(value)}"
                    f"{did_you_mean(str(value), valid)}"
                )
        Kind.of(self.noise)
        if self.noise != "auto" and self.resolved != "reml":
            raise InputError(
                f"the noise model '{self.noise}' is estimated by the method reml; "
                f"{self.resolved} takes its weights from elsewhere"
            )
        if self.method == "wls" and self.weights == "none":
            raise InputError("the method wls needs weights; for none, choose the method ols")
        stated = self.weights != "auto" or self.covariance is not None
        if stated and self.weights != "none" and self.resolved not in ("wls", *ROBUST):
            raise InputError(
                f"the method {self.resolved} does not take stated weights; choose the method wls"
            )
        if self.knows:
            remedy = f"with these there are {', '.join(WITH_KNOWLEDGE)}"
            self._refuse(ROBUST, WITH_KNOWLEDGE, "neither constraints nor a prior", remedy)

    def check_functions(self) -> None:
        """Raise InputError for methods and intervals that take no prior, as functions have."""
        without = (*ROBUST, "eq14", "eq14-residual")
        what = "no prior, which smooth functions have"
        self._refuse(without, ("auto", "classical"), what, "leave it away")

    def _refuse(
        self, without: tuple[str, ...], intervals: tuple[str, ...], what: str, remedy: str
    ) -> None:
        if self.resolved in without:
            raise InputError(
                f"the method {self.resolved} takes {what}; use the default method, which excludes "
                "outliers"
            )
        if self.intervals not in intervals:
            raise InputError(f"{option('intervals', self.intervals)} knows of {what}; {remedy}")

    @property
    def knows(self) -> bool:
        """Whether anything is stated beyond the readings."""
        return self.prior is not None or self.constraints not in (None, Constraints())

    @property
    def resolved(self) -> str:
        """The method that auto stands for."""
        if self.method != "auto":
            return self.method
        if self.weights == "auto" and self.covariance is None:
            return "reml"
        return "ols" if self.weights == "none" else "wls"


@dataclass(frozen=True)
class Course:
    """What a method starts from: fits to all observations, and to those that are not `faulty` (N,);
    `refit` makes another such, of those it is given.  They know nothing of smooth functions among
    the parameters `free`.
    """

    every: Solution
    sound: Solution
    faulty: BoolArray
    free: IntArray
    refit: Callable[[BoolArray], Solution]
    options: Options
    progress: Progress
