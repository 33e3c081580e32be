"""A calibrated arm written in one of the formats, read back, and with what that costs; DH tables,
parameters and smooth functions are made here, URDF and MJCF in robot_files."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from elastocal import messages
from elastocal.above import checked_arguments
from elastocal.cell_tables import Convention, Robot
from elastocal.export import exportable, robot_files
from elastocal.export.robot_files import MujocoRest, NotInPlace
from elastocal.files import atomic_write, together
from elastocal.identification.least_squares import t_quantile
from elastocal.measurements import Measurements
from elastocal.messages import ElastocalError, listed, option, plain, require, rounded
from elastocal.model import dh
from elastocal.model.calibrated import CalibratedArm, Conditions, random_table
from elastocal.model.chain import Chain, Joint
from elastocal.model.effects.base import given_force, transverse_axes
from elastocal.model.manipulator import smooth_groups
from elastocal.model.mjcf import MjcfArm
from elastocal.model.rigid import nominal_flanges
from elastocal.model.urdf import XmlFile, check_urdf, tree_of
from elastocal.tables import csv_text
from elastocal.units import Array, microns, pose_at, rpy_from_rotation

ENDINGS = {
    ".urdf": "urdf", ".xml": "mjcf", ".mjcf": "mjcf", ".csv": "dh", ".yaml": "yaml",
    ".yml": "yaml", ".json": "json",
}  # fmt: skip
FORMATS = ("urdf", "mjcf", "dh", "mdh", "yaml", "json", "corrections")
FRAMED = ("urdf", "mjcf")
FITTED = (*FRAMED, "dh", "mdh")

SCHEMA = "elastocal/export/1"
MOST_POSES = 1_000_000


@checked_arguments
@dataclass(frozen=True)
class Wish:
    """How to export an arm to `path`: the options of `elastocal export`, checked; costs are stated
    under `load` (3,) N at random `poses`; `correct_joints`: with a joint correction."""

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
        _ = self.kind
        for name, low, high in (("temperature_c", -273.15, 2000.0), ("time_s", -1e9, 1e9)):
            if (value := getattr(self, name)) is not None:
                told = f"{option(name)} takes a number of {low:g} to {high:g}; found {value:g}"
                require(low <= value <= high, told)
        given_force(self.load)
        told = f"takes a whole number from 2 to {MOST_POSES:,}; found {self.poses}"
        require(2 <= self.poses <= MOST_POSES, f"{option('poses')} {told}")

    @property
    def kind(self) -> str:
        """The format: as asked for, or by the file's ending."""
        ending, known = ENDINGS.get(self.path.suffix.lower(), ""), ", ".join(FORMATS)
        found = ending if self.format is None else self.format.lower()
        told = f"the ending '{self.path.suffix}' names no known format; use one of"
        ways = f"{', '.join(ENDINGS)}, or name it by {option('format')}: {known}"
        require(self.format is not None or ending, f"{self.path}: {told} {ways}")
        told = f"takes one of {known}; found '{self.format}'{messages.did_you_mean(found, FORMATS)}"
        require(found in FORMATS, f"{option('format')} {told}")
        return found


@dataclass(frozen=True)
class Exported:
    """What was written, and at which cost.

    `held`: parameters that the data did not determine, with the values used; `undetermined`: those
    of them in no sum that is known, which other poses would show; `by_prior`: those that owe more
    to a prior; `refit`: how far the file is from the arm before and after what it holds
    was fitted to it; `correction`: where its joints are to be commanded besides, empty where
    nothing was asked for; `T_tracker_base` (4, 4) goes with what the file holds, which has a place
    for it where it is `framed`; `checked`: the largest distance in m when it was read back with
    `checked_with`, None where it was not; `without_beta`: of a DH table with a column beta_rad that
    in m for who reads four columns only.
    """

    format: str
    cost: exportable.Cost
    held: dict[str, float]
    undetermined: tuple[str, ...]
    by_prior: tuple[str, ...]
    of_the_measurement: tuple[str, ...]
    refit: exportable.Refit | None
    correction: exportable.JointCorrection
    T_tracker_base: Array
    framed: bool
    warnings: tuple[str, ...]
    text: str
    checked: float | None = None
    checked_with: str = ""
    without_beta: float | None = None

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": SCHEMA,
            "format": self.format,
            "cannot_hold": self.cost,
            "refit": self.refit,
            "tracker_to_base": placed(self.T_tracker_base),
            "read_back": {"with": self.checked_with, "max_um": microns(self.checked)},
            "without_beta_max_um": microns(self.without_beta),
            "held": self.held,
            "by_prior": self.by_prior,
            "of_the_measurement": self.of_the_measurement,
            "warnings": self.warnings,
        }


