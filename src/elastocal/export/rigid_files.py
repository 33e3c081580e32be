"""The calibrated arm in rigid formats: URDF, the user's file or a new one, and DH tables."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from elastocal.cell.arm_description import Convention, Robot
from elastocal.errors import InputError, option, require
from elastocal.export.exportable import ExportNumbers, nothing, numbers, origin_attributes
from elastocal.model import dh
from elastocal.model.chain import Chain, Joint, LinkMass
from elastocal.model.effects.placements import transverse_axes
from elastocal.model.mjcf import parsed
from elastocal.model.urdf import Tag, XmlFile, comment, element, tree_of, urdf_file
from elastocal.tables import csv_text
from elastocal.units import Array, pose_at

# The calibrated arm as URDF: the user's own file with corrected joint origins.
#
# With O_i the origin of moving joint i, E_i the error of the link before it (6-D, at the link's
# distal end) and J_i(a_i) the motion by the joint's offset a_i,
#
#     O_i ← O_i E_i J_i(a_i)           and for the flange's own fixed joint      O_f ← O_f E_n.
#
# So joint values stay what the controller commands: the encoder's zero has moved in the file, and
# limits, mimics and calibration marks, which are stated in commanded values, stay as they are.

PREFIX = "elastocal_"
MOUNT, TRACKER, LOAD_POINT = f"{PREFIX}flange_mount", f"{PREFIX}tracker", f"{PREFIX}load_point"


def calibrated_urdf(
    robot: Robot, pieces: ExportNumbers, tool: bool, base_frame: bool, note: str
) -> str:
    """Text of the robot's URDF with the calibrated geometry; `note` becomes a comment in it.

    Only origins that change are touched.  `tool` adds elastocal_marker_NAME and
    elastocal_load_point as links on the flange, `base_frame` elastocal_tracker as the new root.
    """
    assert robot.urdf is not None
    file = urdf_file(robot.urdf)
    tree, tags = tree_of(file), {tag.get("name").strip(): tag for tag in file.root.all("joint")}
    base, flange = tree.ends(robot.base, robot.flange, choose=False)
    lines = [comment(note)]

    def place(joint: str, T: Array) -> None:
        file.set_in(tags[joint], "origin", origin_attributes(T))

    def add(new: str, parent: str, child: str, T: Array) -> None:
        """Link `new` and the fixed joint parent → child, one of which is `new`; a frame of an
        earlier export is moved instead."""
        name = f"{new}_joint"
        old = next((joint for joint in tree.joints if joint.name == name), None)
        if old is not None and (old.kind, old.parent, old.child) == ("fixed", parent, child):
            return place(name, T)
        if old is not None or new in tree.links:
            what = f"joint '{name}'" if old is not None else f"link '{new}'"
            raise InputError(
                f"{tree.path}: {what} stands where export would add its own; rename it, "
                f"or leave the frame out ({option('frames', False)}, or no {option('base_frame')})"
            )
        lines.extend(fixed_link(new, parent, child, T))

    for i, joint in enumerate(tree.serial_chain(base, flange)):
        if not nothing(correction := pieces.correction(i)):
            place(joint.name, joint.origin @ correction)
    last, error = tree.parent_joint[flange], pieces.error(pieces.chain.n_joints - 1)
    if not nothing(error) and last.kind == "fixed":
        place(last.name, last.origin @ error)
    elif not nothing(error):
        # The flange is the link that the last joint moves: a link in between takes the correction.
        file.set_in(tags[last.name], "child", {"link": MOUNT})
        add(MOUNT, MOUNT, flange, error)
    for name, T in tool_frames(pieces).items() if tool else ():
        add(name, flange, name, T)
    if base_frame:
        require(
            base != TRACKER,
            f"{tree.path}: the cell's base is {TRACKER}, the tracker's frame of an earlier "
            "export; name the robot's own base link as [robot] base",
        )
        T = pieces.T_tracker_base @ np.linalg.inv(tree.placed(base))
        if tree.root != TRACKER:
            add(TRACKER, TRACKER, tree.root, T)
        else:
            below = next(joint for joint in tree.joints if joint.parent == TRACKER)
            place(below.name, T @ below.origin)
    file.insert(file.end, "".join(f"  {line}\n" for line in lines))
    return file.result()


def tool_frames(pieces: ExportNumbers) -> dict[str, Array]:
    """Link name → placement (4, 4) in the flange frame of every marker and of the load point."""
    frames: dict[str, Array] = {}
    for marker, T in pieces.markers.items():
        name = f"{PREFIX}marker_{'_'.join(marker.split())}"
        while name in frames:  # "A B" beside "A_B"
            name += "_"
        frames[name] = T
    return frames | {LOAD_POINT: pose_at(pieces.load_point)}


def fixed_link(new: str, parent: str, child: str, T: Array) -> list[str]:
    ends = element("parent", {"link": parent}), element("child", {"link": child})
    joint = {"name": f"{new}_joint", "type": "fixed"}
    return [
        element("link", {"name": new}),
        element("joint", joint, *ends, element("origin", origin_attributes(T))),
    ]


# A URDF for an arm that has none: a robot described by a DH table or a MuJoCo model.

BASE, FLANGE = "base_link", "flange"
NO_LIMIT = 1e6  # m; a URDF's slide must have limits


def new_urdf(pieces: ExportNumbers, tool: bool, base_frame: bool, note: str) -> str:
    """URDF text of links base_link, link_1 … link_n, flange with the calibrated placements.

    Joints bear the table's names and limits (continuous where one has none); masses that are known
    stand with a zero inertia tensor.
    """
    # Masses of the robot's description where no weights act in the model.
    chain, masses = pieces.calibrated_chain(), pieces.masses or pieces.chain.masses
    lines = []
    if base_frame:
        lines += fixed_link(TRACKER, TRACKER, BASE, pieces.T_tracker_base)
    lines += [element("link", {"name": BASE})]
    parent = BASE
    for i, joint in enumerate(chain.joints, start=1):
        lines += _link(f"link_{i}", masses[i - 1] if masses else None)
        lines += _joint(joint, parent, f"link_{i}")
        parent = f"link_{i}"
    lines += fixed_link(FLANGE, parent, FLANGE, chain.flange_placement)
    if tool:
        for name, T in tool_frames(pieces).items():
            lines += fixed_link(name, FLANGE, name, T)
    head = ['<?xml version="1.0" encoding="UTF-8"?>', comment(note)]
    return "\n".join([*head, *_nested("robot", {"name": chain.name}, lines)]) + "\n"


def _link(name: str, body: LinkMass | None) -> list[str]:
    if body is None:
        return [element("link", {"name": name})]
    return _nested("link", {"name": name}, _nested("inertial", {}, [
        element("origin", {"xyz": numbers(body.com), "rpy": "0 0 0"}),
        element("mass", {"value": repr(float(body.mass))}),
        element("inertia", dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")),
    ]))  # fmt: skip


def _joint(joint: Joint, parent: str, child: str) -> list[str]:
    bounded = math.isfinite(joint.lower) and math.isfinite(joint.upper)
    kind = joint.kind if bounded or joint.kind == "prismatic" else "continuous"
    lines = [
        element("parent", {"link": parent}),
        element("child", {"link": child}),
        element("origin", origin_attributes(joint.placement)),
        element("axis", {"xyz": numbers(joint.axis)}),
    ]
    if kind != "continuous":
        ends = {"lower": max(joint.lower, -NO_LIMIT), "upper": min(joint.upper, NO_LIMIT)}
        limit = {name: repr(float(end)) for name, end in ends.items()}
        lines.append(element("limit", limit | {"effort": "0", "velocity": "0"}))
    return _nested("joint", {"name": joint.name, "type": kind}, lines)


def _nested(tag: str, stated: dict[str, str], lines: Sequence[str]) -> list[str]:
    head = element(tag, stated).removesuffix("/>")
    return [f"{head}>", *(f"  {line}" for line in lines), f"</{tag}>"]


# The user's own file, of either kind, written into another folder: its meshes are found from there.

# Files that MuJoCo looks for beside the main file, whatever directories the compiler states.
BESIDE = ("include", "model")


def moved(path: Path, text: str, folder: Path) -> tuple[str, list[str]]:
    """The `text` of a file that lies at `path`, to be written into `folder`, and what to know.

    A file without names of others, or that stays where it was, is as before to the byte.
    """
    xml = XmlFile(path, text.encode("utf-8"), "a file")
    named = [tag for tag in xml.tags if any(_is_file(tag, key) for key in tag.stated)]
    if not named:
        return text, []
    home, there = path.parent.resolve(), folder.resolve()
    if there != home:
        if any(tag.name in BESIDE for tag in named):
            return text, [f"copy it beside {path.name}: the files that it includes are there"]
        if xml.root.name == "mujoco":
            stated = parsed(path).compiler
            places = {key: _from(there, home / (getattr(stated, key) or ""))
                      for key in ("meshdir", "texturedir")}  # fmt: skip
            if compilers := [tag for tag in xml.tags if tag.name == "compiler"]:
                xml.set(compilers[-1], places)
            else:
                xml.insert_in(xml.root, f"\n  {element('compiler', places)}")
        for tag in (tag for tag in named if "filename" in tag.stated):
            place = home / tag.stated["filename"]
            if place.is_file():  # others are found in packages
                xml.set(tag, {"filename": _from(there, place)})
    told = "meshes and other files are named relative to the file: to have it elsewhere, export it"
    return xml.result(), [f"{told} there"]


def _is_file(tag: Tag, key: str) -> bool:
    name = tag.stated[key]
    if key == "filename":  # of a URDF
        relative = "://" not in name and not Path(name).is_absolute()
        return tag.name in ("mesh", "texture") and relative
    return key.startswith("file") and bool(name)


def _from(folder: Path, place: Path) -> str:
    try:
        return Path(os.path.relpath(place, folder)).as_posix()
    except ValueError:  # on another drive
        return place.as_posix()


# The written file as others read it: pinocchio's own reader on all of the text, not elastocal's.


def urdf_flanges(text: str, joints: Sequence[str], base: str, flange: str, q: Array) -> Array:
    """T_base_flange (n, 4, 4) at q (n, joints) of a URDF in pinocchio; other joints are neutral.

    Raises ValueError or RuntimeError where pinocchio refuses it.
    """
    import pinocchio as pin

    model = pin.buildModelFromXML(text.encode("utf-8").decode("utf-8-sig"))
    data, found = model.createData(), []
    ends = [model.getFrameId(name, pin.FrameType.BODY) for name in (base, flange)]
    numbers = [model.getJointId(name) for name in joints]
    for row in q:
        motion = np.zeros(model.nv)  # a position is (cos q, sin q) where there are no limits
        motion[[model.joints[number].idx_v for number in numbers]] = row
        position = pin.integrate(model, pin.neutral(model), motion)
        pin.framesForwardKinematics(model, data, position)
        start, end = (data.oMf[frame].homogeneous for frame in ends)
        found.append(np.linalg.solve(start, end))
    return np.array(found)


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
    """The row of T (4, 4) and the remainder Rz(γ) Tz(h), so that T = row · remainder.

    (θ, a, α) and (θ ± π, −a, −α) say the same: taken is the one closer to `like`, else the one
    with the smaller θ.  Turns of `like` beyond π are kept.  Of nearly parallel axes d is that of
    `like`, else `height`.
    """
    skew = math.hypot(T[0, 2], T[1, 2]) > NEARLY_PARALLEL
    alike, height = (0.0, height) if like is None else like[:2].tolist()
    ways = [_skew(T, s) if skew else _parallel(T, s, height, alike) for s in (1.0, -1.0)]

    def away(row: Array) -> float:
        if like is None:
            return float(abs(row[0]) - 1e-9 * row[2])
        turns = 1 - np.cos(row[[0, 3]] - like[[0, 3]])
        return float(turns.sum() + abs(row[2] - like[2]))

    row = min(ways, key=away)
    row = row if like is None else turned_as(row, like)
    return row, np.asarray(np.linalg.solve(transform(row), T), dtype=np.float64)


def _skew(T: Array, sign: float) -> Array:
    z, p = T[:3, 2], T[:3, 3]
    theta = math.atan2(sign * z[0], -sign * z[1])
    x = np.array([math.cos(theta), math.sin(theta), 0.0])
    alpha = math.atan2(sign * math.hypot(z[0], z[1]), z[2])
    # p = d·z₀ + a·x + h·z: the common normal meets both axes.
    d, a, _ = np.linalg.solve(np.column_stack([[0.0, 0.0, 1.0], x, z]), p)
    return np.array([theta, d, a, alpha, 0.0])


def _parallel(T: Array, sign: float, d: float, alike: float) -> Array:
    z, p = T[:3, 2], T[:3, 3]
    foot = p - (p[2] - d) / z[2] * z  # where the second axis passes through the height d
    a = sign * math.hypot(foot[0], foot[1])
    theta = math.atan2(sign * foot[1], sign * foot[0])
    if abs(a) < 1e-12:  # one axis in the other's line: any direction will do
        theta, a = alike, 0.0
    # z = Rz(θ) Rx(α) Ry(β) e_z = Rz(θ) (sin β, −sin α cos β, cos α cos β)
    c, s = math.cos(theta), math.sin(theta)
    u = (c * z[0] + s * z[1], -s * z[0] + c * z[1], z[2])
    alpha = math.atan2(-u[1], u[2])
    beta = math.atan2(u[0], math.hypot(u[1], u[2]))
    return np.array([theta, d, a, alpha, beta])


# The calibrated arm as a Denavit–Hartenberg table, standard or modified.
#
# Calibration leaves neighbouring axes skew, so a table of four parameters per joint holds them;
# where they are nearly parallel there is a column beta_rad.  Rows of type fixed carry what no joint
# row can: where the first axis stands in the base frame, and the flange.  Numbers that calibration
# did not change are those of the nominal arm.
#
# The chain is written as  L₀ X₀ · L₁(q₁) X₁ · … · L_n(q_n) X_n · F  with L = Rz(θ) Tz(d) and
# X = Tx(a) Rx(α) Ry(β).  A standard row is an L with the X after it, a modified row an L with the
# X before it.

CONVENTIONS: dict[str, Convention] = {"dh": "standard", "mdh": "modified"}
HEADER = ("joint", "type", "theta0_rad", "d_m", "a_m", "alpha_rad", "beta_rad")
LIMITS = {"revolute": ("lower_rad", "upper_rad"), "prismatic": ("lower_m", "upper_m")}
ZERO = 1e-14  # m or rad; rounding of a product of rotations


# One row of the table: its name, its joint, None for a fixed one, and its numbers.
Line = tuple[str, Joint | None, Array]


def dh_lines(robot: Robot, pieces: ExportNumbers, convention: Convention) -> list[Line]:
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
    """CSV text of a table, which `[robot] dh` reads: angles in rad, lengths in m.

    beta_rad stands there only where a row needs it; limits are those of commanded values; comments
    begin with #.
    """
    found = []
    for name, joint, row in lines:
        numbers = zip(HEADER[2:], row.tolist(), strict=True)
        cells = {header: repr(value + 0.0) for header, value in numbers}
        if joint is not None:
            ends = zip(LIMITS[joint.kind], (joint.lower, joint.upper), strict=True)
            cells |= {end: repr(value + 0.0) for end, value in ends if math.isfinite(value)}
        kind = dh.FIXED if joint is None else joint.kind
        found.append(cells | dict(zip(HEADER[:2], (name, kind), strict=True)))
    bounded = {name for cells in found for name in cells}
    limits = [n for names in LIMITS.values() if bounded & set(names) for n in names]
    with_beta = any(row[4] for _, _, row in lines)
    header = [*(HEADER if with_beta else HEADER[:-1]), *limits]
    return csv_text(header, ([cells.get(name, "") for name in header] for cells in found), comments)


def _decompose(chain: Chain, like: list[Array] | None = None) -> tuple[list[Array], Array]:
    """Rows 0 … n of a chain and its flange in the last row's frame, near the rows `like`.

    Of the last of these θ and d alone change, the rest is the flange's.  Its z is often in line
    with the last axis, where a row of its own would turn any way.
    """
    turned = [  # rotations whose z column is the axis
        pose_at(np.zeros(3), np.column_stack([*transverse_axes(joint.axis), joint.axis]))
        for joint in chain.joints
    ]
    ends = [*(joint.placement for joint in chain.joints), chain.flange_placement]
    starts = [np.eye(4), *turned]
    rows: list[Array] = []
    carried: Array = np.eye(4)
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        last = i == chain.n_joints
        T = carried @ np.linalg.inv(start) @ end @ (np.eye(4) if last else turned[i])
        old = None if like is None else like[i]
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
    """What the user's own table says of links 0 … n; None where it is in another convention."""
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
