"""In which load states each pose is read: in all of them, or each where it tells most.

With a pose read in one load state as a candidate, the relaxation weighs poses and load states
together: it has as many stops as the poses have in all load states, shared out anew.  Each load
takes changes by hand, each of which is worth Δ/a stops (Δ s of a change, a s of a stop): with Φ of
order 1/stops, a choice of loads that saves c changes of n stops is as good, in the same time, as

    Φ n / (n + c Δ/a)

Loads that are used least are left out one by one, and the best choice is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from elastocal.errors import require
from elastocal.planning.exchange import prospects
from elastocal.planning.execution import at_stops
from elastocal.planning.information import PoseInformation
from elastocal.planning.relaxation import balanced
from elastocal.planning.setup import Setup
from elastocal.units import Array, IntArray, Progress

# Of Φ, 1 % of an error, by which a choice must be better: the same poses in all load states are
# simpler to measure, and a noise that is stated is not known to that.
SIMPLER = 0.02
SOME = 1000  # poses that the choice is made on
GAP = 1e-3  # of its relaxations


@dataclass(frozen=True)
class LoadStates:
    """In which load states poses are read: each in `"all"`, or each in those `"chosen"` for it.

    `crossed` and `chosen`: the relaxed optimum of both in the plan's unit, in the same time; None
    where there is nothing to choose, and `why`.
    """

    used: Literal["all", "chosen"]
    why: str
    crossed: float | None = None
    chosen: float | None = None

    def to_json(self, forces: Array, readings: IntArray, unit: str) -> dict[str, Any]:
        """With the numbers of poses of a plan that reads them as `readings` (N, L) say."""
        counts = np.count_nonzero(readings, axis=0).tolist()
        stops = zip(forces.tolist(), counts, strict=True)
        return {
            "used": self.used,
            "why": self.why,
            "unit": unit,
            "relaxed": {"all": self.crossed, "chosen": self.chosen},
            "stops": [{"load_N": force, "poses": n} for force, n in stops],
        }


def single_ways(information: PoseInformation) -> IntArray:
    """The ways (K, L) to read a pose in one load state: of deflections in one and unloaded."""
    ways = information.everything * np.eye(len(information.forces), dtype=np.int64)
    if information.model.cell.model.observe == "deflection":
        ways[1:, 0] = ways[0, 0]
        ways = ways[1:]
    return ways


def chosen_states(
    setup: Setup, q: Array, group: IntArray, shares: IntArray, progress: Progress
) -> tuple[IntArray, LoadStates]:
    """The ways (K, L) in which candidates q (N, n) are best read, and why.

    Raises InputError where readings of a pose in several load states share what the choice takes
    for independent.
    """
    information, cell = setup.information, setup.information.model.cell
    require(
        not cell.noise.configuration or cell.model.observe == "deflection",
        f"{cell.path or cell.name}: [noise] configuration_um says that a pose's readings share an "
        'error in all load states, which only load_states = "all" counts with; drop one of them',
    )
    ways = single_ways(information)
    if len(ways) == 1:
        one = "a deflection takes its reading without load and that under the only one"
        alone = "there is one load state"
        return information.everything, LoadStates("all", one if ways.sum() > 1 else alone)
    progress("load states of the poses")
    few = np.arange(0, len(q), max(len(q) // SOME, 1))

    def relaxed(ways: IntArray) -> tuple[float, Array]:
        """Φ of the relaxed optimum and the weight of each way."""
        own = replace(setup, ways=ways)
        problem, _ = balanced(own.problem(own.pool(q[few], group[few]), shares))
        weights = prospects(problem, GAP).weights
        value = float(problem.criterion.of_information(problem.at(weights)))
        return value, weights.reshape(len(ways), -1).sum(axis=1)

    motion, loaded = at_stops(cell), (information.forces != 0).any(axis=1)
    crossed, _ = relaxed(information.everything)
    stops = float(shares.sum() * len(loaded))
    # Nothing but travel may take time; that is not told here.
    worth = motion.load_change / max(motion.dwell * (2 if motion.both_directions else 1), 1.0)
    kept, best, least = np.arange(len(ways)), ways, np.inf
    while True:
        value, weight = relaxed(ways[kept])
        heavy = (ways[kept] > 0)[:, loaded].any(axis=1)
        saved = (loaded.sum() - heavy.sum()) * worth
        if value * stops / (stops + saved) < least:
            best, least = ways[kept], value * stops / (stops + saved)
        if heavy.sum() < 2:
            break
        kept = np.delete(kept, np.flatnonzero(heavy)[np.argmin(weight[heavy])])
    figures = setup.criterion.figure(crossed), setup.criterion.figure(least)
    if least > (1 - SIMPLER) * crossed:
        why = "choosing them for each pose would hardly lower the error"
        return information.everything, LoadStates("all", why, *figures)
    return best, LoadStates("chosen", "", *figures)
