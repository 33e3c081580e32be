"""Does the exact search find the best plan?  Every plan of small pools is evaluated.

    elastocal study experiment_design/exact_quality

Random pools (see small_pools.py) with the criteria test_pose, D and E.  Beside `exact_plan`, from
one start and from several: one plain exchange from one random plan, to show that local optima are
there to be caught in.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from small_pools import CRITERIA, all_plans, all_values, random_problem

from elastocal.planning.exchange import exact_plan, exchange, random_plan
from elastocal.planning.relaxation import DesignProblem, balanced, relax

EQUAL = 1e-7  # the ridge of balanced problems


def tasks(options: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {"criterion": name, "instance": k, "starts": options["starts"]}
        for name in CRITERIA
        for k in range(options["instances"])
    ]


def run(task: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Φ over the optimum for plain exchange, search from one start and from several.  The
    instance's number is its seed, as its draws were before this study had others: `rng` is not
    used."""
    seed, starts = task["instance"], task["starts"]
    problem = random_problem(task["criterion"], seed)
    plans = all_plans(problem)
    best = float(all_values(problem, plans).min())
    turned, _ = balanced(problem)
    relaxed = relax(turned)
    one = exact_plan(turned, relaxed, seed=seed)[1]
    several = exact_plan(turned, relaxed, starts=starts, seed=seed)[1]
    return {
        "plans": len(plans),
        "plain_exchange": plain_exchange(problem, seed) / best,
        "search": one / best,
        "search_from_several": several / best,
    }


def plain_exchange(problem: DesignProblem, seed: int) -> float:
    """Φ of one Fedorov exchange from one random plan."""
    rng = np.random.default_rng(seed)
    turned, _ = balanced(problem)
    return exchange(turned, random_plan(turned, rng))[1]


def summary(frame: pd.DataFrame) -> str:
    lines = [
        "| criterion | instances | plans each, at most | one plain exchange | search, one start | "
        "search, several starts | worst Φ/optimum of several |",
        "|---|---|---|---|---|---|---|",
    ]
    searches = ["search", "search_from_several"]
    for name in CRITERIA:
        rows = frame[frame["criterion"] == name]
        found = (rows[["plain_exchange", *searches]] <= 1 + EQUAL).sum()
        lines.append(
            f"| {name} | {len(rows)} | {rows['plans'].max()} | {found['plain_exchange']} "
            f"| {found['search']} | {found['search_from_several']} "
            f"| {rows['search_from_several'].max():.9f} |"
        )
    return "\n".join(lines)
