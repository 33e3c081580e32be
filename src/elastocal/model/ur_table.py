"""Factory calibration of Universal Robots → nominal chain, in the two forms that users have.

The controller's `calibration.conf` states deviations from the model's nominal table, standard
convention, joint by joint:

    θ = Δθ,  a = a₀ + Δa,  d = d₀ + Δd,  α = α₀ + Δα

The YAML file of `ur_calibration` states the same arm as origins of its joints, x y z in m and
roll pitch yaw in rad, whose z are the axes.  Base is the controller's base, flange its tool flange.
"""

from __future__ import annotations

import configparser
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from elastocal.errors import InputError, option, require
from elastocal.files import read_text
from elastocal.model.chain import Chain, Joint
from elastocal.model.dh import link
from elastocal.model.plausible import check_angles, near_the_arm
from elastocal.model.rigid import nominal_flanges
from elastocal.text import did_you_mean, listed, quoted
from elastocal.units import Array, rotation_from_rpy

ENDINGS = (".conf", ".yaml", ".yml")
MOST_BYTES = 100_000
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


def read_ur_table(path: Path, ur_model: str | None = None) -> Chain:
    """The chain of a `calibration.conf` or of a YAML of `ur_calibration`; no limits, no masses.

    `ur_model`: whose nominal table a calibration.conf counts from; None: that of [DH] in the file,
    or in urcontrol.conf beside it.  Frames are taken near the arm, see `near_the_arm`.

    Raises InputError, naming file and key.
    """
    text = read_text(path, "robot's calibration", MOST_BYTES)
    if path.suffix.lower() == ".conf":
        return _of_deviations(path, text, ur_model)
    require(
        ur_model is None, f"{path}: ur_model belongs to a calibration.conf; leave it out for YAML"
    )
    return _of_origins(path, text)


def _of_deviations(path: Path, text: str, ur_model: str | None) -> Chain:
    sections = _sections(path, text)
    require(
        "mounting" in sections,
        f"{path}: has no section [mounting] with delta_theta, delta_a, delta_d, delta_alpha, as a "
        "calibration.conf of Universal Robots has",
    )
    own = sections["mounting"]
    delta = np.array([_six(path, own, f"delta_{name}") for name in ("theta", "a", "d", "alpha")])
    check_angles(f"{path}: delta_theta", tuple(delta[0]), "this file is in rad")
    nominal = _nominal(path, sections, ur_model, delta)
    chain, far = _apart(path, delta, nominal)
    require(
        far <= FARTHEST,
        f"{path}: the arm is {far * 1e3:.0f} mm away from the nominal one, and factory "
        f"calibrations are millimetres; it fits {_fitting(path, delta) or 'no known robot'}",
    )
    longest = float(np.abs(delta[2]).max())
    told = (
        f"d of up to {longest:.4g} m in the controller's table cancel: joint frames are taken "
        "where the axes pass the arm; it moves as the table says"
    )
    return replace(chain, notes=(told,))


def _apart(path: Path, delta: Array, nominal: Array) -> tuple[Chain, float]:
    """The calibrated chain, and its largest distance in m from the nominal one over some poses."""
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
    """The robots whose nominal table a calibration counts from, by how near it is."""
    near = {name: _apart(path, delta, _published(name))[1] for name in NOMINAL}
    fits = sorted((name for name in near if near[name] <= FARTHEST), key=near.__getitem__)
    return listed(f"{name} ({near[name] * 1e3:.0f} mm)" for name in fits)


def _published(name: str) -> Array:
    """a₀, d₀ and α₀ (3, 6) of a robot."""
    d1, a2, a3, d4, d5, d6 = NOMINAL[name]
    return np.array([(0, a2, a3, 0, 0, 0), (d1, 0, 0, d4, d5, d6), ALPHA])


def _nominal(
    path: Path, sections: Mapping[str, Mapping[str, str]], model: str | None, delta: Array
) -> Array:
    """a₀, d₀ and α₀ (3, 6)."""
    if model is not None:
        by_name = {name.lower(): name for name in NOMINAL}
        known = by_name.get(model.lower().replace(" ", ""))
        if known is None:
            raise InputError(
                f"{path}: the robot '{model}' is not known{did_you_mean(model, NOMINAL)}; known "
                f"are {listed(NOMINAL)}"
            )
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
    text = section.get(key)
    require(text is not None, f"{path}: {key} is missing; it takes six numbers in [ ]")
    words = str(text).strip().strip("[]").split(",")
    return [_number(f"{path}: {key}", word.strip()) for word in _counted(path, key, words)]


def _counted(path: Path, key: str, words: list[str]) -> list[str]:
    require(len(words) == 6, f"{path}: {key} has {len(words)} numbers; a UR has six joints")
    return words


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
    kinematics = found.get("kinematics") if isinstance(found, dict) else None
    if not isinstance(kinematics, dict):
        raise InputError(
            f"{path}: has no 'kinematics' with {listed(LINKS)}, as a file of ur_calibration has"
        )
    joints = []
    for name, of_link in zip(JOINTS, LINKS, strict=True):
        origin = kinematics.get(of_link)
        if not isinstance(origin, dict) or any(key not in origin for key in ORIGIN):
            raise InputError(f"{path}: kinematics.{of_link} needs {', '.join(ORIGIN)}")
        numbers = [_number(f"{path}: kinematics.{of_link}.{key}", origin[key]) for key in ORIGIN]
        check_angles(f"{path}: kinematics.{of_link}", tuple(numbers[3:]), "the file is in rad")
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation_from_rpy(numbers[3:]), numbers[:3]
        joints.append(Joint(name, "revolute", T, np.array([0.0, 0.0, 1.0])))
    return Chain(path.stem, tuple(joints), np.eye(4))