def export(
    calibrated: CalibratedArm, wish: Wish, progress: Callable[[str], None] = lambda _: None
) -> Exported:
    """Raises InsufficientDataError where no random pose has an equilibrium under the load, and
    ElastocalError where the text, read back, is another arm than the model."""
    for asked, given, formats in (
        (option("base_frame"), wish.base_frame, FRAMED),
        (option("joint_correction"), wish.correct_joints, FITTED),
    ):
        said = f"{asked} goes with {listed(formats)}; found format {wish.kind}"
        require(not given or wish.kind in formats, said)
    # The visits measured, where they are known, count under the load that was asked for.
    visits, force = calibrated.visits, given_force(wish.load)
    known = visits is not None or not wish.correct_joints
    lack = f"does not say where the arm was measured, which {option('joint_correction')} needs;"
    require(known, f"{calibrated.source} {lack} identify anew")
    if visits is not None and force is not None:
        visits = replace(visits, force=np.broadcast_to(force, visits.force.shape))
    force = np.zeros(3) if force is None else force
    conditions = Conditions(force, wish.time_s, wish.temperature_c, visits)
    kept = exportable.keep(calibrated, elastic=wish.kind == "mjcf", conditions=conditions)
    refit, correction = None, exportable.JointCorrection()
    if wish.kind in FITTED:
        progress("fitting what the format holds")
        kept, refit, correction = exportable.refitted(
            kept, wish.poses, wish.seed, wish.correct_joints
        )
    pieces = exportable.evaluate_pieces(kept.exported, conditions)
    progress("what the format cannot hold")
    cost = exportable.cost_of(kept, wish.poses, wish.seed)
    progress("writing and reading back")
    # Smooth functions are zero where nothing shows them: no values that are held.
    each = zip(calibrated.model.parameters, calibrated.entries, strict=True)
    held = {p.name: plain(e.get("held")) for p, e in each
            if not p.shrunk and e.get("identifiable") is not True}  # fmt: skip
    left, of = calibrated.left, dict(zip(calibrated.model.names, calibrated.entries, strict=True))
    lost = set(left.names) if left else set[str]()
    summed = {n for n, e in of.items() if n not in lost and e.get("combined_with")}
    alone = [n for n in held if n not in summed.union(left.redundant if left else ())]
    spec, loads = calibrated.model.cell.model, len(cost.forces)
    fitted = refit is not None and refit.taken
    doubts = (
        (fitted and loads > 1 and not kept.exported.elastic,
         f"the arm sags under its load and this file cannot: it is fitted to all {loads} loads "
         f"measured; state {option('load')} for the one that it is for"),
        (calibrated.elastic and wish.load is None and not cost.forces.any()
         and not spec.link_gravity,
         f"no load is given, so compliances cost nothing here: state one with {option('load')} "
         "(N, in the tracker's axes)"),
        (calibrated.untried(cost.forces), calibrated.untried(cost.forces)),
        (spec.torque == "measured",
         "joint torques are taken from the load here, as a file has no measured torques"),
        (cost.unsettled, f"{cost.unsettled} of {cost.poses} random poses have no static "
         "equilibrium under the load and are left out"),
    )  # fmt: skip
    told = [*calibrated.doubted, *(text for so, text in doubts if so)]
    format = {"mdh": "dh", "yaml": "parameters", "json": "parameters"}.get(wish.kind, wish.kind)
    made = getattr(_Writing(calibrated, wish, kept, pieces, cost, fitted), format)()
    warnings = (*told, *made.pop("warnings", ()))
    return Exported(
        wish.kind, cost, held, tuple(alone), calibrated.by_prior, kept.of_the_measurement, refit,
        correction, pieces.T_tracker_base, wish.base_frame, warnings, **made,
    )  # fmt: skip


