"""Synthetic measurements from the model itself: chosen parameter values, chosen noise, a seed.

With the worked example: the KR 270 of Klimchik et al. 2013, simulated and identified end to end.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell import Cell
from elastocal.files import atomic_write
from elastocal.measurements import Measurements, load_states, numbered, visits, with_moves
from elastocal.messages import InputError, did_you_mean, listed, option, quoted, require, wish
from elastocal.model.calibrated import Conditions, random_table
from elastocal.model.effects import statics
from elastocal.model.effects.base import Parameter, index
from elastocal.model.manipulator import NOMINAL, Model, check_equilibrium
from elastocal.model.observations import available_noise, position_covariance
from elastocal.model.rigid import reach_of, suitable_load
from elastocal.units import Array, IntArray

if TYPE_CHECKING:
    from elastocal.identification.result import Calibration

POSES = 50  # from which sizes are taken
# m per rad/(N m) or m/N: what moves a reading by less would move it by a mm only at 1000 rad/(N m),
# and is rounding.  Loads of whole arms have slopes of 0.1 and more.
SHOWS = 1e-6


def values_from(model: Model, chosen: dict[str, float]) -> Array:
    """Parameter values (parameters,): nominal, with the `chosen` ones replaced by name (SI).

    Raises InputError for a name the model does not have.
    """
    x, names = model.nominal.copy(), list(model.names)
    for name, value in chosen.items():
        if name not in names:
            hint = did_you_mean(name, names) or "; it has: " + listed(names)
            raise InputError(f"the model has no parameter '{name}'{hint}")
        require(np.isfinite(value), f"parameter '{name}' must be a finite number, found {value}")
        x[names.index(name)] = value
    return x


def draw_errors(model: Model, scale: float, rng: np.random.Generator) -> dict[str, float]:
    """Random true values: nominal + scale · typical size · N(0, 1) for every parameter, by the
    cell and `rng` alone.

    Compliances vary by 20 % of their nominal value.  Those that have none vary about what winds a
    joint up by RATED_WIND_UP at its rated torque, and where nothing tells that are drawn positive,
    of the size that moves a reading by a millimetre where it moves one most (`_sizes_shown`).
    """
    drawn, shown = {}, None
    for k, p in enumerate(model.parameters):
        compliance = p.effect == statics.JointCompliance.name
        size = 0.2 * abs(p.nominal) if compliance or p.typical is None else p.typical
        step = scale * float(rng.normal())
        if compliance and size == 0.0 and (usual := _usual(model, p)):
            drawn[p.name] = scale * usual * math.exp(0.2 * step / scale) if scale else 0.0
            continue
        if size == 0.0 and p.typical is None and scale:
            shown = _sizes_shown(model) if shown is None else shown
            size, step = shown[k], abs(step)
        drawn[p.name] = p.nominal + step * size
    return drawn


def _usual(model: Model, p: Parameter) -> float:
    """The compliance that arms have where `identify` expects one (`load_ratio`); 0 elsewhere."""
    i, chain = index(p.where), model.chain
    expected = chain.kinds[i] == "revolute" and statics.weight_torque(chain, i) > 0
    return statics.usual_compliance(chain, model.cell, i) if expected else 0.0


def _sizes_shown(model: Model) -> Array:
    """A size (parameters,) that moves a reading by 1 mm where it moves one most; 0 for none.  Read
    at random poses within the joint limits, with the largest load of the cell (or the one that
    suits an arm of this reach) along x, y and z: not in the plan's poses, so that two tables of one
    cell are of one arm."""
    unsized = {p.effect for p in model.parameters if p.typical is None}
    cell = model.cell
    own = tuple(choice for choice in cell.model.effects if choice.name in unsized)
    seen = model.specified(replace(cell.model, observe="position", torque="computed", effects=own))
    load = statics.largest_load(cell) or suitable_load(reach_of(model.chain))
    poses = random_table(seen, Conditions(), POSES, 0).take(np.repeat(np.arange(POSES), 3))
    poses = replace(poses, force=np.tile(load * np.eye(3), (POSES, 1)))
    rows = expand_plan(poses, tuple(cell.tool.markers))
    rows = replace(rows, position=np.zeros((len(rows), 3)))
    known = dict(zip(seen.names, np.abs(seen.regressor(rows).B).max(axis=0), strict=True))
    moved = np.array([known.get(name, 0.0) for name in model.names])
    # A load on a joint's own axis leaves rounding, from which no size follows.
    return np.divide(1e-3, moved, out=np.zeros(len(moved)), where=moved > SHOWS)


def expand_plan(
    plan: Measurements, marker_names: tuple[str, ...], repeats: int = 1, load: Array | None = None
) -> Measurements:
    """Every pose of a plan once per load state, repeat and marker.

    `load` (3,) in N adds a loaded reading after each unloaded one where the plan itself states
    no forces.  Where rows are of another marker than the first, each stays with its own; repeats
    that the plan itself states share the readings, rounded up.  Rows are ordered as one would
    measure: configuration, repeat, load, marker.
    """
    forces = [plan.force]
    if load is not None:
        told = f"the plan has forces of its own; leave {option('load')} away or drop them"
        require(not plan.force.any(), f"{plan.source}: {told}")
        forces = [plan.force, plan.force + load]
    stated = plan.marker_names == marker_names and plan.marker.any()
    shape = len(plan), repeats, len(forces), 1 if stated else len(marker_names)
    index, repeat, state, marker = (part.ravel() for part in np.indices(shape))
    visit = numbered(plan.configuration, plan.marker, load_states(plan.force))
    kept = repeat < -(-repeats // np.bincount(visit)[visit])[index]
    index, repeat, state, marker = (part[kept] for part in (index, repeat, state, marker))
    rows = replace(
        plan.take(index), repeat=plan.repeat[index] * repeats + repeat,
        marker=plan.marker[index] if stated else marker, marker_names=marker_names,
        force=np.stack(forces)[state, index],
    )  # fmt: skip
    return with_moves(rows)


def marker_sigmas(cell: Cell, table: Measurements) -> Measurements:
    """The table with the cell's own σ per marker, where `[design] marker_sigma_um` states them and
    the table none.

    Raises InputError where some markers have one and others none.
    """
    stated = cell.design.marker_sigma
    if not stated or table.sigma is not None or cell.model.observe == "distance":
        return table
    sigmas = wish("marker_sigma", f"{cell.source}: [design] marker_sigma_um")
    for name in table.marker_names:
        told = f"{sigmas} states no σ for marker {quoted(name)}; state one for every marker"
        require(name in stated, told)
    sigma = np.array([stated[name] for name in table.marker_names])[table.marker]
    return replace(table, sigma=np.repeat(sigma[:, None], 3, axis=1), sigma_frame="cartesian")


def simulate(
    model: Model, rows: Measurements, x: Array, rng: np.random.Generator | int, noise: bool = True,
    remedy: str = NOMINAL,
) -> Measurements:  # fmt: skip
    """Readings of the model at parameter values x for every row, with the cell's noise.

    Per-row sigmas of `rows` win over the `marker_sigma_um` of [design], which becomes such, and
    this over the cell's tracker noise; without any a reading has none.  At each visit joints
    settle anew, configurations are off, and positions drift, as the cell's [noise] states, and the
    readings of a stop are off together by the `repeatability_um` of [design].  Positions in m in
    the tracker frame; rotations and distances where the model observes them.

    Raises ElastocalError, with the `remedy`, where a pose has no static equilibrium.
    """
    rng = np.random.default_rng(rng)
    if not noise:
        return _read(model, rows, x, rng, False, remedy)
    cell, n_joints, visit = model.cell, model.chain.n_joints, visits(rows)
    rows = marker_sigmas(cell, rows)
    settled, scatter = rows, cell.noise.of_joints(n_joints)
    if scatter.any():
        shift = rng.normal(size=(visit.max(initial=-1) + 1, n_joints)) * scatter
        settled = replace(rows, q=rows.q + shift[visit])
    found = replace(_read(model, settled, x, rng, True, remedy), q=rows.q)
    if cell.noise.configuration and found.position is not None:
        found = _off(found, cell.noise.configuration, rows.configuration, rng)
    if cell.design.repeatability:
        size = np.full((len(rows), 1), cell.design.repeatability)
        if model.observe == "deflection":  # as plans count it: of the loaded visit
            size *= rows.force.any(axis=1, keepdims=True)
        found = _off(found, size, numbered(rows.configuration, load_states(rows.force)), rng)
    if not cell.noise.drift or found.position is None:
        return found
    # Where nobody says when, visits follow each other in the order of the rows.
    _, first, code = np.unique(visit, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))[code.ravel()].astype(float)
    time = order * cell.design.motion.dwell if rows.time is None else rows.time
    when, place = np.unique(time, return_inverse=True)
    course = cell.noise.drift * rng.normal(size=(len(when), 3))
    for k, same in enumerate(np.exp(-np.diff(when) / cell.noise.lasting), start=1):
        course[k] = same * course[k - 1] + np.sqrt(1 - same**2) * course[k]
    return replace(found, position=found.position + course[place.ravel()], time=time)


def _off(
    rows: Measurements, size: float | Array, place: IntArray, rng: np.random.Generator
) -> Measurements:
    """Readings off by `size` m (standard deviation, each direction), alike at each place (n,)."""
    off = size * rng.normal(size=(place.max(initial=-1) + 1, 3))[place]
    if rows.position is None:
        return replace(rows, distance=np.asarray(rows.distance) + off[:, 0])
    return replace(rows, position=rows.position + off)


def _read(
    model: Model, rows: Measurements, x: Array, rng: np.random.Generator, noise: bool, remedy: str
) -> Measurements:
    n = len(rows)
    if model.observe == "distance":
        length = model.predict(replace(rows, distance=np.ones(n)), x)
        check_equilibrium(model, rows, length[:, None], remedy)
        sigma = (model.cell.tracker.distance_sigma or 0.0) if noise else 0.0
        return replace(rows, distance=length + sigma * _standard(model, rng, (n,)))
    # A pose model asks each row for the measured rotation it is compared with; any will do here.
    rotation, position = model.target_poses(replace(rows, rotation=np.zeros((n, 3))), x)
    check_equilibrium(model, rows, position, remedy)
    exact = replace(rows, position=position)
    if model.observe == "pose":
        turn = rotation
        if noise and model.cell.tracker.rotation_sigma is not None:
            shake = _standard(model, rng, (n, 3)) * model.cell.tracker.rotation_sigma
            turn = (Rotation.from_matrix(rotation) * Rotation.from_rotvec(shake)).as_matrix()
        exact = replace(exact, rotation=Rotation.from_matrix(turn).as_rotvec())
    kind = available_noise(exact, model.cell.tracker) if noise else "none"
    if kind == "none":
        return exact
    covariance, _ = position_covariance(exact, model.cell.tracker, kind)
    drawn = _standard(model, rng, (n, 3))
    shake = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), drawn)
    return replace(exact, position=position + shake)


def _standard(model: Model, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Numbers of variance one, with the tails that the cell's [noise] states."""
    dof = model.cell.noise.tails
    if dof is None:
        return rng.normal(size=shape)
    return np.asarray(rng.standard_t(dof, shape) * np.sqrt(1 - 2 / dof))


