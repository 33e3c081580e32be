"""How to identify: method, noise, intervals, what is held, what becomes of faulty readings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError, option
from elastocal.identification.intervals import KINDS as INTERVALS
from elastocal.identification.intervals import IntervalKind
from elastocal.identification.knowledge import Constraints, GaussianPrior
from elastocal.identification.noise_structure import Kind
from elastocal.identification.weighted_problem import WeightKind
from elastocal.text import did_you_mean, quoted

Method = Literal["auto", "reml", "ols", "wls", "eq14", "eq14-residual", "huber", "l1"]
FaultyReadings = Literal["auto", "drop", "keep"]
METHODS = get_args(Method)
ROBUST = ("huber", "l1")
WITH_KNOWLEDGE = ("auto", "profile")
# A larger share of readings beyond the noise is no accident of measuring: an effect that the model
# lacks looks like that.  Setting them apart would hide it.
MOST_SET_ASIDE = 0.1
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
    constrained or regularised fit on top of the method's weights (knowledge_fit).  `faulty`:
    readings beyond the noise are set apart (auto: unless they are too many to be reading errors),
    always, or never; they are listed in the result in any case.  `seed`: of multi-start and
    searches; `jobs` has no effect, as nothing is drawn in processes.
    """

    method: Method = "auto"
    noise: str = "auto"
    weights: WeightKind = "auto"
    covariance: NDArray[np.float64] | None = None
    intervals: IntervalKind = "auto"
    fixed: tuple[str, ...] = ()
    constraints: Constraints | None = None
    prior: GaussianPrior | None = None
    faulty: FaultyReadings = "auto"
    seed: int = 0
    jobs: int = 1

    def __post_init__(self) -> None:
        for name, value, valid in (
            ("method", self.method, METHODS),
            ("weights", self.weights, get_args(WeightKind)),
            ("intervals", self.intervals, INTERVALS),
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
            self._check_knowledge()

    def _check_knowledge(self) -> None:
        if self.resolved in ROBUST:
            raise InputError(
                f"the method {self.resolved} takes neither constraints nor a prior; use the "
                "default method, which sets faulty readings apart"
            )
        if self.intervals not in WITH_KNOWLEDGE:
            raise InputError(
                f"{option('intervals', self.intervals)} knows of neither constraints nor a prior; "
                f"with these there are {', '.join(WITH_KNOWLEDGE)}"
            )

    def sets_aside(self, faulty: NDArray[np.bool_]) -> bool:
        """Whether the `faulty` readings (N,) are left out of the fit."""
        if self.faulty == "auto":
            return bool(0 < faulty.mean() <= MOST_SET_ASIDE)
        return self.faulty == "drop" and bool(faulty.any())

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


def check_for_functions(options: Options) -> None:
    """Raise InputError for a method or intervals that take no prior, as smooth functions have."""
    if options.resolved in ROBUST or options.resolved.startswith("eq14"):
        raise InputError(
            f"the method {options.resolved} takes no prior, which smooth functions have; use the "
            "default method, which sets faulty readings apart"
        )
    if options.intervals not in ("auto", "classical"):
        raise InputError(
            f"{option('intervals', options.intervals)} knows of no prior, which smooth functions "
            "have; leave it away"
        )