def placed(T: Array) -> dict[str, list[float]]:
    """A placement (4, 4) as m and rad (roll, pitch, yaw)."""
    rpy = [v + 0.0 for v in rpy_from_rotation(T[:3, :3])]
    return {"xyz_m": [float(v) + 0.0 for v in T[:3, 3]], "rpy_rad": rpy}


def base_told(T: Array) -> str:
    xyz, rpy = (" ".join(str(round(v, 9) + 0.0) for v in each) for each in placed(T).values())
    return f"with its base at xyz {xyz} m, rpy {rpy} rad in the tracker's frame"


def write(done: Exported, path: Path, correction: str | Path | None) -> None:
    """The file, and where it is asked for its joint correction: both or none."""
    with together():
        atomic_write(path, done.text)
        if correction is not None:
            told = f"q_effective = q + the deltas of its joint, for {path.name}; SI: rad or m"
            atomic_write(correction, done.correction.csv([told]))


PARAMETERS = "elastocal/parameters/1"
KEYS = ("value", "unit", "std", "ci95", "identifiable", "combined_with", "nominal", "held", "note")
CORRECTIONS_HEADER = (
    "effect", "where", "follows", "position_deg", "time_s", "component", "unit", "value", "half95",
)  # fmt: skip
LEVEL = 0.95
PER_LENGTH = 10  # rows for each correlation length
FEWEST, MOST = 21, 5001
MICRO = {"rad": "urad", "m": "um"}
LARGEST = 1e-8  # m; a hundred times the rounding of a chain of a few metres
LARGEST_AT_REST = 1e-6  # m
POSES_AT_REST = 20
# Origin and points 0.1 m along the flange's axes, homogeneous (4, 4).
CORNERS = np.vstack([np.hstack([np.zeros((3, 1)), 0.1 * np.eye(3)]), np.ones((1, 4))])


Made = dict[str, Any]  # of `Exported`: the text, and what its format alone says


