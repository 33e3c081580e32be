"""What a method ends with."""

from __future__ import annotations

from dataclasses import dataclass, field

from elastocal.identification.constrained import ActiveConstraint
from elastocal.identification.intervals import Intervals
from elastocal.identification.noise_choice import NoiseFit
from elastocal.identification.smooth_part import SmoothPart
from elastocal.identification.solve import Solution
from elastocal.units import Array, BoolArray


@dataclass(frozen=True)
class MethodResult:
    """The final fit, its intervals, and the noise where it was estimated.

    Readings that are not `good` (N,) lie beyond the noise, whether or not they had a part in the
    fit.  What constraints and a prior add: `active` constraints, `prior_share` by parameter, how
    many parameters the readings paid for (`effective`), `leverage` (rows,), and `warnings` where
    the readings contradict them; in a fit to readings alone effective and leverage follow from
    the solution.  `smooth` are the smooth functions, with which `standard` (N, size) are the
    residuals of all readings free of the fit's part in them.  `limits` are the 95 % intervals of
    the parameters that the readings `hardly_shown`, by their index.
    """

    method: str
    solution: Solution
    intervals: Intervals
    noise: NoiseFit | None
    good: BoolArray
    active: tuple[ActiveConstraint, ...] = ()
    prior_share: dict[str, float] = field(default_factory=dict)
    effective: int | None = None
    leverage: Array | None = None
    warnings: tuple[str, ...] = ()
    smooth: tuple[SmoothPart, ...] = ()
    standard: Array | None = None
    limits: dict[int, tuple[float, float]] = field(default_factory=dict)
