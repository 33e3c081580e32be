"""elastocal study: a scripted study, on the local cores or on a Dask cluster."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal.cli.app import app, reporting_errors
from elastocal.errors import require

if TYPE_CHECKING:
    from collections.abc import Callable

    from elastocal.studies.conduct import Ending, Runner, Study
    from elastocal.studies.stopping import Stop


@app.command(short_help="What happens in a thousand simulated campaigns?")
@reporting_errors
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
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed; default: that of study.toml.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Option of the study; repeatable."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Folder of the results; default: FOLDER/results."),
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
    """Run a study's tasks that have no result yet; Ctrl-C stops, the same command goes on.

    Example: elastocal study experiment_design/coverage --jobs 4
    """
    require(cluster is None or jobs is None, "--jobs is for this machine; leave it with --cluster")
    from elastocal.cli.study_progress import StudyProgress
    from elastocal.studies.conduct import conduct, prepare, summarise
    from elastocal.studies.dataset import opened
    from elastocal.studies.stopping import Stop
    from elastocal.studies.table import arrow

    arrow()
    prepared = prepare(folder, seed, set_ or ())
    results = folder / "results" if output is None else output
    # Beside the results, not among them: their folder is a dataset that others read whole.
    page = folder / "result.md" if output is None else output.with_name(f"{output.name}.md")
    with opened(results) as dataset:
        if restart:
            dataset.clear()
        with Stop() as stop, StudyProgress(progress and not quiet) as shown:
            runner = _runner(prepared, jobs, cluster, stop, shown.tell)
            ending = conduct(prepared, dataset, runner, stop, shown, only, retry_failed)
        typer.echo(_told(ending, results))
        if ending.stopped and not ending.complete:
            raise typer.Exit(130)
        if ending.failed:
            raise typer.Exit(1)
        if ending.done == len(prepared.jobs):
            text = summarise(prepared, dataset, page)
            if text is not None:
                typer.echo(f"\n{text}")


def _runner(
    prepared: Study,
    jobs: int | None,
    cluster: str | None,
    stop: Stop,
    tell: Callable[[str], None],
) -> Runner:
    package, digest = prepared.package, prepared.digest
    if cluster is not None:
        from elastocal.studies.cluster import run_at
        from elastocal.studies.cluster_client import dask_distributed

        dask_distributed()
        return lambda left: run_at(cluster, package, digest, left, stop, tell)
    import joblib

    from elastocal.studies.local import run_local

    workers = jobs or joblib.cpu_count()
    return lambda left: run_local(package, digest, left, workers, stop)


def _told(ending: Ending, results: Path) -> str:
    text = f"{ending.done} of {ending.total} tasks done"
    if ending.before:
        text += f" ({ending.before} were there)"
    if ending.failed:
        text += f", {ending.failed} failed"
    text += f"; results in {results}"
    if ending.failed:
        from elastocal.studies.dataset import read_results

        first = read_results(results, failed=True).iloc[0]
        text += (
            f"\nfirst failure: task {first['task']}: {first['task_error']}\n"
            f"tracebacks in {results / '_failures.log'}; --retry-failed runs such tasks again"
        )
    if ending.stopped and not ending.complete:
        text += "\nstopped; the same command goes on with the rest"
    return text
