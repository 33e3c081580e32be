"""Tasks of a study, made ready to be handed out: index, values, seed, hash."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from elastocal.errors import InputError, require
from elastocal.studies.definition import Definition
from elastocal.studies.package import calling
from elastocal.text import quoted

RESERVED = ("task", "task_hash", "task_row", "task_seconds", "elastocal", "task_error")


@dataclass(frozen=True)
class Job:
    """One task: its place in the study, its values as JSON text, and what makes it the same."""

    index: int
    text: str
    seed: int
    hash: str

    @property
    def task(self) -> dict[str, Any]:
        """The values, a copy of their own at each call."""
        values: dict[str, Any] = json.loads(self.text)
        return values

    def rng(self) -> np.random.Generator:
        """Child `index` of SeedSequence(seed): the same as .spawn(n)[index], for every n.

        So the numbers depend on the seed and on the task's place, not on who computes it, when,
        or how many tasks there are.
        """
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(self.index,)))


def make_jobs(definition: Definition, module: ModuleType, digest: str, seed: int) -> list[Job]:
    """The study's tasks in their order.

    Raises InputError where tasks() or run() is absent, tasks() raises or gives none, or a task
    is no dict of plain JSON values.
    """
    script = definition.script
    for name in ("tasks", "run"):
        require(
            callable(getattr(module, name, None)),
            f"{script}: defines no function {name}(); a study has tasks(options) "
            "and run(task, rng)",
        )
    folder = definition.folder.resolve()
    tasks = calling(folder, "tasks()", lambda: list(module.tasks(dict(definition.options))))
    require(bool(tasks), f"{script}: tasks() gives no task with these options; nothing to do")
    return [_job(f"{script}, task {i}", i, task, seed, digest) for i, task in enumerate(tasks)]


def _job(where: str, index: int, task: Any, seed: int, digest: str) -> Job:
    if not isinstance(task, Mapping):
        raise InputError(f"{where}: is a {type(task).__name__}; tasks() gives a dict for each task")
    for key in task:
        require(
            isinstance(key, str) and key not in RESERVED,
            f"{where}: {quoted(key)} cannot be a key; keys are text, and {', '.join(RESERVED)} "
            "are columns of every study",
        )
    try:
        text = json.dumps(dict(task), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{where}: {error}; use plain JSON values (numbers, text, true/false, lists, dicts)"
        ) from None
    ordered = json.dumps(json.loads(text), sort_keys=True)
    digested = hashlib.sha256(f"{digest}\n{seed}\n{index}\n{ordered}".encode()).hexdigest()
    return Job(index, text, seed, digested)
