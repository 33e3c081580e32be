"""The poses that `diagnose --plan` proposes, measured by the simulator, against random ones."""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from draw import World
from score import Record, shortened
from visits import MINUTES_PER_VISIT, draw_poses, draw_visits
from worker import Worker
from world import Visits
from world_files import write_table

from elastocal.measurements import read_plan

ANSWER = "diagnosis.json"


def with_extra_poses(world: World, visible: Path, plan: str, worker: Worker) -> dict[str, Any]:
    """Answers with the planned poses, and with as many random ones."""
    planned = read_visits(world, visible / plan)
    n = len(np.unique(planned.q, axis=0))
    rng = np.random.default_rng((*world.seed, 3))
    campaigns = {"planned": planned, "random": random_visits(world, n, rng)}
    return {"n_poses": n} | {
        name: _diagnosed(world, visits, visible, worker, rng) for name, visits in campaigns.items()
    }


def read_visits(world: World, path: Path) -> Visits:
    """The visits that a plan asks for, after the campaign unless it states when."""
    table = read_plan(path, joint_kinds=("revolute",) * world.spec.skeleton.n_joints)
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
    world: World, extra: Visits, visible: Path, worker: Worker, rng: np.random.Generator
) -> Record | None:
    """The answer to the campaign's own readings and the extra ones in one table, no pose shared."""
    own = vars(world.visits)
    later = vars(replace(extra, pose=own["pose"].max() + 1 + extra.pose))
    both = Visits(**{key: np.concatenate([own[key], later[key]]) for key in own})
    readings = np.concatenate([world.readings(), world.measure(extra, rng)])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file in ("arm.urdf", "cell.toml"):
            shutil.copyfile(visible / file, folder / file)
        write_table(world, both, readings, folder / "data.csv")
        if worker.diagnose(folder, "-o", ANSWER).exit != 0:
            return None
        return shortened(json.loads((folder / ANSWER).read_text(encoding="utf-8")))
