"""Poses that `design` chooses among those measured, and as many at random, on real arms.

ELASTOCAL_DATASETS=… python planned.py        prints a table, writes planned.md, out/planned_*

A table is divided at random.  From one part `design` chooses poses; the cell is identified on their
readings, and on those of RANDOM sets of as many poses; all predict the poses of the other part.
"""

from __future__ import annotations

import csv
import random
from pathlib import Path
from statistics import median

from diagnose import OUT, elastocal, identified, mm
from prepare import HERE, prepare

SEED, RANDOM = 3, 20
POSES = (12, 15, 20, 30, 50)
# Cell, table and how many of its poses there are to choose from.
ARMS = {
    "UR10": ("ur10.toml", "ur10_3000.csv", 2000),
    "UR5": ("ur5.toml", "ur5_grid.csv", 500),
    "WAM": ("wam.toml", "wam_grid.csv", 108),
}
# A plan needs the noise of a reading; equal noise of any size makes the same one, but for what is
# hardly to be seen.
NOISE = "\n[tracker]\nsigma_um = 30\n"
HEAD = (
    "| arm | poses | planned | random: median | least and largest of 20 "
    "| planned is better than |\n"
    "|---|---|---|---|---|---|"
)


def stored(name: str, header: str, lines: list[str]) -> Path:
    path = OUT / f"planned_{name}.csv"
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


def planned(cell: Path, candidates: Path, n: int) -> list[int]:
    """Numbers of the poses chosen among the candidates."""
    plan = OUT / "planned_plan.csv"
    elastocal("design", cell, "-o", plan, "--poses", n, "--candidates", candidates)
    with open(plan, newline="", encoding="utf-8") as handle:
        return [int(row["configuration"]) - 1 for row in csv.DictReader(handle)]


def error(cell: Path, header: str, chosen: list[str], test: Path) -> float:
    """Rms error in µm at the poses of `test` of the cell identified on the `chosen` lines."""
    fit = stored("fit", header, chosen)
    return identified(cell, fit, "planned", "--test", test)["test"]["rms_um"]


def main() -> None:
    data, rows = prepare(), [HEAD]
    OUT.mkdir(exist_ok=True)
    print(f"\nErrors at poses not fitted, rms in mm.\n\n{HEAD}")
    for arm, (name, table, some) in ARMS.items():
        header, *lines = (data / table).read_text(encoding="utf-8").splitlines()
        random.Random(SEED).shuffle(lines)
        pool, test = lines[:some], stored("test", header, lines[some:])
        candidates, cell = stored("pool", header, pool), HERE / f"planned_{name}"
        cell.write_text((HERE / name).read_text(encoding="utf-8") + NOISE, encoding="utf-8")
        for n in POSES:
            chosen = [pool[k] for k in planned(cell, candidates, n)]
            own, draw = error(HERE / name, header, chosen, test), random.Random(SEED)
            others = sorted(
                error(HERE / name, header, draw.sample(pool, n), test) for _ in range(RANDOM)
            )
            rows.append(
                f"| {arm} | {n} | {mm(own)} | {mm(median(others))} "
                f"| {mm(others[0])} to {mm(others[-1])} "
                f"| {sum(own < other for other in others)} of {RANDOM} |"
            )
            print(rows[-1], flush=True)
        cell.unlink()
    (HERE / "planned.md").write_text("\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
