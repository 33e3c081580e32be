"""Where poses may lie: joint ranges, and one joint that may be held at fixed levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.errors import require
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.limits import finite_ranges, joint_index, joint_limits

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JointSpace:
    """`lower`, `upper` (n,) in rad or m, both finite; joint `held` (0-based) only takes `levels`.

    Without a held joint there is one group of poses and no level.
    """

    lower: Array
    upper: Array
    held: int | None = None
    levels: tuple[float, ...] = ()

    @property
    def n_groups(self) -> int:
        return max(len(self.levels), 1)

    def bounds(self, group: int) -> tuple[Array, Array]:
        """Bounds (n,) of the poses of a group; equal for the held joint."""
        lower, upper = self.lower.copy(), self.upper.copy()
        if self.held is not None:
            lower[self.held] = upper[self.held] = self.levels[group]
        return lower, upper

    def poses(self, unit: Array, group: int) -> Array:
        """Poses (N, n) of points (N, free joints) of the unit cube."""
        lower, upper = self.bounds(group)
        free = [i for i in range(len(lower)) if i != self.held]
        q = np.tile(lower, (len(unit), 1))
        q[:, free] += unit * (upper - lower)[free]
        return q


def joint_space(cell: Cell, chain: Chain) -> JointSpace:
    """The robot's limits, narrowed by [limits], with the levels of [design.levels].

    A joint without a limit turns once, from −π to π, or slides 2 m (`finite_ranges`).  Raises
    InputError for levels of several joints, and as `joint_limits` does.
    """
    lower, upper = finite_ranges(chain, *joint_limits(cell, chain))
    wanted = cell.design.levels
    if not wanted:
        return JointSpace(lower, upper)
    require(
        len(wanted) == 1,
        f"{cell.path or cell.name}: [design.levels] holds {', '.join(wanted)} at levels; only one "
        "joint can be held: keep one, and narrow the others by [limits]",
    )
    name, levels = next(iter(wanted.items()))
    return JointSpace(lower, upper, joint_index(cell, chain, name, "[design.levels]"), levels)