@dataclass(frozen=True)
class _Writing:
    """One arm in the formats there are, read back by the library that users read it with."""

    calibrated: CalibratedArm
    wish: Wish
    kept: exportable.Kept
    pieces: exportable.ExportNumbers
    cost: exportable.Cost
    fitted: bool

    def parameters(self) -> Made:
        """Estimates, the geometry they make, and that geometry's cost.  Joint and flange placements
        are those of the calibrated URDF: in the frame before, in m and rad (roll, pitch, yaw),
        offsets included, so that joint values stay commanded ones."""
        pieces, model = self.pieces, self.calibrated.model
        chain, cell = pieces.calibrated_chain(), model.cell
        document = plain({
            "schema": PARAMETERS,
            "robot": chain.name,
            "cell": None if cell.path is None else Path(cell.path).name,
            "result": Path(self.calibrated.source).name,
            "doubt": self.calibrated.doubt,
            "units": "SI: m, rad, N, kg",
            "parameters": [  # what an older result does not have is null
                {"name": name} | {key: entry.get(key) for key in KEYS}
                for name, entry in zip(model.names, self.calibrated.entries, strict=True)
            ],
            "geometry": {
                "tracker_to_base": placed(pieces.T_tracker_base),
                "joints": [
                    {"name": joint.name, "kind": joint.kind, **placed(joint.placement),
                     "axis": joint.axis}
                    for joint in chain.joints
                ],
                "flange": placed(chain.flange_placement),
                "markers": {name: placed(T) for name, T in pieces.markers.items()},
                "load_point_m": pieces.load_point,
            },
            "geometry_alone": self.cost,
        })  # fmt: skip
        if self.wish.kind == "json":
            return {"text": messages.json_text(document) + "\n"}
        import yaml

        text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=np.inf)
        return {"text": text}

    def corrections(self) -> Made:
        """Every smooth function over its range, with the half width of its 95 % band.  A row says
        by how much (urad or um) the place has moved beyond its commanded or identified position: of
        a joint its angle, of a link its end frame along and about its axes (components 1 to 6), of
        the base along and about the data's axes, of a marker its position in the flange frame.
        `position_deg` or `time_s` is what it follows."""
        arm, rows = self.calibrated, list[tuple[str, ...]]()
        quantile = float(t_quantile(LEVEL, np.array(np.inf)))
        at = [arm.model.names.index(name) for name in arm.determined]
        covariance = np.zeros((len(arm.x), len(arm.x)))
        covariance[np.ix_(at, at)] = arm.covariance
        for group in smooth_groups(arm.model):
            if not group.follows or not np.isin(group.columns, at).any():
                continue
            steps = int(np.ceil((group.high - group.low) / group.length * PER_LENGTH))
            x = np.linspace(group.low, group.high, min(max(steps + 1, FEWEST), MOST))
            waves = group.waves.at(x)
            for number, (columns, unit) in enumerate(zip(group.columns, group.units, strict=True)):
                own = covariance[np.ix_(columns, columns)]
                variance = np.einsum("nk,kl,nl->n", waves, own, waves)
                half = quantile * np.sqrt(np.maximum(variance, 0.0))
                for position, *sizes in zip(x, waves @ arm.x[columns], half, strict=True):
                    angle, time = f"{np.degrees(position):.4f}", f"{position:.1f}"
                    micro = (f"{size * 1e6 + 0.0:.3f}" for size in sizes)
                    rows.append((
                        group.effect, group.where, group.follows,
                        *((angle, "") if group.lasting else ("", time)),
                        str(number + 1), MICRO.get(unit, unit), *micro,
                    ))  # fmt: skip
        told = "this arm has no smooth function to be written as corrections; elastocal diagnose"
        require(rows, f"{arm.source}: {told} finds those that the readings show")
        return {"text": csv_text(CORRECTIONS_HEADER, rows, [self.note])}

    @property
    def note(self) -> str:
        conditions, cell = self.kept.conditions, self.calibrated.model.cell
        source = Path(self.calibrated.source).name
        of = Path(cell.path).name if cell.path else "cell"
        told = f"calibrated by elastocal: {source} of {of}"
        if conditions.temperature is not None:
            told += f", at {conditions.temperature:g} °C"
        if conditions.time is not None:
            told += f", at {conditions.time:g} s"
        if self.fitted and conditions.visits is not None:
            sizes = np.linalg.norm(conditions.visits.force, axis=1)
            low, high = rounded(sizes.min(), 4), rounded(sizes.max(), 4)
            span = high if low == high else f"{low} to {high}"
            told += f", fitted where it was measured, under {span} N"
            told += f", {base_told(self.pieces.T_tracker_base)}"
        return "; ".join(filter(None, (told, self.calibrated.doubt)))

    def random(self, poses: int) -> Measurements:
        return random_table(self.kept.full.model, self.kept.conditions, poses, self.wish.seed)

    def urdf(self) -> Made:
        robot, q = self.calibrated.model.cell.robot, self.random(100).q
        how = self.pieces, self.wish.frames, self.wish.base_frame, self.note
        if robot.urdf is not None:
            text = robot_files.calibrated_urdf(robot, *how)
            text, told = robot_files.moved(robot.urdf, text, self.wish.path.parent)
            ends = check_urdf(robot.urdf).ends(robot.base, robot.flange, choose=False)
        else:
            text, ends = robot_files.new_urdf(*how), robot_files.NEW_ENDS
            kept = ", or export as .xml, which keeps those of the model" * (robot.mjcf is not None)
            told = [
                "inertia tensors are zero in this file: of the links masses and their centres "
                "alone are known. Its kinematics and weights are right; before simulating motion "
                f"put in tensors{kept}"
                if self.pieces.masses or self.pieces.chain.masses
                else "the links have no <inertial> in this file, as their masses are not known"
            ]
        chain, reader = self.pieces.calibrated_chain(), "pinocchio"
        try:
            found = robot_files.urdf_flanges(text, [j.name for j in chain.joints], *ends, q)
        except (ValueError, RuntimeError) as error:  # pinocchio's own
            told.append(
                "pinocchio's own reader refuses this file, as it does without the corrections "
                f"({str(error).strip().splitlines()[0]}); only elastocal's has read it back"
            )
            back = tree_of(XmlFile(Path("written.urdf"), text.encode(), "a URDF"))
            found, reader = nominal_flanges(back.chain(*ends), q), "elastocal's reader of URDF"
        apart = _apart(found, nominal_flanges(chain, q))
        return {"text": text, "warnings": told, "checked": apart, "checked_with": reader}

    def mjcf(self) -> Made:
        robot, pieces, warnings = self.calibrated.model.cell.robot, self.pieces, []
        if robot.mjcf is not None:
            try:
                return self.corrected(robot.mjcf)
            except NotInPlace as reason:
                warnings.append(
                    f"{robot.mjcf.name} itself cannot take the corrections: {reason}; this file is "
                    "a new one with the arm alone"
                )
        text = robot_files.calibrated_mjcf(robot, pieces, self.wish.base_frame, self.note)
        if not pieces.masses:
            warnings.append(
                "the links weigh nothing in this file, as in the model it was identified with: "
                "weights would deflect the arm a second time; set [model] link_gravity = true and "
                "identify anew for an arm with weights"
            )
        warnings += self.rigid_joints(f" (gain {robot_files.RIGID:g})")
        if find_spec("mujoco") is None:
            lack = "not read back: MuJoCo is not installed (pip install elastocal[mujoco])"
            return {"text": text, "warnings": [*warnings, lack]}
        placed = pieces.T_tracker_base if self.wish.base_frame else np.eye(4)
        return {"text": text, "warnings": warnings} | self.at_rest(MujocoRest(text), placed)

    def corrected(self, path: Path) -> Made:
        cell, pieces = self.calibrated.model.cell, self.pieces
        if self.wish.base_frame:
            raise NotInPlace(f"{option('base_frame')} makes the tracker's frame the world")
        if pieces.compensator:
            raise NotInPlace("it has no gravity compensator")
        if pieces.masses and not cell.model.link_gravity:
            how = "without those of the file (link_gravity = false)"
            raise NotInPlace(f"weights were identified {how}")
        text, warnings = robot_files.corrected_mjcf(cell.robot, pieces, self.wish.frames, self.note)
        flange = robot_files.FLANGE if f'name="{robot_files.FLANGE}"' in text else cell.robot.flange
        arm = MjcfArm.read(path, cell.robot.base, flange, text)
        if not pieces.masses:
            arm.model.opt.gravity[:] = 0.0
        read = self.at_rest(MujocoRest(text, arm), arm.tree.placed(arm.base))
        if pieces.springs and not pieces.masses:
            warnings.append(
                "the links weigh in this file and did not in the model that was identified: their "
                "weights deflect the springs a second time; set [model] link_gravity = true and "
                "identify anew, or switch gravity off in the file"
            )
        if pieces.springs:
            warnings += self.rigid_joints("")
            warnings.append(
                "the springs stand in series with the joints: hold those by stiff actuators, whose "
                "own error would come on top"
            )
        text, told = robot_files.moved(path, text, self.wish.path.parent)
        return {"text": text, "warnings": [*warnings, *told]} | read

    def rigid_joints(self, how: str) -> list[str]:
        springs, model = {s.site for s in self.pieces.springs}, self.kept.exported.model
        sites = (f"joint{i + 1}" for i in range(model.chain.n_joints))
        rigid: dict[str, list[str]] = {}
        for joint in (site for site in sites if site not in springs):
            asked = f"{joint}.compliance" in model.names
            why = "no compliance was identified for" if asked else "the cell fits no compliance of"
            rigid.setdefault(why, []).append(joint)
        return [f"{why} {', '.join(of)}: rigid in this file{how}" for why, of in rigid.items()]

    def at_rest(self, rest: MujocoRest, T_world_base: Array) -> Made:
        """Largest distance in m of flange and markers between MuJoCo at rest and the exported
        model, whose base is at `T_world_base` (4, 4) in the MJCF's world."""
        part, pieces, table = self.kept.exported, self.pieces, self.random(POSES_AT_REST)
        placed = T_world_base @ np.linalg.inv(pieces.T_tracker_base)
        expected = placed @ part.model.flange_poses(table, part.x)
        worst = 0.0
        for q, force, T in zip(table.q, table.force, expected, strict=True):
            if np.isfinite(T).all():
                away = rest.points(q, force, pieces) - (pieces.points @ T[:3, :3].T + T[:3, 3])
                worst = max(worst, float(np.linalg.norm(away, axis=1).max()))
        checked = _accepted(worst, LARGEST_AT_REST)
        return {"checked": checked, "checked_with": "MuJoCo, at rest under the load"}

    def dh(self) -> Made:
        convention, q = CONVENTIONS[self.wish.kind], self.random(100).q
        lines = dh_lines(self.calibrated.model.cell.robot, self.pieces, convention)
        expected = nominal_flanges(self.pieces.calibrated_chain(), q)

        def checked(text: str, largest: float = LARGEST) -> float:
            with tempfile.TemporaryDirectory() as folder:
                (path := Path(folder) / "written.csv").write_text(text, encoding="utf-8")
                return _apart(nominal_flanges(dh.read_dh(path, convention), q), expected, largest)

        apart, beta = checked(dh_csv(lines)), None
        comments = [
            f"{self.note}; {convention} convention: {FORMULA[convention]}",
            f"rounding of this table: {rounded(apart * 1e6, 2)} um at the flange",
        ]
        if any(row[4] for _, _, row in lines):
            four = [(name, joint, row * [1, 1, 1, 1, 0]) for name, joint, row in lines]
            beta = checked(dh_csv(four), largest=np.inf)
            comments.append(f"without the column beta_rad: {rounded(beta * 1e6)} um")
        checked(text := dh_csv(lines, comments))
        reader = "elastocal's own reader of DH tables"
        return {"text": text, "checked": apart, "checked_with": reader, "without_beta": beta}


