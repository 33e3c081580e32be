"""How a plan is searched for; what it is to be stands in the cell's [design]."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from elastocal.errors import require
from elastocal.identification.constrained.prior import GaussianPrior
from elastocal.measurements import Measurements
from elastocal.text import did_you_mean, listed

Effort = Literal["quick", "normal", "thorough"]


@dataclass(frozen=True)
class Search:
    """`rounds` of polishing and of poses from the continuum added to the pool; `starts` of the
    exchange; fresh `points` per level and `ascents` when the continuum is searched."""

    rounds: int
    starts: int
    points: int
    ascents: int


EFFORTS: dict[str, Search] = {
    "quick": Search(rounds=0, starts=4, points=4096, ascents=2),
    "normal": Search(rounds=1, starts=10, points=16_384, ascents=4),
    "thorough": Search(rounds=3, starts=30, points=65_536, ascents=10),
}


@dataclass(frozen=True)
class DesignOptions:
    """`fixed`: parameters, places or effects held; `prior`: what is known of parameters;
    `done`: measurements that the plan adds to; `curve`: numbers of poses to compare; `notes`:
    sentences on how these came about, for the plan's warnings."""

    effort: Effort = "normal"
    seed: int = 0
    jobs: int = 1
    fixed: tuple[str, ...] = ()
    prior: GaussianPrior | None = None
    done: Measurements | None = None
    curve: tuple[int, ...] = field(default=())
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        efforts = get_args(Effort)
        require(
            self.effort in efforts,
            f"effort '{self.effort}' is unknown{did_you_mean(self.effort, efforts)}; there are "
            f"{listed(efforts)}",
        )
        require(self.seed >= 0, f"the seed must not be negative, found {self.seed}")
        require(
            self.jobs == -1 or self.jobs >= 1,
            f"jobs takes a number of processes, or -1 for all cores; found {self.jobs}",
        )
        require(
            all(n >= 1 for n in self.curve), f"a curve takes numbers of poses, found {self.curve}"
        )
