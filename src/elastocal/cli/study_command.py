"""elastocal study: a scripted study, on the local cores or on a Dask cluster."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from elastocal.cli.app import console
from elastocal.cli.signatures import command
from elastocal.errors import InsufficientDataError, require
from elastocal.screen import say

if TYPE_CHECKING:
    from elastocal.studies.study_run import Ending

EVERY = 10.0  # s between plain lines of progress


@command(short_help="Run many simulations on all cores or a cluster")
def study(
    folder: Annotated[Path, typer.Argument(help="Folder with study.py and study.toml.")],
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="Processes on this machine; default: one per core."),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Dask scheduler, as in tcp://HOST:8786, or 'config' for Dask's own.",
        ),
    ] = None,
    tls_ca: Annotated[
        Path | None, typer.Option(help="Certificate authority (PEM) of a tls:// scheduler.")
    ] = None,
    tls_cert: Annotated[
        Path | None, typer.Option(help="This client's certificate (PEM) for it.")
    ] = None,
    tls_key: Annotated[Path | None, typer.Option(help="The key of that (PEM).")] = None,
    unencrypted: Annotated[
        bool, typer.Option("--unencrypted", help="Reach another host without TLS.")
    ] = False,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed; default: that of study.toml.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Option of the study; repeatable."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Folder of the results, with the summary in OUTPUT.md; default: FOLDER/results "
            "and FOLDER/result.md.",
        ),
    ] = None,
    progress: Annotated[
        bool,
        typer.Option("--progress", show_default=False, help="Rate and time left: the default."),
    ] = True,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", "--no-progress", help="No progress.")
    ] = False,
    only: Annotated[int | None, typer.Option(min=1, help="Run the first N tasks alone.")] = None,
    restart: Annotated[
        bool, typer.Option("--restart", help="Discard the results that are there.")
    ] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Run tasks that failed again.")
    ] = False,
) -> None:
    """Run a study's tasks that have no result yet; after Ctrl-C the same command resumes.

    study.py in the folder is Python code and runs with your rights, here and on a cluster: run
    only folders that you trust.

    Example: elastocal study experiment_design/coverage --jobs 4
    """
    require(cluster is None or jobs is None, "--jobs is for this machine; leave it with --cluster")
    from elastocal.studies.study_folder import read_study
    from elastocal.studies.study_results import StudyResults
    from elastocal.studies.study_run import StudyStop, run_study, summarise

    results = folder / "results" if output is None else output
    page = folder / "result.md"
    if output is not None:
        page = Path(f"{output if output.name else output.resolve()}.md")
        StudyResults(results).check_page(page)
    prepared = read_study(folder, seed, set_ or ())
    with StudyStop() as stop, StudyProgress(progress and not quiet) as shown:
        ending = run_study(
            prepared, results, jobs=jobs, cluster=cluster, only=only, restart=restart,
            retry_failed=retry_failed, stop=stop, progress=shown.show, tell=shown.tell,
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
        from elastocal.studies.study_results import read_results

        first = read_results(results, failed=True).iloc[0]
        text += (
            f"\nfirst failure: task {first['task']}: {first['task_error']}\n"
            f"tracebacks in {results / '_failures.log'}; --retry-failed runs such tasks again"
        )
    if ending.stopped and not ending.complete:
        text += "\nstopped; the same command goes on with the rest"
    return text


class StudyProgress:
    """Done of total, rate per minute of this run, time left, failures; on stderr.

    Use it in `with`; silent where `shown` is false.
    """

    def __init__(self, shown: bool) -> None:
        self._shown, self._screen = shown, console(stderr=True)
        self._total = self._ended = self._failed = self._before = 0
        self._begun = self._told = time.monotonic()
        self._bar: Any = None
        self._context: AbstractContextManager[Any] = nullcontext()

    def __enter__(self) -> Self:
        if self._shown and self._screen.is_terminal:
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (BarColumn(), TextColumn("{task.description}"))
            self._bar = Progress(*columns, console=self._screen)
            self._context = self._bar
        self._context.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._context.__exit__(*error)

    def show(self, total: int, ended: int, failed: int) -> None:
        """`ended` of `total` tasks, failures among them, are there; the first call begins."""
        now = time.monotonic()
        first = self._total == 0
        if first:
            self._before, self._begun, self._told = ended, now, now
        self._total, self._ended, self._failed = total, ended, failed
        if self._bar is not None and first:
            self._bar.add_task(self._line(), total=total, completed=ended)
        elif self._bar is not None:
            only = self._bar.task_ids[0]
            self._bar.update(only, completed=ended, description=self._line())
        elif self._shown and (first or now - self._told > EVERY or ended == total):
            self._told = now
            self._screen.print(f"… {self._line()}")

    def tell(self, message: str) -> None:
        """A message beside the bar, also where no progress is shown."""
        self._screen.print(f"… {message}")

    def _line(self) -> str:
        text = f"{self._ended}/{self._total} tasks"
        if self._ended > self._before:
            rate = (self._ended - self._before) / max(time.monotonic() - self._begun, 1e-3)
            left = round((self._total - self._ended) / rate)
            hours, rest = divmod(left, 3600)
            clock = f"{hours}:{rest // 60:02d}:{rest % 60:02d}"
            text += f", {60 * rate:.{0 if rate > 1 else 1}f} per minute, {clock} left"
        return text + (f", {self._failed} failed" if self._failed else "")
