"""Measurement plans beside those of FIGAROH, pyDOE3 and scipy: values and times in one run.

    python benchmarks/design_peers.py [--figaroh-python PATH] [--only figaroh|exchange]

`figaroh`: D-optimal poses of a UR10 from a pool of 1000, on the regressor that FIGAROH computes.
`exchange`: 15 poses of a KR 270 for the least error at 20 test poses.  FIGAROH and pyDOE3 run in
an environment of their own (README.md says how to make it) and exchange arrays with this one.
Every process has one BLAS thread, nothing runs at the same time, and every value in a table is
computed here, by the same function for all, but for that of FIGAROH's DetMax.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from importlib import metadata
from pathlib import Path

import numpy as np
from peer_kr270 import Arm, evolved, prepared
from peer_tools import ONE_THREAD, Row, Seconds, peer, required, seconds_of, starts, table, timed

from elastocal.planning.criteria import DeterminantCriterion
from elastocal.planning.exchange import exact_plan, exchange, rounded
from elastocal.planning.polish import polish
from elastocal.planning.relaxation import DesignProblem, balanced, relax

SEED = 1
POOL, POSES = 1000, 30  # of the UR10
WORSE = 1e-4  # log det below the convex optimum that is allowed
FASTER = 20
STARTS = (1, 10)
GENERATIONS = 60  # of differential evolution: more than 10 times the time of our first start
POLISHED = 3  # plans, from different seeds
RANDOM = 200


def ur10() -> Path:
    package = metadata.distribution("example-robot-data")
    ending = "ur_description/urdf/ur10_robot.urdf"
    found = next(f for f in package.files or () if str(f).endswith(ending))
    return Path(str(package.locate_file(found)))


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
        return float(np.linalg.slogdet(np.einsum("n,nri,nrj->ij", weights, R, R, optimize=True))[1])

    def log_det_of(phi: float) -> float:
        """log det, in FIGAROH's units, of an information of this Φ = det^(−1/p)."""
        return float(-p * np.log(phi) + 2 * np.log(columns).sum())

    def problem(poses: int) -> DesignProblem:
        criterion, group = DeterminantCriterion(np.eye(p)), np.zeros(POOL, dtype=np.int64)
        shares = np.array([poses])
        return balanced(DesignProblem(R / columns, np.zeros((p, p)), group, shares, criterion))[0]

    print(f"\n## UR10: {POOL} poses, {p} parameters, regressor of FIGAROH")
    # FIGAROH's weights of sum 1 have no upper limit, as those of a plan of one pose.
    ours, took = timed(partial(relax, problem(1), 1e-6))
    socp = seconds_of(theirs, "socp")
    top = log_det_of(ours.bound)
    found = log_det(ours.weights)
    table(
        "relaxed weights of sum 1", "log det M", 6, "below the certified bound",
        [
            Row(f"FIGAROH: SOCP by cvxopt, {theirs['status']}", log_det(theirs["weights"]), socp),
            Row("elastocal: Newton with columns", found, took),
        ],
        lambda value: f"{top - value:.1e}",
    )  # fmt: skip
    required(f"within {WORSE:g} of the convex optimum, here {top - found:.1e}", top - found < WORSE)
    solver = float(theirs["wall_solver"])
    required(
        f"{FASTER} times faster than FIGAROH's SOCP, here {socp.wall / took.wall:.0f} times (CPU "
        f"time: {socp.cpu / took.cpu:.0f}; cvxopt alone, {solver:.1f} s: {solver / took.wall:.0f})",
        socp.wall > FASTER * took.wall and socp.cpu > FASTER * took.cpu,
    )

    once = problem(POSES)
    relaxed, relaxing = timed(partial(relax, once))
    top = log_det_of(relaxed.bound)
    cut = np.isin(np.arange(POOL), theirs["ranked"][:POSES])
    rows = [
        Row(f"FIGAROH: {len(theirs['ranked'])} chosen, cut to {POSES}", log_det(cut), socp),
        Row("FIGAROH: DetMax", float(theirs["detmax"]), seconds_of(theirs, "detmax")),
    ]
    for number in STARTS:
        work = partial(exact_plan, once, relaxed, starts=number, seed=SEED)
        (plan, _), took = timed(work)
        value = log_det(np.bincount(plan, minlength=POOL))
        rows.append(Row(f"elastocal, {starts(number)}", value, relaxing + took))
    table(
        f"{POSES} poses", "log det M", 3, "D-efficiency at least", rows,
        lambda value: f"{np.exp((value - top) / p):.4f}",
    )  # fmt: skip
    required(f"better than FIGAROH's set cut to {POSES}", rows[2].value > rows[0].value)


