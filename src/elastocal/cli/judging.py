"""Verbs that judge measurements: identify, diagnose, next, compare."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal import verbs
from elastocal.cli.app import repeated
from elastocal.cli.signatures import (
    FORCE,
    PAGES,
    Asked,
    CellFile,
    DataFile,
    JsonFile,
    Output,
    ReportFile,
    Run,
    Seed,
    command,
)
from elastocal.errors import InputError, NotAcceptedError, option, require
from elastocal.screen import complain, say
from elastocal.text import listed

if TYPE_CHECKING:
    from elastocal.diagnosis.diagnosis import Diagnosis
    from elastocal.identification.result import Calibration
    from elastocal.report.identification_view import Published, Truth


@command(
    verb=verbs.identify,
    offers="test method noise weights intervals covariance fixed bounded knowledge physical "
    "outliers jobs seed",
)
def identify(
    cell: CellFile,
    data: DataFile,
    output: JsonFile = None,
    report: ReportFile = None,
    certificate: Path | None = None,
    residuals: Path | None = None,
    require: list[str] | None = None,
    *,
    asked: Asked,
    details: bool = False,
    run: Run,
) -> None:
    """What are the parameters of my arm, and how certain are they?

    Example: elastocal identify cell.toml data.csv -o result.json --test other.csv

    Args:
        certificate: Write a calibration certificate (.html, or .xml: a DCC).
        residuals: Write residuals of every reading as CSV.
        require (NAME=UM): Largest error in µm that is accepted: heldout=, new_poses=, test=;
            repeatable, else as [require] of the cell says. Exit code 3 where one is exceeded.
        details: Also method, noise, residuals, intervals, all lists.
    """
    from elastocal.model.effects.catalogue import cell_of
    from elastocal.report.blocks import print_report

    run.writes(
        (output, ".json"), (report, PAGES), (residuals, ".csv"), (certificate, f"{PAGES} .xml")
    )
    limits = limits_of(require or [])
    known = cell_of(cell, run.plugins)  # its plug-ins may have the noise model
    files = (asked.get(name) for name in ("test", "covariance", "knowledge"))
    inputs = run.reads(cell, data, *files, cell=known)
    with run.progress() as progress:
        result = verbs.identify(known, data, **asked, progress=progress)
        write_results(
            result, output, report, residuals, inputs, asked["seed"], certificate=certificate
        )
    run.answer(result.to_json, lambda screen: print_report(screen, result, details))
    if unmet := result.unmet(**limits):
        raise NotAcceptedError(f"not accepted: {'; '.join(unmet)}")


def limits_of(stated: list[str], names: tuple[str, ...] = ()) -> dict[str, float | None]:
    """NAME=UM as limits in m, NAME one of `names`, by default of all."""
    from elastocal.cell.work_cell import Acceptance

    names = names or tuple(vars(Acceptance()))
    limits: dict[str, float | None] = {}
    for text in stated:
        name, _, number = text.partition("=")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if name not in names or not 0 < value < math.inf:
            raise InputError(
                f"{option('require')} takes NAME=UM, NAME one of {listed(names)} and UM a positive "
                f"number in µm; found '{text}'"
            )
        limits[name] = value * 1e-6
    return limits


def write_results(
    result: Calibration, output: Path | None, report: Path | None, residuals: Path | None,
    inputs: list[Path], seed: int, truth: Truth | None = None, published: Published | None = None,
    certificate: Path | None = None,
) -> None:  # fmt: skip
    """Write what was asked for, all of it or nothing.

    `inputs` are named with their hashes in the report, where `truth` and `published` (SI) stand
    beside the estimates.
    """
    from elastocal.files import together
    from elastocal.report.page import write_page
    from elastocal.saving import save_residuals, write_json

    with together(p for p in (output, residuals, report, certificate) if p is not None):
        if output is not None:
            write_json(output, result.to_json())
        if residuals is not None:
            save_residuals(result, residuals)
        if report is not None:
            write_page(result, report, inputs, repeated(), seed, truth=truth, published=published)
        if certificate is not None:
            write_page(result, certificate, inputs, repeated(), seed, certificate=True)


# diagnose: why the real arm still differs from the model.

MOST_POSES = 10


@command(verb=verbs.diagnose, offers="without seed")
def diagnose(
    cell: CellFile,
    data: DataFile,
    output: JsonFile = None,
    report: ReportFile = None,
    plan: Path | None = None,
    poses: Annotated[int | None, typer.Option(min=1)] = None,
    cell_out: Path | None = None,
    *,
    asked: Asked,
    run: Run,
) -> None:
    """Why does the real arm still differ from the model?

    Finds the unmodelled effect that explains the remaining error, its place, and how far the
    error at new poses falls once it is added.

    Example: elastocal diagnose cell.toml data.csv -o diagnosis.json --report diagnosis.html

    Args:
        plan: Write extra poses (CSV) that separate the remaining hypotheses.
        poses: Most extra poses of --plan; default: 10.
        cell_out: Write the cell (TOML) with the effects found added.
    """
    from elastocal.diagnosis.diagnosis import publish
    from elastocal.files import together
    from elastocal.model.effects.catalogue import cell_of
    from elastocal.report.blocks import print_report
    from elastocal.report.page import write_page
    from elastocal.saving import save_diagnosis

    require(
        poses is None or plan is not None,
        f"--poses {poses} has no meaning without --plan; name the file for the extra poses",
    )
    run.writes((output, ".json"), (report, PAGES), (plan, ".csv"), (cell_out, ".toml"))
    known = cell_of(cell, run.plugins)  # its plug-ins may have the effect
    run.reads(cell, data, cell=known)
    most = None if plan is None else poses or MOST_POSES
    with run.progress() as progress:
        found = verbs.diagnose(known, data, **asked, extra_poses=most, progress=progress)
        model = found.model
        assert model is not None  # `diagnose` states it
        told = []
        with together(run.written):
            if output is not None:
                save_diagnosis(found, output)
                told.append(f"wrote {output}")
            if report is not None:
                write_page(found, report, [cell, data], repeated(), asked["seed"])
                told.append(f"wrote {report}")
            if plan is not None:
                told.append(_write_extra_poses(plan, found, model.chain.kinds))
            if cell_out is not None:
                told += _write_extended(cell_out, found, data, run.plugins)
    if run.answer(
        lambda: publish(found, model, found.data),
        lambda screen: print_report(screen, found),
        files=False,
    ):
        for line in told:
            say(line)


def _write_extended(path: Path, found: Diagnosis, data: Path, plugins: bool) -> Iterator[str]:
    """Write the cell with the effects found, and say so and what to do with it."""
    from elastocal.model.manipulator import where_smooth_functions_end
    from elastocal.report.diagnosis_view import added_text
    from elastocal.saving import save_found_cell

    extended = save_found_cell(found, path)
    added = added_text((*found.effects, *found.slight, *found.fields))
    yield f"wrote {path} with {added or 'no further effect'}"
    if ends := where_smooth_functions_end(extended):
        yield (
            f"its smooth functions end outside the measured range: {ends}; there the model "
            "without them holds"
        )
    if added:
        words = ["elastocal", "identify", str(path), str(data)] + ["--plugins"] * plugins
        yield f"to go on: {shlex.join(words)} -o result.json"


def _write_extra_poses(path: Path, found: Diagnosis, kinds: Sequence[str]) -> str:
    """Write the extra poses, and say so; or why there are none to write."""
    from elastocal.saving import save_extra_poses

    extra = found.extra
    if extra is None and found.groups:
        return f"{path} not written: few extra poses do not separate many causes"
    if extra is None:
        return f"{path} not written: there are no rivals to separate"
    if extra.plan is None:
        return f"{path} not written: no pose separates the rivals"
    save_extra_poses(path, extra.plan, kinds)
    return f"wrote {path}: {extra.n_poses} poses, {len(extra.plan)} visits"


# next: which poses to measure next, or that no more are needed.


@command("next")
def next_command(
    cell: CellFile,
    data: DataFile,
    output: Output,
    batch: Annotated[int, typer.Option(min=1)] = 5,
    required: Annotated[str | None, typer.Option("--require")] = None,
    least_gain: Annotated[float, typer.Option(min=0, max=99)] = 1.0,
    candidates: Annotated[int, typer.Option(min=1)] = 400,
    jobs: int = 1,
    seed: Seed = 0,
    *,
    run: Run,
) -> None:
    """Which poses should I measure next, or are these enough?

    Diagnoses and identifies the measurements so far, and writes the next poses (CSV and
    plan.json); none if the required error is kept, or no batch gains enough.

    Example: elastocal next cell.toml data.csv -o next.csv --batch 5 --require new_poses=50

    Args:
        output: The poses to write (CSV); .json beside it.
        batch: Number of poses.
        required (new_poses=UM): Error in µm at new poses that is enough where it is kept with
            95 %; default as [require] of the cell says.
        least_gain (%): A batch pays that lowers the error so far.
        candidates: Feasible candidates to choose from.
        jobs: Processes; -1 for all cores.
    """
    from elastocal.diagnosis.next_poses import next_poses
    from elastocal.files import together
    from elastocal.model.effects.catalogue import cell_of
    from elastocal.report.blocks import print_report
    from elastocal.saving import beside, save_plan

    summary = beside(output)
    run.writes((output, ".csv"), (summary, ".json"))
    limits = limits_of([] if required is None else [required], ("new_poses",))
    known = cell_of(cell, run.plugins)
    run.reads(cell, data, cell=known)
    with run.progress() as progress:
        found = next_poses(
            known, data, batch=batch, require=limits.get("new_poses"),
            least_gain=least_gain / 100, candidates=candidates, seed=seed, jobs=jobs,
            progress=progress,
        )  # fmt: skip
        if found.plan is not None:
            with together(run.written):
                save_plan(found.plan, output, repeated())
    show = partial(print_report, result=found)
    if run.answer(found.to_json, show, files=found.plan is not None) and found.plan is None:
        say(f"{output} not written")


# compare: what has changed since the last calibration.


@command(short_help="What has changed since the last calibration?")
def compare(
    cell: Path,
    old: Path,
    new: Annotated[Path | None, typer.Argument()] = None,
    cell_of_old: Annotated[Path | None, typer.Option("--cell", hidden=True)] = None,
    output: JsonFile = None,
    report: ReportFile = None,
    load: FORCE | None = None,
    level: float = 0.05,
    poses: Annotated[int, typer.Option(min=2, max=100_000)] = 300,
    seed: Seed = 0,
    *,
    run: Run,
) -> None:
    """What has changed between two calibrations: by parameter, and how far the tool moved.

    Example: elastocal compare cell.toml january.json june.json --report changes.html

    Args:
        cell: Cell file (TOML) of both.
        old: Result of identify (JSON), the earlier one.
        new: Result of identify (JSON), the later one.
        cell_of_old: Cell file of both, in the old order OLD NEW.
        load: Force in N at the load point (tracker's axes); default: the measured loads.
        level: Probability of any finding if nothing has changed.
        poses: Random poses.
    """
    from elastocal.diagnosis.changes import compare as compared
    from elastocal.files import together
    from elastocal.model.calibrated import read_calibrated
    from elastocal.report.blocks import print_report
    from elastocal.saving import write_json

    if old_order := new is None:
        cell, old, new = _in_old_order(cell, old, cell_of_old)
    run.writes((output, ".json"), (report, PAGES))
    inputs = run.reads(cell, old, new)
    with run.progress() as progress:
        progress("reading")
        arms = [read_calibrated(cell, path, run.plugins) for path in (old, new)]
        if old_order:
            complain(f"the cell comes first now: elastocal compare {cell} {old} {new}")
        run.reads(cell=arms[0].model.cell)
        progress("comparing")
        found = compared(*arms, load=load, level=level, poses=poses, seed=seed)
    with together(run.written):
        if output is not None:
            write_json(output, found.to_json())
        if report is not None:
            found.report(report, inputs=inputs, command=repeated(), seed=seed)
    run.answer(found.to_json, lambda screen: print_report(screen, found))


def _in_old_order(old: Path, new: Path, cell: Path | None) -> tuple[Path, Path, Path]:
    """Cell and both results where the cell does not come first, as it once did not."""
    if old.suffix.lower() == ".toml":
        raise InputError(
            f"the argument NEW is missing: elastocal compare {old} {new} NEW, the later result"
        )
    known = old.parent / "cell.toml" if cell is None else cell
    if cell is None and not known.is_file():
        raise InputError(
            f"there is no cell.toml beside {old}; name the cell first: elastocal compare CELL "
            f"{old} {new}"
        )
    return known, old, new
