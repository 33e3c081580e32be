"""How many poses a plan has at each level."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.errors import InsufficientDataError, option, require

IntArray = NDArray[np.int64]

DEFAULT = 15  # poses, as in Table 2 of Klimchik et al. 2013


def shares_of(cell: Cell, n_poses: int | None = None) -> IntArray:
    """Poses (L,) per level of [design.levels]; (1,) without levels.

    `n_poses` overrides what the cell says; what does not divide evenly goes to the first levels.
    Raises InputError where levels would be left without a pose, or `per_level` contradicts.
    """
    spec = cell.design
    levels = max(max((len(v) for v in spec.levels.values()), default=1), 1)
    where = f"{cell.path or cell.name}: [design]"
    if spec.per_level and n_poses is None:
        each = spec.per_level * levels if len(spec.per_level) == 1 else spec.per_level
        require(
            len(each) == levels,
            f"{where} poses_per_level has {len(each)} numbers, but there are {levels} levels",
        )
        return np.array(each, dtype=np.int64)
    total = n_poses or spec.poses or DEFAULT
    require(
        total >= levels,
        f"{where} asks for {total} poses at {levels} levels; ask for {levels} at least, or drop "
        "levels",
    )
    return np.array([total // levels + (k < total % levels) for k in range(levels)], dtype=np.int64)


def check_available(cell: Cell, available: IntArray, shares: IntArray) -> None:
    """Are there as many candidates per level, `available` (L,), as the plan has poses there?

    A candidate stands in a plan once.  Raises InputError where too few were asked for,
    InsufficientDataError where too few are feasible.
    """
    short = np.flatnonzero(available < shares)
    if not len(short):
        return
    k, drawn = int(short[0]), cell.design.candidates
    level = f" takes {shares[k]} at level {k + 1} of {next(iter(cell.design.levels), '')}"
    where = f"{cell.path or cell.name}: a plan of {int(shares.sum())} poses"
    where += level if len(shares) > 1 else ""
    asked = drawn // len(shares) + (k < drawn % len(shares))
    require(
        asked >= shares[k],
        f"{where}, but {drawn} candidates leave {asked} to choose from; ask for more "
        f"({option('candidates')}, or [design] candidates)",
    )
    raise InsufficientDataError(
        f"{where}, but only {available[k]} feasible candidates were found; plan fewer poses, or "
        "relax the limits or the rules of [workspace]"
    )


def most_poses(cell: Cell, available: IntArray, limit: int) -> int:
    """The most poses, `limit` at most, for which `available` (L,) candidates per level suffice."""
    n = len(available)
    while n < limit and (shares_of(cell, n + 1) <= available).all():
        n += 1
    return n
