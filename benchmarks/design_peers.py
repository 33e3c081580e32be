"""Measurement plans beside those of FIGAROH: values and times in one run.

    python benchmarks/design_peers.py

D-optimal poses of a UR10 from a pool of 1000, on the regressor that FIGAROH computes.  FIGAROH
runs in the environment of ELASTOCAL_PEERS_PYTHON (README.md says how to make it) and exchanges
arrays with this one.  Every process has one BLAS thread, nothing runs at the same time, and every
value in a table is computed here, by the same function for all, but for that of FIGAROH's DetMax.
"""

from __future__ import annotations

import os
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from bench_tools import ONE_THREAD, Seconds, packaged, peer, required, table, timed, where

from elastocal.planning.criteria import DeterminantCriterion
from elastocal.planning.relaxation import DesignProblem, exact_plan, relax

SEED = 1
POOL, POSES = 1000, 30  # of the UR10
WORSE = 1e-4  # log det below the convex optimum that is allowed
FASTER = 20
STARTS = (1, 10)
UR10 = "example-robot-data", "ur_description/urdf/ur10_robot.urdf"
CLOCKS = ("wall, s", "CPU, s")


def beside_figaroh(folder: Path) -> None:
    """The same regressor for both: relaxed weights, then exact plans of 30 poses."""
    given, out = folder / "ur10_pool.npz", folder / "figaroh.npz"
    q = np.random.default_rng(SEED).uniform(-np.pi, np.pi, (POOL, 6))
    np.savez(given, q=q, poses=POSES, seed=SEED)
    theirs = peer("figaroh_pool.py", packaged(*UR10), given, out)
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
        return DesignProblem(R / columns, np.zeros((p, p)), group, shares, criterion).balanced()

    print(f"\n## UR10: {POOL} poses, {p} parameters, regressor of FIGAROH")
    # FIGAROH's weights of sum 1 have no upper limit, as those of a plan of one pose.
    ours, took = timed(partial(relax, problem(1), 1e-6))
    socp, detmax = (
        Seconds(float(theirs[f"wall_{step}"]), float(theirs[f"cpu_{step}"]))
        for step in ("socp", "detmax")
    )
    top = log_det_of(ours.bound)
    found = log_det(ours.weights)
    table("Relaxed weights of sum 1", ("", "log det M", "below the certified bound", *CLOCKS), [
        (what, f"{value:.6f}", f"{top - value:.1e}", clock.wall, clock.cpu)
        for what, value, clock in (
            (f"FIGAROH: SOCP by cvxopt, {theirs['status']}", log_det(theirs["weights"]), socp),
            ("elastocal: Newton with columns", found, took),
        )
    ])  # fmt: skip
    required(f"within {WORSE:g} of the convex optimum", f"{top - found:.1e}", top - found < WORSE)
    solver = float(theirs["wall_solver"])
    required(
        f"{FASTER} times faster than FIGAROH's SOCP",
        f"{socp.wall / took.wall:.0f} times (CPU time: {socp.cpu / took.cpu:.0f}; cvxopt alone, "
        f"{solver:.1f} s, {solver / took.wall:.0f})",
        socp.wall > FASTER * took.wall and socp.cpu > FASTER * took.cpu,
    )

    once = problem(POSES)
    relaxed, relaxing = timed(partial(relax, once))
    top = log_det_of(relaxed.bound)
    cut = np.isin(np.arange(POOL), theirs["ranked"][:POSES])
    rows = [
        (f"FIGAROH: {len(theirs['ranked'])} chosen, cut to {POSES}", log_det(cut), socp),
        ("FIGAROH: DetMax", float(theirs["detmax"]), detmax),
    ]
    for number in STARTS:
        (plan, _), took = timed(partial(exact_plan, once, relaxed, starts=number, seed=SEED))
        value = log_det(np.bincount(plan, minlength=POOL))
        rows.append((f"elastocal, {number} start{'s' * (number > 1)}", value, relaxing + took))
    table(f"{POSES} poses", ("", "log det M", "D-efficiency at least", *CLOCKS), [
        (what, f"{value:.3f}", f"{np.exp((value - top) / p):.4f}", clock.wall, clock.cpu)
        for what, value, clock in rows
    ])  # fmt: skip
    required("better than FIGAROH's set cut to 30", f"{rows[2][1]:.3f}", rows[2][1] > rows[0][1])


def main() -> None:
    if os.environ.get("OMP_NUM_THREADS") != "1":
        one = os.environ | ONE_THREAD | {"OMP_NUM_THREADS": "1"}
        os.execve(sys.executable, [sys.executable, *sys.argv], one)
    print(where())
    with tempfile.TemporaryDirectory() as name:
        beside_figaroh(Path(name))


if __name__ == "__main__":
    main()
