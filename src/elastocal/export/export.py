"""A calibrated arm written in one of the formats, read back, and with what that costs.

The formats of geometry have rooms of their own; the parameters as YAML or JSON and the smooth
functions are written here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from elastocal.above import checked_arguments
from elastocal.errors import ElastocalError, InputError, option, require
from elastocal.export import exportable, mjcf_file, rigid_files
from elastocal.export.exportable import (
    Cost,
    ExportNumbers,
    JointCorrection,
    Kept,
    Refit,
    refitted,
)
from elastocal.export.mjcf_file import MujocoRest, NotInPlace
from elastocal.files import atomic_write, together
from elastocal.identification.least_squares import t_quantile
from elastocal.model.arm import given_force
from elastocal.model.calibrated import CalibratedArm, Conditions, Valued, random_table
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.manipulator import SmoothGroup, smooth_groups
from elastocal.model.mjcf import MjcfArm
from elastocal.model.rigid import nominal_flanges
from elastocal.model.xml_file import XmlFile
from elastocal.tables import csv_text
from elastocal.text import did_you_mean, json_text, listed, plain
from elastocal.units import Array, microns, rpy_from_rotation

# The parameters as YAML or JSON, to be read by people and by programs of their own.

PARAMETERS = "elastocal/parameters/1"
KEYS = ("value", "unit", "std", "ci95", "identifiable", "combined_with", "nominal", "held", "note")


def _parameters(calibrated: CalibratedArm, pieces: ExportNumbers, cost: Cost, format: str) -> str:
    """Everything to be written: estimates, the geometry they make, and that geometry's cost.

    Joint and flange placements are those of the calibrated URDF: in the frame before, in m and
    rad (roll, pitch, yaw), offsets included, so that joint values stay commanded ones.
    """
    chain = pieces.calibrated_chain()
    cell = calibrated.model.cell

    def placed(T: Array) -> dict[str, list[float]]:
        rpy = [v + 0.0 for v in rpy_from_rotation(T[:3, :3])]
        return {"xyz_m": [float(v) + 0.0 for v in T[:3, 3]], "rpy_rad": rpy}

    document = {
        "schema": PARAMETERS,
        "robot": chain.name,
        "cell": None if cell.path is None else Path(cell.path).name,
        "result": Path(calibrated.source).name,
        "units": "SI: m, rad, N, kg",
        "parameters": [  # what an older result does not have is null
            {"name": name} | {key: plain(entry.get(key)) for key in KEYS}
            for name, entry in zip(calibrated.model.names, calibrated.entries, strict=True)
        ],
        "geometry": {
            "tracker_to_base": placed(pieces.T_tracker_base),
            "joints": [
                {"name": joint.name, "kind": joint.kind, **placed(joint.placement),
                 "axis": [float(v) for v in joint.axis]}
                for joint in chain.joints
            ],
            "flange": placed(chain.flange_placement),
            "markers": {name: placed(T) for name, T in pieces.markers.items()},
            "load_point_m": [float(v) for v in pieces.load_point],
        },
        "geometry_alone": cost.to_json(),
    }  # fmt: skip
    if format == "json":
        return json_text(document) + "\n"
    import yaml

    return str(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=np.inf))


# Smooth functions as a table: what no format of geometry holds, for controllers of one's own.

CORRECTIONS_HEADER = (
    "effect", "where", "follows", "position_deg", "time_s", "component", "unit", "value", "half95",
)  # fmt: skip
LEVEL = 0.95
PER_LENGTH = 10  # rows for each correlation length
FEWEST, MOST = 21, 5001
MICRO = {"rad": "urad", "m": "um"}


def _corrections(calibrated: CalibratedArm, wish: Wish, kept: Kept, _: ExportNumbers) -> Written:
    """Every smooth function over its range, with the half width of its 95 % band.

    A row says by how much (urad or um) the place has moved beyond its commanded or identified
    position: of a joint its angle, of a link its end frame along and about its axes (components 1
    to 6), of the base along and about the data's axes, of a marker its position in the flange
    frame.  `position_deg` or `time_s` is what it follows.  A line that begins with # says where
    the numbers come from.
    """
    groups = smooth_groups(calibrated.model)
    rows = [row for group in groups for row in _correction_rows(calibrated, group)]
    if not rows:
        raise InputError(
            f"{calibrated.source}: this arm has no smooth function to be written as corrections; "
            "elastocal diagnose finds those that the readings show"
        )
    return Written(csv_text(CORRECTIONS_HEADER, rows, [_note(calibrated, kept)]))


def _correction_rows(calibrated: CalibratedArm, group: SmoothGroup) -> Iterator[tuple[str, ...]]:
    names, place = calibrated.model.names, {n: k for k, n in enumerate(calibrated.determined)}
    if group.basis is None or not any(names[c] in place for c in group.columns.ravel()):
        return
    steps = int(np.ceil((group.high - group.low) / group.length * PER_LENGTH))
    x = group.grid(min(max(steps + 1, FEWEST), MOST))
    waves = group.basis(x)
    quantile = float(t_quantile(LEVEL, np.array(np.inf)))
    for component, (columns, unit) in enumerate(zip(group.columns, group.units, strict=True), 1):
        known = np.array([names[c] in place for c in columns])
        at = [place[names[c]] for c in columns[known]]
        own = waves[:, known]
        variance = np.einsum("nk,kl,nl->n", own, calibrated.covariance[np.ix_(at, at)], own)
        half = quantile * np.sqrt(np.maximum(variance, 0.0))
        value = waves @ calibrated.x[columns]
        for position, *sizes in zip(x, value, half, strict=True):
            angle, time = f"{np.degrees(position):.4f}", f"{position:.1f}"
            micro = (f"{size * 1e6 + 0.0:.3f}" for size in sizes)
            yield (
                group.effect, group.where, group.follows,
                *((angle, "") if group.lasting else ("", time)),
                str(component), MICRO.get(unit, unit), *micro,
            )  # fmt: skip


# Which format a file is written in: by its ending, or as asked for.

ENDINGS = {
    ".urdf": "urdf", ".xml": "mjcf", ".mjcf": "mjcf", ".csv": "dh", ".yaml": "yaml",
    ".yml": "yaml", ".json": "json",
}  # fmt: skip
FORMATS = ("urdf", "mjcf", "dh", "mdh", "yaml", "json", "corrections")
FRAMED = ("urdf", "mjcf")
FITTED = (*FRAMED, "dh", "mdh")


def format_of(path: Path, asked: str | None) -> str:
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
            f"{path}: the ending '{path.suffix}' names no known format; use one of "
            f"{', '.join(ENDINGS)}, or name it by {option('format')}: {', '.join(FORMATS)}"
        )
    return found


SCHEMA = "elastocal/export/1"


MOST_POSES = 1_000_000


@checked_arguments
@dataclass(frozen=True)
class Wish:
    """How to export an arm to `path`, checked; the others are the options of `elastocal export`.

    No format goes by the file's ending; costs are stated under `load` (3,) N at random `poses`;
    `correct_joints`: with a joint correction.
    """

    path: Path
    format: str | None = None
    load: ArrayLike | None = None
    frames: bool = True
    base_frame: bool = False
    temperature_c: float | None = None
    time_s: float | None = None
    poses: int = 500
    seed: int = 0
    correct_joints: bool = False

    def __post_init__(self) -> None:
        format_of(self.path, self.format)
        for name, low, high in (("temperature_c", -273.15, 2000.0), ("time_s", -1e9, 1e9)):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(
                    f"{option(name)} takes a number of {low:g} to {high:g}; found {value:g}"
                )
        given_force(self.load)
        require(
            2 <= self.poses <= MOST_POSES,
            f"{option('poses')} takes a whole number from 2 to {MOST_POSES:,}; found {self.poses}",
        )

    @property
    def kind(self) -> str:
        return format_of(self.path, self.format)

    @property
    def conditions(self) -> Conditions:
        force = given_force(self.load)
        force = np.zeros(3) if force is None else force
        return Conditions(force, self.time_s, self.temperature_c)


@dataclass(frozen=True)
class Written:
    """A text, its largest distance in m when read back and with what (None where it was not), what
    to know of it, and of a DH table with a column beta_rad the largest distance in m for who reads
    four columns only."""

    text: str
    checked: float | None = None
    checked_with: str = ""
    warnings: tuple[str, ...] = ()
    without_beta: float | None = None


@dataclass(frozen=True, kw_only=True)
class Exported(Written):
    """What was written, and at which cost.

    `held`: parameters that the data did not determine, with the values used; `refit`: how far the
    file is from the arm before and after what it holds was fitted to it; `correction`: where its
    joints are to be commanded besides, empty where nothing was asked for.
    """

    format: str
    cost: Cost
    held: dict[str, float]
    of_the_measurement: tuple[str, ...]
    refit: Refit | None = None
    correction: JointCorrection = field(default_factory=JointCorrection)

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": SCHEMA,
            "format": self.format,
            "cannot_hold": self.cost.to_json(),
            "refit": None if self.refit is None else self.refit.to_json(),
            "read_back": {"with": self.checked_with, "max_um": microns(self.checked)},
            "without_beta_max_um": microns(self.without_beta),
            "held": self.held,
            "of_the_measurement": list(self.of_the_measurement),
            "warnings": list(self.warnings),
        }


def export(
    calibrated: CalibratedArm, wish: Wish, progress: Callable[[str], None] = lambda _: None
) -> Exported:
    """The calibrated arm as the text of a file.

    Raises InsufficientDataError where no random pose has an equilibrium under the load, and
    ElastocalError where the text, read back, is another arm than the model.
    """
    for asked, given, formats in (
        (option("base_frame"), wish.base_frame, FRAMED),
        (option("joint_correction"), wish.correct_joints, FITTED),
    ):
        if given and wish.kind not in formats:
            raise InputError(f"{asked} goes with {listed(formats)}; found format {wish.kind}")
    # The visits measured, where they are known, count under the load that was asked for.
    visits, conditions = calibrated.visits, wish.conditions
    require(
        visits is not None or not wish.correct_joints,
        f"{calibrated.source} does not say where the arm was measured, which "
        f"{option('joint_correction')} needs; identify anew",
    )
    if visits is not None and wish.load is not None:
        visits = replace(visits, force=np.broadcast_to(conditions.force, visits.force.shape))
    conditions = replace(conditions, visits=visits)
    kept = exportable.keep(calibrated, elastic=wish.kind == "mjcf", conditions=conditions)
    refit, correction = None, JointCorrection()
    if wish.kind in FITTED:
        progress("fitting what the format holds")
        kept, refit, correction = refitted(kept, wish.poses, wish.seed, wish.correct_joints)
    pieces = exportable.evaluate_pieces(kept.exported, conditions)
    progress("what the format cannot hold")
    cost = exportable.cost_of(kept, wish.poses, wish.seed)
    progress("writing and reading back")
    if wish.kind in WRITERS:
        found = WRITERS[wish.kind](calibrated, wish, kept, pieces)
    else:
        found = Written(_parameters(calibrated, pieces, cost, wish.kind))
    # Smooth functions are zero where nothing shows them: no values that are held.
    model, entries = calibrated.model, calibrated.entries
    each = zip(model.names, entries, model.shrunk, strict=True)
    told = (*_warnings(calibrated, kept, cost), *found.warnings)
    return Exported(
        **vars(found) | {"warnings": told},
        format=wish.kind,
        cost=cost,
        held={n: plain(e.get("held")) for n, e, shrunk in each
              if not shrunk and e.get("identifiable") is not True},
        of_the_measurement=kept.of_the_measurement,
        refit=refit,
        correction=correction,
    )  # fmt: skip


def _warnings(calibrated: CalibratedArm, kept: Kept, cost: Cost) -> list[str]:
    spec, loads = calibrated.model.cell.model, len(cost.forces)
    elastic = any(effect_of(choice.name).elastic for choice in spec.effects)
    doubts = (
        (kept.fitted and loads > 1 and not kept.exported.elastic,
         f"the arm sags under its load and this file cannot: it is fitted to all {loads} loads "
         f"measured; state {option('load')} for the one that it is for"),
        (elastic and not cost.forces.any() and not spec.link_gravity,
         f"no load is given, so compliances cost nothing here: state one with {option('load')} "
         "(N, in the tracker's axes)"),
        (spec.torque == "measured",
         "joint torques are taken from the load here, as a file has no measured torques"),
        (cost.unsettled, f"{cost.unsettled} of {cost.poses} random poses have no static "
         "equilibrium under the load and are left out"),
    )  # fmt: skip
    return [told for so, told in doubts if so]


def write(done: Exported, path: Path, correction: str | Path | None) -> None:
    """The file, and where it is asked for its joint correction: both or none."""
    with together():
        atomic_write(path, done.text)
        if correction is not None:
            told = f"q_effective = q + the deltas of its joint, for {path.name}; SI: rad or m"
            atomic_write(correction, done.correction.csv([told]))


# Each format written, and read back by the library that users read it with before it is kept.

LARGEST = 1e-8  # m; a hundred times the rounding of a chain of a few metres
LARGEST_AT_REST = 1e-6  # m
POSES_AT_REST = 20
# Origin and points 0.1 m along the flange's axes, homogeneous (4, 4).
CORNERS = np.vstack([np.hstack([np.zeros((3, 1)), 0.1 * np.eye(3)]), np.ones((1, 4))])


def _apart(found: Array, expected: Array, largest: float = LARGEST) -> float:
    """Largest distance in m between flanges (n, 4, 4), of origin and points on the axes, so that
    orientations count.  Raises ElastocalError where it is more than `largest`."""
    apart = (found - expected)[:, :3] @ CORNERS
    return _accepted(float(np.linalg.norm(apart, axis=1).max()), largest)


def _accepted(distance: float, largest: float) -> float:
    if not distance <= largest:
        raise ElastocalError(
            f"the written file, read back, is {distance * 1e6:.3g} µm from the model and was not "
            "kept; please report this robot description"
        )
    return distance


def _check_rest(
    at_rest: Callable[[Array, Array], Array], pieces: ExportNumbers, kept: Kept,
    T_world_base: Array, seed: int,
) -> float:  # fmt: skip
    """Largest distance in m of flange and markers between MuJoCo at rest and the exported model.

    `at_rest`: `pieces.points` (k, 3) in the MJCF's world by commanded joints and force;
    `T_world_base` (4, 4) there.  Raises ElastocalError where they differ.
    """
    part = kept.exported
    table = random_table(kept.full.model, kept.conditions, POSES_AT_REST, seed)
    placed = T_world_base @ np.linalg.inv(pieces.T_tracker_base)
    expected = placed @ part.model.flange_poses(table, part.x)
    worst = 0.0
    for q, force, T in zip(table.q, table.force, expected, strict=True):
        if np.isfinite(T).all():
            away = at_rest(q, force) - (pieces.points @ T[:3, :3].T + T[:3, 3])
            worst = max(worst, float(np.linalg.norm(away, axis=1).max()))
    return _accepted(worst, LARGEST_AT_REST)


def _note(calibrated: CalibratedArm, kept: Kept) -> str:
    conditions = kept.conditions
    cell = calibrated.model.cell
    source = Path(calibrated.source).name
    told = f"calibrated by elastocal: {source} of {Path(cell.path).name if cell.path else 'cell'}"
    if conditions.temperature is not None:
        told += f", at {conditions.temperature:g} °C"
    if conditions.time is not None:
        told += f", at {conditions.time:g} s"
    if kept.fitted and conditions.visits is not None:
        sizes = np.linalg.norm(conditions.visits.force, axis=1)
        low, high = f"{sizes.min():.4g}", f"{sizes.max():.4g}"
        span = high if low == high else f"{low} to {high}"
        told += f", fitted where it was measured, under {span} N"
    return told


def _urdf(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: ExportNumbers) -> Written:
    from elastocal.model.urdf import check_urdf, tree_of

    robot = calibrated.model.cell.robot
    note = _note(calibrated, kept)
    added = wish.frames, wish.base_frame
    if robot.urdf is not None:
        text = rigid_files.calibrated_urdf(robot, pieces, *added, note)
        text, told = rigid_files.moved(robot.urdf, text, wish.path.parent)
        base, flange = check_urdf(robot.urdf).ends(robot.base, robot.flange, choose=False)
    else:
        text = rigid_files.new_urdf(pieces, *added, note)
        base, flange = rigid_files.BASE, rigid_files.FLANGE
        told = [
            "inertia tensors are zero in this file: of the links masses and their centres alone "
            "are known. Its kinematics and weights are right; before simulating motion put in "
            "tensors"
            + ("" if robot.mjcf is None else ", or export as .xml, which keeps those of the model")
            if pieces.nominal_masses
            else "the links have no <inertial> in this file, as their masses are not known"
        ]
    back = tree_of(XmlFile(Path("written.urdf"), text.encode(), "a URDF")).chain(base, flange)
    q = random_table(kept.full.model, kept.conditions, 100, wish.seed).q
    chain = pieces.calibrated_chain()
    expected = nominal_flanges(chain, q)
    apart = _apart(nominal_flanges(back, q), expected)
    try:
        found = rigid_files.urdf_flanges(
            text, [joint.name for joint in chain.joints], base, flange, q
        )
    except (ValueError, RuntimeError) as error:  # pinocchio's own
        refused = (
            "pinocchio's own reader refuses this file, as it does without the corrections "
            f"({str(error).strip().splitlines()[0]}); only elastocal's has read it back"
        )
        return Written(text, apart, "elastocal's reader of URDF", (*told, refused))
    return Written(text, max(apart, _apart(found, expected)), "pinocchio", tuple(told))


def _mjcf(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: ExportNumbers) -> Written:
    robot, warnings = calibrated.model.cell.robot, []
    if robot.mjcf is not None:
        try:
            return _corrected(calibrated, wish, kept, pieces)
        except NotInPlace as reason:
            warnings.append(
                f"{robot.mjcf.name} itself cannot take the corrections: {reason}; this file is a "
                "new one with the arm alone"
            )
    inertias: tuple[Array, ...] = ()
    if pieces.masses and robot.urdf is not None:
        inertias = exportable.link_inertias(robot.urdf, pieces.chain)
    text = mjcf_file.calibrated_mjcf(
        pieces, _note(calibrated, kept), inertias, _compensator(kept.exported), wish.base_frame
    )
    if not pieces.masses:
        warnings.append(
            "the links weigh nothing in this file, as in the model it was identified with: "
            "weights would deflect the arm a second time; set [model] link_gravity = true and "
            "identify anew for an arm with weights"
        )
    warnings += _rigid_joints(pieces, f" (gain {mjcf_file.RIGID:g})")
    try:
        import mujoco  # noqa: F401
    except ImportError:
        warnings.append("not read back: MuJoCo is not installed (pip install elastocal[mujoco])")
        return Written(text, warnings=tuple(warnings))
    names = ["flange", *(f"marker_{name}" for name in pieces.markers)]
    placed = pieces.T_tracker_base if wish.base_frame else np.eye(4)
    at_rest = partial(MujocoRest(text).sites, names=names)
    distance = _check_rest(at_rest, pieces, kept, placed, wish.seed)
    return Written(text, distance, "MuJoCo, at rest under the load", tuple(warnings))


def _corrected(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: ExportNumbers) -> Written:
    cell = calibrated.model.cell
    if wish.base_frame:
        raise NotInPlace(f"{option('base_frame')} makes the tracker's frame the world")
    if _compensator(kept.exported) is not None:
        raise NotInPlace("it has no gravity compensator")
    if pieces.masses and not cell.model.link_gravity:
        raise NotInPlace("weights were identified without those of the file (link_gravity = false)")
    text, warnings = mjcf_file.corrected_mjcf(
        cell.robot, pieces, wish.frames, _note(calibrated, kept)
    )
    robot, added = cell.robot, mjcf_file.FLANGE
    assert robot.mjcf is not None
    flange = added if f'name="{added}"' in text else robot.flange
    arm = MjcfArm.read(robot.mjcf, robot.base, flange, text)
    if not pieces.masses:
        arm.model.opt.gravity[:] = 0.0
    at_rest = partial(MujocoRest(text, arm).points, pieces=pieces)
    distance = _check_rest(at_rest, pieces, kept, arm.tree.placed(arm.base), wish.seed)
    if pieces.springs and not pieces.masses:
        warnings.append(
            "the links weigh in this file and did not in the model that was identified: their "
            "weights deflect the springs a second time; set [model] link_gravity = true and "
            "identify anew, or switch gravity off in the file"
        )
    if pieces.springs:
        warnings += _rigid_joints(pieces, "")
        warnings.append(
            "the springs stand in series with the joints: hold those by stiff actuators, whose "
            "own error would come on top"
        )
    text, told = rigid_files.moved(robot.mjcf, text, wish.path.parent)
    return Written(text, distance, "MuJoCo, at rest under the load", (*warnings, *told))


def _rigid_joints(pieces: ExportNumbers, how: str) -> list[str]:
    springs = {s.site for s in pieces.springs}
    joints = [f"joint{i + 1}" for i in range(pieces.chain.n_joints)]
    rigid = ", ".join(joint for joint in joints if joint not in springs)
    return [f"no compliance was identified for {rigid}: rigid in this file{how}"] if rigid else []


def _compensator(part: Valued) -> dict[str, float] | None:
    """Values of the gravity compensator by key with its 0-based joint, None where there is none."""
    values = {name: v for name, v in part.values.items() if ".compensator_" in name}
    if not values:
        return None
    joint = int(next(iter(values)).partition(".")[0].removeprefix("joint")) - 1
    return {name.partition(".")[2]: v for name, v in values.items()} | {"joint": joint}


def _dh(calibrated: CalibratedArm, wish: Wish, kept: Kept, pieces: ExportNumbers) -> Written:
    from elastocal.model.dh import read_dh

    convention = rigid_files.CONVENTIONS[wish.kind]
    lines = rigid_files.dh_lines(calibrated.model.cell.robot, pieces, convention)
    q = random_table(kept.full.model, kept.conditions, 100, wish.seed).q
    expected = nominal_flanges(pieces.calibrated_chain(), q)

    def checked(text: str, largest: float = LARGEST) -> float:
        with tempfile.TemporaryDirectory() as folder:
            (path := Path(folder) / "written.csv").write_text(text, encoding="utf-8")
            return _apart(nominal_flanges(read_dh(path, convention), q), expected, largest)

    apart, beta = checked(rigid_files.dh_csv(lines)), None
    comments = [
        f"{_note(calibrated, kept)}; {convention} convention: {rigid_files.FORMULA[convention]}",
        f"rounding of this table: {apart * 1e6:.2g} um at the flange",
    ]
    if any(row[4] for _, _, row in lines):
        four = [(name, joint, row * [1, 1, 1, 1, 0]) for name, joint, row in lines]
        beta = checked(rigid_files.dh_csv(four), largest=np.inf)
        comments.append(f"without the column beta_rad: {beta * 1e6:.3g} um")
    text = rigid_files.dh_csv(lines, comments)
    checked(text)
    return Written(text, apart, "elastocal's own reader of DH tables", (), beta)


WRITERS = {"urdf": _urdf, "mjcf": _mjcf, "dh": _dh, "mdh": _dh, "corrections": _corrections}