DEMO = Path(__file__).parent / "demo"  # its files
LOAD_N = (0.0, 0.0, -2600.0)  # 265 kg: the paper hung 250 to 280 kg
REPEATS = 6
MARK = "table3_compliances.csv"  # by which an earlier demo's folder is known
MADE = ("data.csv", "result.json", "report.html")
SEED = 2013
UNSEEN_COMPLIANCE = 0.35e-6  # rad/(N m); joint 1, which a vertical load cannot show


def run_demo(
    folder: Path, seed: int = SEED, progress: Callable[[str], None] = lambda message: None
) -> tuple[Calibration, dict[str, float], dict[str, tuple[float, float]]]:
    """Table 2's poses, Table 1's noise and Table 3's WLS compliances, measured and identified: the
    result, the true values, and those published.

    Writes cell, robot, plan and data into `folder`, so that every step can be repeated by hand.
    Table 1 states the spread of deflections, the difference of two readings, so each reading
    gets 1/√2 of it.  Raises InputError where the folder cannot be written, or holds files of the
    same names that are not the example's.
    """
    from elastocal.identification.identify import identify

    progress("copying the example")
    _copy_example(folder)
    model = Model(folder / "cell.toml")
    plan = model.read_plan(folder / "plan.csv")
    rows = expand_plan(plan, tuple(model.cell.tool.markers), REPEATS, np.array(LOAD_N))
    rows = replace(rows, sigma=reading_sigma(folder)[rows.configuration])
    truth, published = published_compliances(folder)
    progress(f"measuring {len(rows)} simulated readings")
    table = simulate(model, rows, values_from(model, truth), seed)
    table.save(data := folder / "data.csv")
    return identify(model, replace(table, source=str(data)), progress=progress), truth, published


