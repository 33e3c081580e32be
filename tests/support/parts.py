"""Arms and tables that are worked on whole and in parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from support.calibration import GEOMETRY, cell_of, measured, planar_chain, table_at, true_values
from support.cells import random_poses

from elastocal.cell.arm_description import CartesianNoise, Nominal, PolarNoise, Tracker
from elastocal.identification.least_squares import Problem
from elastocal.identification.outliers import find_faulty
from elastocal.identification.solve import Solution, solve
from elastocal.identification.start import fixed_and_free, start_values
from elastocal.identification.weighted_problem import weights_for
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe, subset
from elastocal.simulation import simulate
from elastocal.units import Array

SIGMA = 3e-5
CARTESIAN = CartesianNoise(np.array([1.0, 2.0, 0.5]) * SIGMA)
Case = tuple[Model, Measurements]


def shuffled(table: Measurements, seed: int) -> Measurements:
    """Rows in no order: a configuration is scattered over the table."""
    return table.take(np.random.default_rng(seed).permutation(len(table)))


def arm(
    effects: Sequence[str],
    seed: int,
    poses: int = 60,
    forces: Any = ((0, 0, 0),),
    observe: str = "position",
    noise: CartesianNoise | PolarNoise | None = None,
    **tracker: Any,
) -> tuple[Model, Measurements, Array, np.random.Generator]:
    """Model, plan, true values and generator of a planar arm with random errors."""
    chain = planar_chain(4)
    cell = cell_of(
        effects, tracker=Tracker(noise=noise, **tracker), observe=observe,
        nominal=Nominal(joint_compliance=(1e-5,) * 4),
    )  # fmt: skip
    model = Model.assembled(chain, cell)
    rng = np.random.default_rng(seed)
    truth = true_values(model, rng)
    return model, table_at(random_poses(chain, poses, seed), forces), truth, rng


def positions() -> Case:
    model, plan, truth, rng = arm(GEOMETRY, 1, noise=CARTESIAN)
    return model, simulate(model, plan, truth, rng)


def deflections() -> Case:
    """Two loads and three repeats share the unloaded readings of their configuration."""
    model, plan, truth, rng = arm(
        ("joint_compliance",),
        4,
        20,
        [[0, 0, 0], [0, 0, -200], [90, 40, 0]],
        "deflection",
        CARTESIAN,
    )
    rows = np.concatenate([np.arange(60), np.flatnonzero(plan.force.any(axis=1))])
    plan = plan.take(rows)
    repeat = np.repeat([0, 1], [60, 40])
    table = replace(plan, repeat=repeat, row=np.arange(100) + 2)
    return model, shuffled(simulate(model, table, truth, rng), 4)


def poses() -> Case:
    effects = ("base_frame", "marker_position", "marker_orientation", "joint_offset")
    model, plan, truth, rng = arm(effects, 5, 50, observe="pose", noise=CARTESIAN,
                                  rotation_sigma=5e-5)  # fmt: skip
    truth[[model.names.index(f"base.r{k}") for k in "xyz"]] = 0.3
    return model, simulate(model, plan, truth, rng)


def distances() -> Case:
    model, plan, truth, rng = arm(("distance_sensor", "marker_position"), 6, 90, observe="distance")
    for name, value in {"anchor_x": 1.6, "anchor_y": -1.2, "anchor_z": 0.3}.items():
        truth[model.names.index(f"tracker.{name}")] = value
    return model, measured(model, plan, truth, 1e-4, rng)


CASES = (positions, deflections, poses, distances)


def solved(model: Model, table: Measurements, covariance: Array | None = None) -> Solution:
    """The weighted fit from nothing, before anything is made of it."""
    observed = observe(table, model.observe)
    weights = weights_for(observed, model.cell.tracker, "auto", covariance)
    free = fixed_and_free(model, ())
    x0 = start_values(model, table, 0, free)
    return solve(Problem(model, observed, weights, x0, free))


def faulty_of(solution: Solution) -> tuple[NDArray[np.bool_], Solution]:
    """Faulty observations, the others solved anew with weights of their own."""
    problem, faulty = solution.problem, find_faulty(solution)
    observed = subset(problem.observations, ~faulty)
    weights = weights_for(observed, problem.model.cell.tracker)
    return faulty, solve(replace(problem, observations=observed, weights=weights), try_wider=False)
