"""Does the exact search find the best plan?  Every plan of small pools is evaluated.

    elastocal study experiment_design/exact_quality

Random pools (see small_pools.py) with the criteria test_pose, D and E.  Beside `exact_plan`, with
and without the relaxation that `design` gives it: one plain exchange from one random plan, to show
that local optima are there to be caught in.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from small_pools import CRITERIA, all_plans, all_values, random_problem

from elastocal.planning.exact_plan import exact_plan
from elastocal.planning.relaxation import relax
from elastocal.planning.selection import DesignProblem, exchange, random_plan, regular_plan

EQUAL = 1e-9


def tasks(options: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {"criterion": name, "instance": k, "starts": options["starts"]}
        for name in CRITERIA
        for k in range(options["instances"])
    ]


def run(task: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Φ over the optimum for plain exchange, search, search with relaxation; share of the starts
    of the search that ended at the optimum.  The instance's number is its seed, as its draws were
    before this study had others: `rng` is not used."""
    seed, starts = task["instance"], task["starts"]
    problem = random_problem(task["criterion"], seed)
    plans = all_plans(problem)
    best = float(all_values(problem, plans).min())
    relaxed = relax(problem)
    alone = exact_plan(problem, starts=starts, seed=seed)
    aided = exact_plan(
        problem, relaxed_weights=relaxed.weights, tangent=relaxed.tangent, starts=starts, seed=seed
    )
    return {
        "plans": len(plans),
        "plain_exchange": plain_exchange(problem, seed) / best,
        "search": alone.value / best,
        "search_with_relaxation": aided.value / best,
        "starts_at_optimum": np.mean(alone.values <= best * (1 + EQUAL)),
    }


def plain_exchange(problem: DesignProblem, seed: int) -> float:
    """Φ of one Fedorov exchange from one random plan."""
    rng = np.random.default_rng(seed)
    return exchange(problem, regular_plan(problem, random_plan(problem, rng), rng)).value


def summary(frame: pd.DataFrame) -> str:
    lines = [
        "| criterion | instances | plans each, at most | one plain exchange | search | search with "
        "relaxation | worst Φ/optimum of either search | starts of the search at the optimum |",
        "|---|---|---|---|---|---|---|---|",
    ]
    searches = ["search", "search_with_relaxation"]
    for name in CRITERIA:
        rows = frame[frame["criterion"] == name]
        found = (rows[["plain_exchange", *searches]] <= 1 + EQUAL).sum()
        lines.append(
            f"| {name} | {len(rows)} | {rows['plans'].max()} | {found['plain_exchange']} "
            f"| {found['search']} | {found['search_with_relaxation']} "
            f"| {rows[searches].to_numpy().max():.9f} | {rows['starts_at_optimum'].mean():.1%} |"
        )
    return "\n".join(lines)
