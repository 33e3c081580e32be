"""Cells to design plans for, what is known of them before, and the ways to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.calibration import cell_of, placement, random_chain
from support.cells import kr270_cell, kr270_chain

from elastocal.cell import Cell
from elastocal.cell_tables import CartesianNoise, DesignSpec, Tool, Tracker
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain, Joint, LinkMass
from elastocal.model.manipulator import Model
from elastocal.planning import poses as target_poses
from elastocal.planning.information import Known
from elastocal.planning.poses import TargetPoses
from elastocal.planning.setup import Setup, set_up

AXIS = CartesianNoise(np.array([10e-6, 15e-6, 20e-6]))
FULL = ("base_frame", "joint_offset", "link_geometry", "joint_compliance", "marker_position")


def plan_cell(
    effects: Sequence[str] = ("joint_compliance",),
    observe: str = "deflection",
    noise: Any = AXIS,
    model: dict[str, Any] | None = None,
    **design: Any,
) -> Cell:
    """The KR 270-2 with a tracker of known noise; `design` goes to DesignSpec."""
    tracker = Tracker(np.array([3.0, -2.0, 0.5]), noise, np.array([2.0, -1.5, 0.3]), 5e-5, 1e-4)
    cell = kr270_cell(effects, observe, **(model or {}))
    return replace(cell, tracker=tracker, design=DesignSpec(**design))


def scara() -> Chain:
    """Two vertical axes, a lift that slides, a vertical wrist; the tool hangs 0.2 m to the side."""
    up = np.array([0.0, 0.0, 1.0])
    joints = (
        Joint("q1", "revolute", placement([0, 0, 0.4]), up, -2.5, 2.5),
        Joint("q2", "revolute", placement([0.4, 0, 0.1]), up, -2.5, 2.5),
        Joint("q3", "prismatic", placement([0.35, 0, 0]), -up, 0.0, 0.3),
        Joint("q4", "revolute", placement([0, 0, -0.1]), up, -3.0, 3.0),
    )
    masses = tuple(LinkMass(5.0, np.array([0.2, 0.0, 0.0])) for _ in joints)
    flange = placement([0, 0, -0.05], Rotation.from_euler("x", np.pi))
    return Chain("scara", joints, flange, masses)


def sliding_chain(seed: int = 3) -> Chain:
    """An arm about random axes, whose second and fifth joints slide."""
    chain = random_chain(seed)
    joints = tuple(
        replace(j, kind="prismatic", lower=-0.4, upper=0.5) if i in (1, 4) else j
        for i, j in enumerate(chain.joints)
    )
    return replace(chain, name="sliding", joints=joints)


def any_cell(
    chain: Chain, effects: Sequence[str], compliance: float = 1e-6, observe: str = "position",
    noise: Any = AXIS, model: dict[str, Any] | None = None, **design: Any,
) -> Cell:  # fmt: skip
    """A cell for any chain: three markers, a load point, the same compliance in every joint."""
    cell = cell_of(effects, observe=observe, **(model or {}))
    markers = {"M1": [0.2, 0, 0.05], "M2": [-0.1, 0.15, 0.1], "M3": [0, -0.15, 0.15]}
    tool = Tool(np.array([0.1, 0.0, 0.2]), {k: np.array(v) for k, v in markers.items()})
    nominal = replace(cell.model.nominal, joint_compliance=(compliance,) * chain.n_joints)
    tracker = Tracker(np.array([3.0, -2.0, 0.5]), noise, np.array([2.0, -1.5, 0.3]), 5e-5, 1e-4)
    return replace(
        cell, tool=tool, tracker=tracker, model=replace(cell.model, nominal=nominal),
        design=DesignSpec(**design),
    )  # fmt: skip


def setup_of(
    cell: Cell,
    q: NDArray,
    chain: Chain | None = None,
    known: Known | None = None,
    seed: int = 0,
    targets: TargetPoses | None = None,
    n_poses: int = 10**9,  # so many show whatever can be shown
) -> Setup:
    """What a design knows before it chooses among candidates q (N, n)."""
    chain = chain or kr270_chain()
    return set_up(
        Model.assembled(chain, cell), q, n_poses,
        targets or target_poses.test_poses(cell, chain, None, seed), known or Known(),
    )  # fmt: skip


def value_of(setup: Setup, q: NDArray) -> float:
    """Φ of a plan of poses q (N, n), each read in all load states."""
    M = setup.gathered(setup.information.blocks(q))
    return float(setup.criterion.of_information(M))


def as_table(q: NDArray) -> Measurements:
    n = len(q)
    return Measurements(
        source="poses", row=np.arange(n) + 2, q=q, configuration=np.arange(n),
        configuration_labels=tuple(map(str, range(1, n + 1))),
        repeat=np.zeros(n, dtype=np.int64), marker=np.zeros(n, dtype=np.int64),
        marker_names=("M1",), force=np.zeros((n, 3)),
    )  # fmt: skip
