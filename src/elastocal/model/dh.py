"""Nominal chain of a Denavit–Hartenberg table or of a factory calibration."""

from __future__ import annotations

import configparser
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from elastocal import messages, tables
from elastocal.cell_tables import Convention
from elastocal.files import read_text
from elastocal.messages import InputError, did_you_mean, listed, option, quoted, require, rounded
from elastocal.model import rigid
from elastocal.model.chain import (
    MAX_ANGLE,
    MAX_JOINTS,
    MAX_LENGTH,
    MIN_JOINTS,
    Chain,
    Joint,
    JointKind,
    LinkMass,
    check_angles,
    near_the_arm,
)
from elastocal.model.rigid import nominal_flanges
from elastocal.tables import NO_UNIT, Column, Columns, Family, RawTable
from elastocal.units import Array, pose_at, rotation_from_rpy

ANGLE, LENGTH = ("rad", "deg"), ("m", "mm")
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
FIXED = "fixed"
# Rows that no joint moves: as types, and as names that need one.
STILL = (FIXED, "base", "tool", "flange")
NO_JOINTS = ("world", "tcp", "end_effector", "ee", *STILL)
MOST_BYTES = 1_000_000
FARTHEST_D = 1e5  # m; axes that meet farther away are parallel to 1e-5 rad

# Multiplied, as these tables always were: 115.7 mm / 1000 is not the same float.
SI = {"": 1.0, "rad": 1.0, "deg": math.pi / 180.0, "m": 1.0, "mm": 1e-3, "kg": 1.0}
ENDS = ("lower", "upper")

DH_FAMILIES = (
    Family("joint", "joint names", {"joint": NO_UNIT}, is_label=True, optional=("joint",)),
    Family("type", "joint types", {"type": NO_UNIT}, is_label=True, optional=("type",)),
    Family("sign", "directions of the joints", {"sign": NO_UNIT}, optional=("sign",)),
    Family(
        "angle", "angles", dict.fromkeys(("theta0", "alpha", "beta"), ANGLE), optional=("beta",)
    ),
    Family("length", "lengths", dict.fromkeys(("d", "a"), LENGTH)),
    Family("limit", "angular limits", dict.fromkeys(ENDS, ANGLE), optional=ENDS),
    Family("travel", "limits of travel", dict.fromkeys(ENDS, LENGTH), optional=ENDS),
)
MASS_FAMILIES = (
    Family("link", "links", {"link": NO_UNIT}, is_label=True),
    Family("mass", "masses", {"mass": ("kg",)}),
    Family("com", "centres of mass", dict.fromkeys(("com_x", "com_y", "com_z"), LENGTH)),
)


