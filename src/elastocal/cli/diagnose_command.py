"""elastocal diagnose: why the real arm still differs from the model."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal.cli.app import (
    CellFile,
    DataFile,
    Json,
    Plugins,
    Quiet,
    ReportFile,
    Seed,
    check_apart,
    check_outputs,
    command,
    console,
    repeated,
)
from elastocal.errors import require
from elastocal.screen import progress_line, say
from elastocal.text import json_text

if TYPE_CHECKING:
    from elastocal.diagnosis.diagnosis import ExtraPlan

MOST_POSES = 10


@command()
def diagnose(
    cell: CellFile,
    data: DataFile,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write the diagnosis as JSON.")
    ] = None,
    report: ReportFile = None,
    plan: Annotated[
        Path | None,
        typer.Option(help="Write extra poses (CSV) that separate the remaining hypotheses."),
    ] = None,
    poses: Annotated[
        int | None,
        typer.Option(min=1, help=f"Most extra poses of --plan.  [default: {MOST_POSES}]"),
    ] = None,
    cell_out: Annotated[
        Path | None, typer.Option(help="Write the cell (TOML) with the effects found added.")
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(metavar="EFFECT", help="Exclude an effect; repeatable."),
    ] = None,
    plugins: Plugins = False,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Why does the real arm still differ from the model?

    Finds the unmodelled effect that explains the remaining error, its place, and how far the
    error at new poses falls once it is added.

    Example: elastocal diagnose cell.toml data.csv -o diagnosis.json --report diagnosis.html
    """
    from elastocal import verbs
    from elastocal.diagnosis.diagnose import write_extended_cell
    from elastocal.diagnosis.diagnosis import publish
    from elastocal.files import together
    from elastocal.model.choice import cell_of
    from elastocal.model.smooth_groups import where_smooth_functions_end
    from elastocal.report.causes_view import added_text
    from elastocal.saving import save_diagnosis

    require(
        poses is None or plan is not None,
        f"--poses {poses} has no meaning without --plan; name the file for the extra poses",
    )
    written = check_outputs(output, report, plan, cell_out)
    known = cell_of(cell, plugins)  # its plug-ins may have the effect
    check_apart(written, [cell, data], known)
    with progress_line(quiet) as progress:
        found = verbs.diagnose(
            known, data, without=without or (), seed=seed, progress=progress,
            extra_poses=None if plan is None else poses or MOST_POSES,
        )  # fmt: skip
        assert found.model is not None  # `diagnose` states it
        kinds = found.model.chain.kinds
        told = []
        with together(written):
            if output is not None:
                save_diagnosis(found, output)
                told.append(f"wrote {output}")
            if report is not None:
                from elastocal.report.page import write_page

                write_page(found, report, [cell, data], repeated(), seed)
                told.append(f"wrote {report}")
            if plan is not None:
                told.append(_write_extra_poses(plan, found.extra, kinds, bool(found.groups)))
            if cell_out is not None:
                extra = (*found.effects, *found.slight, *found.fields)
                extended = write_extended_cell(cell, cell_out, extra, found.model_keys)
                added = added_text(extra)
                told.append(f"wrote {cell_out} with {added or 'no further effect'}")
                if ends := where_smooth_functions_end(extended):
                    told.append(
                        f"its smooth functions end outside the measured range: {ends}; there the "
                        "model without them holds"
                    )
                if added:
                    again = shlex.join(
                        ["elastocal", "identify", str(cell_out), str(data)]
                        + ["--plugins"] * plugins
                    )
                    told.append(f"to go on: {again} -o result.json")
    if as_json:
        say(json_text(publish(found, found.model, found.data)))
        return
    from elastocal.report.diagnosis_terminal import print_diagnosis

    print_diagnosis(console(), found, kinds)
    for line in told:
        say(line)


def _write_extra_poses(
    path: Path, extra: ExtraPlan | None, kinds: Sequence[str], many: bool
) -> str:
    """Write the extra poses, and say so; or why there are none to write: `many` causes act at
    once, or none is left open."""
    from elastocal.saving import save_extra_poses

    if extra is None and many:
        return f"{path} not written: few extra poses do not separate many causes"
    if extra is None:
        return f"{path} not written: there are no rivals to separate"
    if extra.plan is None:
        return f"{path} not written: no pose separates the rivals"
    save_extra_poses(path, extra.plan, kinds)
    return f"wrote {path}: {extra.n_poses} poses, {len(extra.plan)} visits"
