"""What B and a whole fit cost against rows, parameters and joints, with the exponents.

    python benchmarks/scaling.py [--size tiny|short|full] [--json FILE]

Every size is simulated, evaluated and fitted in a process of its own, so that its peak memory is
its own.  A million rows with 46 parameters (51 of which five are held) are part of short, too.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_arms import GEOMETRY, kr270, poses, serial, truth
from bench_clock import exponent, own
from bench_part import Part, Table, run_alone

from elastocal.errors import ElastocalError
from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.simulation.simulate import simulate

ROWS = {
    "tiny": (1000, 3000),
    "short": (1000, 10_000, 100_000, 1_000_000),
    "full": (1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000),
}
# 9, 15 and 51 by leaving effects out, beyond that 3 for every further marker.
PARAMETERS = {
    "tiny": (9, 51),
    "short": (9, 15, 51, 99),  # a fit with 303 takes minutes
    "full": (9, 15, 51, 99, 147, 195, 303),
}
JOINTS = {"tiny": (6, 7), "short": (6, 7, 8, 9), "full": (6, 7, 8, 9)}
AT_A_TIME = 50_000  # rows simulated and evaluated together
FEW = 10_000  # rows of the tables that vary parameters or joints
HELD = ("link6.dx", "link6.dy", "link6.dz", "link6.rx", "link6.ry")  # so that 46 are left


def chosen_model(folder: Path, kind: str, size: int) -> Model:
    if kind == "joints":
        return serial(folder, size, GEOMETRY)
    if kind == "rows" or size == 51:
        return kr270(folder, GEOMETRY)
    if size < 51:
        few = ("base_frame", "marker_position", "joint_offset")
        return kr270(folder, few[: 2 if size == 9 else 3])
    return kr270(folder, GEOMETRY, markers=1 + (size - 51) // 3)


def simulated(model: Model, n: int) -> Measurements:
    """n readings with noise, made a piece at a time."""
    rng, x, plan = np.random.default_rng(5), truth(model), poses(model, n)
    pieces = [
        simulate(model, plan.take(np.arange(first, min(first + AT_A_TIME, n))), x, rng)
        for first in range(0, n, AT_A_TIME)
    ]
    arrays = {
        f.name: np.concatenate([getattr(piece, f.name) for piece in pieces])
        for f in fields(plan)
        if isinstance(getattr(pieces[0], f.name), np.ndarray)
    }
    return replace(plan, **arrays)


def child(kind: str, size: int, rows: int) -> dict[str, Any]:
    """CPU and wall seconds of B of the table, piece by piece, and of a whole fit."""
    with tempfile.TemporaryDirectory() as folder:
        model = chosen_model(Path(folder), kind, size)
    table = simulated(model, rows)
    x = truth(model)
    held = HELD if kind == "rows" else ()
    columns = np.array([i for i, name in enumerate(model.names) if name not in held])
    found: dict[str, Any] = {"parameters": len(columns)}

    def evaluate() -> None:
        for first in range(0, rows, AT_A_TIME):
            piece = table.take(np.arange(first, min(first + AT_A_TIME, rows)))
            model.regressor(piece, x, columns)

    def fit() -> None:
        try:
            result = identify(model, table, Options(fixed=held))
        except ElastocalError as error:
            found["refused"] = str(error)
        else:
            found["converged"] = bool(result.converged)
            found["sigma"] = float(result.sigma)

    evaluate()  # builds and, where that pays, compiles
    for name, work in (("B", evaluate), ("fit", fit)):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        found |= {f"{name}_wall": time.perf_counter() - wall}
        found |= {f"{name}_cpu": time.process_time() - cpu}
    return found | {"backend": model.backend_report()}


def against(kind: str, sizes: Sequence[int], part: Part) -> list[dict[str, Any]]:
    """One table: B and fit against `kind`, and the slopes of their logarithms."""
    few = FEW if sizes[-1] > 51 or len(sizes) > 2 else ROWS["tiny"][-1]
    title = {"rows": "Rows, 46 parameters", "parameters": f"Parameters, {few} rows",
             "joints": f"Joints, {few} rows, all geometric parameters"}[kind]  # fmt: skip
    first = [kind] if kind == "parameters" else [kind, "parameters"]
    columns = ["B, wall s", "B, CPU s", "fit, wall s", "fit, CPU s", "peak, MB", "backend"]
    table = Table(title, [*first, *columns])
    found = []
    for size in sizes:
        rows = size if kind == "rows" else few
        print(f"{kind} {size}", file=sys.stderr, flush=True)
        one = own(__file__, kind, size, rows) | {"size": size}
        if "refused" in one:
            part.remarks.append(f"{kind} {size}: no fit, {one['refused']}")
        elif not one["converged"]:
            part.remarks.append(f"{kind} {size}: the fit did not converge")
        engine = one["backend"].partition(" (")[0]
        seconds = [one[f"{what}_{clock}"] for what in ("B", "fit") for clock in ("wall", "cpu")]
        what = [one["parameters"]] if kind == "parameters" else [size, one["parameters"]]
        table.rows.append([*what, *seconds, one["peak_mb"], engine])
        found.append(one)
    part.tables.append(table)
    x = [one["parameters"] if kind == "parameters" else one["size"] for one in found]
    # What does not grow with the rows, the start from a sample of them, dominates below that.
    large = [k for k, v in enumerate(x) if kind != "rows" or v >= 10_000]
    chosen = large if len(large) > 1 else list(range(len(x)))
    slopes = [
        f"{what} {exponent([x[k] for k in chosen], [found[k][f'{what}_cpu'] for k in chosen]):.2f}"
        for what in ("B", "fit")
    ]
    lower = f", from {x[chosen[0]]} rows on" if kind == "rows" else ""
    part.remarks.append(f"Exponents of CPU time against {kind}{lower}: {', '.join(slopes)}.")
    return found


def measure(size: str) -> Part:
    part = Part("scaling", "Cost against size")
    rows = against("rows", ROWS[size], part)
    part.curves = {"rows": [r["size"] for r in rows], "fit": [r["fit_cpu"] for r in rows],
                   "B": [r["B_cpu"] for r in rows]}  # fmt: skip
    for kind, sizes in (("parameters", PARAMETERS[size]), ("joints", JOINTS[size])):
        found = against(kind, sizes, part)
        part.curves[kind] = [f["parameters"] if kind == "parameters" else f["size"] for f in found]
        part.curves[f"{kind} B"] = [f["B_cpu"] for f in found]
        part.curves[f"{kind} fit"] = [f["fit_cpu"] for f in found]
    for found in rows:
        if found["size"] == FEW:
            what = "identify of 10000 rows, 46 parameters, wall, at most 1.5 s"
            part.goal(what, found["fit_wall"], 1.5, "s")
        if found["size"] == 1_000_000:
            seconds = found["B_wall"] + found["fit_wall"]
            what = "a million rows, 46 parameters, B and fit, wall, at most 15 s"
            part.goal(what, seconds, 15, "s")
            part.goal("peak memory of that, at most 1 GB", found["peak_mb"] / 1e3, 1.0, "GB")
    return part


if __name__ == "__main__":
    if "--child" in sys.argv:
        print(json.dumps(child(sys.argv[2], *map(int, sys.argv[3:5]))))
    else:
        run_alone(measure)
