"""Does the exact search find the best plan?  Every plan of small pools is evaluated.

    python study.py [--instances 100] [--starts 5]

Random pools (see small_pools.py) with the criteria test_pose, D and E.  Beside `exact_plan`, with
and without the relaxation that `design` gives it: one plain exchange from one random plan, to show
that local optima are there to be caught in.  Prints the table and writes result.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from small_pools import CRITERIA, all_plans, all_values, random_problem

from elastocal.design.exact.exchange import exchange
from elastocal.design.exact.plan import exact_plan
from elastocal.design.exact.pool import random_plan
from elastocal.design.exact.regular import regular_plan
from elastocal.design.problem import DesignProblem
from elastocal.design.relaxation.relax import relax

HERE = Path(__file__).parent
EQUAL = 1e-9


def plain_exchange(problem: DesignProblem, seed: int) -> float:
    """Φ of one Fedorov exchange from one random plan."""
    rng = np.random.default_rng(seed)
    return exchange(problem, regular_plan(problem, random_plan(problem, rng), rng)).value


def instance(name: str, seed: int, starts: int) -> tuple[int, list[float], float]:
    """Number of plans; Φ over the optimum for plain exchange, search, search with relaxation;
    share of the starts of the search that ended at the optimum."""
    problem = random_problem(name, seed)
    plans = all_plans(problem)
    best = float(all_values(problem, plans).min())
    relaxed = relax(problem)
    alone = exact_plan(problem, starts=starts, seed=seed)
    aided = exact_plan(
        problem, relaxed_weights=relaxed.weights, tangent=relaxed.tangent, starts=starts, seed=seed
    )
    values = [plain_exchange(problem, seed), alone.value, aided.value]
    at_optimum = float(np.mean(alone.values <= best * (1 + EQUAL)))
    return len(plans), [v / best for v in values], at_optimum


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--instances", type=int, default=100)
    parser.add_argument("--starts", type=int, default=5)
    chosen = parser.parse_args()
    lines = [
        "| criterion | instances | plans each, at most | one plain exchange | search | search with "
        "relaxation | worst Φ/optimum of either search | starts of the search at the optimum |",
        "|---|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines))
    for name in CRITERIA:
        begun = time.perf_counter()
        runs = [instance(name, seed, chosen.starts) for seed in range(chosen.instances)]
        ratios = np.array([r[1] for r in runs])
        found = (ratios <= 1 + EQUAL).sum(axis=0)
        lines.append(
            f"| {name} | {chosen.instances} | {max(r[0] for r in runs)} | {found[0]} | {found[1]} "
            f"| {found[2]} | {ratios[:, 1:].max():.9f} | {np.mean([r[2] for r in runs]):.1%} |"
        )
        print(lines[-1], f"{time.perf_counter() - begun:.0f} s", flush=True)
    (HERE / "result.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
