"""A calibrated arm written in one of the formats, read back, and with what that costs."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from elastocal.errors import ElastocalError, InputError, option
from elastocal.export.dh_table import CONVENTIONS, FORMULA, dh_csv, dh_lines, without_beta
from elastocal.export.exportable import (
    Conditions,
    Cost,
    ExportNumbers,
    Kept,
    Valued,
    cost_of,
    evaluate_pieces,
    keep,
    link_inertias,
    random_table,
)
from elastocal.export.mjcf_file import RIGID, MujocoRest, calibrated_mjcf
from elastocal.export.parameter_file import (
    cost_json,
    estimates_of,
    held_values,
    parameter_document,
    to_yaml,
)
from elastocal.export.urdf_file import BASE, FLANGE, Frames, calibrated_urdf, new_urdf
from elastocal.model.calibrated import CalibratedArm
from elastocal.model.chain import Chain
from elastocal.model.effects import effect_of
from elastocal.model.rigid import nominal_flange
from elastocal.text import did_you_mean, json_text
from elastocal.units import Array

# Which format a file is written in: by its ending, or as asked for.

ENDINGS = {
    ".urdf": "urdf",
    ".xml": "mjcf",
    ".mjcf": "mjcf",
    ".csv": "dh",
    ".yaml": "yaml",
    ".yml": "yaml",
    ".json": "json",
}
FORMATS = ("urdf", "mjcf", "dh", "mdh", "yaml", "json")


def format_of(path: Path, asked: str | None) -> str:
    """The format `asked` for, else that of the file's ending.

    Raises InputError for an unknown format, and for an ending that tells none.
    """
    if asked is not None:
        if asked.lower() not in FORMATS:
            raise InputError(
                f"{option('format')} takes one of {', '.join(FORMATS)}; found '{asked}'"
                f"{did_you_mean(asked.lower(), FORMATS)}"
            )
        return asked.lower()
    found = ENDINGS.get(path.suffix.lower())
    if found is None:
        raise InputError(
            f"{path}: the ending '{path.suffix}' tells no format; use one of "
            f"{', '.join(ENDINGS)}, or name it by {option('format')}: {', '.join(FORMATS)}"
        )
    return found


# What was written is read back, by the library that users read it with, before it is kept.

LARGEST = 1e-8  # m; a hundred times the rounding of a chain of a few metres
# Origin and points 0.1 m along the flange's axes, homogeneous (4, 4).
CORNERS = np.vstack([np.hstack([np.zeros((3, 1)), 0.1 * np.eye(3)]), np.ones((1, 4))])
LARGEST_AT_REST = 1e-6  # m


def flanges(chain: Chain, q: Array) -> Array:
    """T_base_flange (n, 4, 4) of a chain at joint values q (n, joints)."""
    symbol = ca.SX.sym("q", chain.n_joints)
    function = ca.Function("flange", [symbol], [nominal_flange(chain, symbol)])
    return np.array([function(row).full() for row in q])


def check_chain(
    text: str,
    ending: str,
    read: Callable[[Path], Chain],
    chain: Chain,
    kept: Kept,
    seed: int,
    largest: float | None = LARGEST,
) -> float:
    """Largest distance in m between the flange of the written text, read back, and `chain`'s: of
    its origin and of points on its axes, so that its orientation counts.

    Raises ElastocalError where it is more than `largest` (None: any will do).
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"written{ending}"
        path.write_text(text, encoding="utf-8", newline="\n")
        back = read(path)
    q = random_table(kept.full.model, kept.conditions, 100, seed).q
    apart = (flanges(back, q) - flanges(chain, q))[:, :3] @ CORNERS
    worst = float(np.linalg.norm(apart, axis=1).max())
    return worst if largest is None else _accepted(worst, largest)


def check_rest(
    mjcf: str, pieces: ExportNumbers, kept: Kept, base_frame: bool, poses: int, seed: int
) -> float:
    """Largest distance in m of flange and markers between MuJoCo at rest and the exported model.

    Raises InputError where MuJoCo is not installed, ElastocalError where they differ.
    """
    arm = MujocoRest(mjcf)
    part, force = kept.exported, kept.conditions.force
    table = random_table(kept.full.model, kept.conditions, poses, seed)
    expected = part.model.flange_poses(table, part.x)
    if not base_frame:
        expected = np.linalg.inv(pieces.T_tracker_base) @ expected
    names = ["flange", *(f"marker_{name}" for name in pieces.markers)]
    points = np.array([np.zeros(3), *(T[:3, 3] for T in pieces.markers.values())])
    worst = 0.0
    for q, T in zip(table.q, expected, strict=True):
        if np.isfinite(T).all():
            found = arm.sites(q, force, names)
            away = found - (points @ T[:3, :3].T + T[:3, 3])
            worst = max(worst, float(np.linalg.norm(away, axis=1).max()))
    return _accepted(worst, LARGEST_AT_REST)


