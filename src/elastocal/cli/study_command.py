"""elastocal study: a scripted study, on the local cores or on a Dask cluster."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal.cli.signatures import AnyOutput, command
from elastocal.errors import InsufficientDataError, require
from elastocal.screen import progress_line, say

if TYPE_CHECKING:
    from elastocal.studies.run import Ending

EVERY = 10.0  # s between plain lines of progress


@command(short_help="Run many simulations on all cores or a cluster")
def study(
    folder: Path,
    jobs: Annotated[int | None, typer.Option(min=1)] = None,
    cluster: str | None = None,
    tls_ca: Path | None = None,
    tls_cert: Path | None = None,
    tls_key: Path | None = None,
    unencrypted: bool = False,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    set_: list[str] | None = None,
    output: AnyOutput = None,
    progress: Annotated[bool, typer.Option("--progress", show_default=False)] = True,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", "--no-progress")] = False,
    only: Annotated[int | None, typer.Option(min=1)] = None,
    restart: bool = False,
    retry_failed: bool = False,
) -> None:
    """Run a study's tasks that have no result yet; after Ctrl-C the same command resumes.

    study.py in the folder is Python code and runs with your rights, here and on a cluster: run
    only folders that you trust.

    Example: elastocal study experiment_design/coverage --jobs 4

    Args:
        folder: Folder with study.py and study.toml.
        jobs: Processes on this machine; default: one per core.
        cluster (ADDRESS): Dask scheduler, as in tcp://HOST:8786, or 'config' for Dask's own.
        tls_ca: Certificate authority (PEM) of a tls:// scheduler.
        tls_cert: This client's certificate (PEM) for it.
        tls_key: The key of that (PEM).
        unencrypted: Reach another host without TLS.
        seed: Seed; default: that of study.toml.
        set_ (KEY=VALUE): Option of the study; repeatable.
        output: Folder of the results, with the summary in OUTPUT.md; default: FOLDER/results
            and FOLDER/result.md.
        progress: Rate and time left: the default.
        quiet: No progress.
        only: Run the first N tasks alone.
        restart: Discard the results that are there.
        retry_failed: Run tasks that failed again.
    """
    require(cluster is None or jobs is None, "--jobs is for this machine; leave it with --cluster")
    from elastocal.studies.results import check_page
    from elastocal.studies.run import StudyStop, run_study, summarise
    from elastocal.studies.study import read_study

    results = folder / "results" if output is None else output
    page = folder / "result.md"
    if output is not None:
        page = Path(f"{output if output.name else output.resolve()}.md")
        check_page(results, page)
    prepared = read_study(folder, seed, set_ or ())
    with StudyStop() as stop, progress_line(quiet or not progress, EVERY) as tell:
        ending = run_study(
            prepared, results, jobs=jobs, cluster=cluster, only=only, restart=restart,
            retry_failed=retry_failed, stop=stop, progress=Pace(tell).show,
            tell=lambda text: say(f"… {text}", error=True),
            tls_ca=tls_ca, tls_cert=tls_cert, tls_key=tls_key, unencrypted=unencrypted,
        )  # fmt: skip
    say(_told(ending, results))
    if ending.stopped and not ending.complete:
        raise typer.Exit(130)
    if ending.failed:
        raise InsufficientDataError(
            f"{results}: {ending.failed} of {ending.total} tasks failed; see _failures.log there"
        )
    if ending.done == len(prepared.tasks):
        text = summarise(prepared, results, page)
        if text is not None:
            say(f"\n{text}")


def _told(ending: Ending, results: Path) -> str:
    text = f"{ending.done} of {ending.total} tasks done"
    if ending.before:
        text += f" ({ending.before} were there)"
    if ending.failed:
        text += f", {ending.failed} failed"
    text += f"; results in {results}"
    if ending.failed:
        from elastocal.studies.results import read_results

        first = read_results(results, failed=True).iloc[0]
        text += (
            f"\nfirst failure: task {first['task']}: {first['task_error']}\n"
            f"tracebacks in {results / '_failures.log'}; --retry-failed runs such tasks again"
        )
    if ending.stopped and not ending.complete:
        text += "\nstopped; the same command goes on with the rest"
    return text


class Pace:
    """Says how far a study is: done of total, rate per minute of this run, time left, failures."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell, self._begun, self._before = tell, time.monotonic(), -1

    def show(self, total: int, ended: int, failed: int) -> None:
        """`ended` of `total` tasks, failures among them, are there; the first call begins."""
        if self._before < 0:
            self._begun, self._before = time.monotonic(), ended
        text = f"{ended} of {total} tasks"
        if ended > self._before:
            rate = (ended - self._before) / max(time.monotonic() - self._begun, 1e-3)
            left = timedelta(seconds=round((total - ended) / rate))
            text += f", {60 * rate:.{0 if rate > 1 else 1}f} per minute, {left} left"
        self._tell(text + (f", {failed} failed" if failed else ""))
