"""Feasible poses and moves of a KR 270 cell, checked again by MuJoCo's collision.

    python experiment_design/feasibility_check/check.py [--poses 10000] [--jobs 2]

Draws poses until `poses` are feasible, half of them with the load hanging, orders each half so
that neighbours are near, certifies the moves between neighbours, and has MuJoCo look at every
pose and at every free move in steps of 0.1° of the fastest joint.  Writes result.md.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from mujoco_cell import MujocoCell
from scipy.stats import qmc

from elastocal.cell import read_cell
from elastocal.model.chain import joint_limits
from elastocal.model.manipulator import load_chain
from elastocal.planning.collision import END
from elastocal.planning.feasibility import Feasibility

HERE = Path(__file__).resolve().parent
FORCE = np.array([0.0, 0.0, -2600.0])
STEP = np.radians(0.1)
TOLERANCE = 1e-5  # m: GJK against GJK
BATCH = 2**16
MOVES_AT_A_TIME = 50


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--poses", type=int, default=10_000)
    options.add_argument("--jobs", type=int, default=2)
    given = options.parse_args()
    cell = read_cell(HERE / "cell.toml")
    feasibility = Feasibility(cell, load_chain(cell))
    half = given.poses // 2
    columns = [check(feasibility, half, force, given.jobs) for force in (FORCE, 0 * FORCE)]
    lines = [f"| {key} | {columns[0][key]} | {columns[1][key]} |\n" for key in columns[0]]
    text = "| | with the load | without |\n|---|---|---|\n" + "".join(lines)
    print(text)
    (HERE / "result.md").write_text(text, encoding="utf-8")
    wrong = [key for column in columns for key in column if "violat" in key and column[key] != "0"]
    raise SystemExit(1 if wrong else 0)


def check(feasibility: Feasibility, wanted: int, force: np.ndarray, jobs: int) -> dict[str, str]:
    """The table's column for one load state."""
    loaded = bool(force.any())
    started = time.perf_counter()
    q, counts = draw(feasibility, wanted, force)
    drawn = time.perf_counter()
    q = q[tour(q)]
    ordered = time.perf_counter()
    free = feasibility.paths_free(q[:-1], q[1:], loaded)
    certified = time.perf_counter()
    moves = np.flatnonzero(free)
    print(f"{len(q)} poses, {len(moves)} free moves in {certified - started:.0f} s")

    def shared(work, split: list[np.ndarray]) -> list:
        return Parallel(n_jobs=jobs)(delayed(work)(feasibility, part, loaded) for part in split)

    pairs = np.stack([q[:-1], q[1:]], axis=1)
    parts = shared(recheck, np.array_split(pairs[moves], max(len(moves) // MOVES_AT_A_TIME, 1)))
    poses = shared(recheck_poses, np.array_split(q, 2 * jobs))
    ended = time.perf_counter()
    return {
        **{key: f"{n:,}" for key, n in counts.items()},
        "feasible poses checked by MuJoCo": f"{len(q):,}",
        "violations among them: bodies": str(sum(p[0] for p in poses)),
        "violations among them: sight": str(sum(p[1] for p in poses)),
        "moves between neighbours": f"{len(free):,}",
        "of these certified free": f"{len(moves):,}",
        "poses on free moves checked by MuJoCo": f"{sum(p[0] for p in parts):,}",
        "violations on free moves": str(sum(p[1] for p in parts)),
        "drawing, s": f"{drawn - started:.1f}",
        "certifying moves, s": f"{certified - ordered:.1f}",
        "MuJoCo, s": f"{ended - certified:.1f}",
    }


def draw(feasibility: Feasibility, wanted: int, force: np.ndarray) -> tuple[np.ndarray, dict]:
    """Feasible poses (wanted, n), and how many were tried and each rule removed."""
    lower, upper = joint_limits(feasibility.cell, feasibility.chain)
    engine = qmc.Sobol(len(lower), rng=np.random.default_rng(1))
    found: list[np.ndarray] = []
    counts = Counter()
    while sum(len(part) for part in found) < wanted:
        q = lower + engine.random(BATCH) * (upper - lower)
        left = q
        counts["poses tried"] += len(q)
        for rule in feasibility.rules:
            broken = rule.broken(feasibility.kinematics.poses(left, force))
            counts[f"removed by {rule.name}"] += int(broken.sum())
            left = left[~broken]
        found.append(left)
    return np.concatenate(found)[:wanted], counts


def tour(q: np.ndarray) -> np.ndarray:
    """A path through all poses that always goes to the nearest one left."""
    left, path = np.arange(1, len(q)), [0]
    while len(left):
        k = int(np.abs(q[left] - q[path[-1]]).max(axis=1).argmin())
        path.append(int(left[k]))
        left = np.delete(left, k)
    return np.array(path)


def mujoco(feasibility: Feasibility, slack: float) -> MujocoCell:
    return MujocoCell(
        feasibility.cell, feasibility.chain, feasibility.bodies, feasibility.pairs, slack
    )


def recheck_poses(feasibility: Feasibility, q: np.ndarray, loaded: bool) -> tuple[int, int]:
    """Poses in which MuJoCo sees a margin broken, and those with a hidden marker."""
    judge = mujoco(feasibility, -TOLERANCE)
    sight = feasibility.cell.workspace.visibility
    end = END * sight.beam_radius
    bodies = sum(bool(judge.contacts(pose, loaded)) for pose in q)
    return bodies, sum(bool(judge.hidden(pose, end, loaded)) for pose in q)


def dense(move: np.ndarray) -> np.ndarray:
    """Poses on a move (2, n), at most STEP apart in every joint."""
    start, end = move
    count = int(np.ceil(np.abs(end - start).max() / STEP)) + 1
    return start + np.linspace(0.0, 1.0, max(count, 2))[:, None] * (end - start)


def recheck(feasibility: Feasibility, free: np.ndarray, loaded: bool) -> tuple[int, int]:
    """Poses looked at on free moves, and those of them in which a margin is broken."""
    judge = mujoco(feasibility, -TOLERANCE)
    poses = [pose for move in free for pose in dense(move)]
    return len(poses), sum(bool(judge.contacts(pose, loaded)) for pose in poses)


if __name__ == "__main__":
    main()
