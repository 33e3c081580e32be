"""A million readings: simulate, read, identify; wall time of every stage, and peak memory.

    python benchmarks/million_rows.py [--rows 1000000] [--loaded 100000] [--compare 20000]

Every campaign runs in a process of its own, so that its peak memory is its own.  The last one
fits a table that both paths can do, whole and in parts, and prints how far apart they are.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from elastocal.cell.work_cell import read_cell
from elastocal.identification import weighted_problem as partition
from elastocal.identification.identify import identify
from elastocal.identification.result import Calibration
from elastocal.measurements import Measurements, read_measurements, write_measurements
from elastocal.model.chain import joint_limits
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model
from elastocal.simulation.simulate import simulate

GEOMETRY = ("base_frame", "joint_offset", "link_geometry", "marker_position")
BASE = {"base.x": 2.0, "base.y": -1.0, "base.z": 0.5, "base.rz": 2.0}
LOAD_N = (0.0, 0.0, -2600.0)
AT_A_TIME = 50_000
SEED = 1


def write_cell(folder: Path, effects: tuple[str, ...]) -> Path:
    """The KR 270 of the demo with one marker and a 10 µm tracker."""
    path = folder / "cell.toml"
    urdf = files("elastocal.demo") / "kr270_2.urdf"
    path.write_text(
        f'[robot]\nurdf = "{urdf}"\nbase = "base_link"\nflange = "flange"\n'
        "[tool]\nload_point_m = [0.20, 0.0, 0.25]\n[tool.markers_m]\nM1 = [0.25, 0.0, 0.05]\n"
        '[tracker]\nsigma_um = 10\n[model]\nobserve = "position"\n'
        f"effects = {json.dumps(effects)}\n"
    )
    return path


def readings(model: Model, first: int, n: int, x: np.ndarray, loaded: bool) -> Measurements:
    """Readings `first` to `first + n` at random poses, every other one loaded where asked."""
    rng = np.random.default_rng([SEED, first])
    low, high = joint_limits(model.cell, model.chain)
    force = np.zeros((n, 3))
    if loaded:
        force[::2] = LOAD_N
    plan = Measurements(
        source="plan",
        row=np.arange(n),
        q=rng.uniform(low, high, (n, len(low))),
        configuration=np.arange(n),
        configuration_labels=tuple(str(first + i + 1) for i in range(n)),
        repeat=np.zeros(n, dtype=np.int64),
        marker=np.zeros(n, dtype=np.int64),
        marker_names=("M1",),
        force=force,
    )
    return simulate(model, plan, x, rng)


def truth(model: Model) -> np.ndarray:
    """Geometric errors of 1 mm and 1 mrad, compliances of 0.3 to 3 µrad/(N m), a base."""
    rng = np.random.default_rng(SEED)
    x = model.nominal.copy()
    for i, p in enumerate(model.parameters):
        if p.effect in ("joint_offset", "link_geometry"):
            x[i] += 1e-3 * rng.normal()
        if p.effect == "joint_compliance":
            x[i] = rng.uniform(3e-7, 3e-6)
        x[i] = BASE.get(p.name, x[i])
    return x


def write_readings(cell_path: Path, path: Path, n: int, loaded: bool) -> None:
    """A CSV of n readings, simulated and written a few at a time."""
    model = Model(read_cell(cell_path))
    x, piece = truth(model), path.with_suffix(".piece.csv")
    with path.open("wb") as whole:
        for first in range(0, n, AT_A_TIME):
            write_measurements(readings(model, first, min(AT_A_TIME, n - first), x, loaded), piece)
            header, _, rows = piece.read_bytes().partition(b"\n")
            whole.write(rows if first else header + b"\n" + rows)
    piece.unlink()


def load(cell_path: Path, data: Path) -> tuple[Model, Measurements]:
    cell = read_cell(cell_path, known_effects=tuple(CATALOGUE))
    model = Model(cell)
    table = read_measurements(
        data, joint_kinds=model.chain.kinds, marker_names=tuple(cell.tool.markers)
    )
    return model, table


def peak_mb() -> float:
    factor = 1e-6 if sys.platform == "darwin" else 1e-3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * factor


def timed(cell_path: Path, data: Path) -> None:
    """Read and identify; one line per stage: what, seconds, peak memory up to its end."""
    stages: list[tuple[str, float, float]] = []
    last = ("reading", time.perf_counter())

    def progress(message: str) -> None:
        nonlocal last
        now = time.perf_counter()
        stages.append((last[0], now - last[1], peak_mb()))
        last = (message, now)

    print(f"  {'':44s}          {peak_mb():6.0f} MB once imported")
    model, table = load(cell_path, data)
    progress("checking")
    result = identify(model, table, progress=progress)
    progress("result as JSON")
    json.dumps(result.to_json())
    progress("")
    for name, seconds, memory in stages:
        print(f"  {name:44s} {seconds:7.1f} s {memory:6.0f} MB")
    fit = sum(seconds for name, seconds, _ in stages if name != "reading")
    print(
        f"  {len(table)} readings, {len(model.parameters)} parameters, {len(result.determined)} "
        f"determined: fit {fit:.1f} s, all {sum(s for _, s, _ in stages):.1f} s, "
        f"peak {peak_mb():.0f} MB"
    )
    print(
        f"  sigma {result.sigma:.5f} of the stated, held out {result.heldout_rms * 1e6:.3f} µm, "
        f"{len(result.outliers)} readings beyond the noise, converged: {result.converged}"
    )


def compared(cell_path: Path, data: Path) -> None:
    """The same table whole and in parts: seconds, and the largest differences."""
    model, table = load(cell_path, data)

    def run(large: int) -> tuple[Calibration, float]:
        partition.LARGE = large
        start = time.perf_counter()
        return identify(model, table), time.perf_counter() - start

    run(sys.maxsize)  # tapes built, memory touched
    (whole, dense), (parts, chunked) = run(sys.maxsize), run(0)
    kept = [model.names.index(name) for name in whole.determined]
    std = np.sqrt(np.diag(whole.covariance))
    off = np.abs(parts.x - whole.x)[kept]
    other = np.sqrt(np.diag(parts.covariance))
    print(
        f"  {len(table)} readings: whole {dense:.2f} s, in parts {chunked:.2f} s, "
        f"ratio {dense / chunked:.2f}\n"
        f"  same parameters: {whole.determined == parts.determined}; largest differences: "
        f"estimate {(off / std).max():.1e} of its std and {off.max():.1e} SI, "
        f"std {np.abs(other / std - 1).max():.1e} relative, "
        f"held out {np.abs(parts.held_out - whole.held_out).max():.1e} m"
    )


def campaign(kind: str, n: int, loaded: bool) -> None:
    """Simulate in one process, identify in another."""
    effects = (*GEOMETRY, "joint_compliance") if loaded else GEOMETRY
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cell, data = write_cell(folder, effects), folder / "data.csv"
        start = time.perf_counter()
        _own_process("write", cell, data, n, loaded)
        size = data.stat().st_size / 1e6
        print(f"{n} readings{' (half of them loaded)' if loaded else ''}: {', '.join(effects)}")
        print(
            f"  {f'simulated and written ({size:.0f} MB)':44s} {time.perf_counter() - start:7.1f} s"
        )
        _own_process(kind, cell, data, n, loaded)


def _own_process(*arguments: Any) -> None:
    sys.stdout.flush()
    command = [sys.executable, __file__, "--process", *map(str, arguments)]
    # With a thread for each core linear algebra waits for itself more than it works.
    subprocess.run(command, check=True, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--loaded", type=int, default=100_000, help="readings with a load")
    parser.add_argument("--compare", type=int, default=20_000, help="readings for both paths")
    parser.add_argument("--process", nargs=5, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.process:
        kind, cell, data, n, loaded = chosen.process
        if kind == "write":
            write_readings(Path(cell), Path(data), int(n), loaded == "True")
        else:
            {"timed": timed, "compared": compared}[kind](Path(cell), Path(data))
        return
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    for kind, n, loaded in (
        ("timed", chosen.rows, False),
        ("timed", chosen.loaded, True),
        ("compared", chosen.compare, False),
    ):
        if n:
            campaign(kind, n, loaded)


if __name__ == "__main__":
    main()
