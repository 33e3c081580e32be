"""A calibrated arm cut down to some of its effects, what it is compared under, random poses."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from elastocal.measurements import Measurements
from elastocal.model.calibrated import CalibratedArm, MeasuredVisits
from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.effects.loads import LinkGravity
from elastocal.model.manipulator import Model
from elastocal.units import Array

RECORDED = {"torque": "recorded torques"}  # what an effect needs and only a table has


@dataclass(frozen=True)
class Conditions:
    """What the arm is compared under: force (3,) N in the tracker frame at the load point, time
    in s and temperature in °C of the table's columns (None: not stated).  With `visits` poses are
    those within their joints' ranges, and forces theirs."""

    force: Array = field(default_factory=lambda: np.zeros(3))
    time: float | None = None
    temperature: float | None = None
    visits: MeasuredVisits | None = None

    def state(self, need: str) -> bool:
        """Is what an effect needs ("time", "temperature", …) stated here?"""
        return need not in RECORDED and getattr(self, need, 0.0) is not None


@dataclass(frozen=True)
class Valued:
    """A model and the values x (parameters,) to evaluate it at."""

    model: Model
    x: Array

    @property
    def values(self) -> dict[str, float]:
        """Name → value in SI units."""
        return dict(zip(self.model.names, map(float, self.x), strict=True))

    @property
    def effects(self) -> list[str]:
        """Active effects in the catalogue's order, link weights included, the load left out."""
        spec = self.model.cell.model
        active = {choice.name for choice in spec.effects}
        if spec.link_gravity:
            active.add(LinkGravity.name)
        return [name for name in CATALOGUE if name in active]

    @property
    def elastic(self) -> bool:
        """Whether loads deflect it."""
        return any(CATALOGUE[name].elastic for name in self.effects)


def unstated_needs(calibrated: CalibratedArm, conditions: Conditions) -> dict[str, list[str]]:
    """By effect of the arm itself what it needs and the conditions do not state."""
    return {
        name: [
            need
            for need in CATALOGUE[name].needed(calibrated.model.cell)
            if not conditions.state(need)
        ]
        for name in Valued(calibrated.model, calibrated.x).effects
        if not CATALOGUE[name].of_the_measurement
    }


def arm_with(calibrated: CalibratedArm, names: Collection[str]) -> Valued:
    """The calibrated model with the effects `names` alone."""
    cell = calibrated.model.cell
    spec = cell.model
    spec = replace(
        spec,
        effects=tuple(choice for choice in spec.effects if choice.name in names),
        link_gravity=spec.link_gravity and LinkGravity.name in names,
        observe="position",
        torque="computed",
    )
    model = Model.assembled(calibrated.model.chain, replace(cell, model=spec))
    return Valued(model, np.array([calibrated.values[name] for name in model.names]))


def random_table(model: Model, conditions: Conditions, poses: int, seed: int) -> Measurements:
    """`poses` random poses, a row each, with every column that the arm's effects may ask for."""
    cell, chain, visits = model.cell, model.chain, conditions.visits
    rng = np.random.default_rng(seed)
    low, high = finite_ranges(chain, *joint_limits(cell, chain))
    force = conditions.force
    if visits is not None:
        low, high = np.clip([visits.q.min(axis=0), visits.q.max(axis=0)], low, high)
        force = visits.force[np.arange(poses) % len(visits.force)]
    q = rng.uniform(low, high, (poses, chain.n_joints))
    for joint, levels in cell.model.compliance_levels.items():
        q[:, int(joint.removeprefix("joint")) - 1] = rng.choice(levels, poses)
    return table_at(model, conditions, q, force, rng)


def table_at(
    model: Model, conditions: Conditions, q: Array, force: Array, rng: np.random.Generator
) -> Measurements:
    """The poses q (poses, joints) under `force` (3,) or (poses, 3) N; the last motions are drawn,
    each pose's of its own, in whatever order they stand."""
    cell, poses, side = model.cell, len(q), rng.choice([-1.0, 1.0], q.shape)
    stated = {"time": conditions.time, "temperature": conditions.temperature}
    more: dict[str, Any] = {k: np.full(poses, v) for k, v in stated.items() if v is not None}
    return Measurements.of_poses(
        "random poses", q, force, marker_names=tuple(cell.tool.markers)[:1],
        approach=side, direction=side, move=side * rng.uniform(0.1, 1.0, q.shape), **more,
    )  # fmt: skip
