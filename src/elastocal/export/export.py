"""A calibrated arm written in one of the formats, checked, and with what that costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from elastocal.errors import option
from elastocal.export.check import check_chain, check_rest
from elastocal.export.cost import Cost, cost_of
from elastocal.export.dh import CONVENTIONS, FORMULA, dh_csv, dh_lines, without_beta
from elastocal.export.inertia import link_inertias
from elastocal.export.kept import Conditions, Kept, Valued, keep
from elastocal.export.mjcf import RIGID, calibrated_mjcf
from elastocal.export.parameters import (
    cost_json,
    estimates_of,
    held_values,
    parameter_document,
)
from elastocal.export.pieces import Pieces, evaluate_pieces
from elastocal.export.urdf import Frames, calibrated_urdf
from elastocal.export.urdf_new import BASE, FLANGE, new_urdf
from elastocal.export.yaml_text import to_yaml
from elastocal.manipulator.calibrated import CalibratedArm
from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.effects import effect_of
from elastocal.text import json_text

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
    pieces: Pieces,
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


def _urdf(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: Pieces) -> Written:
    from elastocal.manipulator.urdf import read_urdf

    robot = calibrated.model.cell.robot
    note = _note(calibrated, wish)
    if robot.urdf is not None:
        text = calibrated_urdf(robot, pieces, wish.frames, note)
        base, flange = robot.base, robot.flange
        if wish.frames.base and base is None:
            from elastocal.manipulator.urdf_check import check_urdf

            base = check_urdf(robot.urdf).root
    else:
        text = new_urdf(pieces, wish.frames, note)
        base, flange = BASE, FLANGE
    read = partial(read_urdf, base=base, flange=flange)
    chain = pieces.calibrated_chain()
    return text, check_chain(text, ".urdf", read, chain, kept, wish.seed), "pinocchio", [], None


def _mjcf(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: Pieces) -> Written:
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


def _dh(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: Pieces) -> Written:
    from elastocal.manipulator.dh import read_dh

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
