"""What the commands cost: start, first answer, every command on the demo, large tables.

    python benchmarks/costs.py [--size tiny|short|full] [--beside SRC]

Every command runs in a process of its own.  `--beside` names the folder `src` of another checkout:
each command runs there too, in turn, and its CPU time over that of this one stands beside.  Tables
of a million readings and 10 000 rows of a diagnosis are simulated by the command itself.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_arms import kr270, poses, truth
from bench_tools import HERE, Ran, elastocal, goal, table

from elastocal.measurements import Measurements
from elastocal.model.chain import joint_limits
from elastocal.model.manipulator import Model
from elastocal.simulation import expand_plan, simulate, values_from

EXAMPLE = HERE.parent / "experiment_design" / "blind_diagnosis" / "example"
ROWS = {"tiny": (1000,), "short": (10_000,), "full": (10_000, 1_000_000)}
HIDDEN = {"joint4.harmonic2_sin": 3e-4, "joint4.harmonic2_cos": -2e-4}


class Clock:
    """Runs commands, here and beside; `rows` of the table."""

    def __init__(self, beside: Path | None) -> None:
        self.beside, self.rows = beside, []

    def run(self, what: str, *arguments: Any, repeats: int = 1, limit: float = 0.0) -> Ran:
        """The run of least wall time; a goal where its wall time has a limit in s."""
        here, there = [], []
        for _ in range(repeats):
            here.append(elastocal(*arguments))
            if self.beside:
                there.append(elastocal(*arguments, PYTHONPATH=str(self.beside)))
        best = min(here, key=lambda ran: ran.wall)
        row = [what, best.wall, best.cpu, best.peak_mb]
        if self.beside:
            row.append(min(ran.cpu for ran in there) / best.cpu)
        self.rows.append(row)
        if limit:
            goal(f"{what}, wall, at most {limit:g} s", best.wall, limit, "s")
        return best


def demo_commands(clock: Clock, folder: Path, tiny: bool) -> None:
    """Every command on the demo."""
    repeats = 1 if tiny else 5
    for verb in ((), ("identify",), ("design",), ("diagnose",)):
        what = f"`{' '.join(('elastocal', *verb, '--help'))}`"
        clock.run(what, *verb, "--help", repeats=repeats, limit=0.15)
    demo = folder / "demo"
    clock.run("demo", "demo", "-o", demo)
    cell, data = demo / "cell.toml", demo / "data.csv"
    clock.run("identify", "identify", cell, data, "--quiet", repeats=repeats, limit=1.0)
    page = ("--report", folder / "r.html")
    clock.run("identify with report", "identify", cell, data, *page, "--quiet")
    clock.run("simulate", "simulate", cell, demo / "plan.csv", "-o", folder / "sim.csv",
              "--load", 0, 0, -2600, "--repeats", 6)  # fmt: skip
    if tiny:
        return
    clock.run("diagnose", "diagnose", cell, data, "-o", folder / "diagnosis.json", "--quiet")
    arm = folder / "arm"
    arm.mkdir()
    robot = shutil.copy(demo / "kr270_2.urdf", arm)
    clock.run("init", "init", robot, "-o", arm / "cell.toml", "--force")
    plan = ("design", arm / "cell.toml", "-o", arm / "plan.csv", "--effort", "quick", "--quiet")
    one = clock.run("design of 30 poses, quick, the cell as `init` writes it", *plan, "--poses", 30)
    curve = clock.run("the same with `--curve` of three sizes", *plan, "--curve", "20,30,40")
    goal("design of 30 poses, quick, CPU, at most 20 s", one.cpu, 20, "s")
    goal("`--curve` of three sizes over one plan, CPU, at most 2", curve.cpu / one.cpu, 2)


def large_fits(clock: Clock, folder: Path, size: str) -> None:
    """Readings of a KR 270 with 46 parameters, from the file to the result."""
    model = kr270(folder)
    held = ("link6.dx", "link6.dy", "link6.dz", "link6.rx", "link6.ry")
    fixed = [part for name in held for part in ("--fix", name)]
    for rows in ROWS[size]:
        data = folder / f"data{rows}.csv"
        simulate(model, poses(model, rows), truth(model), 5).save(data)
        given = ("identify", folder / "kr270.toml", data, "-o", folder / "r.json", "--quiet")
        limit = {10_000: 3.0, 1_000_000: 30.0}.get(rows, 0.0)
        ran = clock.run(f"identify of {rows} readings, 46 parameters", *given, *fixed, limit=limit)
        if rows == 1_000_000:
            goal("peak memory of that, at most 1 GB", ran.peak_mb / 1e3, 1.0, "GB")


def diagnoses(clock: Clock, folder: Path, size: str) -> None:
    """The blind check's example, and tables of the same arm with a gear out of round."""
    cases = [("blind check, 60 poses × 2 loads × 3 markers", EXAMPLE / "data.csv", 2.5)]
    if size != "tiny":
        cases.append(("simulated, 10000 rows", simulated(folder, 10_000), 15.0))
    for what, data, limit in cases:
        given = ("diagnose", EXAMPLE / "cell.toml", data, "-o", folder / "d.json", "--quiet")
        clock.run(f"diagnose, {what}", *given, limit=limit)


def simulated(folder: Path, rows: int) -> Path:
    """At least `rows` rows: random poses × 2 loads × 3 markers, with times and approach, so that
    the whole catalogue is tried."""
    text = (EXAMPLE / "cell.toml").read_text().replace('urdf = "', f'urdf = "{EXAMPLE}/')
    text = text.replace('"marker_position"]', '"marker_position", "gear_second_harmonic"]')
    world = folder / "world.toml"
    world.write_text(text.replace("[tracker]\n", "[tracker]\nsigma_um = 15\n"))
    model = Model(world)
    low, high = joint_limits(model.cell, model.chain)
    q = np.random.default_rng(rows).uniform(low, high, (-(-rows // 6), len(low))).round(9)
    plan = Measurements.of_poses("plan", q, np.zeros(3))
    table = expand_plan(plan, tuple(model.cell.tool.markers), 1, np.array([0.0, 0.0, -300.0]))
    side = np.where(np.diff(q, axis=0, prepend=0.0) < 0, -1.0, 1.0)
    found = simulate(model, table, values_from(model, HIDDEN), 3)
    found = replace(found, time=3.0 * np.arange(len(found)), approach=side[found.configuration])
    found.save(folder / "diagnosed.csv")
    return folder / "diagnosed.csv"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", choices=("tiny", "short", "full"), default="short")
    parser.add_argument("--beside", type=Path, help="the folder src of another checkout")
    asked = parser.parse_args()
    clock = Clock(asked.beside)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        demo_commands(clock, folder, asked.size == "tiny")
        large_fits(clock, folder, asked.size)
        diagnoses(clock, folder, asked.size)
    beside = ["CPU of the other over it"] if asked.beside else []
    table("The commands", ["command", "wall, s", "CPU, s", "peak, MB", *beside], clock.rows)


if __name__ == "__main__":
    main()
