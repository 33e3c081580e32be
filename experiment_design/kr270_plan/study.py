"""Table 2 against our plans: predicted, certified, and measured in simulated campaigns.

    .venv/bin/python experiment_design/kr270_plan/study.py [--jobs 2] [--campaigns 500]

Writes result.md, the plans as CSV and pictures of them beside itself.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from compared import Study, realised, table_2

from elastocal.planning.plan import write_plan
from elastocal.report.arm_view import write_plan_picture

HERE = Path(__file__).parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--candidates", type=int, default=20_000)
    parser.add_argument("--effort", default="thorough")
    parser.add_argument("--campaigns", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    text = ["# Result", "", f"`study.py`, {asked.campaigns} campaigns per plan.", ""]
    for name in ("joint_limits", "work_cell"):
        text += _of_cell(Study(name, asked.candidates), asked)
    (HERE / "result.md").write_text("\n".join(text) + "\n", encoding="utf-8")
    print("\n".join(text))


def _of_cell(study: Study, asked: argparse.Namespace) -> list[str]:
    print(f"{study.name}: ours", flush=True)
    started = time.perf_counter()
    ours = study.planned("test_pose", asked.effort, asked.jobs)
    took = time.perf_counter() - started
    write_plan(HERE / f"plan_{study.name}.csv", *ours.rows, forces=ours.stated_forces is not None)
    write_plan_picture(HERE / f"poses_{study.name}.png", ours)
    print(f"{study.name}: D-optimal", flush=True)
    by_determinant = study.planned("D", "normal", asked.jobs)
    random = study.at_random()
    plans = {
        "ours": ours.q,
        "D-optimal": by_determinant.q,
        "Table 2": table_2(study.model),
        "random (one of them)": study.pool.q[study.random_plan(np.random.default_rng(1))],
    }
    bound = float(ours.bound_reported or np.nan)
    removed = [f"{rule} {n}" for rule, n in ours.candidates.removed_by.items() if n]
    by_rules = f" (removed by {', '.join(removed)})" if removed else ""
    lines = [
        f"## {study.cell.name}",
        "",
        f"{ours.candidates.feasible} feasible candidates of {ours.candidates.tried} tried"
        f"{by_rules}; pool of {ours.certificate.pool} after {asked.effort} search, "
        f"{took:.0f} s with {asked.jobs} process(es).",
        "",
        f"Bound on the pool: ρ₀ ≥ {bound:.3f} µm. Efficiency of our plan: "
        f"{ours.certificate.efficiency_pool:.4f} certified on the pool, "
        f"{ours.certificate.efficiency_continuum:.4f} estimated on the continuum "
        f"({ours.certificate.searched} more poses, {ours.certificate.ascents} local searches).",
        "",
        "| plan | ρ₀ predicted, µm | over the bound | efficiency (bound²/ρ₀²) | poses the cell "
        "allows | realised rms, µm | realised / predicted |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, q in plans.items():
        rho = study.rho(q)
        print(f"{study.name}: campaigns with {name}", flush=True)
        errors = realised(study, q, asked.campaigns, asked.jobs)
        rms = 1e6 * np.sqrt(errors.mean())
        spread = errors.std() / errors.mean() / 2 / np.sqrt(len(errors))
        lines.append(
            f"| {name} | {rho:.3f} | {rho / bound:.3f} | {(bound / rho) ** 2:.3f} | "
            f"{int(study.allowed(q).sum())} of {len(q)} | {rms:.3f} | "
            f"{rms / rho:.3f} ± {2 * spread:.3f} |"
        )
    low, high = random.min(), np.median(random)
    lines += [
        "",
        f"Of {len(random)} random feasible plans the median has ρ₀ = {high:.3f} µm "
        f"({high / bound:.2f} times the bound), the best {low:.3f} µm. Table 2 has "
        f"{study.rho(table_2(study.model)) / study.rho(ours.q):.3f} times our ρ₀.",
        "",
    ]
    return lines


if __name__ == "__main__":
    main()