def _apart(found: Array, expected: Array, largest: float = LARGEST) -> float:
    """Largest distance in m between flanges (n, 4, 4), of origin and points on the axes, so that
    orientations count."""
    apart = (found - expected)[:, :3] @ CORNERS
    return _accepted(float(np.linalg.norm(apart, axis=1).max()), largest)


def _accepted(distance: float, largest: float) -> float:
    if not distance <= largest:
        told = f"read back, is {messages.length(distance)} from the model and was not kept"
        raise ElastocalError(f"the written file, {told}; please report this robot description")
    return distance


# A link between two joint axes as Denavit–Hartenberg parameters.
#
# Every rigid transform between two frames whose z are joint axes is
#
#     T = Rz(θ) Tz(d) Tx(a) Rx(α) · Rz(γ) Tz(h)                 axes not parallel
#     T = Rz(θ) Tz(d) Tx(a) Rx(α) Ry(β) · Rz(γ) Tz(h)     nearly parallel, d chosen (Hayati)
#
# Rz(γ) Tz(h) commutes with the motion of the next joint and goes into its θ and d.  So n links are
# n rows and one remainder at the flange, exactly.  (Denavit and Hartenberg, J. Appl. Mech. 1955;
# Hayati, IEEE Conference on Decision and Control 1983.)

