"""One world: drawn, sealed, diagnosed blind, and only then scored."""

from __future__ import annotations

import json
import secrets
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from afterwards import distances, plain_fit, true_reduction
from draw import MINUTES_PER_VISIT, World, draw_poses, draw_visits
from score import Record, claims, shortened, truths
from suites import Task
from whole_score import NEW, judged, tested
from worker import run
from world import Visits
from world_files import write_table, write_world

from elastocal.measurements import read_measurements

DIAGNOSE = "diagnose", "cell.toml", "data.csv"
ANSWER, CELL, PLAN = "diagnosis.json", "extended.toml", "extra.csv"
MOST_EXTRA = 20  # a third of the campaign


def diagnose_world(task: Task, origin: dict[str, Any]) -> Record:
    """Write the world, have it diagnosed, and only then look at the truth.

    The two trees have nothing in common but the folder for temporary files; their names are drawn
    at random, and the command gets that of the visible one.  `origin` stands in the record.
    """
    visible, sealed = (Path(tempfile.mkdtemp(prefix=secrets.token_hex(8))) for _ in range(2))
    try:
        world = task.recipe.draw()
        write_world(world, visible, sealed)
        arguments = ["-o", ANSWER, "--cell-out", CELL]
        arguments += [a for name in task.without for a in ("--without", name)]
        if task.asked.plan:
            arguments += ["--plan", PLAN, "--poses", str(MOST_EXTRA)]
        done = run(visible, *DIAGNOSE, *arguments)
        answer = None
        if done.exit == 0:
            answer = shortened(json.loads((visible / ANSWER).read_text(encoding="utf-8")))
        record: Record = origin | {
            "suite": task.suite,
            "world": world.name,
            "factor": task.recipe.factor,
            "exit": done.exit,
            "seconds": done.seconds,
            "message": done.message if done.exit else "",
            "truth": json.loads((sealed / "truth.json").read_text(encoding="utf-8")),
            "answer": answer,
        }
        if task.asked.distance or task.asked.reduction:
            base = plain_fit(visible)
        if task.asked.distance:
            record["distances"] = distances(base, world, task.without)
        found = [said[0] for said in claims(answer)]
        if task.asked.reduction and found and found == truths(record["truth"]):
            fresh = sealed / "fresh.csv"
            record["reduction"] = true_reduction(base, answer, visible / CELL, fresh)
        if task.asked.left_out and answer is not None:
            shutil.copyfile(sealed / "fresh.csv", visible / NEW)
            record["dearer"] = _dearer(visible)
        if task.asked.whole:
            record["whole"] = judged(world, visible, sealed / "fresh.csv", answer, CELL)
        if task.asked.plan and (visible / PLAN).exists():
            record["extra"] = with_extra_poses(world, visible)
        return record
    finally:
        shutil.rmtree(visible)
        shutil.rmtree(sealed)


def _dearer(visible: Path) -> float | None:
    """The error at new poses of the cell that a diagnosis without the effect wrote, over that of
    one with the whole catalogue."""
    if run(visible, *DIAGNOSE, "-o", "all.json", "--cell-out", "all.toml").exit != 0:
        return None
    without, whole = (tested(visible, cell) for cell in (CELL, "all.toml"))
    return without / whole if without and whole else None


# The poses that `diagnose --plan` proposes, measured by the simulator, against random ones.


def with_extra_poses(world: World, visible: Path) -> dict[str, Any]:
    """Answers with the planned poses, and with as many random ones."""
    planned = read_visits(world, visible / PLAN)
    n = len(np.unique(planned.q, axis=0))
    rng = np.random.default_rng((*world.seed, 3))
    campaigns = {"planned": planned, "random": random_visits(world, n, rng)}
    return {"n_poses": n} | {
        name: _diagnosed(world, visits, visible, rng) for name, visits in campaigns.items()
    }


def read_visits(world: World, path: Path) -> Visits:
    """The visits that a plan asks for, after the campaign unless it states when."""
    table = read_measurements(
        path, joint_kinds=("revolute",) * world.spec.skeleton.n_joints, observe="plan"
    )
    rng = np.random.default_rng((*world.seed, 4))
    approach = rng.choice([-1.0, 1.0], table.q.shape) if table.approach is None else table.approach
    visits = Visits(
        table.q, table.force, np.zeros(len(table)), approach.astype(float), table.configuration
    )
    return _later(world, visits) if table.time is None else replace(visits, time=table.time)


def random_visits(world: World, n: int, rng: np.random.Generator) -> Visits:
    """n random poses, unloaded and loaded, after the campaign."""
    poses = draw_poses(world.spec, n, rng)
    return _later(
        world, draw_visits(world.spec, poses, "interleaved", world.approach_by_motion, rng)
    )


def _later(world: World, visits: Visits) -> Visits:
    steps = np.arange(1.0, len(visits.q) + 1)
    return replace(visits, time=world.visits.time[-1] + 60 * MINUTES_PER_VISIT * steps)


def _diagnosed(
    world: World, extra: Visits, visible: Path, rng: np.random.Generator
) -> Record | None:
    """The answer to the campaign's own readings and the extra ones in one table, no pose shared."""
    own = world.visits
    both = own.then(replace(extra, pose=own.pose.max() + 1 + extra.pose))
    readings = np.concatenate([world.readings(), world.measure(extra, rng)])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file in ("arm.urdf", "cell.toml"):
            shutil.copyfile(visible / file, folder / file)
        write_table(world, both, readings, folder / "data.csv")
        if run(folder, *DIAGNOSE, "-o", ANSWER).exit != 0:
            return None
        return shortened(json.loads((folder / ANSWER).read_text(encoding="utf-8")))