def _accepted(distance: float, largest: float) -> float:
    if not distance <= largest:
        raise ElastocalError(
            f"the written file, read back, is {distance * 1e6:.3g} µm from the model and was not "
            "kept; please report this robot description"
        )
    return distance


# A calibrated arm written in one of the formats, checked, and with what that costs.

SCHEMA = "elastocal/export/1"
POSES_AT_REST = 20


@dataclass(frozen=True)
class Wish:
    """How to export: `poses` random poses for the cost, drawn with `seed`."""

    format: str
    frames: Frames = field(default_factory=Frames)
    conditions: Conditions = field(default_factory=Conditions)
    poses: int = 500
    seed: int = 0


@dataclass(frozen=True)
class Exported:
    """`text` to write; `checked`: largest distance in m when read back, None where it was not.

    `held`: parameters that the data did not determine, with the values used; `without_beta`: of a
    DH table with a column beta_rad, the largest distance in m for who reads four columns only.
    """

    text: str
    format: str
    cost: Cost
    checked: float | None
    checked_with: str
    held: dict[str, float]
    of_the_measurement: tuple[str, ...]
    warnings: tuple[str, ...]
    without_beta: float | None = None

    def to_json(self) -> dict[str, Any]:
        """The answer as a JSON-ready dictionary, lengths in µm."""
        return {
            "schema": SCHEMA,
            "format": self.format,
            "cannot_hold": cost_json(self.cost),
            "read_back": {"with": self.checked_with, "max_um": _um(self.checked)},
            "without_beta_max_um": _um(self.without_beta),
            "held": self.held,
            "of_the_measurement": list(self.of_the_measurement),
            "warnings": list(self.warnings),
        }


def export(
    calibrated: CalibratedArm, wish: Wish, progress: Callable[[str], None] = lambda _: None
) -> Exported:
    """The calibrated arm as the text of a file.

    Raises InputError where the format cannot be written for this robot, InsufficientDataError
    where no random pose has an equilibrium under the load, and ElastocalError where the text,
    read back, is another arm than the model.
    """
    estimates = estimates_of(calibrated)
    kept = keep(calibrated, elastic=wish.format == "mjcf", conditions=wish.conditions)
    pieces = evaluate_pieces(kept.exported, wish.conditions)
    progress("what the format cannot hold")
    cost = cost_of(kept, wish.poses, wish.seed)
    progress("writing and reading back")
    text, checked, tool, warnings, beta = _written(calibrated, wish, kept, pieces, cost, estimates)
    return Exported(
        text=text,
        format=wish.format,
        cost=cost,
        checked=checked,
        checked_with=tool,
        held=held_values(estimates),
        of_the_measurement=kept.of_the_measurement,
        warnings=(*_warnings(calibrated, cost), *warnings),
        without_beta=beta,
    )


Written = tuple[str, float | None, str, list[str], float | None]


def _written(
    calibrated: CalibratedArm,
    wish: Wish,
    kept: Kept,
    pieces: ExportNumbers,
    cost: Cost,
    estimates: list[dict[str, Any]],
) -> Written:
    """Text, distance when read back, by what, warnings, distance without beta."""
    if wish.format == "urdf":
        return _urdf(calibrated, wish, kept, pieces)
    if wish.format == "mjcf":
        return _mjcf(calibrated, wish, kept, pieces)
    if wish.format in CONVENTIONS:
        return _dh(calibrated, wish, kept, pieces)
    document = parameter_document(calibrated, estimates, pieces, cost)
    if wish.format == "yaml":
        return to_yaml(document), None, "", [], None
    return json_text(document) + "\n", None, "", [], None


def _note(calibrated: CalibratedArm, wish: Wish) -> str:
    """One line for a comment in the file: where its numbers come from, what they hold for."""
    cell = calibrated.model.cell
    source = Path(calibrated.source).name
    told = f"calibrated by elastocal: {source} of {Path(cell.path).name if cell.path else 'cell'}"
    if wish.conditions.temperature is not None:
        told += f", at {wish.conditions.temperature:g} °C"
    if wish.conditions.time is not None:
        told += f", at {wish.conditions.time:g} s"
    return told


