"""B of a whole table, four ways: CasADi in a Python loop, its `map`, its C code in a bare C loop,
and elastocal's; and of few rows by elastocal's second engine, which is CasADi again.

    python benchmarks/evaluation.py [--size tiny|short|full]

A KR 270 with 51 geometric parameters.  All ways get the same rows in turn, round after round; the
least of several rounds counts.  Every way's B is compared with that of the replay first.  The
Python loop and `map` of more than 10 000 rows are run with --size full only.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
from bench_arms import GEOMETRY, kr270, poses, truth
from bench_tools import goal, race, table
from evaluation_rivals import BareC, Mapped, function_of, python_loop

from elastocal.model.arm import row_inputs
from elastocal.model.evaluate import BatchFunction
from elastocal.model.manipulator import Model

ROWS = {"tiny": (300, 2000), "short": (300, 10_000, 100_000), "full": (300, 10_000, 100_000)}
FEW = (1, 4, 16, 64)
LOOP, MAP = "CasADi, Python loop", "CasADi, map"
BARE, REPLAY = "C by CasADi, -O3, bare loop", "elastocal, replay (numpy)"
SLOW = (LOOP, MAP)


class Ways:
    """Every way to evaluate B, as name → function of (table rows as arrays, n)."""

    def __init__(self, model: Model, n: int) -> None:
        s = model._symbolic
        self.symbolic, self.x = s, truth(model)
        inputs = [*s.arm.inputs.values(), s.p]
        outputs = [s.reading, ca.jacobian(s.reading, s.p)]
        self.f = function_of(inputs, outputs)
        replay, mapped = BatchFunction(inputs, outputs, "numpy"), Mapped(self.f, n)
        bare = BareC(self.f)
        self.run: dict[str, Callable] = {
            LOOP: lambda a, n: python_loop(self.f, a, n)[1],
            MAP: lambda a, n: mapped(a, n)[1],
            BARE: lambda a, n: bare(a, n)[1],
            REPLAY: lambda a, n: replay(*a)[1],
        }

    def arrays(self, model: Model, n: int) -> list[np.ndarray]:
        return [*row_inputs(self.symbolic.arm, poses(model, n)), self.x]


def agreement(ways: Ways, model: Model) -> None:
    """Stops the benchmark where a way's B is not the replay's: it would measure something else."""
    arrays = ways.arrays(model, 97)
    expected = ways.run[REPLAY](arrays, 97)
    size = np.abs(expected).max(axis=(0, 1))
    for name, way in ways.run.items():
        off = float((np.abs(way(arrays, 97) - expected).max(axis=(0, 1)) / size).max())
        if not off <= 1e-12:
            sys.exit(f"{name}: B differs by {off:.1e}")


def timed(model: Model, rows: int, size: str) -> dict[str, tuple[float, float]]:
    """CPU and wall µs per row of every way at `rows` rows."""
    ways = Ways(model, rows)
    arrays = ways.arrays(model, rows)
    slow = SLOW if rows <= 10_000 or size == "full" else ()
    quick = [name for name in ways.run if name not in SLOW]
    took = race({name: lambda w=ways.run[name]: w(arrays, rows) for name in slow}, 1, 1.0)
    took |= race({name: lambda w=ways.run[name]: w(arrays, rows) for name in quick}, 3, 2.0)
    return {name: (t.cpu / rows * 1e6, t.wall / rows * 1e6) for name, t in took.items()}


def few_rows(model: Model) -> None:
    """A call for so few rows that numpy's calls are most of it."""
    ways = Ways(model, 97)
    tape = BatchFunction(ways.f.sx_in(), ways.f(*ways.f.sx_in()))
    rows = []
    for n in FEW:
        arrays = ways.arrays(model, n)
        took = race({"auto": lambda a=arrays: tape(*a),
                     REPLAY: lambda a=arrays, n=n: ways.run[REPLAY](a, n)}, 5, 0.3)  # fmt: skip
        auto, numpy = took["auto"].wall * 1e3, took[REPLAY].wall * 1e3
        rows.append([n, tape.report.backend, auto, numpy, numpy / auto])
    columns = ["rows", "evaluated by", "wall, ms", "numpy, wall, ms", "numpy over it"]
    table("A call for few rows, prediction and B, `--backend auto`", columns, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", choices=tuple(ROWS), default="short")
    size = parser.parse_args().size
    os.environ["OMP_NUM_THREADS"] = "1"
    with tempfile.TemporaryDirectory() as name:
        model = kr270(Path(name), GEOMETRY)
    agreement(Ways(model, 97), model)
    micro = {rows: timed(model, rows, size) for rows in ROWS[size]}
    columns = ["way", *[f"{rows} rows" for rows in ROWS[size]]]
    for k, clock in enumerate(("CPU", "wall")):
        table(f"{clock} time in µs per row, one thread", columns, [
            [way, *(micro[rows][way][k] if way in micro[rows] else None for rows in ROWS[size])]
            for way in (*SLOW, BARE, REPLAY)
        ])  # fmt: skip
        largest, few = ({w: t[k] for w, t in micro[n].items()} for n in (ROWS[size][-1], 300))
        goal(f"replay over the bare C loop, {ROWS[size][-1]} rows, {clock}, at most 2.0",
             largest[REPLAY] / largest[BARE], 2.0, "times")  # fmt: skip
        goal(f"Python loop over {REPLAY}, 300 rows, {clock}, at least 10",
             few[LOOP] / few[REPLAY], 10.0, "times", least=True)  # fmt: skip
    few_rows(model)


if __name__ == "__main__":
    main()
