"""B of a whole table, six ways: CasADi's three, numpy by hand, a bare C loop, and elastocal's; and
of few rows by elastocal's second, which is CasADi again.

    python benchmarks/evaluation.py [--size tiny|short|full] [--json FILE]

A KR 270 with 51 geometric parameters.  All ways get the same rows in turn, round after round; the
least of several rounds counts.  Every way's B is compared with that of the replay first.  The
Python loop and `map` of a million rows are run with --size full only.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import casadi as ca
import numpy as np
from bench_arms import GEOMETRY, kr270, poses, truth
from bench_clock import own, race
from bench_part import Part, Table, run_alone
from evaluation_numpy import NumpyRegressor
from evaluation_rivals import BareC, Mapped, buffered_loop, function_of, python_loop

from elastocal.model.arm import row_inputs
from elastocal.model.evaluate import BatchFunction
from elastocal.model.manipulator import Model

ROWS = {"tiny": (300, 2000), "short": (300, 10_000, 100_000, 1_000_000)}
ROWS["full"] = ROWS["short"]
FEW = (1, 4, 16, 64)
AT_A_TIME = 100_000  # rows whose B is held at once: 122 MB
LOOP, BUFFER, MAP = "CasADi, Python loop", "CasADi, FunctionBuffer in a loop", "CasADi, map"
HAND, BARE = "numpy, by hand", "C by CasADi, -O3, bare loop"
REPLAY = "elastocal, replay (numpy)"
SLOW = (LOOP, BUFFER, MAP)
EQUAL = {HAND: 1e-9, LOOP: 1e-12, BUFFER: 1e-12, MAP: 1e-12, BARE: 1e-12}


class Ways:
    """Every way to evaluate B, as name → function of (table rows as arrays, n)."""

    def __init__(self, model: Model, n: int) -> None:
        s = model._symbolic
        self.symbolic, self.x = s, truth(model)
        inputs = [*s.arm.inputs.values(), s.p]
        outputs = [s.reading, ca.jacobian(s.reading, s.p)]
        self.f = function_of(inputs, outputs)
        by_hand = NumpyRegressor(model)
        replay = BatchFunction(inputs, outputs, "numpy")
        loops = {LOOP: python_loop, BUFFER: buffered_loop}
        self.run: dict[str, Callable] = {
            name: lambda a, n, loop=loop: loop(self.f, a, n)[1] for name, loop in loops.items()
        }
        mapped, bare = Mapped(self.f, n), BareC(self.f)
        self.run |= {
            MAP: lambda a, n: mapped(a, n)[1],
            HAND: lambda a, n: by_hand(a[0], self.x),
            BARE: lambda a, n: bare(a, n)[1],
            REPLAY: lambda a, n: replay(*a)[1],
        }

    def arrays(self, model: Model, n: int) -> list[np.ndarray]:
        return [*row_inputs(self.symbolic.arm, poses(model, n)), self.x]


def agreement(ways: Ways, model: Model) -> dict[str, float]:
    """Largest difference of each way's B from the replay's, over the column's largest number.

    Stops the benchmark where one is not what it should be: then it measures something else.
    """
    arrays = ways.arrays(model, 97)
    expected = ways.run[REPLAY](arrays, 97)
    size = np.abs(expected).max(axis=(0, 1))
    differences = {}
    for name, limit in EQUAL.items():
        found = ways.run[name](arrays, 97)
        differences[name] = float((np.abs(found - expected).max(axis=(0, 1)) / size).max())
        if not differences[name] <= limit:
            sys.exit(f"{name}: B differs by {differences[name]:.1e}, allowed {limit:g}")
    return differences


def timed(model: Model, rows: int, size: str) -> dict[str, tuple[float, float]]:
    """Wall and CPU µs per row of every way at `rows` rows."""
    held = min(rows, AT_A_TIME)
    ways = Ways(model, held)
    arrays = ways.arrays(model, held)
    pieces = rows // held

    def work(name: str) -> Callable[[], None]:
        def run() -> None:
            for _ in range(pieces):
                ways.run[name](arrays, held)

        return run

    slow = [] if rows > 10_000 and size != "full" else list(SLOW)
    quick = [name for name in ways.run if name not in SLOW]
    # A million rows in a Python loop take a minute, others a second: they need fewer rounds.
    took = race({name: work(name) for name in slow}, 2 if rows < 1e5 else 0, 2.0)
    took |= race({name: work(name) for name in quick}, 3, 2.0)
    return {name: (t.wall / rows * 1e6, t.cpu / rows * 1e6) for name, t in took.items()}


def whole_calls(folder: Path, part: Part, sizes: tuple[int, ...]) -> None:
    """`Model.regressor` itself, from table to B: what a user's call costs."""
    table = Table(
        "`Model.regressor`, table checks and derivatives through the equilibrium included",
        ["model", "rows", "wall, ms", "CPU, ms", "CPU, µs per row"],
    )
    loaded = (*GEOMETRY, "joint_compliance")
    for what, effects, load in (("rigid", GEOMETRY, False), ("under load", loaded, True)):
        model = kr270(folder, effects)
        x = truth(model)
        for n in sizes:
            readings = poses(model, n, load)
            own_engine = Model.assembled(model.chain, model.cell, backend="numpy")
            t = race({"numpy": partial(own_engine.regressor, readings, x)}, 5, 1.0)["numpy"]
            what_now = f"{what}, {len(model.parameters)} parameters"
            table.rows.append([what_now, n, t.wall * 1e3, t.cpu * 1e3, t.cpu / n * 1e6])
    part.tables.append(table)


