"""Arms to calibrate, true values, simulated readings, and estimates held against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation
from support.cells import choices, random_poses, table_at

from elastocal.cell import Cell
from elastocal.cell_tables import ModelSpec, Robot, Tool, Tracker, Unsteadiness
from elastocal.identification.result import Calibration
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain, Joint, LinkMass
from elastocal.model.manipulator import Model
from elastocal.simulation import simulate
from elastocal.units import Array

GEOMETRY = ("base_frame", "joint_offset", "link_geometry", "marker_position")
SPRINGS = (*GEOMETRY, "joint_compliance")
PLACED = ("base_frame", "marker_position")
BASE = tuple(f"base.{k}" for k in ("x", "y", "z", "rx", "ry", "rz"))


def random_chain(seed: int, n: int = 6, vertical_first: bool = False) -> Chain:
    """Revolute joints about random axes, 0.15 to 0.5 m apart, limits ±2.5 rad."""
    rng = np.random.default_rng(seed)
    joints = []
    for i in range(n):
        T = placement(
            rng.uniform(-0.3, 0.3, 3) + np.array([0, 0, 0.2]), Rotation.random(random_state=rng)
        )
        axis = rng.normal(size=3)
        if i == 0 and vertical_first:
            T, axis = placement([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 1.0])
        joints.append(Joint(f"q{i + 1}", "revolute", T, axis / np.linalg.norm(axis), -2.5, 2.5))
    masses = tuple(LinkMass(10.0, rng.uniform(-0.1, 0.1, 3)) for _ in range(n))
    flange = placement(rng.uniform(-0.1, 0.1, 3), Rotation.random(random_state=rng))
    return Chain(f"random{seed}", tuple(joints), flange, masses)


def planar_chain(n: int = 3) -> Chain:
    """Joint 1 vertical, all others about parallel horizontal axes, links along x."""
    joints = [Joint("q1", "revolute", placement([0, 0, 0.4]), np.array([0.0, 0, 1]), -3.0, 3.0)]
    for i in range(1, n):
        where = [0.2, 0.0, 0.0] if i == 1 else [0.5, 0.0, 0.0]
        axis = np.array([0.0, 1.0, 0.0])
        joints.append(Joint(f"q{i + 1}", "revolute", placement(where), axis, -2.5, 2.5))
    masses = tuple(LinkMass(10.0, np.array([0.2, 0.0, 0.0])) for _ in range(n))
    return Chain("planar", tuple(joints), placement([0.4, 0.0, 0.0]), masses)


def placement(where: Any, turned: Rotation | None = None) -> Array:
    T = np.eye(4)
    T[:3, 3] = where
    if turned is not None:
        T[:3, :3] = turned.as_matrix()
    return T


def cell_of(
    effects: Sequence[str],
    markers: dict[str, Array] | None = None,
    tracker: Tracker | None = None,
    observe: str = "position",
    load_point: Any = (0.1, 0.0, 0.1),
    noise: Unsteadiness | None = None,
    **model: Any,
) -> Cell:
    """A cell with the given effects; one marker at the flange's origin unless stated."""
    return Cell(
        "cell", None, Robot(),
        Tool(np.array(load_point, dtype=float), markers or {"M1": np.zeros(3)}),
        tracker or Tracker(),
        ModelSpec(observe=observe, effects=choices(effects), **model),  # type: ignore[arg-type]
        noise=noise or Unsteadiness(),
    )  # fmt: skip


def true_values(
    model: Model, rng: np.random.Generator, geometry: float = 1e-3, anywhere: bool = True
) -> Array:
    """Geometric errors N(0, geometry), compliances ± 20 %, tool within 0.15 m, base anywhere."""
    x = model.nominal.copy()
    for i, p in enumerate(model.parameters):
        if p.effect in ("joint_offset", "link_geometry"):
            x[i] += geometry * rng.normal()
        if p.effect == "joint_compliance":
            x[i] *= 1 + 0.2 * np.clip(rng.normal(), -2, 2)
        if p.effect == "marker_position" and anywhere:
            x[i] += rng.uniform(-0.15, 0.15)
        if p.name in BASE[:3] and anywhere:
            x[i] = rng.uniform(-3, 3)
    if anywhere and BASE[3] in model.names:
        rows = [model.names.index(name) for name in BASE[3:]]
        x[rows] = Rotation.random(random_state=rng).as_rotvec()
    return x


def measured(
    model: Model, table: Measurements, x: Array, sigma: float, rng: np.random.Generator
) -> Measurements:
    """Readings at x with isotropic noise `sigma` in m on positions or distances."""
    exact = simulate(model, table, x, rng, noise=False)
    if model.observe == "distance":
        noise = sigma * rng.normal(size=len(table))
        return replace(exact, distance=np.asarray(exact.distance) + noise)
    noise = sigma * rng.normal(size=(len(table), 3))
    return replace(exact, position=np.asarray(exact.position) + noise)


def campaign(
    effects: Sequence[str] = PLACED, poses: int = 30, seed: int = 0, sigma: float = 5e-5,
    forces: Any = ((0, 0, 0),), chain: Chain | None = None, **cell: Any,
) -> tuple[Model, Measurements, Array]:  # fmt: skip
    """An arm, by default a planar one, readings of it, and the true values behind them."""
    model = Model.assembled(chain or planar_chain(), cell_of(effects, **cell))
    rng = np.random.default_rng(seed)
    x = true_values(model, rng)
    plan = table_at(random_poses(model.chain, poses, seed), forces)
    return model, measured(model, plan, x, sigma, rng), x


def with_values(model: Model, values: dict[str, float]) -> Array:
    x = model.nominal.copy()
    for name, value in values.items():
        x[model.names.index(name)] = value
    return x


def combination_truth(result: Calibration, truth: Array, first: str) -> float:
    """True value of a determined parameter or combination: X_k + Σ f (X_d − held_d)."""
    names = result.model.names
    value = truth[names.index(first)]
    if result[first].combined_with:
        for name, factor in result.combination(first).terms.items():
            if name != first:
                value += factor * (truth[names.index(name)] - result[name].held)
    return float(value)


def z_scores(result: Calibration, truth: Array, names: Sequence[str] = ()) -> Array:
    """(estimate − truth)/std of every determined parameter or combination (or of `names`)."""
    std = np.sqrt(np.diag(result.covariance))
    chosen = names or result.determined
    return np.array(
        [
            (result[name].held - combination_truth(result, truth, name))
            / std[result.determined.index(name)]
            for name in chosen
        ]
    )


def covered(result: Calibration, truth: Array, names: Sequence[str] = ()) -> Array:
    """Whether each 95 % t interval covers the truth (determined,)."""
    return np.abs(z_scores(result, truth, names)) < stats.t.ppf(0.975, result.dof)


def binomial_band(n: int, p: float, level: float = 0.999) -> tuple[int, int]:
    """Counts k with P(outside [low, high]) ≤ 1 − level for k ~ Binomial(n, p)."""
    tail = (1 - level) / 2
    return int(stats.binom.ppf(tail, n, p)), int(stats.binom.isf(tail, n, p))
