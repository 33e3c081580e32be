"""Places of the data's frame reached by the arm, in postures that the work cell allows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.inverse_kinematics import Postures, inverse_kinematics
from elastocal.manipulator.limits import joint_limits

Array = NDArray[np.float64]


FEW, MANY = 16, 256  # postures per place; many where the work cell allows none of few
WRONG_UNIT = 1e5  # mm


class Rules(Protocol):
    """What a work cell allows: `check` gives a verdict with `ok` (N,)."""

    def check(self, q: Array, force: Array) -> Any: ...


def working_loads(cell: Cell) -> Array:
    """The forces (L, 3) N of the design's loads that are not zero, or none but zero."""
    loads = cell.design.loads
    loaded = np.zeros((0, 3)) if loads is None else loads[(loads != 0).any(axis=1)]
    return loaded if len(loaded) else np.zeros((1, 3))


@dataclass(frozen=True)
class Places:
    """`position` (T, 3) m in the data's frame for the `point` (3,) of the flange, `rotation`
    (T, 3, 3) of the flange, None for any, and `force` (T, 3) N, None for the cell's loads."""

    position: Array
    rotation: Array | None
    point: Array
    force: Array | None

    def take(self, index: NDArray[np.int64]) -> Places:
        """Some of the places."""
        return replace(
            self,
            position=self.position[index],
            rotation=None if self.rotation is None else self.rotation[index],
            force=None if self.force is None else self.force[index],
        )


def reach(cell: Cell, chain: Chain, places: Places, seed: int, postures: int = FEW) -> Postures:
    """Postures at the places: inverse kinematics with the cell's limits, base and home."""
    nominal, T = cell.model.nominal, np.eye(4)
    if nominal.base_rotation is not None:
        T[:3, :3] = nominal.base_rotation
    if nominal.base_position is not None:
        T[:3, 3] = nominal.base_position
    return inverse_kinematics(
        chain,
        places.position,
        joint_limits(cell, chain),
        rotation=places.rotation,
        point=places.point,
        T_data_base=T,
        near=cell.design.motion.home,
        postures=postures,
        seed=seed,
    )


def preferred(
    cell: Cell, chain: Chain, places: Places, found: Postures, rules: Rules | None, seed: int
) -> tuple[Array, str]:
    """Per place the first posture that the rules allow, and what to tell.

    Where they allow none of those found, more are tried; where they allow none at all, it is the
    first, and the text says of how many places that holds.
    """
    q = found.q[:, 0].copy()
    if rules is None:
        return q, ""
    stuck = _take_allowed(cell, places, found, rules, q, np.arange(len(q)))
    if len(stuck):
        more = reach(cell, chain, places.take(stuck), seed, MANY)
        stuck = _take_allowed(cell, places.take(stuck), more, rules, q, stuck)
    told = f" ({len(stuck)} of them in no posture that the work cell allows)"
    return q, told if len(stuck) else ""


def _take_allowed(
    cell: Cell,
    places: Places,
    found: Postures,
    rules: Rules,
    q: Array,
    rows: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Put the first allowed posture of each place into q[rows]; the rows that have none."""
    T, K, n = found.q.shape
    allowed = found.reached.copy()
    loads = working_loads(cell)[:, None] if places.force is None else places.force[None]
    for load in loads:
        of_each = np.repeat(np.broadcast_to(load, (T, 3)), K, axis=0)
        allowed &= np.asarray(rules.check(found.q.reshape(T * K, n), of_each).ok).reshape(T, K)
    some = allowed.any(axis=1)
    q[rows[some]] = found.q[some, allowed[some].argmax(axis=1)]
    return rows[~some]


def how_near(found: Postures, t: int) -> str:
    """How near the arm gets to target t."""
    distance, turn = found.miss[t, 0] * 1e3, np.degrees(found.turn[t, 0])
    # A place missed by this much is given in another unit than its column says.
    told = f"{distance:.4g} mm" if distance < WRONG_UNIT else f"{distance:.0f} mm, wrong unit?"
    also = f" and {turn:.3g}° from its rotation" if turn > 0.01 else ""
    return f"the arm gets no nearer than {told}{also}"


def remedy(cell: Cell) -> str:
    """What to do about a place out of reach."""
    if cell.model.nominal.base_position is None:
        return (
            "move it, or state where the arm stands in the data's frame ([model.nominal] "
            "base_position_m, base_rpy_deg)"
        )
    return "move it, or check base_position_m and base_rpy_deg of [model.nominal], and [limits]"