# Below this angle between two axes (rad) the foot of their common normal runs away with the
# smallest error, a/α away; Hayati's parameter keeps it in place.
NEARLY_PARALLEL = 0.02
ARE_ANGLES, TRAILING = np.array([1, 0, 0, 1, 1]), np.array([0, 0, 1, 1, 1])
NO_ROW = np.zeros(5)  # a row is θ, d, a, α and Hayati's β, in rad and m


def transform(row: Array) -> Array:
    return np.matmul(*dh.link(*row.tolist()))


def turned_as(row: Array, other: Array) -> Array:
    return row + 2 * np.pi * np.round((other - row) / (2 * np.pi)) * ARE_ANGLES


def near(row: Array, other: Array, tolerance: float = 1e-12) -> Array:
    """The row with the other's number wherever the two agree to rounding."""
    return np.where(np.abs(row - other) < tolerance, other, row)


def split(T: Array, like: Array | None = None, height: float = 0.0) -> tuple[Array, Array]:
    """The row of T (4, 4) and the remainder Rz(γ) Tz(h), so that T = row · remainder.  (θ, a, α)
    and (θ ± π, −a, −α) say the same: taken is the one closer to `like`, else the one with the
    smaller θ.  Turns of `like` beyond π are kept.  Of nearly parallel axes d is that of `like`,
    else `height`."""
    alike, height = (0.0, height) if like is None else like[:2].tolist()
    ways = [_row(T, sign, height, alike) for sign in (1.0, -1.0)]

    def away(row: Array) -> float:
        if like is None:
            return float(abs(row[0]) - 1e-9 * row[2])
        turns = 1 - np.cos(row[[0, 3]] - like[[0, 3]])
        return float(turns.sum() + abs(row[2] - like[2]))

    row = min(ways, key=away)
    row = row if like is None else turned_as(row, like)
    return row, np.asarray(np.linalg.solve(transform(row), T), dtype=np.float64)