def read_dh(
    path: str | Path, convention: Convention = "standard", masses_path: str | Path | None = None,
    ur_model: str | None = None,
) -> Chain:  # fmt: skip
    """The chain of a DH table in CSV, one row per joint, or of a factory calibration of a UR.

    Columns theta0_rad|deg, d_m|mm, a_m|mm, alpha_rad|deg; optional: beta_rad|deg, joint (name),
    type (revolute|prismatic, or fixed|base|tool|flange for a row that no joint moves), sign (1, or
    -1 where the joint's value counts against the axis), limits lower_/upper_rad|deg for revolute
    and lower_/upper_m|mm for prismatic joints (blank: none).  masses_path: CSV with link (1…n,
    linkN or the joint's name), mass_kg, com_x_m, com_y_m, com_z_m, the centre of mass in DH frame
    i; every link once.

    Where axes are nearly parallel their common normal lies far away, and d of hundreds of metres
    cancel (factory calibrations): such frames are taken near the arm, see `near_the_arm`.

    Of a `calibration.conf` or a YAML of `ur_calibration`, without limits and masses: `ur_model` is
    whose nominal table a calibration.conf counts from; None: that of [DH] in the file, or in
    urcontrol.conf beside it.
    """
    path = Path(path)
    if (ending := path.suffix.lower()) in UR_ENDINGS:
        told = f"{path}: takes no [robot] masses; state the arm as a DH table"
        require(masses_path is None, told)
        text = read_text(path, "robot's calibration", MOST_BYTES)
        if ending == ".conf":
            return _of_deviations(path, text, ur_model)
        told = f"{path}: ur_model belongs to a calibration.conf; leave it out for YAML"
        require(ur_model is None, told)
        return _of_origins(path, text)
    table = read_dh_table(path)
    kinds = [_kind(table, i) for i in range(len(table.row))]
    moving = [i for i, kind in enumerate(kinds) if kind is not None]
    told = f"{len(moving)} rows below the header, one per joint; {MIN_JOINTS} to {MAX_JOINTS}"
    require(MIN_JOINTS <= len(moving) <= MAX_JOINTS, f"{path}: {told} joints are supported")
    names = [table.text(i, "joint") or f"joint{k}" for k, i in enumerate(moving, start=1)]
    for i, name in zip(moving, names, strict=True):
        told = f"{table.where(i, 'joint')}: '{name}' appears twice; rename one"
        require(names.count(name) == 1, told)
    joints, after, passed = list[Joint](), list[Array](), np.eye(4)
    for i, kind in enumerate(kinds):
        theta0, alpha, beta = (
            _plausible(table, i, "angle", k) for k in ("theta0", "alpha", "beta")
        )
        d, a = (_plausible(table, i, "length", k) for k in ("d", "a"))
        beta = 0.0 if math.isnan(beta) else beta
        T_before, T_after = link(theta0, d, a, alpha, beta, convention)
        if kind is None:
            passed = passed @ T_before @ T_after
            continue
        sign = dh_number(table, i, "sign", "sign")
        sign = 1.0 if math.isnan(sign) else sign
        told = f"{sign:g}; write 1, or -1 where the joint turns against z"
        require(sign in (1.0, -1.0), f"{table.where(i, 'sign')}: {told}")
        axis, name = np.array(Z) * sign, names[len(joints)]
        joints.append(Joint(name, kind, passed @ T_before, axis, *_limits(table, i, kind)))
        passed = T_after
        after.append(T_after)
    masses = () if masses_path is None else _masses(Path(masses_path), names, after)
    chain = Chain(path.stem, tuple(joints), passed, masses)
    return _closer(table, chain) if sum(chain.lengths) > MAX_LENGTH else chain


def read_dh_table(path: Path) -> RawTable:
    return _read(path, DH_FAMILIES, ("angle", "length"), "DH table")


def dh_number(table: RawTable, i: int, family: str, stem: str) -> float:
    """A number of row i in rad, m or kg; NaN where its cell is empty or there is no such column."""
    column = table.column(family, stem)
    return math.nan if column is None else float(table.numbers[column.header][i] * SI[column.unit])


def _read(path: Path, known: Sequence[Family], needed: Sequence[str], what: str) -> RawTable:
    named = {family.name: family for family in known}

    def choose(header: Sequence[str]) -> Columns:
        every = listed(way for f in known for stem in f.units for way in f.columns(stem))
        return tables.match_columns(
            str(path), header, named, [(n,) for n in needed], f"a {what} needs", called=CALLED,
            explain=partial(_no_table, what), valid=f"; a {what} takes {every}",
        )  # fmt: skip

    return tables.read_table(path, choose, what=what, comments=True, most=MOST_BYTES)


def link(
    theta0: float, d: float, a: float, alpha: float, beta: float = 0.0, convention: str = "standard"
) -> tuple[Array, Array]:
    """T_{i-1,i}(q_i) = before · motion(q_i) · after: the two constant factors (4, 4)."""
    Rz_theta, Tz_d = turn(Z, theta0), shift(Z, d)
    Tx_a, Rx_alpha, Ry_beta = shift(X, a), turn(X, alpha), turn(Y, beta)
    if convention == "standard":
        return Rz_theta, Tz_d @ Tx_a @ Rx_alpha @ Ry_beta
    return Rx_alpha @ Tx_a @ Ry_beta @ Rz_theta @ Tz_d, np.eye(4)


turn, shift = partial(rigid.moved, "revolute"), partial(rigid.moved, "prismatic")


def _plausible(table: RawTable, i: int, family: str, stem: str) -> float:
    value, column = dh_number(table, i, family, stem), table.column(family, stem)
    if column is not None:
        # Whether a long d is one is seen in the chain.
        most = FARTHEST_D if stem == "d" else MAX_LENGTH
        if column.unit in LENGTH and abs(value) > most:
            raise _too_much(table, i, column, value, "m is too long for a link")
        if column.unit in ANGLE and abs(value) > MAX_ANGLE:
            raise _too_much(table, i, column, value, "rad is more than two turns")
    return value


