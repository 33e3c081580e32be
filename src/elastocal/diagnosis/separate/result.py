"""What the design of extra poses promises."""

from __future__ import annotations

from dataclasses import dataclass

from elastocal.measurements import Measurements


@dataclass(frozen=True)
class RivalPair:
    """Two hypotheses and how far apart they are: d in standard deviations of the noise, in the
    data so far and with the extra poses, each the smaller of the two ways round.

    The best possible test between two known alternatives is right with probability Φ(d/2).
    """

    first: str
    second: str
    distance_before: float
    distance_after: float


@dataclass(frozen=True)
class ExtraPlan:
    """Extra poses that tell the rivals apart, or why none would.

    `plan` holds one row per visit (pose and load state) in the order of measuring, None where
    poses cannot separate them; `probability_before` and `probability_after` of naming the right
    one of the rivals; `probability_random` the same after as many random poses.  Rivals that no
    pose separates count as one: `inseparable`, groups of their names.  `advice` in words (load,
    approach direction, time, monuments).
    """

    rivals: tuple[str, ...]
    pairs: tuple[RivalPair, ...]
    plan: Measurements | None
    n_poses: int
    probability_before: float
    probability_after: float
    probability_random: float
    separable: bool
    inseparable: tuple[tuple[str, ...], ...]
    advice: tuple[str, ...]
