"""Campaigns on arms with faults, and their diagnoses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from support.cells import (
    ANCHOR,
    COMPLIANCE,
    DOWN,
    LOAD_POINT,
    MARKERS,
    choices,
    kr270_chain,
    random_poses,
    table_of,
)
from support.robots import KR270

import elastocal as ec
from elastocal import Diagnosis
from elastocal.cell import Cell
from elastocal.cell_tables import CartesianNoise, ModelSpec, Nominal, Robot, Tool, Tracker
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain
from elastocal.model.manipulator import Model
from elastocal.simulation import draw_errors, simulate, values_from

Array = np.ndarray
FITTED = ("base_frame", "joint_offset", "joint_compliance", "marker_position")
SIGMA, REPEATABILITY = 1e-5, 3e-6
VISIT_TIME = 30.0  # s
JUMP_TIME = 900.0


@dataclass(frozen=True)
class Fault:
    """An effect of the true arm: parameters by key, and its settings."""

    effect: str
    where: str
    values: Mapping[str, float]
    settings: Mapping[str, float] = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, str]:
        return self.effect, self.where


FAULTS = {f"{f.effect}:{f.where}": f for f in (
    Fault("encoder_scale", "joint3", {"encoder_scale": 2e-4}),
    Fault("gear_eccentricity", "joint2", {"eccentricity_sin": 1e-4, "eccentricity_cos": -1.2e-4}),
    Fault("gear_eccentricity", "joint4", {"eccentricity_sin": 1.5e-4, "eccentricity_cos": -1e-4}),
    Fault("gear_ripple", "joint5", {"ripple_sin": 1e-4, "ripple_cos": 5e-5},
          {"ripple_order": 81.3}),
    Fault("hysteresis", "joint3", {"hysteresis": 1e-4}),
    Fault("encoder_jump", "joint4", {"jump": 2e-4}, {"jump_time_s": JUMP_TIME}),
    Fault("marker_slip", "marker:M2", {"slip_x": 1.5e-4, "slip_y": -1e-4, "slip_z": 8e-5},
          {"slip_time_s": JUMP_TIME}),
    Fault("payload_error", "load", {"payload_scale": 0.05}),
    Fault("off_axis_compliance", "joint3",
          {"off_axis_compliance_x": 1.5e-7, "off_axis_compliance_y": 1e-7}),
    Fault("tracker_distortion", "tracker",
          {"azimuth_sin": 5e-5, "azimuth_cos": -4e-5, "elevation_sin": 5e-5}),
    Fault("thermal_expansion", "link2", {"expansion": 2e-4}, {"time_constant_s": 1200.0}),
)}  # fmt: skip


def cell(
    effects: Sequence[str] = FITTED, observe: Any = "position", sigma: float = SIGMA, **model: Any
) -> Cell:
    model.setdefault("nominal", Nominal(joint_compliance=COMPLIANCE))
    model.setdefault("link_gravity", True)
    tracker = Tracker(
        position=np.array([3.5, -2.0, 0.6]), noise=CartesianNoise(np.full(3, sigma)), anchor=ANCHOR,
        rotation_sigma=5e-5, distance_sigma=sigma,
    )  # fmt: skip
    spec = ModelSpec(observe=observe, effects=choices(effects), **model)
    return Cell("arm", None, Robot(urdf=KR270), Tool(LOAD_POINT, dict(MARKERS)), tracker, spec)


def measured(
    chain: Chain, plain: Cell, faults: Sequence[Fault], table: Measurements, seed: int
) -> Measurements:
    """The table as read on the arm with the faults: equilibria at scattered joint angles.

    What the cell fits deviates at random from nominal.
    """
    nominal = plain.model.nominal
    settings = {f.where: dict(f.settings) for f in faults if f.settings}
    effects = (*plain.model.effects, *choices([f"{f.effect}:{f.where}" for f in faults]))
    spec = replace(plain.model, effects=effects, nominal=replace(nominal, settings=settings))
    truth = Model.assembled(chain, replace(plain, model=spec))
    errors = draw_errors(Model.assembled(chain, plain), 1.0, np.random.default_rng((seed, 4)))
    values = errors | {f"{f.where}.{key}": v for f in faults for key, v in f.values.items()}
    rng = np.random.default_rng((seed, 2))
    key = np.column_stack([table.configuration, table.repeat, table.force])
    visit = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    shake = REPEATABILITY * rng.normal(size=(visit.max() + 1, chain.n_joints))
    shaken = replace(table, q=table.q + shake[visit])
    return replace(simulate(truth, shaken, values_from(truth, values), rng), q=table.q)


def plan(chain: Chain, n: int, seed: int, force: Array = DOWN) -> Measurements:
    """`n` random poses, unloaded and loaded, with times and random sides of approach."""
    table = table_of(random_poses(chain, n, seed), force, both=True)
    visit = np.arange(len(table)) // len(MARKERS)
    sides = np.random.default_rng((seed, 3)).choice([-1.0, 1.0], (visit[-1] + 1, chain.n_joints))
    return replace(table, time=VISIT_TIME * visit, approach=sides[visit])


@lru_cache
def campaign(
    *names: str, n: int = 24, seed: int = 1, observe: str = "position", sigma: float = SIGMA
) -> tuple[Model, Measurements]:
    """Model without, and readings with, the faults of these names."""
    chain, plain = kr270_chain(), cell(observe=observe, sigma=sigma)
    faults = [FAULTS[name] for name in names]
    return Model.assembled(chain, plain), measured(chain, plain, faults, plan(chain, n, seed), seed)


@lru_cache
def diagnosed(*names: str, without: tuple[str, ...] = (), n: int = 24, seed: int = 1) -> Diagnosis:
    return ec.diagnose(*campaign(*names, n=n, seed=seed), without=without)
