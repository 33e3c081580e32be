"""Every result as a file, in the form that its verb of the command line writes, and back.

`Result.save` and `CalibratedArm.save` find `save` by name (elastocal.above); the command line
calls the function of the kind.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from elastocal.above import checked_arguments
from elastocal.files import atomic_write, read_json
from elastocal.measurements import DEFAULT_MARKER, Measurements, write_measurements
from elastocal.messages import InputError, json_text, option, require
from elastocal.model.calibrated import CalibratedArm, read_calibrated
from elastocal.model.manipulator import Model
from elastocal.tables import PARQUET, Labels, csv_text

if TYPE_CHECKING:
    from elastocal.cell import Cell
    from elastocal.compensation import Compensation
    from elastocal.diagnosis.diagnosis import Diagnosis
    from elastocal.identification.result import Calibration
    from elastocal.planning.plan import Plan

LARGEST_SUMMARY = 200_000_000  # bytes

# One verb's result should not load another verb: each function imports what it needs.


@checked_arguments
def save(result: Any, path: str | Path, **how: Any) -> None:
    """Write a result or a calibrated arm; class and ending decide what, `how` are its options.

    A name without ending is of the first kind that there is.
    """
    path, kind = Path(path), type(result).__name__
    by_ending = WRITERS[kind]
    write = by_ending.get(path.suffix.lower() or next(iter(by_ending)), by_ending.get(ANY))
    if write is None:
        raise InputError(f"{path}: {kind} is saved as {' or '.join(by_ending)}; name the file so")
    write(result, path, **how)


def write_json(path: Path, content: Any) -> None:
    atomic_write(path, json_text(content) + "\n")


def save_published(result: Any, path: Path) -> None:
    write_json(path, result.to_json())


def save_residuals(fit: Calibration, path: Path) -> None:
    rows = fit.residual_table()
    atomic_write(path, csv_text(list(rows[0]), [list(row.values()) for row in rows]))


def beside(path: Path) -> Path:
    """Where the summary (JSON) of the plan `path` is written, which nobody names."""
    require(path.suffix.lower() != ".json", f"{path}: name the plan .csv; .json goes beside it")
    summary = path.with_suffix(".json")
    if summary.exists():
        try:
            found = read_json(summary, "summary", LARGEST_SUMMARY, "")
        except InputError:
            found = None
        require(
            isinstance(found, dict) and str(found.get("schema")).startswith("elastocal/"),
            f"{summary}: goes beside {path} and would be written over, but elastocal did not "
            "write it; move it, or name the plan otherwise",
        )
    return summary


def save_plan(plan: Plan, path: Path, command: str | None = None) -> None:
    """plan.csv, which people measure by, and plan.json (schema elastocal/plan/1) beside it.

    `command` is the command line that repeats the design.  Raises InputError as `beside` does.
    """
    from elastocal.planning.plan import SCHEMA, write_plan

    summary = beside(path)
    write_plan(path, *plan.rows, forces=plan.stated_forces is not None)
    repeat = {"command": command, "backend": plan.model.backend_report()}
    write_json(summary, {"schema": SCHEMA, **plan.to_json(), **repeat})


def save_found_cell(diagnosis: Diagnosis, path: Path) -> Cell:
    """The cell file that was diagnosed with the effects found added; it is returned as written.

    Raises InputError where the cell was built in Python or changed after it was read.
    """
    from elastocal.cell import read_cell
    from elastocal.diagnosis.diagnose import write_extended_cell
    from elastocal.model.chain import numbered

    assert diagnosis.model is not None  # `diagnose` states it
    cell, chain = diagnosis.model.cell, diagnosis.model.chain
    if cell.path is None or repr(numbered(read_cell(cell.path), chain).model) != repr(cell.model):
        raise InputError(
            f"{path}: the model diagnosed is not that of a cell file, which what was found could "
            "join; write the cell as a file (TOML), and diagnose that"
        )
    require(
        path.resolve() != cell.path.resolve(),
        f"{path} is the cell that was diagnosed; write the cell found to another file",
    )
    extra = (*diagnosis.effects, *diagnosis.slight, *diagnosis.fields)
    return write_extended_cell(cell.path, path, extra, diagnosis.model_keys)


def save_compensation(found: Compensation, path: Path, partial: bool = False) -> None:
    """The table of commands (CSV).

    Raises InsufficientDataError where targets are not reached, unless `partial`: their rows are
    then left empty.
    """
    from elastocal.compensation import check_reached, commands_csv

    if not partial:
        check_reached(found)
    atomic_write(path, commands_csv(found))


def save_arm(arm: CalibratedArm, path: Path, **how: Any) -> None:
    """The calibrated arm for other programs; `how` as for `Wish`.

    Raises InputError where the format cannot be written for this robot, InsufficientDataError
    where no random pose has a static equilibrium under the load, and ElastocalError where the
    text, read back, is another arm than the model.
    """
    from elastocal.export.export import Wish, export, write

    correction = how.pop("joint_correction", None)
    write(export(arm, Wish(path, **how, correct_joints=correction is not None)), path, correction)


def save_extra_poses(path: str | Path, plan: Measurements, kinds: Sequence[str]) -> None:
    """Write visits (rows of `plan`, in the order of measuring) as plan.csv, which `simulate` reads.

    Angles in degrees, travel in mm, force, approach direction and time where the plan has them.  A
    pose that is visited again under the same force is a configuration of its own: 4, 4/2, ….
    """
    from elastocal.planning.plan import write_plan

    names = []
    visits: Counter[tuple[int, bytes]] = Counter()
    for code, force in zip(plan.configuration, plan.force + 0.0, strict=True):
        visits[key := (int(code), force.tobytes())] += 1
        again = f"/{visits[key]}" if visits[key] > 1 else ""
        names.append(plan.configuration_labels[code] + again)
    visited = Labels.of(names)
    table = replace(
        plan, configuration=visited.codes, configuration_labels=visited.names,
        marker=np.zeros(len(plan), dtype=np.int64), marker_names=(DEFAULT_MARKER,),
        joint_kinds=tuple(kinds),
    )  # fmt: skip
    order = list(map(str, range(1, len(plan) + 1)))
    write_plan(path, table, {"level": ["1"] * len(plan), "order": order})


ANY = "any ending"  # of an arm the formats know theirs
WRITERS: dict[str, dict[str, Callable[..., Any]]] = {
    "Comparison": {".json": save_published},
    "Calibration": {".json": save_published, ".csv": save_residuals},
    "Plan": {".csv": save_plan},
    "Diagnosis": {".json": save_published, ".toml": save_found_cell},
    "Compensation": {".csv": save_compensation},
    "CalibratedArm": {ANY: save_arm},
    "Measurements": dict.fromkeys((".csv", *PARQUET), write_measurements),
    "NextPoses": {".csv": lambda found, path: save_plan(found.plan, path) if found.plan else None},
}


@checked_arguments
def load(path: str | Path, cell: str | Path | None = None) -> Model | CalibratedArm | Measurements:
    """Read a file by what it is.

    Args:
        path: A cell file (.toml), which becomes a `Model`; a result of identify (.json), which
            becomes the `CalibratedArm`; or a table (.csv, .parquet), which becomes `Measurements`.
        cell: The cell file of a result or a table; None takes cell.toml beside it.

    Returns:
        The `Model`, `CalibratedArm` or `Measurements`.

    Raises:
        InputError: The file is none of these or is wrong, or there is no cell file.

    Examples:
        >>> model = ec.load("cell.toml")
        >>> ec.identify(model, ec.load("data.csv")).save("result.json")
        >>> ec.load("result.json")
        <CalibratedArm kuka_kr270_2: 9 of 10 parameters determined, from result.json>
    """
    path, kind = Path(path), Path(path).suffix.lower()
    if kind == ".toml":
        return Model(path)
    require(
        kind in (".json", ".csv", ".parquet", ".pq"),
        f"{path}: give a cell file (.toml), a result of identify (.json) or a table (.csv, "
        ".parquet)",
    )
    of = path.parent / "cell.toml" if cell is None else Path(cell)
    require(
        cell is not None or of.is_file(),
        f"there is no cell.toml beside {path}; name the cell file by {option('cell')}",
    )
    return read_calibrated(of, path) if kind == ".json" else Model(of).read(path)