def _too_much(table: RawTable, i: int, column: Column, value: float, wrong: str) -> InputError:
    meant = {"rad": ("degrees", "deg"), "m": ("millimetres", "mm")}.get(column.unit)
    remedy = "correct it"
    if meant:
        remedy = f"if these are {meant[0]}, call the column {column.stem}_{meant[1]}"
    return InputError(f"{table.where(i, column.header)}: {value:g} {wrong}; {remedy}")


def _closer(table: RawTable, chain: Chain) -> Chain:
    closer = near_the_arm(chain)
    whole = sum(closer.lengths)
    d = np.array([dh_number(table, i, "length", "d") for i in range(len(table.row))])
    i, column = int(np.argmax(np.abs(d))), table.column("length", "d")
    if whole > MAX_LENGTH and column is not None:
        raise _too_much(table, i, column, d[i], "m is too long for a link, and the d do not cancel")
    told = (
        f"the d of nearly parallel axes, up to {rounded(abs(d[i]), 4)} m, cancel: joint frames are "
        f"taken where the axes pass the arm, whose links are {whole:.2f} m long together; it moves "
        "as the table says"
    )
    return replace(closer, notes=(*closer.notes, told))


# Other people's names of columns, as of `match_columns`.
CALLED = {
    "(q|j|joint|angle|theta)?(lim|limit)?(min|low|lower|lb)(limit|angle)?": "lower",
    "(q|j|joint|angle|theta)?(lim|limit)?(max|high|upper|ub)(limit|angle)?": "upper",
    "theta|θ|θ0|offset|q0|thetaoffset": "theta0",
    "α": "alpha", "β": "beta", "r": "a", "name": "joint", "sigma|kind": "type",
    "direction|flip|dir": "sign",
}  # fmt: skip


OF_THE_LINK_BEFORE = re.compile(r"(?i)(alpha|α|a)_?\W?(i? ?[-−] ?1|i_?m_?1|i_?minus_?1|prev).*")


def _no_table(what: str, header: str) -> str | None:
    if of_link := OF_THE_LINK_BEFORE.fullmatch(header):
        told = f"column {quoted(header)} is of the link before, as in Craig's tables: call it "
        name = of_link[1].lower().replace("α", "alpha")
        how = f'{option("convention", "modified")}, or [robot] dh_convention = "modified"'
        return f"{told}{name}_… (with its unit), and state {how}"
    if not header.startswith(("<", "version https://git-lfs")):
        return None
    kind = "a web page or XML" if header.startswith("<") else "a pointer of Git LFS"
    return f"is {kind}, not a {what}; download the file itself"


def _kind(table: RawTable, i: int) -> JointKind | None:
    kind, name = table.text(i, "type"), table.text(i, "joint")
    if not kind and name.lower() in NO_JOINTS:
        raise InputError(
            f"{table.where(i, 'joint')}: '{name}' names no joint; give the row type {FIXED} in the "
            "column type (or revolute, prismatic, if a joint moves it)"
        )
    if kind.lower() in STILL:
        return None
    if kind in ("", "revolute", "prismatic"):
        return "prismatic" if kind == "prismatic" else "revolute"
    hint = did_you_mean(kind, ("revolute", "prismatic", *STILL))
    told = f"unknown joint type '{kind}'{hint}; valid: revolute, prismatic, fixed"
    raise InputError(f"{table.where(i, 'type')}: {told}")


def _limits(table: RawTable, i: int, kind: JointKind) -> tuple[float, float]:
    own, other = ("limit", "travel") if kind == "revolute" else ("travel", "limit")
    for side in ENDS:
        wrong = table.column(other, side)
        if wrong is not None and not math.isnan(dh_number(table, i, other, side)):
            raise InputError(
                f"{table.where(i, wrong.header)}: the joint is {kind}; leave this blank and give "
                f"its limits in {'rad or deg' if own == 'limit' else 'm or mm'}"
            )
    lower, upper = (dh_number(table, i, own, side) for side in ENDS)
    if lower >= upper:
        where = table.where(i, *(column.header for column in table.columns[own]))
        raise InputError(f"{where}: lower is not below upper; check the limits")
    return (-np.inf if math.isnan(lower) else lower, np.inf if math.isnan(upper) else upper)