def _row(T: Array, sign: float, d: float, alike: float) -> Array:
    """With its d, and `alike` as θ where any will do, where the axes are nearly parallel."""
    z, p = T[:3, 2], T[:3, 3]
    if (across := math.hypot(z[0], z[1])) > NEARLY_PARALLEL:
        theta = math.atan2(sign * z[0], -sign * z[1])
        x = np.array([math.cos(theta), math.sin(theta), 0.0])
        # p = d·z₀ + a·x + h·z: the common normal meets both axes.
        d, a, _ = np.linalg.solve(np.column_stack([[0.0, 0.0, 1.0], x, z]), p)
        return np.array([theta, d, a, math.atan2(sign * across, z[2]), 0.0])
    foot = p - (p[2] - d) / z[2] * z  # where the second axis passes through the height d
    a = sign * math.hypot(foot[0], foot[1])
    theta = math.atan2(sign * foot[1], sign * foot[0])
    if abs(a) < 1e-12:  # one axis in the other's line: any direction will do
        theta, a = alike, 0.0
    # z = Rz(θ) Rx(α) Ry(β) e_z = Rz(θ) (sin β, −sin α cos β, cos α cos β)
    c, s = math.cos(theta), math.sin(theta)
    x, y = c * z[0] + s * z[1], c * z[1] - s * z[0]
    return np.array([theta, d, a, math.atan2(-y, z[2]), math.atan2(x, math.hypot(y, z[2]))])


# The table: L₀ X₀ · L₁(q₁) X₁ · … · L_n(q_n) X_n · F  with L = Rz(θ) Tz(d), X = Tx(a) Rx(α) Ry(β).
# A standard row is an L with the X after it, a modified row an L with the X before it.  Rows of
# type fixed carry what no joint row can: where the first axis stands in the base frame, and the
# flange.  Numbers that calibration did not change are those of the nominal arm.

CONVENTIONS: dict[str, Convention] = {"dh": "standard", "mdh": "modified"}
HEADER = ("joint", "type", "theta0_rad", "d_m", "a_m", "alpha_rad", "beta_rad")
LIMITS = {"revolute": ("lower_rad", "upper_rad"), "prismatic": ("lower_m", "upper_m")}
ZERO = 1e-14  # m or rad; rounding of a product of rotations

# One row of the table: its name, its joint, None for a fixed one, and its numbers.
Line = tuple[str, Joint | None, Array]


def dh_lines(robot: Robot, pieces: exportable.ExportNumbers, convention: Convention) -> list[Line]:
    """The rows of the calibrated table; `robot` says which nominal table, if any, to keep to."""
    nominal = pieces.chain
    ideal = _nominal_rows(robot, nominal, convention) or _decompose(nominal)[0]
    rows, F = _decompose(pieces.calibrated_chain(), ideal)
    end, last = split(F)
    rest = np.array([math.atan2(last[1, 0], last[0, 0]), last[2, 3], 0.0, 0.0, 0.0])
    every = np.array([*(near(row, old) for row, old in zip(rows, ideal, strict=True)), end, rest])
    if convention == "modified":
        every[:, 2:] = np.vstack([NO_ROW, every[:-1]])[:, 2:]
    every = near(every, NO_ROW, ZERO)
    names = ["base", *(joint.name for joint in nominal.joints), "flange1", "flange2"]
    lines = zip(names, [None, *nominal.joints, None, None], every, strict=True)
    return [line for line in lines if line[1] is not None or line[2].any()]


