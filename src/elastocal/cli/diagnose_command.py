"""elastocal diagnose: why the real arm still differs from the model."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal import verbs
from elastocal.cli.app import repeated
from elastocal.cli.signatures import Asked, CellFile, DataFile, JsonFile, ReportFile, Run, command
from elastocal.errors import require
from elastocal.screen import say

if TYPE_CHECKING:
    from elastocal.diagnosis.diagnosis import Diagnosis

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
    from elastocal.model.choice import cell_of
    from elastocal.report.page import write_page
    from elastocal.report.terminal import print_report
    from elastocal.saving import save_diagnosis

    require(
        poses is None or plan is not None,
        f"--poses {poses} has no meaning without --plan; name the file for the extra poses",
    )
    run.writes(output, report, plan, cell_out)
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
                told += _write_extended(cell_out, found, cell, data, run.plugins)
    if run.answer(
        lambda: publish(found, model, found.data),
        lambda screen: print_report(screen, found),
        files=False,
    ):
        for line in told:
            say(line)


def _write_extended(
    path: Path, found: Diagnosis, cell: Path, data: Path, plugins: bool
) -> Iterator[str]:
    """Write the cell with the effects found, and say so and what to do with it."""
    from elastocal.diagnosis.diagnose import write_extended_cell
    from elastocal.model.smooth_groups import where_smooth_functions_end
    from elastocal.report.causes_view import added_text

    extra = (*found.effects, *found.slight, *found.fields)
    extended = write_extended_cell(cell, path, extra, found.model_keys)
    added = added_text(extra)
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
