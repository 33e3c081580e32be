"""A study from its folder to its dataset: what is done already, what is left, how it ended."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Protocol

import elastocal
from elastocal import __version__
from elastocal.errors import InputError
from elastocal.studies.dataset import Dataset, read_results
from elastocal.studies.definition import Definition, read_definition
from elastocal.studies.execution import Outcome
from elastocal.studies.job import Job, make_jobs
from elastocal.studies.package import Package, calling, load, pack
from elastocal.studies.recorder import SOONEST, Recorder
from elastocal.studies.stopping import Stop
from elastocal.studies.table import Table
from elastocal.text import quoted

Runner = Callable[[Sequence[Job]], Generator[Outcome, None, None]]


class Watcher(Protocol):
    """Who is told how far a study is."""

    def begin(self, total: int, done: int, failed: int) -> None: ...

    def advance(self, failed: bool) -> None: ...


@dataclass(frozen=True)
class Study:
    """A study ready to run: its definition with seed and options settled, its tasks in order."""

    definition: Definition
    package: Package
    digest: str
    module: ModuleType
    jobs: tuple[Job, ...]


@dataclass(frozen=True)
class Ending:
    """Of `total` tasks (those asked for), `done` have a result and `failed` an error."""

    total: int
    before: int
    done: int
    failed: int
    stopped: bool

    @property
    def complete(self) -> bool:
        return self.done + self.failed == self.total


def prepare(folder: str | Path, seed: int | None = None, options: Sequence[str] = ()) -> Study:
    """The study in `folder`, with another seed and other options where given.

    Raises InputError where the folder, study.toml, study.py, an option or a task is wrong.
    """
    definition = read_definition(folder).with_options(options)
    if seed is not None:
        definition = replace(definition, seed=seed)
    package = pack(definition)
    digest = package.digest
    module = load(package, digest)
    jobs = tuple(make_jobs(definition, module, digest, definition.seed))
    return Study(definition, package, digest, module, jobs)


def conduct(
    study: Study,
    dataset: Dataset,
    runner: Runner,
    stop: Stop,
    watcher: Watcher,
    only: int | None = None,
    retry_failed: bool = False,
    soonest: float = SOONEST,
) -> Ending:
    """Run the tasks that have no result yet (of the first `only`) and record what comes.

    However the run ends, what was done by then is written.  Raises InputError where the dataset
    holds results of another seed, source or task.
    """
    version = source_version()
    table = Table(study.jobs, study.package.columns, version)
    failures = check_same(study, dataset, table)
    if retry_failed and any(failures.values()):
        dataset.drop_failed()
        failures = {index: False for index, failed in failures.items() if not failed}
    dataset.state(
        {
            "schema": "elastocal/study/1",
            "title": study.definition.title,
            "seed": study.definition.seed,
            "options": dict(study.definition.options),
            "tasks": len(study.jobs),
            "columns": dict(study.package.columns),
            "sources": study.package.digests,
            "elastocal": version,
        }
    )
    wanted = study.jobs[:only]
    left = [job for job in wanted if job.index not in failures]
    failed = sum(failures.get(job.index, False) for job in wanted)
    before = len(wanted) - len(left)
    watcher.begin(len(wanted), before, failed)
    done = before - failed
    try:
        with Recorder(dataset, table, soonest) as recorder, closing(runner(left)) as outcomes:
            for outcome in outcomes:
                stop.check()
                recorder.add(outcome)
                failed += outcome.error is not None
                done += outcome.error is None
                watcher.advance(outcome.error is not None)
    except KeyboardInterrupt:
        if not stop.asked:
            raise
    return Ending(len(wanted), before, done, failed, stop.asked)


def check_same(study: Study, dataset: Dataset, table: Table) -> dict[int, bool]:
    """Whether it failed, by index of each task that the dataset holds.

    Raises InputError where a task there is not the study's task of that index now.
    """
    whole = dataset.read(table.schema)
    if whole is None:
        return {}
    lines = zip(
        whole["task"].to_pylist(), whole["task_hash"].to_pylist(), whole["task_error"].to_pylist(),
        strict=True,
    )  # fmt: skip
    known = {index: (hash_, error is not None) for index, hash_, error in lines}
    for index, (hash_, _) in sorted(known.items()):
        if index < len(study.jobs) and study.jobs[index].hash != hash_:
            raise InputError(
                f"{dataset.folder}: holds results of another study: "
                f"{'; '.join(_changes(study, dataset)) or f'task {index} was another one'}. "
                "Run with --restart to discard them, or with -o NEW to keep them"
            )
    return {index: failed for index, (_, failed) in known.items() if index < len(study.jobs)}


def _changes(study: Study, dataset: Dataset) -> list[str]:
    """What differs from the study that the results are of, in words."""
    before = dataset.stated()
    now, told = study.definition, []
    sources, digests = before.get("sources", {}), study.package.digests
    changed = [n for n in sorted({*sources, *digests}) if sources.get(n) != digests.get(n)]
    if sources and changed:
        told.append(f"{', '.join(changed)} changed since")
    if before.get("seed", now.seed) != now.seed:
        told.append(f"the seed was {before['seed']}, now it is {now.seed}")
    options = before.get("options", {})
    for name, value in now.options.items():
        if name in options and options[name] != value:
            told.append(f"option {name} was {quoted(options[name])}, now it is {quoted(value)}")
    return told


def summarise(study: Study, dataset: Dataset, result: Path) -> str | None:
    """What summary(frame) of study.py says, also written to `result`; None where there is none.

    `frame` has the rows of the study's tasks in their order.  Raises InputError with file and
    line where summary() raises or gives no text.
    """
    from elastocal.files import atomic_write_text

    summary = getattr(study.module, "summary", None)
    if summary is None:
        return None
    frame = read_results(dataset.folder)
    frame = frame[frame["task"] < len(study.jobs)]
    folder = study.definition.folder.resolve()
    text = calling(folder, "summary()", lambda: summary(frame))
    if not isinstance(text, str):
        raise InputError(
            f"{study.definition.script}: summary() returned {type(text).__name__}; it returns text"
        )
    atomic_write_text(result, text.rstrip("\n") + "\n")
    return text


def source_version() -> str:
    """Version of elastocal, with the commit where it stands in a git checkout: 0.1.0+gabc1234."""
    here = Path(elastocal.__file__).parent
    try:
        command = ["git", "-C", str(here), "describe", "--always", "--dirty", "--exclude=*"]
        told = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
        tracked = ["git", "-C", str(here), "ls-files", "--error-unmatch", "__init__.py"]
        subprocess.run(tracked, capture_output=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return __version__
    return f"{__version__}+g{told.stdout.strip()}"
