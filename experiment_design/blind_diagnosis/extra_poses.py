"""The poses that `diagnose --plan` proposes, measured by the simulator, against random ones."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import records
from draw import World
from numpy.typing import NDArray
from visits import MINUTES_PER_VISIT, draw_poses, draw_visits
from worker import Worker
from world import Visits
from world_files import write_table

from elastocal.measurements import read_plan

Array = NDArray[np.float64]
ANSWER = "diagnosis.json"


def with_extra_poses(
    world: World, visible: Path, plan: str, worker: Worker
) -> dict[str, Any] | None:
    """Answers with the planned poses, as many random ones, and twice as many; None without plan."""
    if not (visible / plan).exists():
        return None
    planned = read_visits(world, visible / plan)
    n = len(np.unique(planned.q, axis=0))
    rng = np.random.default_rng((*world.seed, 3))
    campaigns = {
        "planned": planned,
        "random": random_visits(world, n, rng),
        "random_twice": random_visits(world, 2 * n, rng),
    }
    return {"n_poses": n} | {
        name: _diagnosed(world, visits, visible, worker, rng) for name, visits in campaigns.items()
    }


def read_visits(world: World, path: Path) -> Visits:
    """The visits that a plan asks for, after the campaign unless it states when."""
    kinds = ("revolute",) * world.spec.skeleton.n_joints
    table = read_plan(path, joint_kinds=kinds)
    time = _later(world, len(table)) if table.time is None else table.time
    if table.approach is None:
        rng = np.random.default_rng((*world.seed, 4))
        approach = rng.choice([-1.0, 1.0], table.q.shape)
    else:
        approach = table.approach.astype(float)
    return Visits(table.q, table.force, time, approach, table.configuration)


def random_visits(world: World, n: int, rng: np.random.Generator) -> Visits:
    """n random poses, unloaded and loaded, after the campaign."""
    poses = draw_poses(world.spec, n, rng)
    v = draw_visits(world.spec, poses, "interleaved", world.approach_by_motion, rng)
    return Visits(v.q, v.force, _later(world, len(v.q)), v.approach, v.pose)


def _later(world: World, n: int) -> Array:
    return world.visits.time[-1] + 60 * MINUTES_PER_VISIT * np.arange(1.0, n + 1)


def _diagnosed(
    world: World, extra: Visits, visible: Path, worker: Worker, rng: np.random.Generator
) -> records.Record | None:
    """The answer to the campaign's own readings and the extra ones together."""
    both = joined(world.visits, extra)
    readings = np.concatenate([world.readings(), world.measure(extra, rng)])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file in ("arm.urdf", "cell.toml"):
            shutil.copyfile(visible / file, folder / file)
        write_table(world, both, readings, folder / "data.csv")
        if worker.diagnose(folder, "-o", ANSWER).exit != 0:
            return None
        return records.shortened(json.loads((folder / ANSWER).read_text(encoding="utf-8")))


def joined(first: Visits, then: Visits) -> Visits:
    """Both in one table, no pose shared."""
    return Visits(
        np.concatenate([first.q, then.q]),
        np.concatenate([first.force, then.force]),
        np.concatenate([first.time, then.time]),
        np.concatenate([first.approach, then.approach]),
        np.concatenate([first.pose, first.pose.max() + 1 + then.pose]),
    )
