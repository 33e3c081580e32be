"""Imports, --help, building a model with the whole catalogue, and peak memory of every verb.

python benchmarks/startup.py [--size tiny|short|full] [--json FILE]
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bench_clock import Ran, elastocal, own, process
from bench_part import ONE_THREAD, Part, Table, run_alone

REPEATS = {"tiny": 1, "short": 5, "full": 9}
IMPORTS = ("pass", "import elastocal", "import numpy", "import casadi",
           "from elastocal.model.manipulator import Model",
           "from elastocal.identification.identify import identify")  # fmt: skip
# Not in one model: a distance sensor sees no position, a marker's orientation no position; payload
# and weights act without being named.
WITHOUT = ("distance_sensor", "marker_orientation", "link_gravity", "payload")
SETTINGS = """link_gravity = true
gear_ripple_orders = [8.0]
[model.nominal]
joint_compliance = [3e-7, 3e-7, 4e-7, 3e-6, 3e-6, 2e-6]
gravity_compensator = { joint = "joint2", stiffness_N_per_m = 1.4e5, anchor_m = [0.686, 0.12], \
arm_m = 0.185, free_length_m = 0.458 }
settings.tracker = { jump_time_s = 4000.0 }
settings."marker:M1" = { slip_time_s = 3500.0 }
""" + "".join(f"settings.joint{k} = {{ jump_time_s = 3000.0 }}\n" for k in range(1, 7))


def best(run: Callable[[], Ran], repeats: int) -> Ran:
    """The run of least wall time."""
    runs = [run() for _ in range(repeats)]
    if runs[0].code:
        sys.exit(f"failed:\n{runs[0].errors}")
    return min(runs, key=lambda ran: ran.wall)


def start(repeats: int, part: Part) -> None:
    table = Table("Start-up", ["what", "wall, s", "CPU, s", "peak, MB"])
    for code in IMPORTS:
        ran = best(lambda c=code: process([sys.executable, "-c", c]), repeats)
        what = "Python itself" if code == "pass" else f"`{code}`"
        table.rows.append([what, ran.wall, ran.cpu, ran.peak_mb])
    for verb in ((), ("identify",), ("design",), ("diagnose",)):
        ran = best(lambda v=verb: elastocal(*v, "--help"), repeats)
        table.rows.append([f"`elastocal {' '.join((*verb, '--help'))}`", ran.wall, ran.cpu,
                           ran.peak_mb])  # fmt: skip
        what = " ".join(("elastocal", *verb, "--help"))
        part.goal(f"`{what}`, wall, at most 0.15 s", ran.wall, 0.15, "s")
    part.tables.append(table)


def child() -> None:
    """Seconds of building the arm, imports apart, and of the first and second B of 60 poses."""
    from bench_arms import GEOMETRY, kr270, poses

    from elastocal.model.effects.catalogue import CATALOGUE

    clock = time.process_time
    with tempfile.TemporaryDirectory() as folder:
        begun = clock()
        kr270(Path(folder), GEOMETRY)  # reads a URDF, and imports what that takes
        imported = clock()
        effects = [name for name in CATALOGUE if name not in WITHOUT]
        model = kr270(Path(folder), effects, SETTINGS)
    built = clock()
    table = poses(model, 60, loaded=True, everything=True)
    before = clock()
    model.regressor(table)
    first = clock()
    model.regressor(table)
    print(json.dumps({
        "parameters": len(model.parameters), "imports": imported - begun,
        "build": built - imported, "first": first - before, "second": clock() - first,
    }))  # fmt: skip


def building(repeats: int, part: Part) -> None:
    """The whole catalogue, in a process of its own."""
    steps = ("a first small model (imports)", "build", "first B", "second B")
    columns = ["", *[f"{step}, CPU s" for step in steps], "peak, MB"]
    title = "A model of a 6-axis arm with the whole catalogue of effects, B of 60 loaded poses"
    table = Table(title, columns)
    runs = [own(__file__, OMP_NUM_THREADS="1") for _ in range(repeats)]
    least = min(runs, key=lambda run: run["build"] + run["first"])
    times = [least[key] for key in ("imports", "build", "first", "second")]
    table.rows.append([f"{least['parameters']} parameters", *times, least["peak_mb"]])
    part.goal("model and first B, CPU, at most 1 s", least["build"] + least["first"], 1.0, "s")
    part.tables.append(table)


def verbs(folder: Path, part: Part, tiny: bool) -> None:
    """Every verb on the demo, each in a process of its own."""
    table = Table("The verbs on the demo", ["verb", "wall, s", "CPU, s", "peak, MB"])

    def run(what: str, *arguments: object) -> Ran:
        ran = elastocal(*arguments)
        if ran.code:
            sys.exit(f"elastocal {arguments} failed:\n{ran.errors}")
        table.rows.append([what, ran.wall, ran.cpu, ran.peak_mb])
        return ran

    demo = folder / "demo"
    run("demo", "demo", "-o", demo)
    cell, data = demo / "cell.toml", demo / "data.csv"
    run("identify", "identify", cell, data, "-o", folder / "result.json", "--quiet")
    first = min(first_answer(cell, data) for _ in range(1 if tiny else 5))
    table.rows.append(["identify, its first answer", first, None, None])
    part.goal("first answer of `identify` on the demo, wall, at most 1 s", first, 1.0, "s")
    run("identify with report", "identify", cell, data, "--report", folder / "r.html", "--quiet")
    run("simulate", "simulate", cell, demo / "plan.csv", "-o", folder / "sim.csv",
        "--load", 0, 0, -2600, "--repeats", 6)  # fmt: skip
    if not tiny:
        run("diagnose", "diagnose", cell, data, "-o", folder / "diagnosis.json", "--quiet")
        # The demo's plan is given; asking for one takes a cell that says what to measure.
        planned = demo / "planned.toml"
        wanted = "\n[design]\nposes = 15\nloads_N = [[0, 0, 0], [0, 0, -2600]]\n"
        # … and without levels of joint 2, which a plan would have to keep to.
        text = cell.read_text(encoding="utf-8").partition("[model.compliance_levels]")[0]
        planned.write_text(text + wanted, encoding="utf-8")
        run("design, quick, 1000 candidates", "design", planned, "-o", folder / "plan.csv",
            "--effort", "quick", "--candidates", 1000, "--fix", "joint1.compliance",
            "--quiet")  # fmt: skip
        as_written(run, demo, folder, part)
    part.tables.append(table)


def first_answer(cell: Path, data: Path) -> float:
    """Seconds from the start of Python to the first letter of what `identify` says."""
    begun = time.perf_counter()
    command = [sys.executable, "-m", "elastocal", "identify", str(cell), str(data), "--quiet"]
    environment = os.environ | ONE_THREAD
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as running:
        assert running.stdout is not None
        if not running.stdout.read(1):
            sys.exit("identify said nothing")
        took = time.perf_counter() - begun
        running.stdout.read()
    return took


def as_written(run: Callable[..., Ran], demo: Path, folder: Path, part: Part) -> None:
    """A plan for geometry and compliance of a six-axis arm, from the cell that `init` writes."""
    arm = folder / "arm"
    arm.mkdir()
    robot = shutil.copy(demo / "kr270_2.urdf", arm)
    run("init", "init", robot, "-o", arm / "cell.toml")
    plan = ("design", arm / "cell.toml", "-o", arm / "plan.csv", "--effort", "quick", "--quiet")
    one = run("design of 30 poses, quick, the cell as `init` writes it", *plan, "--poses", 30)
    curve = run("the same with `--curve` of three sizes", *plan, "--curve", "20,30,40")
    part.goal("design of 30 poses, quick, CPU, at most 20 s", one.cpu, 20, "s")
    part.goal("`--curve` of three sizes over one plan, CPU, at most 2", curve.cpu / one.cpu, 2, "")


def measure(size: str) -> Part:
    part = Part("startup", "Start-up, model building, memory of the verbs")
    start(REPEATS[size], part)
    building(REPEATS[size], part)
    with tempfile.TemporaryDirectory() as folder:
        verbs(Path(folder), part, size == "tiny")
    return part


if __name__ == "__main__":
    child() if "--child" in sys.argv else run_alone(measure)