def _copy_example(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"{folder}: is or lies in a file; name a folder for the demo") from None
    except PermissionError:
        raise InputError(f"{folder}: no permission to make this folder; name another") from None
    own = [path for path in DEMO.iterdir() if path.suffix in (".toml", ".urdf", ".csv")]
    # A campaign of somebody's own, or an example changed since, is not written over.
    there = {folder / path.name: path for path in own if (folder / path.name).exists()}
    foreign = [path for path, ours in there.items() if path.read_bytes() != ours.read_bytes()]
    foreign += [folder / n for n in MADE if folder / MARK not in there]
    for path in (path for path in foreign if path.exists()):
        raise InputError(f"{path} is not the demo's and would be written over; name another folder")
    for path in own:
        atomic_write(folder / path.name, path.read_text(encoding="utf-8"))


def reading_sigma(folder: Path) -> np.ndarray:
    """Standard deviation (configurations, 3) in m of one reading, from Table 1."""
    table = _table(folder, "table1_noise.csv")
    deflection = np.column_stack([table[f"sigma_{a}_um"] for a in "xyz"])
    return deflection * 1e-6 / np.sqrt(2)


def published_compliances(folder: Path) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """True values in rad/(N m), and the published OLS value with its ±3σ, by parameter name."""
    truth, published = {"joint1.compliance": UNSEEN_COMPLIANCE}, {}
    for row in _table(folder, MARK):
        joint, level = row["parameter"][1], row["parameter"][2:]
        name = f"joint{joint}.compliance" + (f"_level{level}" if level else "")
        keys = (f"{key}_urad_per_Nm" for key in ("wls", "ols", "ols_ci3sigma"))
        truth[name], *ols = (float(row[key]) * 1e-6 for key in keys)
        published[name] = ols[0], ols[1]
    return truth, published


def _table(folder: Path, name: str) -> np.ndarray:
    return np.genfromtxt(folder / name, delimiter=",", names=True, dtype=None, encoding="utf-8")
