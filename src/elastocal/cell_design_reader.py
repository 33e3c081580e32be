"""[design]: checked tables → what is asked of a plan, in SI units."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from elastocal.cell_design import DesignSpec, Motion, TargetBox, TargetPath, TargetPose
from elastocal.cell_design_schema import (
    DesignTable,
    LevelsTable,
    MotionTable,
    TargetBoxTable,
    TargetPathTable,
    TargetPoseTable,
)
from elastocal.cell_joints import joint_values
from elastocal.cell_keys import header, place
from elastocal.cell_values import check_markers, in_one_unit, rotation_from_rpy, vector
from elastocal.errors import InputError, require
from elastocal.files import check_exists
from elastocal.units import to_si

JOINTS = {"deg": "deg", "si": ""}
SPEEDS = {"deg_per_s": "deg", "si": ""}


def read_design(path: Path, table: DesignTable, markers: tuple[str, ...]) -> DesignSpec:
    """What the cell file `path`, whose tool has these markers, asks of a plan.

    Where poses_per_level is given and poses is not, poses is its sum.  Raises InputError for
    keys that do not go together, numbers of poses that disagree, missing files and markers that
    the cell does not have.
    """
    default = DesignSpec()
    levels, per_level = _levels(path, table.levels or LevelsTable())
    poses = _poses(path, table.poses, levels, per_level)
    sigma = table.marker_sigma_um or {}
    check_markers(path, ("design", "marker_sigma_um"), sigma, markers)
    _check_combination(path, table)
    target, repeatability = table.target_um, table.repeatability_um
    return DesignSpec(
        poses=poses,
        criterion=table.criterion or default.criterion,
        levels=levels,
        per_level=per_level,
        repeats=table.repeats or default.repeats,
        loads=None if table.loads_N is None else _loads(path, table.loads_N),
        load_choice=bool(table.load_choice),
        repeatability=0.0 if repeatability is None else to_si(repeatability, "um"),
        marker_sigma={name: to_si(float(value), "um") for name, value in sigma.items()},
        interest=tuple(table.interest or ()),
        combination=dict(table.combination or {}),
        prior=table.prior or default.prior,
        robust=table.robust or default.robust,
        robust_samples=table.robust_samples or default.robust_samples,
        candidates=table.candidates or default.candidates,
        target=None if target is None else to_si(target, "um"),
        test_poses=tuple(_pose(path, i, t) for i, t in enumerate(table.test_pose or [])),
        test_path=None if table.test_path is None else _path(path, table.test_path),
        test_box=None if table.test_box is None else _box(path, table.test_box),
        motion=_motion(path, table.motion or MotionTable()),
    )


def _levels(path: Path, table: LevelsTable) -> tuple[dict[str, tuple[float, ...]], tuple[int, ...]]:
    """The one joint with levels and the number of poses of each, () where not stated."""
    given = table.model_extra or {}
    levels = joint_values(path, ("design", "levels"), given, ("poses_per_level",))
    per_level = table.poses_per_level
    if len(levels) > 1:
        raise InputError(
            f"{path}: [design.levels] has levels of {' and '.join(levels)}; only one joint can "
            "have levels: keep one, and narrow the others in [limits]"
        )
    for joint, values in levels.items():
        if len(set(values)) < len(values):
            raise InputError(f"{path}: [design.levels] repeats a level of {joint}; give each once")
    if per_level is None:
        return levels, ()
    if not levels:
        raise InputError(
            f"{path}: key design.levels.poses_per_level has no meaning without levels; name the "
            "joint, as in joint2_deg = [-90, -45, 0]"
        )
    n = len(next(iter(levels.values())))
    if isinstance(per_level, int):
        return levels, (per_level,) * n
    if len(per_level) != n:
        raise InputError(
            f"{path}: key design.levels.poses_per_level has {len(per_level)} numbers for {n} "
            f"levels of {next(iter(levels))}; give one number for all, or one per level"
        )
    return levels, tuple(per_level)


def _poses(
    path: Path,
    poses: int | None,
    levels: dict[str, tuple[float, ...]],
    per_level: tuple[int, ...],
) -> int | None:
    if per_level:
        if poses is not None and poses != sum(per_level):
            raise InputError(
                f"{path}: key design.poses is {poses}, but the poses per level in "
                f"[design.levels] sum to {sum(per_level)}; drop or correct one of them"
            )
        return sum(per_level)
    for joint, values in levels.items():
        if poses is not None and poses < len(values):
            raise InputError(
                f"{path}: key design.poses is {poses}, but {joint} has {len(values)} levels in "
                "[design.levels], and each needs at least one pose; ask for more poses or fewer "
                "levels"
            )
    return poses


def _loads(path: Path, loads: list[list[float]]) -> np.ndarray:
    forces = np.array(loads, dtype=float)
    require(
        len(np.unique(forces, axis=0)) == len(forces),
        f"{path}: key design.loads_N repeats a load; give each once ([design] repeats says how "
        "often each is read)",
    )
    return forces


def _check_combination(path: Path, table: DesignTable) -> None:
    combination = table.combination or {}
    if combination and not any(combination.values()):
        raise InputError(
            f"{path}: key design.combination has no factor other than zero; give the combination "
            "of parameters that is to be known well"
        )


def _pose(path: Path, i: int, table: TargetPoseTable) -> TargetPose:
    above = ("design", "test_pose", i)
    q = in_one_unit(path, table, above, "q", JOINTS)
    if q is None:
        raise InputError(
            f"{path}: key {place(*above, 'q_deg')} is missing; it takes one number per joint, in "
            "degrees (q_si: in rad or m)"
        )
    return TargetPose(
        q=q[0],
        force=vector(table.load_N),
        weight=1.0 if table.weight is None else float(table.weight),
        point=vector(table.point_m),
        degrees=q[1] == "deg",
    )


def _path(path: Path, table: TargetPathTable) -> TargetPath:
    file = check_exists(path.parent / table.file, "design.test_path.file", path)
    return TargetPath(file, vector(table.load_N), vector(table.point_m))


def _box(path: Path, table: TargetBoxTable) -> TargetBox:
    lower, upper = np.array(table.lower_m, dtype=float), np.array(table.upper_m, dtype=float)
    if not (lower < upper).all():
        k = int(np.argmin(lower < upper))
        raise InputError(
            f"{path}: {header(('design', 'test_box'))} takes lower_m < upper_m in x, y and z; "
            f"found {lower[k]:g} and {upper[k]:g} in {'xyz'[k]}; swap or correct them"
        )
    return TargetBox(
        lower=lower,
        upper=upper,
        count=TargetBox.count if table.count is None else table.count,
        rotation=None if table.rpy_deg is None else rotation_from_rpy(table.rpy_deg),
        force=vector(table.load_N),
        point=vector(table.point_m),
    )


def _motion(path: Path, table: MotionTable) -> Motion:
    default, above = Motion(), ("design", "motion")
    speed = in_one_unit(path, table, above, "speed", SPEEDS)
    home = in_one_unit(path, table, above, "home", JOINTS)
    if speed and home and (speed[1] == "si") != (home[1] == "si"):
        raise InputError(
            f"{path}: keys design.motion.speed_{speed[1]} and design.motion.home_{home[1]} mix "
            "units; give both in degrees, or both in SI units (_si)"
        )
    dwell, change = table.dwell_s, table.load_change_s
    overshoot = table.overshoot_deg
    return Motion(
        speed=None if speed is None else np.atleast_1d(speed[0]),
        home=None if home is None else home[0],
        dwell=default.dwell if dwell is None else float(dwell),
        load_change=default.load_change if change is None else float(change),
        both_directions=bool(table.both_directions),
        overshoot=default.overshoot if overshoot is None else to_si(overshoot, "deg"),
        degrees=any(given is not None and given[1] != "si" for given in (speed, home)),
    )