def _urdf(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: ExportNumbers) -> Written:
    from elastocal.model.urdf import read_urdf

    robot = calibrated.model.cell.robot
    note = _note(calibrated, wish)
    if robot.urdf is not None:
        text = calibrated_urdf(robot, pieces, wish.frames, note)
        base, flange = robot.base, robot.flange
        if wish.frames.base and base is None:
            from elastocal.model.urdf import check_urdf

            base = check_urdf(robot.urdf).root
    else:
        text = new_urdf(pieces, wish.frames, note)
        base, flange = BASE, FLANGE
    read = partial(read_urdf, base=base, flange=flange)
    chain = pieces.calibrated_chain()
    return text, check_chain(text, ".urdf", read, chain, kept, wish.seed), "pinocchio", [], None


def _mjcf(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: ExportNumbers) -> Written:
    cell = calibrated.model.cell
    inertias: tuple[Array, ...] = ()
    if pieces.masses and cell.robot.urdf is not None:
        inertias = link_inertias(cell.robot.urdf, pieces.chain)
    text = calibrated_mjcf(
        pieces, _note(calibrated, wish), inertias, _compensator(kept.exported), wish.frames.base
    )
    warnings = []
    if not pieces.masses:
        warnings.append(
            "the links weigh nothing in this file, as in the model it was identified with: "
            "weights would deflect the arm a second time; set [model] link_gravity = true and "
            "identify anew for an arm with weights"
        )
    springs = {s.site for s in pieces.springs if s.compliance > 0}
    rigid = [
        f"joint{i + 1}" for i in range(pieces.chain.n_joints) if f"joint{i + 1}" not in springs
    ]
    if rigid:
        warnings.append(
            f"no compliance was identified for {', '.join(rigid)}: rigid in this file "
            f"(gain {RIGID:g})"
        )
    try:
        import mujoco  # noqa: F401
    except ImportError:
        warnings.append("not read back: MuJoCo is not installed (pip install elastocal[mujoco])")
        return text, None, "", warnings, None
    distance = check_rest(text, pieces, kept, wish.frames.base, POSES_AT_REST, wish.seed)
    return text, distance, "MuJoCo, at rest under the load", warnings, None


def _compensator(part: Valued) -> dict[str, float] | None:
    """Values of the gravity compensator by key with its 0-based joint, None where there is none."""
    values = {name: v for name, v in part.values.items() if ".compensator_" in name}
    if not values:
        return None
    joint = int(next(iter(values)).partition(".")[0].removeprefix("joint")) - 1
    return {name.partition(".")[2]: v for name, v in values.items()} | {"joint": joint}


def _dh(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: ExportNumbers) -> Written:
    from elastocal.model.dh import read_dh

    convention = CONVENTIONS[wish.format]
    lines = dh_lines(calibrated.model.cell.robot, pieces, convention)
    read: Callable[[Path], Chain] = partial(read_dh, convention=convention)
    chain = pieces.calibrated_chain()
    checked = check_chain(dh_csv(lines), ".csv", read, chain, kept, wish.seed)
    comments = [
        f"{_note(calibrated, wish)}; {convention} convention: {FORMULA[convention]}",
        f"largest flange error of this table: {checked * 1e6:.2g} um",
    ]
    beta = None
    if any(line.row.beta for line in lines):
        plain = dh_csv(without_beta(lines))
        beta = check_chain(plain, ".csv", read, chain, kept, wish.seed, largest=None)
        comments.append(f"without the column beta_rad: {beta * 1e6:.3g} um")
    text = dh_csv(lines, comments)
    check_chain(text, ".csv", read, chain, kept, wish.seed)
    return text, checked, "elastocal's own reader of DH tables", [], beta


def _warnings(calibrated: CalibratedArm, cost: Cost) -> list[str]:
    found = []
    spec = calibrated.model.cell.model
    elastic = any(effect_of(choice.name).elastic for choice in spec.effects)
    if elastic and not cost.force.any() and not spec.link_gravity:
        found.append(
            f"no load is given, so compliances cost nothing here: state one with {option('load')} "
            "(N, in the tracker's axes)"
        )
    if spec.torque == "measured":
        found.append(
            "joint torques are taken from the load here, as a file has no measured torques"
        )
    if cost.unsettled:
        found.append(
            f"{cost.unsettled} of {cost.poses} random poses have no static equilibrium under the "
            "load and are left out"
        )
    return found


def _um(metres: float | None) -> float | None:
    return None if metres is None else metres * 1e6
