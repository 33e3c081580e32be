"""Small studies to run, and runners that end early or in another order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pandas as pd

from elastocal.studies import Ending, Study, StudyStop, execute, read_results, read_study
from elastocal.studies import on_processes as processes
from elastocal.studies import run_study as run_prepared

SCRIPT = """\
def tasks(options):
    return [{"n": n, "label": "few" if n < 9 else "many", "replicate": k}
            for n in (4, 16) for k in range(options["replicates"])]


def run(task, rng):
    x = rng.normal(size=task["n"])
    return [{"mean": x.mean(), "inside": abs(x.mean()) < 1, "above": int((x > 0).sum())},
            {"mean": x.max(), "inside": False}]
"""
TOML = """\
seed = 11
[options]
replicates = 6
scale = 1.0
[columns]
mean = "mm"
inside = "yes/no"
above = "count"
"""
NUMBERS = ["task", "task_hash", "n", "label", "replicate", "task_row", "mean", "inside", "above"]


def write_study(folder: Path, script: str = SCRIPT, toml: str = TOML) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "study.py").write_text(script, encoding="utf-8")
    (folder / "study.toml").write_text(toml, encoding="utf-8")
    return folder


def here(study: Study, order: Callable[[list[Any]], list[Any]] = list, stop_after: int = 10**9):
    """A runner in this process that takes the tasks in `order` and ends after so many."""

    def runner(jobs) -> Iterator[Any]:
        for job in order(list(jobs))[:stop_after]:
            yield execute(study.sources, job)

    return runner


def on_processes(study: Study, workers: int, stop: StudyStop | None = None):
    return lambda tasks: processes(study, tasks, stop or StudyStop(), workers)


def run_study(folder: Path, results: Path, runner=None, seed: Any = None, **how: Any) -> Ending:
    """The study in `folder` run into `results` by `runner(study)`, by default in this process."""
    study = read_study(folder, seed)
    made = (runner or here)(study)
    with patch("elastocal.studies.on_processes", lambda study, tasks, *_: made(tasks)):
        return run_prepared(study, results, **how)


def numbers(results: Path) -> pd.DataFrame:
    """What must not depend on who computed it, and when."""
    return read_results(results)[NUMBERS]
