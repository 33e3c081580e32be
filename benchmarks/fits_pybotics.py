"""pybotics' side of fits_peers.py, in the peers' environment; imports nothing of elastocal.

x, y and z of each reading's error are handed to scipy's least_squares with its defaults.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from bench_tools import Clock
from pybotics.geometry import vector_2_matrix
from pybotics.optimization import OptimizationHandler
from pybotics.robot import Robot
from pybotics.tool import Tool
from scipy.optimize import least_squares

# What is estimated of α, a, θ, d of each link, chosen by hand: pybotics has no choice of its own.
# The base takes up all of link 1, the tool θ and d of the last link; axes 2, 3 and 4 are parallel
# and share one d.
ESTIMATED = [[0, 0, 0, 0], [1, 1, 1, 0], [1, 1, 1, 0], [1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 0, 0]]


def components(vector: Any, handler: OptimizationHandler, qs: Any, points: Any) -> Any:
    handler.apply_optimization_vector(vector)
    return (positions(handler.robot, qs) - points).ravel()


def positions(robot: Robot, qs: Any) -> Any:
    return np.array([robot.fk(q)[:3, 3] for q in qs])


def fit(how: str, folder: Path, clock: Clock) -> tuple[Any, int]:
    given = np.load(folder / "given.npz")
    with clock.step("read"):
        # The start of base and tool comes from whoever measures: 10 mm and half a degree off.
        base = given["base"] + np.array([0.01, -0.01, 0.01, 0.01, -0.01, 0.01])
        robot = Robot.from_parameters(given["table"].copy())
        robot.world_frame = vector_2_matrix(base)
        robot.tool = Tool()
        robot.tool.position = given["marker"] + np.array([-0.01, 0.01, -0.01])
        handler = OptimizationHandler(
            robot,
            kinematic_chain_mask=np.array(ESTIMATED, dtype=bool).ravel(),
            tool_mask=np.array([1, 1, 1, 0, 0, 0], dtype=bool),
            world_mask=np.ones(6, dtype=bool),
        )
    with clock.step("fit"):
        found = least_squares(
            components,
            handler.generate_optimization_vector(),
            args=(handler, given["q"], given["points"]),
        )
    handler.apply_optimization_vector(found.x)
    return positions(handler.robot, given["fresh_q"]), len(found.x)
