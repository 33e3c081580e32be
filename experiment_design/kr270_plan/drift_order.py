"""What 50 µm of steady drift put on the test poses, by the order in which a plan is measured.

    .venv/bin/python experiment_design/kr270_plan/drift_order.py

The plans of `plan_*.csv` and, in joint limits, Table 2: all unloaded and then all loaded on the
shortest way, and in the order of `design` with two and with four changes of load, also where an
`extra_time` leaves no time to read poses twice without load.  Writes drift.md.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from compared import HERE, Study, table_2

from elastocal.measurements import read_plan
from elastocal.planning.arrangement import VIA
from elastocal.planning.choices import at_stops
from elastocal.planning.execution import DRIFT, Alias, schedule
from elastocal.planning.further_effects import clocked

CANDIDATES = 2000  # those behind the setup, and the points that moves may go through
ORDERS = {  # changes of load, share of extra time
    "all unloaded, then all loaded": (None, 0.0),
    "`design`, two changes of load": (2, None),
    "`design`, four changes": (4, None),
    "`design`, two changes, `extra_time = 0.05`": (2, 0.05),
    "`design`, four changes, `extra_time = 0.05`": (4, 0.05),
}


def main() -> None:
    lines = [
        "# A drift, by order",
        "",
        f"`drift_order.py`: what a drift of tracker or base by {1e6 * DRIFT:.0f} µm, steady from "
        "the first reading to the last, puts on the test poses at worst, and along x, y, z; µm. "
        "Where no `extra_time` is stated poses are read twice without load, half their readings "
        "each time, if that pays.",
        "",
        "| plan | order | ρ₀ | stops | time, min | travel, s | at worst | x, y, z |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in ("joint_limits", "work_cell"):
        study = Study.of(name, CANDIDATES)
        kinds = study.model.chain.kinds
        plans = {f"`plan_{name}.csv`": read_plan(HERE / f"plan_{name}.csv", joint_kinds=kinds).q}
        if name == "joint_limits":
            plans["Table 2"] = table_2(study.model)
        for called, q in plans.items():
            lines += [f"| {called} | {row}" for row in _rows(study, q)]
            print("\n".join(lines[-len(ORDERS) :]), flush=True)
    (HERE / "drift.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _rows(study: Study, q: np.ndarray) -> list[str]:
    blocks = study.setup.information.blocks(q)
    M, R = study.setup.gathered(blocks), study.setup.target_rows
    alias = Alias.of(study.setup.information, q, blocks, M, R)
    assert alias is not None and alias.at_test_poses
    rows = []
    for order, (changes, extra) in ORDERS.items():
        motion = replace(at_stops(study.cell), load_changes=changes, extra_time=extra)
        execution = schedule(
            q, motion, study.feasibility, loads=study.forces,
            via=study.pool.q[:: max(len(study.pool) // VIA, 1)], alias=alias,
        )  # fmt: skip
        stops = clocked(execution).stops
        time = np.array([stop.time for stop in stops])
        course = DRIFT * (time - time.mean()) / np.ptp(time)
        read = Counter((stop.pose, stop.load) for stop in stops)
        error = sum(  # of the tool, per direction of the drift
            t * alias.share[stop.pose, stop.load] / read[stop.pose, stop.load]
            for t, stop in zip(course, stops, strict=True)
        )
        assert extra == 0 or np.isclose(execution.drift.bias, np.linalg.norm(error, 2))
        along = ", ".join(f"{1e6 * v:.2f}" for v in np.linalg.norm(error, axis=0))
        rows.append(
            f"{order} | {1e6 * alias.noise:.2f} | {len(execution.stops)} | "
            f"{execution.total / 60:.0f} | {execution.travel:.0f} | "
            f"{1e6 * np.linalg.norm(error, 2):.2f} | {along} |"
        )
    return rows


if __name__ == "__main__":
    main()
