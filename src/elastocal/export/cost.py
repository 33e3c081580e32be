"""What an export costs: how far the file's arm is from the calibrated one, effect by effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.cell import Array
from elastocal.errors import InsufficientDataError, option
from elastocal.export.kept import Conditions, Kept, Valued
from elastocal.export.pieces import evaluate_pieces
from elastocal.manipulator.limits import finite_ranges, joint_limits
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements


@dataclass(frozen=True)
class Difference:
    """Distance between two predictions over the poses, in m: of the flange and of the markers."""

    flange_rms: float
    flange_max: float
    marker_rms: float
    marker_max: float

    def to_json(self) -> dict[str, float]:
        """The four numbers in µm."""
        return {f"{name}_um": value * 1e6 for name, value in vars(self).items()}


@dataclass(frozen=True)
class EffectCost:
    """What leaving one effect out changes; `difference` is None where that cannot be said."""

    effect: str
    note: str
    difference: Difference | None


@dataclass(frozen=True)
class Cost:
    """`total` between the full model and the file's, `effects` one by one, over `poses`.

    Effects interact, so the total need not be their sum.  `unsettled`: poses without a static
    equilibrium under the load, left out.
    """

    total: Difference
    effects: tuple[EffectCost, ...]
    poses: int
    unsettled: int
    force: Array


def cost_of(kept: Kept, poses: int, seed: int) -> Cost:
    """Differences at `poses` random poses inside the joint limits, under the stated conditions.

    A joint split into compliance levels stands at one of its levels, for which alone the full
    model is identified.  Raises InsufficientDataError where no pose has an equilibrium.
    """
    table = random_table(kept.full.model, kept.conditions, poses, seed)
    # No omission touches the tool, so one set of markers serves every model.
    tool = evaluate_pieces(kept.exported, kept.conditions).markers
    markers = np.array([np.zeros(3), *(T[:3, 3] for T in tool.values())])
    full = _positions(kept.full, table, markers)
    exported = _positions(kept.exported, table, markers)
    settled = np.isfinite(full).all(axis=(1, 2)) & np.isfinite(exported).all(axis=(1, 2))
    if not settled.any():
        raise InsufficientDataError(
            f"none of {poses} random poses has a static equilibrium under the load "
            f"{kept.conditions.force.tolist()} N; check {option('load')} and the "
            "compliances of the result"
        )
    effects = []
    for omission in kept.omissions:
        difference = None
        if omission.without is not None:
            without = _positions(omission.without, table, markers)
            difference = _difference(full[settled], without[settled])
        effects.append(EffectCost(omission.effect, omission.note, difference))
    effects.sort(key=lambda e: -np.inf if e.difference is None else -e.difference.marker_rms)
    return Cost(
        total=_difference(full[settled], exported[settled]),
        effects=tuple(effects),
        poses=poses,
        unsettled=int((~settled).sum()),
        force=kept.conditions.force,
    )


def random_table(model: Model, conditions: Conditions, poses: int, seed: int) -> Measurements:
    """`poses` random poses, a row each, with every column that the arm's effects may ask for."""
    cell, chain = model.cell, model.chain
    rng = np.random.default_rng(seed)
    low, high = finite_ranges(chain, *joint_limits(cell, chain))
    q = rng.uniform(low, high, (poses, chain.n_joints))
    for joint, levels in cell.model.compliance_levels.items():
        q[:, int(joint.removeprefix("joint")) - 1] = rng.choice(levels, poses)
    return Measurements(
        source="random poses",
        row=np.arange(poses) + 2,
        q=q,
        configuration=np.arange(poses),
        configuration_labels=tuple(str(i + 1) for i in range(poses)),
        repeat=np.zeros(poses, dtype=np.int64),
        marker=np.zeros(poses, dtype=np.int64),
        marker_names=tuple(cell.tool.markers)[:1],
        force=np.tile(conditions.force, (poses, 1)),
        approach=rng.choice([-1.0, 1.0], (poses, chain.n_joints)),
        time=_column(conditions.time, poses),
        temperature=_column(conditions.temperature, poses),
    )


def _column(value: float | None, n: int) -> Array | None:
    return None if value is None else np.full(n, value)


def _positions(part: Valued, table: Measurements, points: Array) -> Array:
    """Points (k, 3) of the flange frame in the tracker frame (poses, k, 3); NaN: no equilibrium."""
    T = part.model.flange_poses(table, part.x)
    return np.asarray(T[:, None, :3, :3] @ points[..., None])[..., 0] + T[:, None, :3, 3]


def _difference(a: Array, b: Array) -> Difference:
    distance = np.linalg.norm(a - b, axis=2)
    flange, markers = distance[:, :1], distance[:, 1:]
    return Difference(_rms(flange), float(flange.max()), _rms(markers), float(markers.max()))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
