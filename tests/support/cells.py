"""The KR 270-2 as a cell, and random tables to evaluate models on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from support.robots import KR270

from elastocal.cell import Cell
from elastocal.cell_tables import EffectChoice, ModelSpec, Nominal, Robot, Tool, Tracker
from elastocal.measurements import Measurements, read_measurements
from elastocal.model.chain import Chain
from elastocal.model.rigid import nominal_flanges
from elastocal.model.urdf import read_urdf
from elastocal.units import Array

# Table 3 of Klimchik et al. (2013) in rad/(N m), k2 at its first level; k1 is not in it.
COMPLIANCE = (3.5e-7, 0.287e-6, 0.416e-6, 2.786e-6, 3.483e-6, 2.074e-6)
LOAD_POINT = np.array([0.20, 0.0, 0.25])
# Three non-collinear markers, each 0.25 m from the flange's origin.
MARKERS = {
    "M1": np.array([0.25, 0.0, 0.0]),
    "M2": np.array([-0.10, 0.20, 0.1118]),
    "M3": np.array([-0.10, -0.20, 0.1118]),
}
ANCHOR = np.array([2.0, -1.5, 0.3])
# An example with the geometry FACTS remembers for this robot; the stiffness is a guess.
COMPENSATOR = {
    "joint": "joint2",
    "stiffness_N_per_m": 1.4e5,
    "anchor_m": (0.686, 0.120),
    "arm_m": 0.185,
    "free_length_m": 0.458,
}
DOWN = np.array([0.0, 0.0, -2600.0])
SLANTED = np.array([900.0, -1500.0, -2600.0])

# Table 2 of Klimchik et al. (2013): the 15 measurement configurations, (15, 6) rad.
PLAN = KR270.with_name("plan.csv")
TABLE_2 = read_measurements(PLAN, joint_kinds=("revolute",) * 6, observe="plan").q


@lru_cache
def kr270_chain() -> Chain:
    return read_urdf(KR270)


def kr270_cell(effects: Sequence[str] = (), observe: Any = "position", **model: Any) -> Cell:
    """A cell of the KR 270-2; `effects` as in a cell file ("name" or "name:place").

    `model` goes to ModelSpec; the nominal compliances are Table 3's unless `nominal` is given.
    """
    model.setdefault("nominal", Nominal(joint_compliance=COMPLIANCE))
    return Cell(
        name="kr270",
        path=None,
        robot=Robot(urdf=KR270),
        tool=Tool(LOAD_POINT, dict(MARKERS)),
        tracker=Tracker(anchor=ANCHOR),
        model=ModelSpec(observe=observe, effects=choices(effects), **model),
    )


def choices(effects: Sequence[str]) -> tuple[EffectChoice, ...]:
    """ "joint_compliance:joint2" → EffectChoice("joint_compliance", "joint2")."""
    parts = [effect.partition(":") for effect in effects]
    return tuple(EffectChoice(name, where or None) for name, _, where in parts)


def random_poses(chain: Chain, n: int, seed: int) -> Array:
    """(n, joints) in rad or m, inside the joint limits; ±π where there is none."""
    low = [max(joint.lower, -np.pi) for joint in chain.joints]
    high = [min(joint.upper, np.pi) for joint in chain.joints]
    return np.random.default_rng(seed).uniform(low, high, (n, chain.n_joints))


def table_at(
    q: Array, forces: Any = ((0, 0, 0),), markers: Sequence[str] = ("M1",)
) -> Measurements:
    """Every pose under every force with every marker; a configuration per pose, positions zero.

    `forces` (states, 3) for all poses, or (poses, states, 3).
    """
    forces = np.asarray(forces, dtype=float)
    per_pose = np.broadcast_to(forces, (len(q), *forces.shape[-2:]))
    n, states, m = len(q), per_pose.shape[1], len(markers)
    pose = np.repeat(np.arange(n), states * m)
    return Measurements(
        source="table.csv",
        row=np.arange(len(pose)) + 2,
        q=np.asarray(q, dtype=float)[pose],
        configuration=pose,
        configuration_labels=tuple(str(i + 1) for i in range(n)),
        repeat=np.zeros(len(pose), dtype=np.int64),
        marker=np.tile(np.arange(m), n * states),
        marker_names=tuple(markers),
        force=np.repeat(per_pose.reshape(-1, 3), m, axis=0),
        position=np.zeros((len(pose), 3)),
    )


def table_of(
    poses: Array, force: Array, markers: Sequence[str] = tuple(MARKERS), both: bool = False
) -> Measurements:
    """Every pose once per marker under `force` (3,); with `both`, also without load, before."""
    return replace(
        table_at(poses, [0 * force, force] if both else [force], markers), source="table"
    )


def random_table(
    chain: Chain, n: int, seed: int, force: Array = SLANTED, markers: Sequence[str] = tuple(MARKERS)
) -> Measurements:
    """`n` random poses, each unloaded and loaded, with every column a model may ask for.

    Loads scatter about `force`; measured rotations lie within about 0.2 rad of the nominal
    flange; everything else is noise of a plausible size.
    """
    rng = np.random.default_rng(seed + 1000)
    table = table_of(random_poses(chain, n, seed), np.asarray(force, dtype=float), markers, True)
    rows = len(table)
    per_pose = rng.uniform(0.7, 1.3, (n, 3))
    turned = Rotation.from_matrix(nominal_flanges(chain, table.q)[:, :3, :3])
    return replace(
        table,
        force=table.force * per_pose[table.configuration],
        position=rng.normal(size=(rows, 3)),
        rotation=(turned * Rotation.from_rotvec(0.1 * rng.normal(size=(rows, 3)))).as_rotvec(),
        distance=rng.uniform(1.0, 4.0, rows),
        torque=rng.normal(size=(rows, chain.n_joints)) * 2000.0,
        time=np.sort(rng.uniform(0.0, 7200.0, rows)),
        approach=rng.choice([-1.0, 1.0], (rows, chain.n_joints)),
        temperature=rng.uniform(18.0, 26.0, rows),
    )
