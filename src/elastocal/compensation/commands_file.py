"""Commands as files: the table that a robot program is made from, and a summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from elastocal.compensation.compensate import REACHED, Compensation
from elastocal.errors import InsufficientDataError, option
from elastocal.manipulator.chain import Array
from elastocal.measurements import families
from elastocal.tables import column, csv_text
from elastocal.text import plain

SCHEMA = "elastocal/compensation/1"
# Of degrees and mm: 9e-12 rad and 5e-13 m.
DIGITS = 9


REMEDIES = {
    "limit": "joint limits prevent it: widen [limits], move the target, or give q1_deg … of "
    "another posture",
    "not reached": "out of reach, or beside a singular posture: move the target, or give q1_deg … "
    "of another posture",
    "no equilibrium": "no static equilibrium under this load: check force_*_N",
}
NAMED = 8  # rows that a message names


def check_reached(result: Compensation) -> None:
    """Raise InsufficientDataError where targets are not reached: which, and what would help."""
    table = result.targets.table
    rows = [f"line {line}" for line in table.row]
    check_status(f"{table.source}: %d of %d targets", rows, result.status, REACHED, REMEDIES)


def check_status(
    what: str,
    rows: Sequence[str],
    status: Sequence[str],
    good: str,
    remedies: Mapping[str, str],
) -> None:
    """Raise InsufficientDataError for rows of another status than `good`; `what` counts them."""
    lost = [(row, s) for row, s in zip(rows, status, strict=True) if s != good]
    if not lost:
        return
    named = ", ".join(f"{row} ({s})" for row, s in lost[:NAMED])
    more = f" and {len(lost) - NAMED} more" if len(lost) > NAMED else ""
    kinds = dict.fromkeys(s for _, s in lost)
    raise InsufficientDataError(
        f"{what % (len(lost), len(status))} are not reached: {named}{more}. "
        + "; ".join(f"{kind}: {remedies[kind]}" for kind in kinds)
        + f". Nothing was written; {option('partial', True)} writes the others"
    )


def in_file_units(values: Array, kinds: Sequence[str]) -> Array:
    """Joints in rad or m as degrees or mm."""
    return values * np.where([kind == "revolute" for kind in kinds], 180 / np.pi, 1e3)


def joint_columns(kinds: Sequence[str], before: str = "") -> list[str]:
    """q1_deg …, q3_mm for a prismatic joint, each after `before`."""
    units = ["deg" if kind == "revolute" else "mm" for kind in kinds]
    return [column(f"{before}q{i}", unit) for i, unit in enumerate(units, start=1)]


def commands_csv(result: Compensation, kinds: Sequence[str]) -> str:
    """The commands, one row per target in the order of the targets.

    Joints and corrections of a row that is not reached are left empty.  Forces stand in the
    data's frame, as in every plan, so that `simulate` can read the table.
    """
    blocks: list[tuple[list[str], Array, str]] = []
    held = np.where(result.reached[:, None], 1.0, np.nan)
    q = in_file_units(result.q, kinds)
    blocks.append((joint_columns(kinds), held * q, f".{DIGITS}f"))
    table = result.targets.table
    if result.force.any():
        blocks.append((["force_x_N", "force_y_N", "force_z_N"], result.force, ".9g"))
    for name, values, unit in (
        ("time", table.time, "s"),
        ("approach", table.approach, ""),
        ("temperature", table.temperature, "C"),
        ("torque", table.torque, "Nm"),
    ):
        if values is not None:
            stems = families(kinds)[name].units
            heads = [
                column(stem, unit if unit in units else units[0]) for stem, units in stems.items()
            ]
            blocks.append((heads, values.reshape(len(table), -1), ".12g"))
    change = held * in_file_units(result.q - result.nominal, kinds)
    blocks.append((joint_columns(kinds, "correction_"), change, f".{DIGITS}f"))
    errors = np.column_stack([result.before, result.after]) * 1e6
    blocks.append((["error_before_um", "error_after_um"], errors, ".4g"))
    if result.goals.rotation is not None:
        heads = ["error_rotation_before_urad", "error_rotation_after_urad"]
        blocks.append((heads, result.turn * 1e6, ".4g"))
    blocks.append((["std_um"], result.uncertainty.std[:, None] * 1e6, ".4g"))
    header = ["configuration", *(h for heads, _, _ in blocks for h in heads), "status"]
    rows = []
    for i in range(len(table)):
        cells = [_cell(v, form) for _, values, form in blocks for v in values[i]]
        label = table.configuration_labels[table.configuration[i]]
        rows.append([label, *cells, result.status[i]])
    return csv_text(header, rows)


def _cell(value: float, form: str) -> str:
    return format(value + 0.0, form) if np.isfinite(value) else ""


def summary(result: Compensation, kinds: Sequence[str], commands: bool) -> dict[str, Any]:
    """What was done, JSON-ready; with `commands` also every command."""
    good = result.reached
    names = joint_columns(kinds)
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "targets": result.targets.table.source,
        "frame": result.targets.frame,
        "point": result.point.told,
        "n": len(good),
        "reached": int(good.sum()),
        "error_before_um": spread(result.before[good]),
        "error_after_um": spread(result.after[good]),
        "std_um": spread(result.uncertainty.std[good]),
        "largest_correction": dict(
            zip(names, _largest(in_file_units(result.q - result.nominal, kinds)[good]), strict=True)
        ),
        "not_reached": [
            {"line": int(result.targets.table.row[i]), "status": result.status[i],
             "nearest_um": plain(result.after[i] * 1e6)}
            for i in np.flatnonzero(~good)
        ],
        "undetermined": list(result.uncertainty.blamed),
        "warnings": list(result.warnings),
    }  # fmt: skip
    if commands:
        q = in_file_units(result.q, kinds)
        content["commands"] = [
            {"status": status}
            | (dict(zip(names, map(float, q[i]), strict=True)) if status == REACHED else {})
            for i, status in enumerate(result.status)
        ]
    return content


def _largest(values: Array) -> list[float | None]:
    if not len(values):
        return [None] * values.shape[1]
    return [float(v) for v in np.abs(values).max(axis=0)]


def spread(values: Array) -> dict[str, float | None]:
    """rms, 95 % quantile and maximum of values in m (rad), in µm (µrad); None without values."""
    known = values[np.isfinite(values)] * 1e6
    if not len(known):
        return {"rms": None, "p95": None, "max": None}
    return {
        "rms": float(np.sqrt(np.mean(known**2))),
        "p95": float(np.quantile(known, 0.95)),
        "max": float(known.max()),
    }