def beside_exchange(python: Path | None, folder: Path) -> None:
    """The test-pose criterion: pyDOE3's exchange, differential evolution, ours."""
    arm, pooling = timed(partial(prepared, folder, SEED))
    print(
        f"\n## KR 270: {arm.poses} poses, pool of {len(arm.pool)} (drawn and evaluated in "
        f"{pooling.wall:.2f} s), {arm.problem.blocks.shape[2]} parameters, ρ₀ at {arm.n_targets} "
        "test poses"
    )
    ours, bound = _ours(arm, pooling)
    others = [] if python is None else list(_pydoe(python, folder, arm, pooling))
    (plan_q, plans), took = timed(partial(evolved, arm, GENERATIONS, SEED))
    others.append(Row(f"scipy: differential evolution, {plans} plans", arm.rho(plan_q), took))
    rng = np.random.default_rng(SEED)
    drawn = [rng.choice(len(arm.pool), arm.poses, replace=False) for _ in range(RANDOM)]
    chance = Row(f"mean of {RANDOM} random plans", float(arm.rhos(arm.pool.q[drawn]).mean()))
    table(
        f"{arm.poses} poses", "ρ₀, µm", 3, f"above the bound on the pool, {bound:.3f} µm",
        [chance, *others, *ours], lambda value: f"{100 * (value / bound - 1):.1f} %",
    )  # fmt: skip
    for row in others:
        better = [own for own in ours if own.value < row.value]
        own = min(better or ours, key=lambda r: r.cpu)
        required(
            f"{own.what}, beside {row.what.split(',')[0]}: ρ₀ "
            f"{100 * (1 - own.value / row.value):.1f} % smaller, {row.cpu / own.cpu:.1f} times as "
            f"fast (wall: {row.wall / own.wall:.1f})",
            bool(better) and own.cpu < row.cpu,
        )


def _ours(arm: Arm, pooling: Seconds) -> tuple[list[Row], float]:
    """Plans of increasing effort, each with all the time that it took, and the bound in µm."""
    problem, q = arm.problem, arm.pool.q
    problem, T = balanced(problem)
    relaxed, relaxing = timed(partial(relax, problem))
    before = pooling + relaxing
    (once, _), took = timed(lambda: exchange(problem, rounded(problem, relaxed.weights)))
    rows = [Row("elastocal, one exchange", arm.rho(q[once]), before + took)]
    for number in STARTS:
        (plan, _), took = timed(partial(exact_plan, problem, relaxed, starts=number, seed=SEED))
        rows.append(Row(f"elastocal, {starts(number)}", arm.rho(q[plan]), before + took))
    value, total = np.inf, before
    for k in range(POLISHED):
        rng = np.random.default_rng(SEED + k) if k else None
        plan, took = timed(partial(rounded, problem, relaxed.weights, rng))
        poses = q[plan], arm.pool.group[plan]
        off, last = timed(partial(polish, problem, arm.searches, T, *poses))
        value, total = min(value, arm.rho(off)), total + took + last
        name = "elastocal, 1 start, polished" if k == 0 else f"elastocal, best of {k + 1} polished"
        rows.append(Row(name, value, total))
    return rows, float(1e6 * np.sqrt(relaxed.bound))


def _pydoe(python: Path, folder: Path, arm: Arm, pooling: Seconds) -> Iterator[Row]:
    given, out = folder / "kr270_pool.npz", folder / "pydoe.npz"
    np.savez(given, blocks=arm.pool.blocks, C=arm.C, n_poses=arm.poses)
    found = peer(python, "pydoe_exchange.py", given, out)
    for name in ("simple_exchange", "modified_fedorov", "detmax"):
        took = pooling + seconds_of(found, name)
        yield Row(f"pyDOE3: {name}", arm.rho(arm.pool.q[found[f"chosen_{name}"]]), took)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--figaroh-python",
        default=os.environ.get("ELASTOCAL_FIGAROH_PYTHON"),
        help="Python with FIGAROH and pyDOE3 (default: ELASTOCAL_FIGAROH_PYTHON)",
    )
    parser.add_argument("--only", choices=("figaroh", "exchange"))
    chosen = parser.parse_args()
    if any(os.environ.get(name) != one for name, one in ONE_THREAD.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | ONE_THREAD)
    python = Path(chosen.figaroh_python) if chosen.figaroh_python else None
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
