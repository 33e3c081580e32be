"""The frozen result of a design: poses in order, what they promise, how far from the best."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.above import Result
from elastocal.design.order.execution import Execution
from elastocal.design.plan_file import plan_rows
from elastocal.design.random_plans import RandomPlans
from elastocal.design.reasons import Predicted, Reason
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements
from elastocal.planning.criterion import Criterion

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Candidates:
    """How many poses were tried, how many the cell allows, and which rule removed the others."""

    tried: int
    feasible: int
    removed_by: dict[str, int]


@dataclass(frozen=True)
class Certificate:
    """How far the plan is from the best, as shares of the criterion (1: cannot be better).

    `efficiency_pool` is certified: no plan with the same shares from the `pool` candidates has a
    value below `bound_pool`.  `efficiency_continuum` is an estimate: the search tried `searched`
    poses and `ascents` local searches, and a better pose may still exist.  Values Φ; None where
    the criterion has no bound.
    """

    pool: int
    bound_pool: float | None
    efficiency_pool: float | None
    bound_continuum: float | None = None
    efficiency_continuum: float | None = None
    searched: int = 0
    ascents: int = 0


@dataclass(frozen=True)
class Chance:
    """The same number of random feasible poses: criteria of `drawn` such plans in the plan's unit.

    `determined` of them determine every parameter; `median`, `best` and `worst` are None where
    that plan does not.  `efficiency` is the plan's Φ over the median's, None where the criterion
    has no bound: such a Φ does not count poses.
    """

    drawn: int
    determined: int
    median: float | None
    best: float | None
    worst: float | None
    efficiency: float | None

    @classmethod
    def of(cls, found: RandomPlans, value: float, criterion: Criterion) -> Chance:
        """What `found` is beside a plan of Φ = `value`."""

        def known(phi: float) -> float | None:
            return criterion.reported(phi)[0] if np.isfinite(phi) else None

        values = found.values
        return cls(
            len(values), found.determined, known(found.median), known(float(values[0])),
            known(float(values[-1])),
            found.efficiency(value) if criterion.certifiable else None,
        )  # fmt: skip


@dataclass(frozen=True)
class SizePoint:
    """The criterion of the best plan found of `poses` poses, and its bound, in the plan's unit."""

    poses: int
    value: float
    bound: float | None


