"""Measurement plans beside those of FIGAROH, pyDOE3 and scipy: values and times in one run.

    python benchmarks/design_peers.py [--figaroh-python PATH] [--only figaroh|exchange]

`figaroh`: D-optimal poses of a UR10 from a pool of 1000, on the regressor that FIGAROH computes.
`exchange`: 15 poses of a KR 270 for the least error at 20 test poses.  FIGAROH and pyDOE3 run in
an environment of their own (README.md says how to make it) and exchange arrays with this one.
Every process has one BLAS thread, nothing runs at the same time, and every value in a table is
computed here, by the same function for all.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from design_peers_kr270 import Arm, evolved, prepared

from elastocal.design.criteria.determinant import DeterminantCriterion
from elastocal.design.exact.plan import exact_plan
from elastocal.design.polish.coordinate_ascent import polish
from elastocal.design.problem import DesignProblem
from elastocal.design.relaxation.relax import relax

HERE = Path(__file__).parent
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
SEED = 1
POOL, POSES = 1000, 30  # of the UR10
WORSE = 1e-4  # log det below the convex optimum that is allowed
FASTER = 20.0
STARTS = (1, 10)
DE_BUDGET = 10.0  # times our CPU time
RANDOM = 200
T = TypeVar("T")


@dataclass(frozen=True)
class Seconds:
    """Wall and CPU time; CPU time hardly depends on what else the machine does."""

    wall: float
    cpu: float

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.wall + other.wall, self.cpu + other.cpu)


def timed(work: Callable[[], T]) -> tuple[T, Seconds]:
    wall, cpu = time.perf_counter(), time.process_time()
    done = work()
    return done, Seconds(time.perf_counter() - wall, time.process_time() - cpu)


def table(header: str, rows: list[tuple[str, float, str, Seconds | None]], digits: int) -> None:
    """Markdown: what, value, how far from the bound, wall and CPU seconds."""
    print(f"\n| {header} | wall, s | CPU, s |\n|---|---|---|---|---|")
    for what, value, beside, seconds in rows:
        times = f"{seconds.wall:.2f} | {seconds.cpu:.2f}" if seconds else " | "
        print(f"| {what} | {value:.{digits}f} | {beside} | {times} |", flush=True)


def required(what: str, met: bool) -> None:
    print(f"- {what}: {'met' if met else 'NOT MET'}")


def peer(python: Path, script: str, *arguments: Path) -> Any:
    """Run a script of the peers' environment; what it wrote to the last of its arguments."""
    command = [str(python), str(HERE / script), *map(str, arguments)]
    ran = subprocess.run(command, capture_output=True, text=True, env=os.environ | ONE_THREAD)
    if ran.returncode:
        sys.exit(f"{script} failed:\n{ran.stderr}")
    return np.load(arguments[-1])


def ur10() -> Path:
    package = metadata.distribution("example-robot-data")
    ending = "ur_description/urdf/ur10_robot.urdf"
    return Path(
        str(package.locate_file(next(f for f in package.files or () if str(f).endswith(ending))))
    )


