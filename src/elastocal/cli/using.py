"""Verbs that use measurements and results: identify … compare; studies, and the example."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal import verbs
from elastocal.cli.app import (
    FORCE,
    PAGES,
    Asked,
    Run,
    command,
    named_numbers,
    repeated,
    whole_numbers,
)
from elastocal.messages import InsufficientDataError, NotAcceptedError, listed, option, require
from elastocal.screen import complain, progress_line, say

if TYPE_CHECKING:
    from elastocal.diagnosis.diagnosis import Diagnosis
    from elastocal.studies import Ending


@command(
    verb=verbs.identify,
    offers="test method noise weights intervals covariance fixed bounded knowledge physical "
    "outliers jobs seed",
)
def identify(
    cell: Path, data: Path, output: Path | None = None, report: Path | None = None,
    certificate: Path | None = None, residuals: Path | None = None,
    require: list[str] | None = None, *, asked: Asked, details: bool = False, run: Run,
) -> None:  # fmt: skip
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
    from elastocal.report.renderers import print_report, write_page
    from elastocal.saving import save_residuals

    run.writes(
        (output, ".json"), (report, PAGES), (residuals, ".csv"), (certificate, f"{PAGES} .xml")
    )
    limits = limits_of(require or [])
    known = cell_of(cell, run.plugins)  # its plug-ins may have the noise model
    files = (asked.get(name) for name in ("test", "covariance", "knowledge"))
    inputs = run.reads(cell, data, *files, cell=known)
    with run.progress() as progress:
        result = verbs.identify(known, data, **asked, progress=progress)
        page = partial(write_page, result, inputs=inputs, command=repeated(), seed=asked["seed"])
        run.write(
            (output, result.save),
            (residuals, partial(save_residuals, result)),
            (report, page),
            (certificate, partial(page, certificate=True)),
        )
    run.answer(result.to_json, lambda screen: print_report(screen, result, details))
    if unmet := result.unmet(**limits):
        raise NotAcceptedError(f"not accepted: {'; '.join(unmet)}")


def limits_of(stated: list[str], names: tuple[str, ...] = ()) -> dict[str, float]:
    """NAME=UM as limits in m, NAME one of `names`, by default of all."""
    from elastocal.cell import Acceptance

    names = names or tuple(vars(Acceptance()))
    takes = f"NAME=UM, NAME one of {listed(names)} and UM a positive number in µm"
    found = named_numbers(stated, f"{option('require')} takes {takes}")
    for name, um in found.items():
        fits = name in names and 0 < um < math.inf
        require(fits, f"{option('require')} takes {takes}; found '{name}={um:g}'")
    return {name: um * 1e-6 for name, um in found.items()}


MOST_POSES = 10


@command(verb=verbs.diagnose, offers="without seed")
def diagnose(
    cell: Path, data: Path, output: Path | None = None, report: Path | None = None,
    plan: Path | None = None, poses: Annotated[int | None, typer.Option(min=1)] = None,
    cell_out: Path | None = None, *, asked: Asked, run: Run,
) -> None:  # fmt: skip
    """Why does the real arm still differ from the model?

    Finds the unmodelled effect that explains the remaining error, its place, and how far the
    error at new poses falls once it is added.

    Example: elastocal diagnose cell.toml data.csv -o diagnosis.json --report diagnosis.html

    Args:
        plan: Write extra poses (CSV) that separate the remaining hypotheses.
        poses: Most extra poses of --plan; default: 10.
        cell_out: Write the cell (TOML) with the effects found added.
    """
    from elastocal.model.effects.catalogue import cell_of
    from elastocal.report.renderers import print_report, write_page

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
        told = [f"wrote {path}" for path in (output, report) if path is not None]
        run.write(
            (output, found.save),
            (report, lambda path: write_page(found, path, [cell, data], repeated(), asked["seed"])),
            (plan, lambda path: told.append(_write_extra_poses(path, found, model.chain.kinds))),
            (cell_out, lambda path: told.extend(_write_extended(path, found, data, run.plugins))),
        )
    if run.answer(found.to_json, lambda screen: print_report(screen, found), files=False):
        for line in told:
            say(line)


def _write_extended(path: Path, found: Diagnosis, data: Path, plugins: bool) -> Iterator[str]:
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


@command("next")
def next_command(
    cell: Path, data: Path, output: Path, batch: Annotated[int, typer.Option(min=1)] = 5,
    required: Annotated[str | None, typer.Option("--require")] = None,
    least_gain: Annotated[float, typer.Option(min=0, max=99)] = 1.0,
    candidates: Annotated[int, typer.Option(min=1)] = 400, jobs: int = 1, seed: int = 0, *,
    run: Run,
) -> None:  # fmt: skip
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
    from elastocal.model.effects.catalogue import cell_of
    from elastocal.report.renderers import print_report
    from elastocal.saving import beside, save_plan

    run.writes((output, ".csv"), (beside(output), ".json"))
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
            run.write((output, partial(save_plan, found.plan, command=repeated())))
    show = partial(print_report, result=found)
    if run.answer(found.to_json, show, files=found.plan is not None) and found.plan is None:
        say(f"{output} not written")


GRID = "--grid takes whole numbers, as in 5 or 9,7,7,3,3,1"


@command(verb=verbs.compensate, offers="frame point load seed", texts={"point": ("POINT", str)})
def compensate(
    cell: Path, result: Path, targets: Annotated[Path | None, typer.Argument()] = None,
    output: Path | None = None, target: str | None = None, near: str | None = None,
    partial: bool = False, table: Path | None = None, grid: str = "5", box: str | None = None,
    rotation: str | None = None, *, asked: Asked, run: Run,
) -> None:  # fmt: skip
    """Compute corrected joint commands for targets.

    Solves the calibrated arm under load for every target.  --table writes corrections that a
    controller adds to nominal targets.

    Example: elastocal compensate cell.toml result.json targets.csv -o commands.csv

    Args:
        targets: Targets (CSV): x_mm, y_mm, z_mm, rx_deg, …, or q1_deg, …
        output: Commands to write (CSV).
        target (X,Y,Z[,RX,RY,RZ]): One target instead, in mm and degrees.
        near (Q1,Q2,…): Joints in degrees (mm where prismatic) of a posture to start near.
        partial: Write the rows reached; leave others empty.
        table: Correction table to write (CSV), over --grid.
        grid (N[,N…]): Levels per joint (or of x, y, z): 5 or 9,7,7,3,3,1.
        box (X0,Y0,Z0,X1,Y1,Z1): Grid over this box in mm in the base frame, not over the joints.
        rotation (RX,RY,RZ): Rotation vector of the tool in --box, in degrees.
    """
    from elastocal import compensation as single
    from elastocal import correction_table as grids
    from elastocal.files import atomic_write
    from elastocal.model.calibrated import read_calibrated, tool_point
    from elastocal.model.effects.base import given_force
    from elastocal.report.renderers import print_blocks
    from elastocal.report.smaller_views import compensation_blocks

    # What can be wrong with the options is told before any file is read.
    single.check_frame(asked["frame"])
    force = given_force(asked.get("load"))
    given = (targets is not None) + (target is not None)
    need = "nothing to compensate: name a table of targets, or give --target x,y,z or --table FILE"
    require(given > 0 or table is not None, need)
    require(given < 2, f"both {targets} and --target are given; drop one of them")
    need = "-o writes the commands of targets; name a table of them, or give --target"
    require(given > 0 or output is None, need)
    need = "--grid, --box and --rotation belong to a correction table; give --table FILE"
    require(table is not None or (grid, box, rotation) == ("5", None, None), need)
    require(rotation is None or box is not None, "--rotation belongs to --box")
    run.writes((output, ".csv"), (table, ".csv"))
    content, commands, corrections, reached = {}, "", "", False
    with run.progress() as progress:
        progress("reading")
        arm = read_calibrated(cell, result, run.plugins)
        run.reads(cell, result, targets, cell=arm.model.cell)
        start = grids.posture_of(arm, near)
        counts = tuple(whole_numbers(grid, GRID))
        lines = None if table is None else grids.grid_of(arm, counts, box, rotation)
        wanted = targets if target is None else single.one_target(target, asked["frame"], force)
        if wanted is not None:
            found = verbs.compensate(arm, wanted, **asked, near=start, progress=progress)
            if not partial:
                single.check_reached(found)
            content["commands"] = single.summary(found, commands=output is None)
            commands, reached = single.commands_csv(found), bool(found.reached.any())
        if lines is not None:
            how = tool_point(arm.model.cell, asked.get("point")), force, start, asked["seed"]
            made = grids.correction_table(arm, lines, *how, progress, asked["frame"])
            content["table"], corrections = grids.summary_and_csv(made, partial)
        # Nothing is written before every answer is there: a refused table leaves no commands.
        run.write(
            (output, lambda path: atomic_write(path, commands)),
            (table, lambda path: atomic_write(path, corrections)),
        )
    shown = run.answer(
        lambda: {"schema": single.SCHEMA} | content.pop("commands", {}) | content,
        lambda screen: print_blocks(screen, compensation_blocks(content)),
    )
    if shown and output is not None and reached:
        told = " 95 % of the targets should be reached within its column within95_um, measurement "
        told += "noise excluded."
        kept = told * (arm.model.observe != "deflection")  # of which nothing says where the tool is
        say(f"Next: Run {output.name} and measure some.{kept}")


@command(short_help="Write the calibrated model: URDF, MuJoCo, DH table")
def export(
    cell: Path, result: Path, output: Path, format: str | None = None,
    load: FORCE | None = None, frames: Annotated[bool, typer.Option("--frames/--no-frames")] = True,
    base_frame: bool = False, joint_correction: Path | None = None,
    temperature_c: float | None = None, time_s: float | None = None,
    poses: Annotated[int, typer.Option(min=2, max=1_000_000)] = 500, seed: int = 0, *, run: Run,
) -> None:  # fmt: skip
    """Write the calibrated arm as URDF, MJCF, DH table or parameters, and state the loss.

    Example: elastocal export cell.toml result.json -o calibrated.urdf --load 0 0 -2600

    Args:
        output: File to write: .urdf, .xml or .mjcf, .csv (DH), .yaml, .json.
        format: urdf, mjcf, dh, mdh (modified DH), yaml, json, or corrections (smooth functions
            as CSV); default: by the ending.
        load: Force in N at the load point (tracker's axes) for costs and fit.
        frames: URDF: links for markers and load point.
        base_frame: Put the tracker's frame above the robot's base.
        joint_correction: Write the joint correction for simulators (CSV); the file is fitted
            with it.
        temperature_c: Temperature in °C to export at.
        time_s: Time in s, as in the data, to export at.
        poses: Random poses to find costs at.
    """
    from elastocal.export.export import Wish, write
    from elastocal.export.export import export as exported
    from elastocal.model.calibrated import read_calibrated
    from elastocal.report.renderers import print_blocks
    from elastocal.report.smaller_views import export_blocks

    run.writes((output, ""), (joint_correction, ".csv"))
    wish = Wish(
        output, format, load, frames, base_frame, temperature_c, time_s, poses, seed,
        joint_correction is not None,
    )  # fmt: skip
    with run.progress() as progress:
        progress("reading")
        calibrated = read_calibrated(cell, result, run.plugins)
        run.reads(cell, result, cell=calibrated.model.cell)
        done = exported(calibrated, wish, progress)
    write(done, output, joint_correction)
    run.answer(
        lambda: {"output": str(output)} | done.to_json(),
        lambda screen: print_blocks(screen, export_blocks(done)),
    )


@command(short_help="What has changed since the last calibration?")
def compare(
    cell: Path, old: Path, new: Annotated[Path | None, typer.Argument()] = None,
    cell_of_old: Annotated[Path | None, typer.Option("--cell", hidden=True)] = None,
    output: Path | None = None, report: Path | None = None, load: FORCE | None = None,
    level: float = 0.05, poses: Annotated[int, typer.Option(min=2, max=100_000)] = 300,
    seed: int = 0, *, run: Run,
) -> None:  # fmt: skip
    """What has changed between two calibrations: by parameter, and how far the tool moved.

    Example: elastocal compare cell.toml january.json june.json --report changes.html

    Args:
        cell: Cell file (TOML) of both.
        old: Result of identify (JSON), the earlier one.
        new: Result of identify (JSON), the later one.
        cell_of_old: Cell file of both, in the old order OLD NEW.
        load: Force in N at the load point (tracker's axes); default: the measured loads.
        level: Probability that any parameter is named if nothing has changed.
        poses: Random poses.
    """
    from elastocal.diagnosis.changes import compare as compared
    from elastocal.model.calibrated import read_calibrated
    from elastocal.report.renderers import print_report, write_page

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
    run.write(
        (output, found.save),
        (report, lambda path: write_page(found, path, inputs, repeated(), seed)),
    )
    run.answer(found.to_json, lambda screen: print_report(screen, found))


def _in_old_order(old: Path, new: Path, cell: Path | None) -> tuple[Path, Path, Path]:
    """Where the cell does not come first, as it once did not."""
    told = f"the argument NEW is missing: elastocal compare {old} {new} NEW, the later result"
    require(old.suffix.lower() != ".toml", told)
    known = old.parent / "cell.toml" if cell is None else cell
    told = f"there is no cell.toml beside {old}; name the cell first: elastocal compare CELL"
    require(cell is not None or known.is_file(), f"{told} {old} {new}")
    return known, old, new


EVERY = 10.0  # s between plain lines of progress


@command(short_help="Run many simulations on all cores or a cluster")
def study(
    folder: Path, jobs: Annotated[int | None, typer.Option(min=1)] = None,
    cluster: str | None = None, tls_ca: Path | None = None, tls_cert: Path | None = None,
    tls_key: Path | None = None, unencrypted: bool = False,
    seed: Annotated[int | None, typer.Option(min=0)] = None, set_: list[str] | None = None,
    output: Path | None = None,
    progress: Annotated[bool, typer.Option("--progress", show_default=False)] = True,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", "--no-progress")] = False,
    only: Annotated[int | None, typer.Option(min=1)] = None, restart: bool = False,
    retry_failed: bool = False,
) -> None:  # fmt: skip
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
        output: Folder of the results, with the summary in its result.md; default:
            FOLDER/results and FOLDER/result.md.
        progress: Rate and time left: the default.
        quiet: No progress.
        only: Run the first N tasks alone.
        restart: Discard the results that are there.
        retry_failed: Run tasks that failed again.
    """
    require(cluster is None or jobs is None, "--jobs is for this machine; drop it with --cluster")
    from elastocal.studies import PAGE, StudyStop, read_study, run_study, summarise

    results = folder / "results" if output is None else output
    page = (output or folder) / PAGE
    prepared = read_study(folder, seed, set_ or ())
    with StudyStop() as stop, progress_line(quiet or not progress, EVERY) as tell:
        ending = run_study(
            prepared, results, jobs=jobs, cluster=cluster, only=only, restart=restart,
            retry_failed=retry_failed, stop=stop, progress=pace(tell),
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
    text += f" ({ending.before} were there)" if ending.before else ""
    text += f", {ending.failed} failed" if ending.failed else ""
    text += f"; results in {results}"
    if ending.failed:
        from elastocal.studies import read_results

        first = read_results(results, failed=True).iloc[0]
        text += (
            f"\nfirst failure: task {first['task']}: {first['task_error']}\n"
            f"tracebacks in {results / '_failures.log'}; --retry-failed runs such tasks again"
        )
    if ending.stopped and not ending.complete:
        text += "\nstopped; the same command goes on with the rest"
    return text


def pace(tell: Callable[[str], None]) -> Callable[[int, int, int], None]:
    """Rate per minute of this run, time left, failures; the first call begins."""
    begun, before = time.monotonic(), -1

    def show(total: int, ended: int, failed: int) -> None:
        nonlocal begun, before
        if before < 0:
            begun, before = time.monotonic(), ended
        text = f"{ended} of {total} tasks"
        if ended > before:
            rate = (ended - before) / max(time.monotonic() - begun, 1e-3)
            left = timedelta(seconds=round((total - ended) / rate))
            text += f", {60 * rate:.{0 if rate > 1 else 1}f} per minute, {left} left"
        tell(text + (f", {failed} failed" if failed else ""))

    return show


@command(short_help="Simulate and calibrate a KR 270 (Klimchik et al. 2013)", flags="json quiet")
def demo(output: Path = Path("demo_out"), seed: int = 2013, *, run: Run) -> None:
    """The KR 270 example of Klimchik et al. 2013, measured (simulated) and identified.

    Example: elastocal demo -o demo_out

    Args:
        output: Folder for the example's files, data, result and report.
    """
    from elastocal.files import together
    from elastocal.report.renderers import print_report, write_page
    from elastocal.simulation import run_demo

    result, report = output / "result.json", output / "report.html"
    with run.progress() as progress:
        found, truth, published = run_demo(output, seed, progress)
        inputs = [output / name for name in ("cell.toml", "plan.csv", "data.csv")]
        with together():
            found.save(result)
            write_page(found, report, inputs, repeated(), seed, truth=truth, published=published)
    if run.answer(
        lambda: found.to_json() | {"truth": truth},
        lambda screen: print_report(screen, found, details=False, truth=truth),
    ):
        say(
            f"\nTo repeat it by hand: elastocal identify {inputs[0]} {inputs[2]} -o result.json\n"
            f"Report to open: {report.absolute()}"
        )
