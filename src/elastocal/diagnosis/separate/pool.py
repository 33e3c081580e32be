"""The visits that could still be made: feasible poses after the campaign, in its load states."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.design.candidates import draw
from elastocal.design.feasibility.feasibility import Feasibility
from elastocal.design.readings import LoadStates
from elastocal.diagnosis.baseline import visits
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements
from elastocal.simulation.simulate import simulate

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

CANDIDATES, FEWEST_POSES = 256, 64
NEWTON = 1.0  # forces are told apart to this
RARE = 0.1  # share of the visits below which a load state is not asked for again


@dataclass(frozen=True)
class Pool:
    """N candidates, each one pose with its side of approach and moment, in all load states.

    `q` (N, n); `approach` (N, n) of ±1 and `time` (N,) s where the table has them; `forces`
    (L, 3) N.  `table` holds their rows: candidate by candidate, load by load, marker by marker,
    with the readings that the fitted model expects.
    """

    q: Array
    approach: Array | None
    time: Array | None
    forces: Array
    table: Measurements

    def __len__(self) -> int:
        return len(self.q)


def draw_pool(
    model: Model, x: Array, table: Measurements, *, sides: bool, waits: bool, most: int, seed: int
) -> Pool:
    """Candidates that the cell's rules allow, after the campaign of `table`.

    Some CANDIDATES, or `most` where memory is short, of FEWEST_POSES poses at least.  With
    `sides` every pose comes twice, each joint from either side; with `waits` twice too: at once
    and after as long as the campaign took.  Both only where the table has such a column.

    Raises InsufficientDataError where no pose is feasible.
    """
    sides, waits = sides and table.approach is not None, waits and table.time is not None
    rng = np.random.default_rng(seed)
    forces = load_forces(table)
    states = LoadStates(forces, False, np.ones(len(forces), dtype=bool))
    n = max(min(CANDIDATES, most) // (1 + sides) // (1 + waits), FEWEST_POSES)
    cell, chain = model.cell, model.chain
    if cell.model.compliance_levels and not cell.design.levels:
        # A joint whose compliance is known at its levels only can be nowhere else.
        spec = replace(cell.design, levels=cell.model.compliance_levels)
        cell = replace(cell, design=spec)
    q = draw(cell, chain, states, Feasibility(cell, chain), n, seed).q
    approach = time = None
    if table.approach is not None:
        approach = rng.choice([-1.0, 1.0], q.shape)
        if sides:
            q, approach = np.concatenate([q, q]), np.concatenate([approach, -approach])
    if table.time is not None:
        begin, step = table.time.max() + time_step(table), np.ptp(table.time)
        time = np.full(len(q), begin)
        if waits:
            q, time = np.concatenate([q, q]), np.concatenate([time, time + step])
            approach = None if approach is None else np.tile(approach, (2, 1))
    return pool_of(model, x, table, q, approach, time, forces)


def pool_of(
    model: Model, x: Array, table: Measurements, q: Array, approach: Array | None,
    time: Array | None, forces: Array,
) -> Pool:  # fmt: skip
    """The pool of these candidates, read as the model at `x` would be."""
    n, L, M = len(q), len(forces), len(table.marker_names)
    candidate = np.repeat(np.arange(n), L * M)
    known = len(table.configuration_labels)
    rows = replace(
        table.take(np.zeros(len(candidate), dtype=np.int64)),
        row=np.zeros(len(candidate), dtype=np.int64),  # no line of any file
        q=q[candidate],
        configuration=known + candidate,
        configuration_labels=table.configuration_labels + tuple(f"candidate {i}" for i in range(n)),
        repeat=np.zeros(len(candidate), dtype=np.int64),
        marker=np.tile(np.arange(M), n * L),
        force=forces[np.tile(np.repeat(np.arange(L), M), n)],
        approach=None if approach is None else approach[candidate],
        time=None if time is None else time[candidate],
    )
    if table.temperature is not None:
        rows = replace(rows, temperature=np.full(len(rows), np.median(table.temperature)))
    return Pool(q, approach, time, forces, simulate(model, rows, x, 0, noise=False))


def load_forces(table: Measurements) -> Array:
    """The table's usual load states (L, 3) N; the mean load where every visit has its own."""
    _, first = np.unique(visits(table), return_index=True)
    force = table.force[first]
    _, group, count = np.unique(
        np.round(force / NEWTON), axis=0, return_inverse=True, return_counts=True
    )
    usual = [k for k in range(len(count)) if count[k] >= RARE * len(force)]
    loaded = np.any(force != 0, axis=1)
    if not usual or (loaded.any() and not loaded[np.isin(group.ravel(), usual)].any()):
        means = [force[part].mean(axis=0) for part in (~loaded, loaded) if part.any()]
        return np.array(means)
    means = [force[group.ravel() == k].mean(axis=0) for k in usual]
    return np.array(sorted(means, key=lambda f: float(np.linalg.norm(f))))


def time_step(table: Measurements) -> float:
    """How long a visit usually takes, in s."""
    assert table.time is not None
    moments = np.unique(table.time)
    return float(np.median(np.diff(moments))) if len(moments) > 1 else 0.0


def joined(first: Measurements, second: Measurements) -> Measurements:
    """Both tables' rows; the second's labels hold for both, its columns are the first's."""
    arrays: dict[str, Any] = {
        f.name: np.concatenate([getattr(first, f.name), getattr(second, f.name)])
        for f in fields(first)
        if isinstance(getattr(first, f.name), np.ndarray)
    }
    return replace(second, source=first.source, **arrays)
