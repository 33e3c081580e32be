"""Tasks on the cores of this machine, by joblib."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from elastocal.studies.execution import Outcome, execute
from elastocal.studies.job import Job
from elastocal.studies.package import Package
from elastocal.studies.stopping import Stop, ignore_interrupts

TRIES = 3


def run_local(
    package: Package, digest: str, jobs: Sequence[Job], workers: int, stop: Stop
) -> Generator[Outcome, None, None]:
    """Outcomes as they come, none twice; no new task begins once `stop` is asked for.

    With one worker the tasks run in this process.  Where a worker process dies, the tasks that
    were out are tried again, each alone so that it is known which one kills; one that does so
    three times is an outcome with an error.
    """
    left = {job.index: job for job in jobs}
    deaths: Counter[int] = Counter()
    while left and not stop.asked:
        group = [job for job in left.values() if not deaths[job.index]]
        alone = not group
        group = group or [next(iter(left.values()))]
        out: list[int] = []
        # joblib runs a single worker in this process, which a suspect must not kill.
        processes = max(2, workers) if alone else workers
        try:
            for outcome in _parallel(package, digest, group, processes, stop, out):
                del left[outcome.index]
                yield outcome
        except BrokenProcessPool as error:
            for index in [i for i in out if i in left]:
                deaths[index] += 1
                if deaths[index] == TRIES:
                    del left[index]
                    yield killed(index, f"{TRIES} times", str(error))


def killed(index: int, times: str, trace: str) -> Outcome:
    """The outcome of a task whose worker process died each time."""
    line = f"its worker process died {times} (out of memory, killed, or crashed in a library)"
    return Outcome(index, error=line, trace=f"{line}\n{trace}\n")


def _parallel(
    package: Package, digest: str, jobs: Sequence[Job], workers: int, stop: Stop, out: list[int]
) -> Generator[Outcome, None, None]:
    """One joblib run; `out` gets the indices as they are handed out."""
    from joblib import Parallel, delayed

    def handed_out() -> Iterator[Any]:
        for job in jobs:
            if stop.asked:
                return
            out.append(job.index)
            yield delayed(execute)(package, digest, job)

    options: dict[str, Any] = {"initializer": ignore_interrupts} if workers > 1 else {}
    # One task a batch and none in reserve: what is handed out is what is waited for on Ctrl-C.
    parallel = Parallel(
        workers, return_as="generator_unordered", batch_size=1, pre_dispatch="n_jobs", **options
    )
    outcomes = parallel(handed_out())
    try:
        yield from outcomes
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the generator is closed early is meant
            outcomes.close()
