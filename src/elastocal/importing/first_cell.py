"""A first cell for an arm: what its file says, and guesses of what it does not, marked as such.

The text is a cell file that runs as it is (`design`, `simulate`), so that one begins with plans
and readings of an arm like one's own and puts the true numbers in one by one.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from elastocal.above import checked_arguments
from elastocal.cell import Cell, read_cell
from elastocal.cell_tables import SOURCES, Convention, Robot
from elastocal.config import toml_key, toml_value
from elastocal.files import atomic_writer
from elastocal.messages import InputError, listed, option, printable, require
from elastocal.model.chain import Chain, clashing, jaw_told, names_told
from elastocal.model.dh import UR_ENDINGS
from elastocal.model.effects.geometry import BaseFrame, JointOffset, LinkGeometry, MarkerPosition
from elastocal.model.effects.statics import JointCompliance, feels_weight, usual_over_stated_mass
from elastocal.model.manipulator import load_chain
from elastocal.model.mjcf import MjcfArm
from elastocal.model.rigid import drawn_joints, origin_heights, reach_of, suitable_load
from elastocal.model.urdf import TRACKER, Tree, XmlFile, check_urdf, is_called, xacro_left
from elastocal.units import Array, pose_at, rpy_from_rotation

ENDINGS = {".urdf": "urdf", ".xml": "mjcf", ".mjcf": "mjcf", ".csv": "dh"}
ENDINGS |= dict.fromkeys(UR_ENDINGS, "dh")
OF_ROOT = {"robot": "urdf", "mujoco": "mjcf"}  # whatever the ending says
# Sites that are flanges by what MuJoCo users call them.
FLANGE_SITES = ("elastocal_flange", "attachment_site", "flange", "tool0", "ee_site")
WORLDS = (TRACKER, "world", "map", "odom")  # roots that are no part of a robot
MOST_SITES = 8  # listed as markers; of more most are something else
THICKNESS = 15.0  # reach over a link's radius


@checked_arguments
def init(
    robot: str | Path | Robot,
    output: str | Path | None = None,
    *,
    base: str | None = None,
    flange: str | None = None,
    convention: Convention = "standard",
    ur_model: str | None = None,
    force: bool = False,
) -> str:
    """Write a first cell file for an arm.

    What the robot's file says (joints, limits, flange, masses, a MuJoCo model's sites) and guesses
    of what it does not, marked as such: a cell file that `design` and `simulate` run with.

    Args:
        robot: A URDF, MuJoCo model (MJCF), DH table or UR's factory calibration (calibration.conf,
            YAML), or a `Robot`.
        output: The cell file to write; None writes none.
        base: First link or body, None for the root.
        flange: Last link, body or site; None for the one that is found.
        convention: Of a DH table: "standard" or "modified".
        ur_model: Of a calibration.conf: the robot, as "UR10e".
        force: Write over a file that is there.

    Returns:
        The text of the cell file.

    Raises:
        InputError: The robot's file is wrong, leaves a choice open, or `output` is there already.

    Examples:
        >>> text = ec.init("kr270_2.urdf", "first.toml")
        >>> ec.Model("first.toml").chain.n_joints
        6
    """
    target = None if output is None else Path(output)
    told = f"{target} is there already; name another file, or give {option('force', True)}"
    require(target is None or force or not target.exists(), told)
    found = robot
    if not isinstance(found, Robot):
        found = robot_of(Path(found), base, flange, convention, ur_model)
    text = first_cell(found, Path() if target is None else target.parent)
    if target is not None:
        with atomic_writer(target) as handle:
            handle.write(text)
            handle.flush()
            try:  # before it appears: a cell that cannot be read is not left behind
                load_chain(read_cell(handle.name))
            except InputError as error:
                why = str(error).replace(handle.name, "the cell made of it")
                file = found.urdf or found.mjcf or found.dh
                raise InputError(f"{file}: is no robot to begin with: {why}") from None
    return text


def robot_of(
    path: Path, base: str | None, flange: str | None, convention: Convention, ur_model: str | None
) -> Robot:
    """The robot of a file; base and flange are those that are found where none are named, so that a
    cell states them."""
    ending, is_for = path.suffix.lower(), f"leave it out for {path}"
    kind = ENDINGS.get(ending)
    require(ending != ".xacro", xacro_left(path, f"the ending '{path.suffix}'"))
    require(
        kind is not None,
        f"{path}: the ending '{printable(path.suffix)}' names no robot file; give a URDF (.urdf), "
        "a MuJoCo model (.xml, .mjcf), a DH table (.csv) or the factory calibration of a UR "
        "(.conf, .yaml)",
    )
    told = f"{option('ur_model')} is for a calibration.conf; {is_for}"
    require(ur_model is None or ending == ".conf", told)
    if kind == "dh":
        for name, given in (("base", base), ("flange", flange)):
            require(given is None, f"{option(name)} has no meaning for a DH table; leave it out")
        return replace(Robot.from_dh(path, convention), ur_model=ur_model)
    require(convention == "standard", f"{option('convention')} is for DH tables; {is_for}")
    what = ("URDF file", "a URDF") if kind == "urdf" else ("MuJoCo model", "an MJCF file")
    kind = OF_ROOT.get(XmlFile.read(path, *what).root.name, kind)
    if kind == "urdf":
        tree = check_urdf(path)
        start, end = tree.ends(base, flange or None)
        return Robot.from_urdf(path, _own_base(tree, start, end) if base is None else start, end)
    arm = MjcfArm.read(path, base, flange)
    there = arm.tree.places(arm.base, arm.flange) if flange is None else ()
    found = (site for name in FLANGE_SITES for site in there if is_called(site, name))
    start = _own_base(arm.tree, arm.base, arm.flange) if base is None else base
    return Robot.from_mjcf(path, start, next(found, arm.flange))


def _own_base(tree: Tree, base: str, flange: str) -> str:
    """The base, or where that is no part of the robot what is fixed to it."""
    first = tree.ways[tree.link_of(flange)[0]][0]
    return base if first.moves or base != tree.root or base not in WORLDS else first.child


def first_cell(robot: Robot, folder: Path) -> str:
    kind, path = next((k, p) for k in SOURCES if (p := getattr(robot, k)) is not None)
    chain = load_chain(Cell(name=path.stem, robot=robot))
    arm = MjcfArm.read(path, robot.base, robot.flange) if kind == "mjcf" else None
    tree = None if kind == "dh" else check_urdf(path) if arm is None else arm.tree
    reach = max(reach_of(chain), 0.05)
    if clashing(chain) and robot.joint_names is None:
        robot = replace(robot, joint_names="order")
    lines = [
        f"# {printable(chain.name)}: a first cell, made of {printable(path.name)} by elastocal"
        " init. It runs as it is.",
        "# What the robot's file does not say is a guess, and marked so: replace it by your own.",
        *(f"# Note: {printable(note)}." for note in notes_of(robot, chain)),
        f"name = {toml_value(chain.name)}",
        "",
        *_robot(robot, kind, path, folder),
        *_joints(chain),
        REST.format(
            **_guesses(chain, reach, *_mount(robot, tree, arm)), **_tool(robot, reach, tree)
        ),
    ]
    return "\n".join(lines)


def notes_of(robot: Robot, chain: Chain) -> list[str]:
    found = list(chain.notes)
    if clash := clashing(chain):
        found.append(
            f"the file calls other joints {listed(clash, 3)} than their number in the arm: here "
            f'jointN is the Nth joint ({names_told(chain)}); [robot] joint_names = "file" takes '
            "the file's names instead"
        )
    moved = ""
    if robot.urdf is not None and robot.flange is not None:
        moved = robot.flange if check_urdf(robot.urdf).parent_joint[robot.flange].moves else ""
    weightless = [chain.joints[i].name for i, body in enumerate(chain.masses) if body.mass == 0]
    if weightless and not any("mass of" in note for note in found):
        found.append(f"the file has no mass for what {listed(weightless)} alone move: taken as 0")
    if doubt := placeholder_masses(chain):
        found.append(
            f"{doubt}, which looks like placeholders or a mistake. Weights would bend the joints "
            "wrongly, so link_gravity is off; put in the masses of the data sheet and switch it on"
        )
    return found + jaw_told(chain, moved)


NO_MASSES = "the file has no masses; if weights bend joints, state them and set true"
FEW_KINDS = 3  # links of each mass, on average, from which on nobody has weighed them


def placeholder_masses(chain: Chain) -> str:
    """Many links of one mass, or all together far from what an arm of that length weighs, or a
    centre farther from its joint than the arm is long; "" where nothing speaks against them."""
    length, far = sum(chain.lengths), [float(np.linalg.norm(body.com)) for body in chain.masses]
    if max(far, default=0.0) > length and "prismatic" not in chain.kinds:
        return (
            f"the file has the centre of mass of link {far.index(max(far)) + 1} {max(far):.3g} m "
            f"from its joint, and an arm of {length:.3g} m"
        )
    masses = [f"{body.mass:.4g}" for body in chain.masses]
    if masses and len(set(masses)) * FEW_KINDS <= len(masses):
        mass, k = Counter(masses).most_common(1)[0]
        return f"the file states {mass} kg for {k} of {len(masses)} links"
    ratio = usual_over_stated_mass(chain)
    if ratio == 1:
        return ""
    whole = sum(body.mass for body in chain.masses)
    return (
        f"the file's links weigh {whole:.3g} kg together, where arms of that length weigh about "
        f"{whole * ratio:.2g} kg"
    )


def _mount(robot: Robot, tree: Tree | None, arm: MjcfArm | None) -> tuple[Array, str]:
    """T (4, 4) of the base in a frame whose z is up, as the file has it, and who says so."""
    if arm is not None:
        up, told = arm.upright()
        return pose_at(np.zeros(3), up) @ arm.tree.placed(arm.base), told
    if tree is None:
        return np.eye(4), "guess: the base stands upright"
    base = tree.root if robot.base is None else robot.base
    T, told = tree.placed(base), f"of '{base}' in the file's '{tree.root}', z up"
    return (T if tree.root in WORLDS else pose_at(np.zeros(3), T[:3, :3])), told


def _vector(values: Any, digits: int = 4) -> str:
    return "[" + ", ".join(f"{round(float(v), digits) + 0.0:g}" for v in values) + "]"


def _robot(robot: Robot, kind: str, path: Path, folder: Path) -> Iterator[str]:
    yield "[robot]"
    yield f"{kind} = {toml_value(Path(os.path.relpath(path, folder)).as_posix())}"
    if kind == "dh" and path.suffix.lower() == ".csv":
        yield f'dh_convention = "{robot.dh_convention}"' + " " * 7 + '# or "modified" (Craig)'
        yield '# masses = "links.csv"           # link, mass_kg, com_x_m, com_y_m, com_z_m: weights'
    for name in ("base", "flange", "ur_model", "joint_names"):
        if (value := getattr(robot, name)) is not None:
            yield f"{name} = {toml_value(value)}"
    yield ""


def _joints(chain: Chain) -> Iterator[str]:
    yield f"[limits]                               # of {chain.n_joints} joints, in their order"
    low, high, _ = drawn_joints(chain)
    for i, (joint, ends) in enumerate(zip(chain.joints, zip(low, high, strict=True), strict=True)):
        unit, scale = ("deg", math.degrees(1.0)) if joint.kind == "revolute" else ("mm", 1e3)
        told = f"{printable(joint.name)}, {joint.kind}"
        told += "; the file has no limit: guess" * (ends != (joint.lower, joint.upper))
        values = ", ".join(f"{value * scale:.6g}" for value in ends)
        yield f"joint{i + 1}_{unit} = [{values}]".ljust(38) + f" # {told}"
    yield ""


def _tool(robot: Robot, reach: float, tree: Tree | None) -> dict[str, str]:
    there = {} if tree is None else tree.places(*tree.ends(robot.base, robot.flange))
    usable = {n: p for n, p in there.items() if n == n.strip() == printable(n)}
    told, side, digits = "the model's sites; keep the reflectors", reach / 12, 4
    # Off the last joint's axis, which a load on it would not turn.
    load, whose = np.array([side, 0, side]), "guess: where a load hangs"
    own = {n.removeprefix("elastocal_"): p for n, p in usable.items()}
    if "load_point" in own:
        load, whose, told, digits = own["load_point"], "of the file", "of the file", 6
        usable = {n.removeprefix("marker_"): own[n] for n in own if n.startswith("marker_")}
    if not 0 < len(usable) <= MOST_SITES:
        places = {"M1": (1, 0.0, 1 / 3), "M2": (-0.5, 0.9, 0.5), "M3": (-0.5, -0.9, 1)}
        usable = {name: side * np.array(at) for name, at in places.items()}
        told, digits = "guess; fitted below", 4
    lines = [f"{'[tool.markers_m]':<38} # {told}"]
    lines += [f"{toml_key(name)} = {_vector(at, digits)}" for name, at in usable.items()]
    load_line = f"load_point_m = {_vector(load, digits)}"
    return {"load_point": f"{load_line:<38} # {whose}", "markers": "\n".join(lines)}


# What follows robot and limits: keys at their guesses, each line's remark in column 40.
REST = """\
[tool]                                 # all in m, in the flange frame
{load_point}