def _masses(path: Path, names: Sequence[str], after: Sequence[Array]) -> tuple[LinkMass, ...]:
    """Masses by link, centres of mass taken from DH frame i to joint frame i."""
    table = _read(path, MASS_FAMILIES, ("link", "mass", "com"), "table of link masses")
    numbered = [f"link{i}" for i in range(1, len(names) + 1)]
    known = {f"{what}{i + 1}": i for what in ("link", "joint", "") for i in range(len(names))}
    known |= {name: i for i, name in enumerate(names)}
    found: dict[int, LinkMass] = {}
    for k in range(len(table.row)):
        text, where = table.text(k, "link"), table.where(k, "link")
        if (i := known.get(text)) is None:
            hint = f"{did_you_mean(text, (*numbered, *names))}; valid: {listed(numbered)}"
            raise InputError(f"{where}: unknown link '{text}'{hint} or the joints' names")
        require(i not in found, f"{where}: '{text}' appears twice")
        mass = dh_number(table, k, "mass", "mass")
        com = [dh_number(table, k, "com", f"com_{axis}") for axis in "xyz"]
        require(not mass < 0, f"{table.where(k, 'mass_kg')}: {mass:g} is negative; give 0 or more")
        found[i] = LinkMass(mass, (after[i] @ np.array([*com, 1.0]))[:3])
    missing = [link for i, link in enumerate(numbered) if i not in found]
    told = f"no row for {listed(missing)}; give every link, with mass_kg 0 if it has none"
    require(not missing, f"{path}: {told}")
    return tuple(found[i] for i in range(len(names)))


# Factory calibration of Universal Robots, in the two forms that users have.
# The controller's `calibration.conf` states deviations from the model's nominal table, standard
# convention, joint by joint:
#
#     θ = Δθ,  a = a₀ + Δa,  d = d₀ + Δd,  α = α₀ + Δα
#
# The YAML file of `ur_calibration` states the same arm as origins of its joints, x y z in m and
# roll pitch yaw in rad, whose z are the axes.  Base and flange are the controller's.

