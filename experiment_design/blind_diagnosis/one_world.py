"""One world: drawn, sealed, diagnosed blind, and only then scored."""

from __future__ import annotations

import atexit
import json
import secrets
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from afterwards import distances, plain_fit, true_reduction
from draw import World
from extra_poses import with_extra_poses
from score import Record, claims, shortened, truths
from suites import Task
from whole_score import judged
from worker import Worker
from world_files import write_world

ANSWER, CELL, PLAN = "diagnosis.json", "extended.toml", "extra.csv"
MOST_EXTRA = 20  # a third of the campaign


def diagnose_world(task: Task, worker: Worker, origin: dict[str, Any]) -> Record:
    """Write the world, have it diagnosed, and only then look at the truth.

    The two trees have nothing in common but the folder for temporary files; their names are drawn
    at random, and the worker gets that of the visible one.  `origin` stands in the record.
    """
    visible = Path(tempfile.mkdtemp(prefix=secrets.token_hex(8)))
    sealed = Path(tempfile.mkdtemp(prefix=secrets.token_hex(8)))
    try:
        world = task.recipe.draw()
        write_world(world, visible, sealed)
        arguments = ["-o", ANSWER, "--cell-out", CELL]
        arguments += [a for name in task.without for a in ("--without", name)]
        if task.asked.plan:
            arguments += ["--plan", PLAN, "--poses", str(MOST_EXTRA)]
        run = worker.diagnose(visible, *arguments)
        answer = None
        if run.exit == 0:
            answer = shortened(json.loads((visible / ANSWER).read_text(encoding="utf-8")))
        record: Record = origin | {
            "suite": task.suite,
            "world": world.name,
            "factor": task.recipe.factor,
            "exit": run.exit,
            "seconds": run.seconds,
            "message": run.message if run.exit else "",
            "truth": json.loads((sealed / "truth.json").read_text(encoding="utf-8")),
            "answer": answer,
        }
        if task.asked.distance or task.asked.reduction:
            record |= _afterwards(task, world, record, visible, sealed)
        if task.asked.whole:
            fresh = sealed / "fresh.csv"
            record["whole"] = judged(
                world, visible, fresh, lambda *a: worker.run(visible, *a).exit, answer, CELL
            )
        if task.asked.plan and (visible / PLAN).exists():
            record["extra"] = with_extra_poses(world, visible, PLAN, worker)
        return record
    finally:
        shutil.rmtree(visible)
        shutil.rmtree(sealed)


def _afterwards(
    task: Task, world: World, record: Record, visible: Path, sealed: Path
) -> dict[str, Any]:
    """d of the true effects, and the shrinkage where exactly they were found."""
    base, answer, out = plain_fit(visible), record["answer"], dict[str, Any]()
    if task.asked.distance:
        out["distances"] = distances(base, world, task.without)
    found = [said[0] for said in claims(answer)]
    if task.asked.reduction and answer is not None and found == truths(record["truth"]):
        out["reduction"] = true_reduction(base, answer, visible / CELL, sealed / "fresh.csv")
    return out


@cache
def _own_worker() -> Worker:
    worker = Worker()
    atexit.register(worker.close)
    return worker


def in_own_worker(task: Task, origin: dict[str, Any]) -> Record:
    """The same by this process's worker.  A module's function: processes are sent its name."""
    return diagnose_world(task, _own_worker(), origin)
