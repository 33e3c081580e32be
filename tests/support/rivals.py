"""Campaigns on arms with one more effect, and what a plan of extra poses reads of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from support.cells import COMPLIANCE, DOWN, kr270_cell, kr270_chain, table_of

from elastocal.cell.arm_description import CartesianNoise, Nominal
from elastocal.cell.work_cell import Cell
from elastocal.diagnosis.diagnosis import Candidate, EffectAt, NoiseFloor
from elastocal.measurements import Measurements
from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.model.manipulator import Model
from elastocal.simulation import simulate, values_from

Key = tuple[str, str]

FITTED = ("base_frame", "joint_offset", "joint_compliance", "marker_position")
SIGMA, REPEATABILITY = 20e-6, 6e-6
ECCENTRIC: Key = ("gear_eccentricity", "joint3")
SCALE: Key = ("encoder_scale", "joint3")
JUMP_TIME = 1000.0


def cell_of(effects: Sequence[str] = (), **model: Any) -> Cell:
    cell = kr270_cell([*FITTED, *effects], **model)
    tracker = replace(cell.tracker, noise=CartesianNoise(np.full(3, SIGMA)))
    return replace(cell, tracker=tracker)


def diagnosis_of(
    rivals: Mapping[Key, float], settings: Mapping[Key, dict[str, float]] | None = None
) -> Any:
    """An ambiguous verdict on these rivals with their probabilities: what a plan reads of it."""
    settings = settings or {}
    return SimpleNamespace(
        verdict="ambiguous",
        effects=(EffectAt(*next(iter(rivals))),),
        groups=(),
        candidates=tuple(
            Candidate(effect, where, "transmission", p, 0.0, 5.0, settings.get((effect, where), {}))
            for (effect, where), p in rivals.items()
        ),
        indistinguishable=(tuple(EffectAt(*key) for key in rivals),),
        location=None,
        model_keys={"play_side": "load_and_approach"},
        noise=NoiseFloor(True, 1.0, 1.0, SIGMA, (REPEATABILITY,) * 6, 0.2, None),
        probability_unknown=0.0,
        probability_nothing=0.0,
    )


def campaign(
    effects: Mapping[str, float], half_range: float, seed: int = 0, n: int = 30, **model: Any
) -> tuple[Model, Measurements]:
    """The plain model and readings of an arm with `effects` (parameter → value), joint 3 within
    ± `half_range` rad, times a minute apart."""
    chain = kr270_chain()
    plain = cell_of(**model)
    rng = np.random.default_rng((seed, 1))
    q = rng.uniform(*finite_ranges(chain, *joint_limits(plain, chain)), (n, 6))
    q[:, 2] = rng.uniform(-half_range, half_range, n)
    table = table_of(q, DOWN, both=True)
    table = replace(table, time=30.0 * (np.arange(len(table)) // 3))
    return Model.assembled(chain, plain), measured(table, effects, seed, **model)


def measured(
    table: Measurements, effects: Mapping[str, float], seed: int, **model: Any
) -> Measurements:
    """The table as read on the arm with `effects`, with tracker noise and repeatability."""
    settings = {
        "joint1": {"jump_time_s": JUMP_TIME},
        "tracker": {"jump_time_s": JUMP_TIME},
    }
    nominal = Nominal(joint_compliance=COMPLIANCE, settings=settings)
    names = {
        "eccentricity": "gear_eccentricity",
        "encoder": "encoder_scale",
        "jump": "encoder_jump",
        "hysteresis": "hysteresis",
    }
    active = {
        f"{names[key.split('_')[0]]}:{where}"
        for where, _, key in (name.partition(".") for name in effects)
    }
    truth = Model.assembled(kr270_chain(), cell_of(sorted(active), nominal=nominal, **model))
    rng = np.random.default_rng((seed, 2))
    visit = np.unique(
        np.column_stack([table.configuration, table.force]), axis=0, return_inverse=True
    )[1].ravel()
    shake = REPEATABILITY * rng.normal(size=(visit.max() + 1, 6))
    moved = replace(table, q=table.q + shake[visit])
    read = simulate(truth, moved, values_from(truth, dict(effects)), rng)
    return replace(read, q=table.q)