@dataclass(frozen=True, repr=False)
class Plan(Result):
    """A measurement plan: poses in their order, what they promise, how far from the best they are.

    Attributes:
        model: The `Model` that it is for.
        criterion: What was made small; `value` is it as the search has it (Φ), `reported` as people
            know it, in `unit`.
        q: Commanded joints (N, joints), in rad or m.
        load: (N,), each pose's load state, an index into `forces`; −1 for all of them.
        forces: Load states (L, 3), in N.
        group: (N,), the level of each pose, an index into `levels` of the joint `level_joint`.
        execution: The order of execution, with the points in between.
        candidates: How many poses were tried, and which rule removed how many.
        certificate: How far the plan is from the best: certified on the pool of candidates,
            estimated on the continuum.
        predicted: How far each parameter will be known.
        reasons: What each pose is for.
        targets: What the test poses were, in words.
        seed: Of all random draws.
        polished: How many poses were moved from their candidate.
        curve: The criterion against the number of poses, where it was asked for.
        bound_reported: The certificate's bound, in `unit`.
        warnings: What to know before one measures, in sentences.
        first: Number of the first configuration: after those that were measured already.
        chance: What as many random poses would reach.

    Examples:
        >>> plan = ec.design(
        ...     "cell.toml", poses=4, criterion="D", candidates=60, effort="quick",
        ...     loads=[[0, 0, -2600]], levels={"joint2": np.radians([-25.24, -99.85])},
        ... )
        >>> len(plan), plan.q.shape, plan.unit
        (4, (4, 6), 'log det')
        >>> data = ec.simulate("cell.toml", plan, load=[0, 0, -2600])
        >>> plan.save("plan4.csv")
    """

    model: Model
    criterion: str
    value: float
    reported: float
    unit: str
    q: Array
    load: IntArray
    forces: Array
    group: IntArray
    levels: tuple[float, ...]
    level_joint: str | None
    execution: Execution
    candidates: Candidates
    certificate: Certificate
    predicted: tuple[Predicted, ...]
    reasons: tuple[Reason, ...]
    targets: str
    seed: int
    polished: int = 0
    curve: tuple[SizePoint, ...] = ()
    bound_reported: float | None = None
    warnings: tuple[str, ...] = field(default=())
    first: int = 1
    chance: Chance | None = None

    def __repr__(self) -> str:
        sure = self.certificate.efficiency_pool
        told = "" if sure is None else f", at least {100 * sure:.1f} % of the best of its pool"
        return (
            f"<Plan {self.model.chain.name}: {len(self)} poses by {self.criterion}, "
            f"{self.reported:.4g} {self.unit}{told}>"
        )

    def __len__(self) -> int:
        return len(self.q)

    def table(self) -> Measurements:
        """The poses as a table for `simulate`, as the plan's file has them."""
        rows = plan_rows(self.execution, self.configurations, self.group + 1, self.stated_forces)
        return rows.table(self.model.chain.kinds)

    @property
    def configurations(self) -> tuple[str, ...]:
        """Their names: numbers from `first` on."""
        return tuple(str(self.first + k) for k in range(len(self.q)))

    @property
    def group_names(self) -> tuple[str, ...]:
        """The levels as people read them: "joint2 at -25.24°"."""
        if self.level_joint is None:
            return ("poses",)
        revolute = self.model.chain.kinds[int(self.level_joint.removeprefix("joint")) - 1]
        if revolute == "revolute":
            return tuple(f"{self.level_joint} at {np.degrees(v):.6g}°" for v in self.levels)
        return tuple(f"{self.level_joint} at {v * 1e3:.6g} mm" for v in self.levels)

    @property
    def stated_forces(self) -> Array | None:
        """The load states where the plan must state them row by row.

        Not where every pose is measured unloaded, or unloaded and under one load, which is what
        `simulate` does with a load to a plan without forces.
        """
        loaded = np.any(self.forces != 0, axis=1)
        usual = not loaded[0] and loaded[1:].all() and len(loaded) <= 2
        return None if usual and (self.load < 0).all() else self.forces

    def to_json(self) -> dict[str, Any]:
        """The plan as numbers and texts; the file adds its schema."""
        c = self.certificate
        return {
            "criterion": self.criterion,
            "value": self.reported,
            "unit": self.unit,
            "n_poses": len(self.q),
            "candidates": {
                "tried": self.candidates.tried,
                "feasible": self.candidates.feasible,
                "removed_by": self.candidates.removed_by,
            },
            "certificate": {
                "efficiency_pool": c.efficiency_pool,
                "bound_pool": self.bound_reported,
                "efficiency_continuum": c.efficiency_continuum,
                "pool": c.pool,
                "pool_is": "certified on the pool",
                "continuum_is": "estimated on the continuum",
                "searched": c.searched,
                "ascents": c.ascents,
            },
            "random_plans": None if self.chance is None else {
                "n": self.chance.drawn,
                "determined": self.chance.determined,
                "median": self.chance.median,
                "best": self.chance.best,
                "worst": self.chance.worst,
                "efficiency": self.chance.efficiency,
            },
            "predicted": [
                {
                    "name": p.name,
                    "std": p.std,
                    "unit": p.unit,
                    "ci95_half_width": p.half_width,
                    "combined_with": list(p.combined_with),
                }
                for p in self.predicted
            ],
            "poses": [
                {
                    "configuration": k + 1,
                    "value_without": None if not np.isfinite(r.loss) else r.loss,
                    "serves": [
                        {"name": name, "std_without": None if not np.isfinite(f) else f}
                        for name, f in r.serves
                    ],
                }
                for k, r in enumerate(self.reasons)
            ],
            "curve": [{"n_poses": s.poses, "value": s.value, "bound": s.bound} for s in self.curve],
            "warnings": list(self.warnings),
            "seed": self.seed,
        }  # fmt: skip