{markers}

[tracker]
{station:<38} # guess: where it stands, in the data's frame
sigma_um = 15                          # guess; or range_um, range_ppm, transverse_um, …

[model]
observe = "position"                   # or deflection, pose, distance (with "distance_sensor")
# What is fitted; elastocal effects lists all that can be.
effects = [
    {effects}
]
{gravity:<38} # {weights}

[model.nominal]                        # the robot's base in the data's frame
{position:<38} # {placed}
{turned:<38} # {whose}

[workspace]                            # where the arm may be; design keeps to it
{radii:<38} # guess
clearance_mm = {clearance}

[[workspace.keep_out]]
name = "mounting plane"                # the arm stays {side} it, z of the base
point_m = {origin}
normal = {up}

# [[workspace.obstacle]]
# name = "table"
# shape = "box"
# size_m = [1.0, 0.8, 0.7]
# position_m = [1.2, 0.0, 0.35]

[design]                               # elastocal design
poses = 20
candidates = 2000                      # to choose from; more take longer
{loads:<38} # guess for a reach of {reach:.2f} m
"""


def _guesses(chain: Chain, reach: float, T: Array, whose: str) -> dict[str, Any]:
    n, turned, origin = chain.n_joints, T[:3, :3], T[:3, 3]
    names = [effect.name for effect in (BaseFrame, MarkerPosition, JointOffset, LinkGeometry)]
    sprung = [j + 1 for j in range(n) if feels_weight(chain, j, turned[2])]
    names += [f"{JointCompliance.name}:joint{i}" for i in sprung]
    effects = [f'"{name}",' for name in names]
    weighed = bool(chain.masses) and not placeholder_masses(chain)
    told = "masses of the robot's file bend the joints" if weighed else NO_MASSES
    if chain.masses and not weighed:
        told = "the file's masses look like placeholders"
    if any("gravity " in note or "mass of" in note for note in chain.notes):
        told = "a choice: see the notes above"
    # In mm, fives; the links get thinner towards the wrist.
    thick = max(5 * round(reach * 1e3 / THICKNESS / 5), 5)
    thin = max(5 * round(thick * 0.6 / 5), 5)
    radii = [thick if i < n - 3 else thin for i in range(n)]
    # What never leaves the mounting plane is no body that could strike it.
    heights = origin_heights(chain) * 1e3
    hangs = heights.max() <= 1 < -heights.min()
    farthest = (-heights if hangs else heights).max(axis=0)
    radii = [0 if h <= r else r for h, r in zip(farthest, radii, strict=True)]
    if chain.kinds[:2] == ("prismatic", "prismatic"):  # of a gantry: no column in its middle
        radii[0] = 0
    return {
        "station": f"position_m = {_vector([round(2 * reach, 1), 0, round(0.5 * reach, 1)])}",
        "effects": "\n    ".join(" ".join(effects[k : k + 2]) for k in range(0, len(effects), 2)),
        "gravity": f"link_gravity = {str(weighed).lower()}",
        "weights": told,
        "position": f"base_position_m = {_vector(origin)}",
        "placed": "of the file" if origin.any() else "guess: the base is the origin of the data",
        "origin": _vector(origin),
        "turned": f"base_rpy_deg = {_vector(np.degrees(rpy_from_rotation(turned)))}",
        "whose": whose,
        "radii": f"link_radius_mm = [{', '.join(map(str, radii))}]",
        "clearance": thin,
        "up": _vector(-turned[:, 2] if hangs else turned[:, 2]),
        "side": "below" if hangs else "above",
        "loads": f"loads_N = [[0, 0, 0], [0, 0, -{suitable_load(reach):g}]]",
        "reach": reach,
    }
