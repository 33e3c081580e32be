"""What a pose will be read as: its table rows, load states, and the covariance of its readings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.errors import require
from elastocal.identification.noise import stated_covariance
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import Observations
from elastocal.measurements import Measurements
from elastocal.text import quoted
from elastocal.tracker_noise import available_noise

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

ALL_LOADS = -1  # a candidate measured in every load state
NO_FORCE = 1e-9  # N


@dataclass(frozen=True)
class LoadStates:
    """`forces` (L, 3) N, the states a plan measures; `chosen`: a pose is measured in one of them.

    `seen` (L,) says which states give an observation of their own: for deflections the unloaded
    state is only what is subtracted.
    """

    forces: Array
    chosen: bool
    seen: NDArray[np.bool_]

    def of(self, load: int) -> IntArray:
        """The states in which a candidate with `load` is measured."""
        return np.arange(len(self.forces)) if load == ALL_LOADS else np.array([load])


def load_states(cell: Cell) -> LoadStates:
    """The load states of the cell's plan.

    Without `[design] loads_N` poses are measured unloaded.  Raises InputError where deflections
    are to be observed without a load, or with a load chosen per pose.
    """
    spec = cell.design
    forces = np.zeros((1, 3)) if spec.loads is None else np.asarray(spec.loads, dtype=float)
    loaded = np.linalg.norm(forces, axis=1) > NO_FORCE
    if cell.model.observe != "deflection":
        return LoadStates(forces, spec.load_choice and len(forces) > 1, np.ones(len(forces), bool))
    require(
        bool(loaded.any()),
        f'{cell.path or cell.name}: observe = "deflection" needs a load; state it as in '
        "[design] loads_N = [[0, 0, -2600]]",
    )
    require(
        not spec.load_choice,
        f"{cell.path or cell.name}: [design] load_choice has no meaning where deflections are "
        "observed: every pose is measured unloaded and loaded; drop it",
    )
    forces = np.vstack([np.zeros((1, 3)), forces[loaded]])
    return LoadStates(forces, False, np.arange(len(forces)) > 0)


def rows_of(
    q: Array, load: IntArray, states: LoadStates, marker_names: tuple[str, ...]
) -> Measurements:
    """Table rows of candidates: for each pose, each of its load states, each marker.

    q (N, n); load (N,) as in LoadStates.of, all of the candidates ALL_LOADS or none.
    """
    n, markers = len(q), len(marker_names)
    each = len(states.forces) if n and load[0] == ALL_LOADS else 1
    state = np.tile(np.arange(each), n) if each > 1 else np.where(load < 0, 0, load)
    pose = np.repeat(np.arange(n), each * markers)
    count = len(pose)
    return Measurements(
        source="plan",
        row=pose + 2,
        q=q[pose],
        configuration=pose,
        configuration_labels=tuple(map(str, range(1, n + 1))),
        repeat=np.zeros(count, dtype=np.int64),
        marker=np.tile(np.arange(markers), n * each),
        marker_names=marker_names,
        force=states.forces[np.repeat(state, markers)],
    )


def marker_sigmas(cell: Cell, table: Measurements) -> Measurements:
    """The table with the cell's own σ per marker, where `[design] marker_sigma_um` states them.

    Raises InputError where some markers have one and others none.
    """
    stated = cell.design.marker_sigma
    if not stated:
        return table
    missing = [name for name in table.marker_names if name not in stated]
    require(
        not missing,
        f"{cell.path or cell.name}: [design] marker_sigma_um states no σ for marker "
        f"{quoted(missing[0]) if missing else ''}; state one for every marker",
    )
    sigma = np.array([stated[name] for name in table.marker_names])[table.marker]
    return replace(table, sigma=np.repeat(sigma[:, None], 3, axis=1), sigma_frame="cartesian")


def reading_covariance(model: Model, seen: Observations) -> Array:
    """Covariance (n_rows, size, size) of a single reading of each table row.

    Raises InputError where neither tracker nor markers state a noise.
    """
    cell = model.cell
    kind = available_noise(seen.table, cell.tracker)
    require(
        kind != "none" or (seen.kind == "distance" and cell.tracker.distance_sigma is not None),
        f"{cell.path or cell.name}: a plan needs the noise of a reading; state [tracker] sigma_um, "
        "range_um and transverse_um, or distance_um, as the instrument's data sheet says",
    )
    return stated_covariance(seen, cell.tracker, kind)[0]


def pose_covariance(model: Model, seen: Observations, n_poses: int, states: LoadStates) -> Array:
    """Covariance (N, r, r) of a pose's observations, means of `[design] repeats` readings each.

    Σ = T Σ_rows Tᵀ / repeats + τ² per load state and direction: deflections share their unloaded
    reading, and what the arm does not repeat (τ, `[design] repeatability_um`) is common to the
    markers of a visit.  A pose that is approached from both sides is visited twice.
    """
    spec = model.cell.design
    visits = 2 if spec.motion.both_directions else 1
    single = reading_covariance(model, seen) / spec.repeats
    size, rows = single.shape[1], len(seen.table) // n_poses
    full = np.zeros((n_poses, rows, size, rows, size))
    index = np.arange(rows)
    full[:, index, :, index, :] = single.reshape(n_poses, rows, size, size).transpose(1, 0, 2, 3)
    # Rows combine to observations in the same way at every pose.
    T = seen.combine[: len(seen.lead) // n_poses, :rows].toarray()
    covariance = np.einsum("ak,nkilj,bl->naibj", T, full, T, optimize=True)
    r = T.shape[0] * size
    covariance = covariance.reshape(n_poses, r, r)
    if spec.repeatability > 0:
        force = seen.table.force[seen.lead[: T.shape[0]]]
        same = (force[:, None] == force[None]).all(axis=2).astype(float)
        moved = np.diag(np.arange(size) < 3).astype(float)
        covariance = covariance + spec.repeatability**2 * np.kron(same, moved)
    return covariance / visits


def readings_each(cell: Cell) -> int:
    """How often a plan reads each pose in each load state: repeats, from one side or from both."""
    return cell.design.repeats * (2 if cell.design.motion.both_directions else 1)
