"""Starting values found from the data: base, markers and target orientation, or cable geometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from elastocal.identification.registration import SAMPLE, RegistrationProblem, register
from elastocal.manipulator.effects.placements import BaseFrame, DistanceSensor, MarkerPosition
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

Array = NDArray[np.float64]

DISTANCE_STARTS = 64
DISTANCE_SAMPLE = 300


def start_values(
    model: Model, table: Measurements, seed: int = 0, free: NDArray[np.int64] | None = None
) -> Array:
    """Parameter values (parameters,) near the data: nominal, but base, markers and cable placed.

    Only parameters that are active in the model and among `free` (default all) are moved.
    Positions are registered to the nominal arm; distances are fitted by a robust multi-start.
    """
    x = model.nominal.copy()
    movable = set(range(len(x)) if free is None else free.tolist())
    if model.observe == "distance":
        return _distance_start(model, table, x, seed, movable)
    if table.position is None:
        return x
    places = {
        p.where
        for i, p in enumerate(model.parameters)
        if i in movable and p.effect in (BaseFrame.name, MarkerPosition.name)
    }
    if not places:
        return x
    names = list(model.cell.tool.markers)
    codes = np.array([names.index(m) for m in table.marker_names])[table.marker]
    # Deflected readings would pull the start; unloaded ones serve alone where they are enough
    # and show every marker.
    light = ~np.any(table.force != 0, axis=1)
    enough = light.sum() >= 12 and np.array_equal(np.unique(codes[light]), np.unique(codes))
    rows = np.flatnonzero(light) if enough else np.arange(len(table))
    if len(rows) > SAMPLE:
        rows = np.random.default_rng(seed).choice(rows, SAMPLE, replace=False)
    T = model.rigid.flange_poses(table.take(rows))
    nominal = model.cell.model.nominal
    problem = RegistrationProblem(
        T[:, :3, :3], T[:, :3, 3], table.position[rows], codes[rows],
        np.array([model.cell.tool.markers[m] for m in names]),
        np.array([f"marker:{m}" in places for m in names]),
        "base" in places,
        np.eye(3) if nominal.base_rotation is None else nominal.base_rotation,
        np.zeros(3) if nominal.base_position is None else nominal.base_position,
    )  # fmt: skip
    found = register(problem, seed)
    values = dict(zip(("base.x", "base.y", "base.z"), found.translation, strict=True))
    vector = Rotation.from_matrix(found.rotation).as_rotvec()
    values |= dict(zip(("base.rx", "base.ry", "base.rz"), vector, strict=True))
    for name, position in zip(names, found.markers, strict=True):
        values |= {f"marker:{name}.{k}": v for k, v in zip("xyz", position, strict=True)}
    if model.observe == "pose" and table.rotation is not None:
        values |= _target_rotations(found.rotation, T, table.take(rows), codes[rows], names)
    for i, parameter in enumerate(model.parameters):
        if parameter.name in values and i in movable:
            x[i] = values[parameter.name]
    return x


def _target_rotations(
    base: Array, T: Array, table: Measurements, codes: NDArray, names: list[str]
) -> dict[str, float]:
    measured = Rotation.from_rotvec(np.asarray(table.rotation))
    relative = Rotation.from_matrix(base @ T[:, :3, :3]).inv() * measured
    values: dict[str, float] = {}
    for c, name in enumerate(names):
        if (codes == c).any():
            vector = relative[codes == c].mean().as_rotvec()
            values |= {f"marker:{name}.r{k}": v for k, v in zip("xyz", vector, strict=True)}
    return values


def _distance_start(
    model: Model, table: Measurements, x: Array, seed: int, movable: set[int]
) -> Array:
    """Anchor, offset and attachment by robust least squares from many anchors.

    A distance tells the side of the robot on which the anchor lies only through all poses
    together, so anchors are tried on a sphere around the poses; the best robust cost wins.
    """
    columns = np.array(
        [i for i, p in enumerate(model.parameters)
         if i in movable and p.effect in (DistanceSensor.name, MarkerPosition.name)]
    )  # fmt: skip
    if not len(columns):
        return x
    rng = np.random.default_rng(seed)
    if len(table) > DISTANCE_SAMPLE:
        table = table.take(np.sort(rng.choice(len(table), DISTANCE_SAMPLE, replace=False)))
    distance = np.asarray(table.distance)
    centre = model.rigid.flange_poses(table)[:, :3, 3].mean(axis=0)
    anchor = [i for i in columns if "anchor" in model.parameters[i].name]
    directions = qmc.Sobol(3, rng=seed).random(DISTANCE_STARTS) * 2 - 1
    best, best_cost = x, np.inf
    given = model.cell.tracker.anchor is not None

    def residual(z: Array) -> Array:
        y = x.copy()
        y[columns] = z
        return model.predict(table, y) - distance

    def jacobian(z: Array) -> Array:
        y = x.copy()
        y[columns] = z
        return model.regressor(table, y, columns).B

    for k, direction in enumerate(directions):
        trial = x.copy()
        if anchor and not (given and k == 0):
            unit = direction / np.linalg.norm(direction)
            trial[anchor] = centre + unit * np.median(distance)
        found = least_squares(
            residual, trial[columns], jacobian, loss="soft_l1", f_scale=2e-3, max_nfev=60
        )
        if found.cost < best_cost:
            best, best_cost = trial.copy(), found.cost
            best[columns] = found.x
    return best