UR_ENDINGS = (".conf", ".yaml", ".yml")
JOINTS = tuple(
    f"{name}_joint"
    for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
)
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
ORIGIN = ("x", "y", "z", "roll", "pitch", "yaw")
# d₁, a₂, a₃, d₄, d₅, d₆ in m, as Universal Robots publishes them; α₀ is that of all models.
NOMINAL = {
    "UR3": (0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
    "UR5": (0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "UR10": (0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "UR3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "UR5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "UR10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "UR16e": (0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
    "UR20": (0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543),
    "UR30": (0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543),
}
ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
CONTROLLER = "urcontrol.conf"
# Factory calibrations move the flange by millimetres, another robot's by 40 mm and more.
FARTHEST = 0.03  # m


def _of_deviations(path: Path, text: str, ur_model: str | None) -> Chain:
    sections, keys = _sections(path, text), ("delta_theta", "delta_a", "delta_d", "delta_alpha")
    told = f"has no section [mounting] with {', '.join(keys)}, as a calibration.conf of Universal"
    require("mounting" in sections, f"{path}: {told} Robots has")
    delta = np.array([_six(path, sections["mounting"], key) for key in keys])
    check_angles(f"{path}: delta_theta", tuple(delta[0]), "this file is in rad")
    chain, far = _apart(path, delta, _nominal(path, sections, ur_model, delta))
    if far > FARTHEST:
        raise InputError(
            f"{path}: the arm is {far * 1e3:.0f} mm away from the nominal one, and factory "
            f"calibrations are millimetres; it fits {_fitting(path, delta) or 'no known robot'}"
        )
    longest = float(np.abs(delta[2]).max())
    told = (
        f"d of up to {rounded(longest, 4)} m in the controller's table cancel: joint frames are "
        "taken where the axes pass the arm; it moves as the table says"
    )
    return replace(chain, notes=(told,))


def _apart(path: Path, delta: Array, nominal: Array) -> tuple[Chain, float]:
    chains = []
    for deviation in (np.zeros_like(delta), delta):
        T, joints = np.eye(4), []
        theta, a, d, alpha = np.vstack([np.zeros(6), nominal]) + deviation
        for i, name in enumerate(JOINTS):
            before, after = link(theta[i], d[i], a[i], alpha[i])
            joints.append(Joint(name, "revolute", T @ before, np.array([0.0, 0.0, 1.0])))
            T = after
        chains.append(near_the_arm(Chain(path.stem, tuple(joints), T)))
    q = np.random.default_rng(0).uniform(-math.pi, math.pi, (50, 6))
    plain, calibrated = (nominal_flanges(chain, q)[:, :3, 3] for chain in chains)
    return chains[1], float(np.linalg.norm(calibrated - plain, axis=1).max())


def _fitting(path: Path, delta: Array) -> str:
    near = {name: _apart(path, delta, _published(name))[1] for name in NOMINAL}
    fits = sorted((name for name in near if near[name] <= FARTHEST), key=near.__getitem__)
    return listed(f"{name} ({near[name] * 1e3:.0f} mm)" for name in fits)


def _published(name: str) -> Array:
    d1, a2, a3, d4, d5, d6 = NOMINAL[name]
    return np.array([(0, a2, a3, 0, 0, 0), (d1, 0, 0, d4, d5, d6), ALPHA])


def _nominal(
    path: Path, sections: Mapping[str, Mapping[str, str]], model: str | None, delta: Array
) -> Array:
    if model is not None:
        by_name = {name.lower(): name for name in NOMINAL}
        known = by_name.get(model.lower().replace(" ", ""), model)
        told = f"{path}: the robot '{model}' is not known"
        messages.check_known(known, NOMINAL, told, "known are")
        return _published(known)
    beside = path.with_name(CONTROLLER)
    if "DH" not in sections and beside.is_file():
        path = beside
        sections = _sections(path, read_text(path, "controller's settings", MOST_BYTES))
    if "DH" in sections:
        return np.array([_six(path, sections["DH"], name) for name in ("a", "d", "alpha")])
    raise InputError(
        f"{path}: states deviations from the robot's nominal table; name the robot, as in ur_model "
        f'= "UR10e" in [robot] or {option("ur_model")}, or put the {CONTROLLER} of its controller '
        f"beside it; this one fits {_fitting(path, delta) or f'none of {listed(NOMINAL)}'}"
    )


def _sections(path: Path, text: str) -> Mapping[str, Mapping[str, str]]:
    parser = configparser.ConfigParser(
        strict=False, inline_comment_prefixes=("#",), interpolation=None
    )
    try:
        parser.read_string(text)
    except configparser.Error as error:
        first = str(error).splitlines()[0]
        raise InputError(f"{path}: no file of a controller ({first}); check it") from None
    return {name: dict(parser[name]) for name in parser.sections()}


def _six(path: Path, section: Mapping[str, str], key: str) -> list[float]:
    require(key in section, f"{path}: {key} is missing; it takes six numbers in [ ]")
    words = section[key].strip().strip("[]").split(",")
    require(len(words) == 6, f"{path}: {key} has {len(words)} numbers; a UR has six joints")
    return [_number(f"{path}: {key}", word.strip()) for word in words]


def _number(where: str, found: Any) -> float:
    try:
        value = float(found)
    except (TypeError, ValueError):
        value = math.nan
    require(math.isfinite(value), f"{where}: {quoted(found)} is not a finite number; correct it")
    return value


def _of_origins(path: Path, text: str) -> Chain:
    import yaml

    require("&" not in text, f"{path}: has YAML anchors, which no such file has; remove them")
    try:
        found = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError):
        raise InputError(f"{path}: not YAML; save the file of ur_calibration again") from None
    kinematics: Any = found.get("kinematics") if isinstance(found, dict) else None
    told = f"has no 'kinematics' with {listed(LINKS)}, as a file of ur_calibration has"
    require(isinstance(kinematics, dict), f"{path}: {told}")
    joints = []
    for name, of_link in zip(JOINTS, LINKS, strict=True):
        origin, where = kinematics.get(of_link), f"{path}: kinematics.{of_link}"
        complete = isinstance(origin, dict) and all(key in origin for key in ORIGIN)
        require(complete, f"{where} needs {', '.join(ORIGIN)}")
        numbers = [_number(f"{where}.{key}", origin[key]) for key in ORIGIN]
        check_angles(where, tuple(numbers[3:]), "the file is in rad")
        T = pose_at(numbers[:3], rotation_from_rpy(numbers[3:]))
        joints.append(Joint(name, "revolute", T, np.array([0.0, 0.0, 1.0])))
    return Chain(path.stem, tuple(joints), np.eye(4))
