"""Time and memory of `elastocal diagnose` with the whole catalogue.

    python benchmarks/diagnosis.py [--size tiny|short|full] [--json FILE]

The blind check's example (60 poses, 2 loads, 3 markers, simulated in MuJoCo), and tables of the
same arm that `elastocal simulate` makes, with a gear that runs out of round at joint 4.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from bench_clock import Ran, elastocal
from bench_part import HERE, Part, Table, run_alone

from elastocal.cell.work_cell import read_cell
from elastocal.model.chain import joint_limits
from elastocal.model.manipulator import Model

EXAMPLE = HERE.parent / "experiment_design" / "blind_diagnosis" / "example"
ROWS = {"tiny": (), "short": (10_000,), "full": (3000, 10_000, 100_000)}
HIDDEN = {"joint4.harmonic2_sin": 3e-4, "joint4.harmonic2_cos": -2e-4}
FOUND = ("gear_second_harmonic", "joint4")


def ran(*arguments: object, **environment: str) -> Ran:
    done = elastocal(*arguments, **environment)
    if done.code:
        sys.exit(f"elastocal {' '.join(map(str, arguments))} failed:\n{done.errors}")
    return done


def simulated(folder: Path, rows: int) -> Path:
    """A table of at least `rows` rows: random poses × 2 loads × 3 markers."""
    cell = EXAMPLE / "cell.toml"
    text = cell.read_text().replace('urdf = "', f'urdf = "{EXAMPLE}/')
    text = text.replace('"marker_position"]', '"marker_position", "gear_second_harmonic"]')
    text = text.replace("[tracker]\n", "[tracker]\nsigma_um = 15\n")
    world = folder / "world.toml"
    world.write_text(text)
    model = Model(read_cell(world))
    low, high = joint_limits(model.cell, model.chain)
    n = -(-rows // 6)
    q = np.degrees(np.random.default_rng(rows).uniform(low, high, (n, len(low))))
    plan = folder / "plan.csv"
    names = ["configuration", *[f"q{k + 1}_deg" for k in range(len(low))]]
    lines = [",".join([str(k + 1), *[f"{v:.6f}" for v in row]]) for k, row in enumerate(q)]
    plan.write_text("\n".join([",".join(names), *lines]) + "\n")
    data = folder / f"data{rows}.csv"
    true = [part for name, value in HIDDEN.items() for part in ("--set", f"{name}={value}")]
    ran("simulate", world, plan, "-o", data, "--load", 0, 0, -300, "--seed", 3, *true)
    _circumstances(data, q)
    return data


def _circumstances(data: Path, q: np.ndarray) -> None:
    """Time and side of approach beside every reading, so that the whole catalogue is tried."""
    header, *rows = data.read_text().splitlines()
    side = np.where(np.diff(q, axis=0, prepend=0.0) < 0, -1, 1)
    names = ["time_min", *[f"approach_{k + 1}" for k in range(q.shape[1])]]
    lines = [",".join([header, *names])]
    for k, row in enumerate(rows):
        pose = int(row.partition(",")[0]) - 1
        lines.append(",".join([row, f"{k / 20:.2f}", *map(str, side[pose])]))
    data.write_text("\n".join(lines) + "\n")


def measure(size: str) -> Part:
    part = Part("diagnosis", "Diagnosis, whole catalogue")
    table = Table(
        "`elastocal diagnose`, from start to JSON",
        ["data", "rows", "wall, s", "CPU, s", "peak, MB", "verdict"],
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cell = EXAMPLE / "cell.toml"
        cases = [("blind check: 60 poses × 2 loads × 3 markers", EXAMPLE / "data.csv", 2.5)]
        for rows in ROWS[size]:
            data = simulated(folder, rows)
            cases.append((f"simulated, {rows} rows", data, {10_000: 15}.get(rows, 0)))
        for what, data, limit in cases:
            answer, rows = folder / "diagnosis.json", len(data.read_text().splitlines()) - 1
            given = ("diagnose", cell, data, "-o", answer, "--quiet")
            print(what, file=sys.stderr, flush=True)
            done = ran(*given)
            content = json.loads(answer.read_text())
            effects = ", ".join(f"{e['effect']}:{e['where']}" for e in content["effects"])
            verdict = f"{content['verdict']} {effects}".strip()
            if data.parent == folder and ":".join(FOUND) not in verdict:
                part.remarks.append(f"{what}: {':'.join(FOUND)} was not named")
            table.rows.append([what, rows, done.wall, done.cpu, done.peak_mb, verdict])
            if limit:
                part.goal(f"{what}: wall, at most {limit} s", done.wall, limit, "s")
    part.tables.append(table)
    return part


if __name__ == "__main__":
    run_alone(measure)
