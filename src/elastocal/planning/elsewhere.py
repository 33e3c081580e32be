"""As good as possible all over the joint ranges, at a price at the test poses that is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from elastocal.planning.exact_plan import restrict
from elastocal.planning.relaxation import relax
from elastocal.planning.selection import DesignProblem
from elastocal.planning.setup import FeasiblePool, Setup
from elastocal.units import IntArray, Progress

# The weight of what lies elsewhere, from the price that the test poses may pay for it.
#
# The relaxed optimum w(s) of Φ = (1 − s) Φ_test + s Φ_elsewhere has Φ_test(w(s)) rising and
# Φ_elsewhere(w(s)) falling with s; all that can be had lies on this curve (both are convex).  Near
# s = 0, where Φ_test is least, it rises with the square of u = s/(1 − s).

FIRST, MOST = 0.3, 0.9  # shares tried first, and at most
TRIES = 5
CLOSE = 0.004  # of Φ at the test poses under the limit: a better share would not be noticed
LOOSE = 1e-3  # gap of the relaxations
SOME = 4000  # candidates that tell the share: it hangs on where poses are, not on each of them


def share_within(
    setup: Setup, pool: FeasiblePool, shares: IntArray, cap: float, progress: Progress
) -> float:
    """The largest share s of the postures elsewhere for which the relaxed optimum is at most
    `cap` worse at the test poses (rms) than it could be; 0 where there are none."""
    if setup.elsewhere_rows is None or not cap:
        return 0.0
    progress(f"weight of the joint ranges, at most {100 * cap:g} % worse at the test poses")
    problem = _some(setup.sharing(0.0).problem(pool, shares))
    own = problem.criterion
    alone = relax(problem, tolerance=LOOSE)
    least, limit = alone.value, (1 + cap) ** 2 * alone.value
    low, high, share, weights = 0.0, MOST, FIRST, alone.weights
    for _ in range(TRIES):
        other = replace(problem, criterion=setup.sharing(share).criterion)
        weights = relax(other, tolerance=LOOSE, start=weights).weights
        value = float(own.value(problem.information(weights)))
        if value <= limit:
            low = share
            if share == MOST or value > (1 - CLOSE) * limit:
                break
        else:
            high = share
        u = share / (1 - share) * np.sqrt((limit - least) / max(value - least, 1e-3 * least))
        share = u / (1 + u)
        if not low < share < high:
            share = high if high == MOST and low else (low + high) / 2
    return low


def _some(problem: DesignProblem) -> DesignProblem:
    """The problem with about SOME of its candidates, equally many of each group."""
    each = max(SOME // len(problem.shares), 20 * int(problem.shares.max()))
    members = [np.flatnonzero(problem.group == g) for g in range(len(problem.shares))]
    return restrict(problem, np.sort(np.concatenate([m[:: -(-len(m) // each)] for m in members])))
