"""A suite of worlds in parallel, resumed where it was stopped."""

from __future__ import annotations

import subprocess
from pathlib import Path

import records
from joblib import Parallel, delayed
from one_world import in_own_worker
from rich.progress import Progress
from suites import tasks

HERE = Path(__file__).resolve().parent


def run_suite(suite: str, seed: int, per_effect: int, jobs: int, out: Path, bar: Progress) -> None:
    """Every world of the suite that is not done yet."""
    before = records.read(out, suite)
    if any(record["seed"] != seed for record in before):
        raise SystemExit(f"{out} holds worlds of another seed; name another folder with --out")
    done = {record["world"] for record in before}
    every = list(tasks(suite, seed, per_effect))
    open_ = [task for task in every if task.recipe.name not in done]
    line = bar.add_task(suite, total=len(every), completed=len(every) - len(open_))
    origin = {"seed": seed, "commit": state_of_the_code()}
    found = Parallel(jobs, return_as="generator_unordered", batch_size=1)(
        delayed(in_own_worker)(task, origin) for task in open_
    )
    for record in found:
        records.append(out, record)
        bar.advance(line)


def state_of_the_code() -> str:
    """The commit, with a + where files differ from it."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=HERE, capture_output=True, text=True)
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--", ".", "../../src")
    return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