def beside_figaroh(python: Path, folder: Path) -> None:
    """The same regressor for both: relaxed weights, then exact plans of 30 poses."""
    given, out = folder / "ur10_pool.npz", folder / "figaroh.npz"
    q = np.random.default_rng(SEED).uniform(-np.pi, np.pi, (POOL, 6))
    np.savez(given, q=q, poses=POSES, seed=SEED)
    theirs = peer(python, "figaroh_pool.py", ur10(), given, out)
    R = theirs["regressor"]
    p = R.shape[2]
    columns = np.sqrt((R**2).mean(axis=(0, 1)))

    def log_det(weights: np.ndarray) -> float:
        return float(np.linalg.slogdet(np.einsum("n,nri,nrj->ij", weights, R, R))[1])

    def problem(most: int) -> DesignProblem:
        group, shares = np.zeros(POOL, dtype=np.int64), np.array([POSES])
        criterion = DeterminantCriterion(np.arange(p))
        return DesignProblem(
            (R / columns)[None], np.zeros((1, p, p)), group, shares, criterion, most
        )

    def bound(phi: float) -> float:
        """log det of any information, in FIGAROH's units, from a bound on Φ = det^(−1/p)."""
        return float(-p * np.log(phi) + 2 * np.log(columns).sum())

    # FIGAROH's weights have no upper limit; nor has a pose that all 30 measurements may take.
    free, conic = problem(POSES), timed(lambda: relax(problem(POSES), method="conic"))
    ours, seconds = timed(lambda: relax(free, method="first-order"))
    best = bound(ours.bound) - p * np.log(POSES)
    socp = Seconds(float(theirs["wall_socp"]), float(theirs["cpu_socp"]))
    found = log_det(ours.weights / POSES)
    rows = [
        (f"FIGAROH: SOCP, cvxopt ({theirs['status']})", theirs["weights"], socp),
        ("elastocal: first-order relaxation", ours.weights / POSES, seconds),
        ("elastocal: conic relaxation (clarabel)", conic[0].weights / POSES, conic[1]),
    ]
    print(f"\nUR10, {POOL} poses, {p} parameters, regressor of FIGAROH")
    table(
        "relaxed weights of sum 1 | log det M | below the certified bound",
        [(what, log_det(w), f"{best - log_det(w):.1e}", s) for what, w, s in rows],
        6,
    )
    solver = float(theirs["wall_solver"])
    required(f"log det within {WORSE:g} of the convex optimum, here {best - found:.1e}",
             best - found <= WORSE)  # fmt: skip
    required(
        f"{FASTER:.0f} times faster than the SOCP, here {socp.wall / seconds.wall:.0f} times "
        f"({socp.cpu / seconds.cpu:.0f} in CPU time, {solver / seconds.wall:.0f} against "
        f"cvxopt's {solver:.1f} s without building the model)",
        socp.wall >= FASTER * seconds.wall,
    )

    once = problem(1)
    relaxed, before = timed(lambda: relax(once))
    top = bound(relaxed.bound)
    cut = np.zeros(POOL)
    cut[theirs["ranked"][:POSES]] = 1.0
    detmax = Seconds(float(theirs["wall_detmax"]), float(theirs["cpu_detmax"]))
    plans = [
        (f"FIGAROH: its {len(theirs['ranked'])} poses cut to {POSES}", log_det(cut), socp),
        ("FIGAROH: DetMax", float(theirs["detmax"]), detmax),
    ]
    for starts in STARTS:
        plan, took = timed(
            lambda s=starts: exact_plan(once, relaxed_weights=relaxed.weights, starts=s, seed=SEED)
        )
        weights = np.bincount(plan.chosen, minlength=POOL).astype(float)
        name = f"elastocal: relaxation and exchange, {_starts(starts)}"
        plans.append((name, log_det(weights), before + took))
    table(
        f"exact plan of {POSES} poses | log det M | D-efficiency, at least",
        [(what, value, f"{np.exp((value - top) / p):.4f}", s) for what, value, s in plans],
        3,
    )
    required("better than FIGAROH's set cut to 30", plans[2][1] > plans[0][1])