FORMULA = {
    "standard": "T = Rz(theta0 + q) Tz(d) Tx(a) Rx(alpha) Ry(beta) per row",
    "modified": "T = Rx(alpha) Tx(a) Ry(beta) Rz(theta0 + q) Tz(d) per row",
}


def dh_csv(lines: Sequence[Line], comments: Sequence[str] = ()) -> str:
    """CSV text of a table, which `[robot] dh` reads: angles in rad, lengths in m.  beta_rad stands
    there only where a row needs it; limits are those of commanded values."""
    found = list[dict[str, str]]()
    for name, joint, row in lines:
        stated = dict(zip(HEADER[2:], row.tolist(), strict=True))
        if joint is not None:
            stated |= zip(LIMITS[joint.kind], (joint.lower, joint.upper), strict=True)
        kind = dh.FIXED if joint is None else joint.kind
        numbers = {k: repr(value + 0.0) for k, value in stated.items() if math.isfinite(value)}
        found.append({"joint": name, "type": kind} | numbers)
    bounded = {name for cells in found for name in cells}
    limits = [n for names in LIMITS.values() if bounded & set(names) for n in names]
    with_beta = any(row[4] for _, _, row in lines)
    header = [*(HEADER if with_beta else HEADER[:-1]), *limits]
    return csv_text(header, ([cells.get(name, "") for name in header] for cells in found), comments)


def _decompose(chain: Chain, like: list[Array] | None = None) -> tuple[list[Array], Array]:
    """Rows 0 … n of a chain and its flange in the last row's frame, near the rows `like`.  Of the
    last of these θ and d alone change, the rest is the flange's.  Its z is often in line with the
    last axis, where a row of its own would turn any way."""
    turned = [  # rotations whose z column is the axis
        pose_at(np.zeros(3), np.column_stack([*transverse_axes(joint.axis), joint.axis]))
        for joint in chain.joints
    ]
    ends = [*(joint.placement for joint in chain.joints), chain.flange_placement]
    turned, rows, carried = [np.eye(4), *turned, np.eye(4)], list[Array](), np.eye(4)
    for i, end in enumerate(ends):
        last, old = i == chain.n_joints, None if like is None else like[i]
        T = carried @ np.linalg.inv(turned[i]) @ end @ turned[i + 1]
        if last and old is not None:
            # The turn about and the shift along the axis that bring it closest to T.
            R = T[:3, :3] @ transform(old * TRAILING)[:3, :3].T
            theta = math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])
            row = turned_as(np.array([theta, T[2, 3], *old[2:]]), old)
            carried = np.asarray(np.linalg.solve(transform(row), T), dtype=np.float64)
        else:
            row, carried = split(T, old, height=float(T[2, 3]) if last else 0.0)
        rows.append(row)
    return rows, carried


def _nominal_rows(robot: Robot, chain: Chain, convention: Convention) -> list[Array] | None:
    """Of links 0 … n; None where the user's own table is in another convention."""
    if robot.dh is None or robot.dh_convention != convention or robot.dh.suffix in dh.UR_ENDINGS:
        return None
    table = dh.read_dh_table(robot.dh)
    n = len(table.row)
    # Rows without a joint, joints against z and frames slid along their axes are not rows of ours.
    if n != chain.n_joints or chain.notes or any(joint.axis[2] < 0 for joint in chain.joints):
        return None
    stems = ("theta0", "d", "a", "alpha", "beta")
    keys = [("length" if len(stem) == 1 else "angle", stem) for stem in stems]
    numbers = [[dh.dh_number(table, i, *key) for key in keys] for i in range(n)]
    own = np.vstack([NO_ROW, np.nan_to_num(numbers)])
    if convention == "modified":  # θ and d of one, the rest of the next
        own[:, 2:] = np.vstack([own[1:], NO_ROW])[:, 2:]
    return list(own)
