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
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import chdir
from functools import partial
from pathlib import Path

import casadi as ca
import numpy as np
from bench_arms import kr270, poses, truth
from bench_tools import goal, race, table
from numpy.typing import NDArray

from elastocal.model.effects.base import row_inputs
from elastocal.model.evaluate import BatchFunction
from elastocal.model.manipulator import Model

Array = NDArray[np.float64]
ROWS = {"tiny": (300, 2000), "short": (300, 10_000, 100_000), "full": (300, 10_000, 100_000)}
FEW = (1, 4, 16, 64)
LOOP, MAP = "CasADi, Python loop", "CasADi, map"
BARE, REPLAY = "C by CasADi, -O3, bare loop", "elastocal, replay (numpy)"
SLOW = (LOOP, MAP)


def python_loop(f: ca.Function, arrays: Sequence[Array]) -> Array:
    """One call per row, all numbers written into arrays (n, rows, columns)."""
    results = [np.empty((len(arrays[0]), *f.size_out(k))) for k in range(f.n_out())]
    for i in range(len(arrays[0])):
        found = f.call([a[i] if a.ndim == 2 else a for a in arrays])
        for result, value in zip(results, found, strict=True):
            result[i] = value
    return results[1]


def mapped(loop: ca.Function, arrays: Sequence[Array]) -> Array:
    found = [np.asarray(r) for r in loop.call([a.T if a.ndim == 2 else a for a in arrays])]
    return found[1].reshape(len(found[1]), len(arrays[0]), -1).transpose(1, 0, 2)


class BareC:
    """C that CasADi generates of its `map`, a loop over one row after the other, compiled whole at
    -O3; it reads and writes numpy's memory."""

    def __init__(self, loop: ca.Function, shapes: Sequence[tuple[int, ...]]) -> None:
        with tempfile.TemporaryDirectory() as folder, chdir(folder):
            loop.generate("bare.c")  # CasADi writes to the current folder only
            flags = ("-O3", "-shared", "-fPIC", "-w", "bare.c", "-o", "bare.so", "-lm")
            command = [os.environ.get("CC") or "cc", *flags]
            subprocess.run(command, check=True, capture_output=True)
            compiled = ca.external(loop.name(), str(Path(folder, "bare.so")))
        self.buffer, self.call = compiled.buffer()
        self.found = [np.empty(shape) for shape in shapes]
        for k, found in enumerate(self.found):
            self.buffer.set_res(k, memoryview(found))

    def __call__(self, arrays: Sequence[Array]) -> Array:
        given = [np.require(a, requirements="CW") for a in arrays]
        for k, own in enumerate(given):
            self.buffer.set_arg(k, memoryview(own))
        self.call()
        return self.found[1].transpose(0, 2, 1)


class Ways:
    """Every way to evaluate B of n rows, as name → function of the table's rows as arrays."""

    def __init__(self, model: Model, n: int) -> None:
        s = model.symbolic
        inputs = [*s.arm.inputs.values(), s.p]
        outputs = [ca.densify(o) for o in (s.reading, ca.jacobian(s.reading, s.p))]
        self.f = ca.Function("tape", inputs, outputs, {"cse": True})
        self.arrays = [*row_inputs(s.arm, poses(model, n)), truth(model)]
        shared = [k for k, a in enumerate(self.arrays) if a.ndim == 1]
        loop = self.f.map("loop", "serial", n, shared, [])
        bare = BareC(loop, [(n, *o.shape[::-1]) for o in outputs])
        replay = BatchFunction(inputs, outputs, "numpy")
        self.run: dict[str, Callable[[], Array]] = {
            LOOP: partial(python_loop, self.f, self.arrays),
            MAP: partial(mapped, loop, self.arrays),
            BARE: partial(bare, self.arrays),
            REPLAY: lambda: replay(*self.arrays)[1],
        }


def agreement(model: Model) -> None:
    """Stops the benchmark where a way's B is not the replay's: it would measure something else."""
    ways = Ways(model, 97)
    expected = ways.run[REPLAY]()
    size = np.abs(expected).max(axis=(0, 1))
    for name, way in ways.run.items():
        off = float((np.abs(way() - expected).max(axis=(0, 1)) / size).max())
        if not off <= 1e-12:
            sys.exit(f"{name}: B differs by {off:.1e}")


def timed(model: Model, rows: int, size: str) -> dict[str, tuple[float, float]]:
    """CPU and wall µs per row of every way at `rows` rows."""
    run = Ways(model, rows).run
    slow = {name: run.pop(name) for name in SLOW}
    took = race(slow, 1, 1.0) if rows <= 10_000 or size == "full" else {}
    took |= race(run, 3, 2.0)
    return {name: (t.cpu / rows * 1e6, t.wall / rows * 1e6) for name, t in took.items()}


def few_rows(model: Model) -> None:
    """A call for so few rows that numpy's calls are most of it."""
    ways, rows = Ways(model, max(FEW)), []
    given = ways.f.sx_in()
    auto, numpy = (BatchFunction(given, ways.f(*given), by) for by in (None, "numpy"))
    for n in FEW:
        some = [a[:n] if a.ndim == 2 else a for a in ways.arrays]
        took = race({"auto": partial(auto, *some), "numpy": partial(numpy, *some)}, 5, 0.3)
        ms = [took[by].wall * 1e3 for by in ("auto", "numpy")]
        rows.append([n, *ms, ms[1] / ms[0]])
    columns = ["rows", "wall, ms", "numpy, wall, ms", "numpy over it"]
    table("A call for few rows, prediction and B, `--backend auto`", columns, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", choices=tuple(ROWS), default="short")
    size = parser.parse_args().size
    os.environ["OMP_NUM_THREADS"] = "1"
    with tempfile.TemporaryDirectory() as name:
        model = kr270(Path(name))
    agreement(model)
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