def beside_exchange(python: Path | None, folder: Path) -> None:
    """The test-pose criterion: pyDOE3's exchange, differential evolution, ours."""
    arm, pooling = timed(lambda: prepared(folder, SEED))
    problem = arm.problem
    relaxed, relaxing = timed(lambda: relax(problem))
    rows: list[tuple[str, float, Seconds | None]] = []
    for starts in STARTS:
        plan, exchanging = timed(
            lambda s=starts: exact_plan(
                problem, relaxed_weights=relaxed.weights, starts=s, seed=SEED
            )
        )
        total = pooling + relaxing + exchanging
        name = f"elastocal: relaxation and exchange, {_starts(starts)}"
        rows.append((name, arm.rho(arm.pool.q[plan.chosen]), total))
    chosen = plan.chosen
    moved, polishing = timed(
        lambda: polish(problem, arm.searches, arm.pool.q, arm.pool.load, chosen)
    )
    rows.append(("elastocal: and polished off the pool", arm.rho(moved.q), total + polishing))
    ours, seconds = rows[0][1], total if len(STARTS) == 1 else rows[0][2]
    others = [*_pydoe(python, folder, arm), _evolution(arm, seconds)]
    rng = np.random.default_rng(SEED)
    drawn = [rng.choice(len(arm.pool), arm.poses, replace=False) for _ in range(RANDOM)]
    chance = np.mean([arm.rho(arm.pool.q[c]) for c in drawn])
    bound = 1e6 * np.sqrt(relaxed.bound)
    rows = [(f"mean of {RANDOM} random plans", float(chance), None), *others, *rows]
    print(
        f"\nKR 270, {arm.poses} poses from {len(arm.pool)}, {problem.blocks.shape[3]} parameters, "
        f"ρ₀ at {arm.n_targets} test poses; bound on the pool {bound:.3f} µm"
    )
    table(
        "plan | ρ₀, µm | above the bound",
        [(what, value, f"{100 * (value / bound - 1):.1f} %", s) for what, value, s in rows],
        3,
    )
    for what, value, took in others:
        if took is not None and seconds is not None:
            required(
                f"better and quicker than {what.split(',')[0]}: {value / ours:.3f} times its ρ₀, "
                f"{took.wall / seconds.wall:.1f} times our time",
                ours < value and seconds.wall < took.wall,
            )


def _pydoe(python: Path | None, folder: Path, arm: Arm) -> list[tuple[str, float, Seconds | None]]:
    if python is None:
        return []
    given, out = folder / "kr270_pool.npz", folder / "pydoe.npz"
    np.savez(given, blocks=arm.pool.blocks[0], C=arm.C, n_poses=arm.poses)
    found = peer(python, "pydoe_exchange.py", given, out)
    return [
        (
            f"pyDOE3: {name.removeprefix('chosen_')}",
            arm.rho(arm.pool.q[found[name]]),
            Seconds(*(float(found[name.replace("chosen", kind)]) for kind in ("wall", "cpu"))),
        )
        for name in found
        if name.startswith("chosen_")
    ]


def _evolution(arm: Arm, ours: Seconds | None) -> tuple[str, float, Seconds]:
    budget = DE_BUDGET * (ours.cpu if ours else 1.0)
    (found, plans), seconds = timed(lambda: evolved(arm, budget, SEED))
    return f"scipy: differential evolution, {plans} plans", arm.rho(found), seconds


def _starts(number: int) -> str:
    return f"{number} start{'s' if number > 1 else ''}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--figaroh-python",
        type=Path,
        default=os.environ.get("ELASTOCAL_FIGAROH_PYTHON"),
        help="Python with FIGAROH and pyDOE3 (default: ELASTOCAL_FIGAROH_PYTHON)",
    )
    parser.add_argument("--only", choices=("figaroh", "exchange"))
    chosen = parser.parse_args()
    if any(os.environ.get(name) != one for name, one in ONE_THREAD.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | ONE_THREAD)
    python = chosen.figaroh_python
    if python is None:
        print(
            "FIGAROH and pyDOE3: skipped, no environment; give --figaroh-python PATH or set "
            "ELASTOCAL_FIGAROH_PYTHON (benchmarks/README.md says how to make it)"
        )
    elif not python.exists():
        parser.error(f"--figaroh-python: there is no {python}")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, one BLAS thread each")
    with tempfile.TemporaryDirectory() as name:
        if python is not None and chosen.only != "exchange":
            beside_figaroh(python, Path(name))
        if chosen.only != "figaroh":
            beside_exchange(python, Path(name))


if __name__ == "__main__":
    main()