def few_rows(ways: Ways, model: Model, part: Part) -> None:
    """A call for so few rows that numpy's calls are most of it."""
    tape = BatchFunction(ways.f.sx_in(), ways.f(*ways.f.sx_in()))
    table = Table(
        "A call for few rows, prediction and B, `--backend auto`",
        ["rows", "evaluated by", "wall, ms", "numpy, wall, ms", "numpy over it"],
    )
    for n in FEW:
        arrays = ways.arrays(model, n)
        took = race({"auto": lambda a=arrays: tape(*a),
                     REPLAY: lambda a=arrays, n=n: ways.run[REPLAY](a, n)}, 5, 0.3)  # fmt: skip
        auto, numpy = took["auto"].wall * 1e3, took[REPLAY].wall * 1e3
        table.rows.append([n, tape.report.backend, auto, numpy, numpy / auto])
    part.tables.append(table)


def threads(model: Model, part: Part, n: int) -> None:
    """Ours on one thread and on all cores."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    ways = Ways(model, n)
    arrays = ways.arrays(model, n)
    table = Table(f"Threads, {n} rows", ["", "threads", "wall, µs per row", "CPU"])
    before = os.environ.get("OMP_NUM_THREADS")
    for count in (1, cores):
        os.environ["OMP_NUM_THREADS"] = str(count)
        took = race({REPLAY: lambda: ways.run[REPLAY](arrays, n)}, 3, 1.0)[REPLAY]
        table.rows.append([REPLAY, count, took.wall / n * 1e6, took.cpu / n * 1e6])
    os.environ.pop("OMP_NUM_THREADS")
    if before is not None:
        os.environ["OMP_NUM_THREADS"] = before
    part.tables.append(table)


def memory(part: Part, size: str, n: int) -> None:
    """Peak of a process that evaluates B of n rows once, each way in its own."""
    table = Table(
        f"Peak memory, {n} rows, B itself {n * 3 * 51 * 8 / 1e6:.0f} MB",
        ["way", "peak of the process, MB", "above what it held before, MB"],
    )
    for name in (LOOP, BUFFER, MAP, HAND, BARE, REPLAY):
        if name == LOOP and size != "full":
            continue
        found = own(__file__, name, n, OMP_NUM_THREADS="1")
        table.rows.append([name, found["peak_mb"], found["grown_mb"]])
    part.tables.append(table)


def child(name: str, n: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        model = kr270(Path(folder), GEOMETRY)
    ways = Ways(model, n)
    arrays = ways.arrays(model, n)
    ways.run[name](ways.arrays(model, 10), 10)
    factor = 1e-6 if sys.platform == "darwin" else 1e-3
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * factor
    ways.run[name](arrays, n)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * factor
    print(json.dumps({"grown_mb": after - before}))


def measure(size: str) -> Part:
    part = Part("evaluation", "B of a table: 51 parameters of a 6-axis arm")
    rows_of = ROWS[size]
    largest = min(rows_of[-1], AT_A_TIME)
    os.environ["OMP_NUM_THREADS"] = "1"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = kr270(folder, GEOMETRY)
        ways = Ways(model, 97)
        differences = agreement(ways, model)
        micro = {rows: timed(model, rows, size) for rows in rows_of}
        for k, clock in ((1, "CPU"), (0, "wall")):
            table = Table(
                f"{clock} time in µs per row, one thread",
                ["way", *[f"{rows} rows" for rows in rows_of], "difference of B"],
            )
            for way in (*SLOW, HAND, BARE, REPLAY):
                times = [micro[rows][way][k] if way in micro[rows] else None for rows in rows_of]
                table.rows.append([way, *times, differences.get(way)])
            part.tables.append(table)
        whole_calls(folder, part, rows_of[:2])
        few_rows(ways, model, part)
    os.environ.pop("OMP_NUM_THREADS")
    threads(model, part, largest)
    memory(part, size, largest)
    for k, clock in ((1, "CPU"), (0, "wall")):
        hundred, few = ({w: t[k] for w, t in micro[rows].items()} for rows in (largest, 300))
        part.goal(f"replay over the bare C loop, {largest} rows, {clock}, at most 2.0",
                  hundred[REPLAY] / hundred[BARE], 2.0, "times")  # fmt: skip
        part.goal(f"Python loop over {REPLAY}, 300 rows, {clock}, at least 10",
                  few[LOOP] / few[REPLAY], 10.0, "times", least=True)  # fmt: skip
    part.curves = {"rows": list(rows_of), "cpu": {
        way: [micro[rows][way][1] if way in micro[rows] else None for rows in rows_of]
        for way in (*SLOW, HAND, BARE, REPLAY)
    }}  # fmt: skip
    return part


if __name__ == "__main__":
    if "--child" in sys.argv:
        child(sys.argv[2], int(sys.argv[3]))
    else:
        run_alone(measure)
