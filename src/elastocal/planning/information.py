"""What a pose will be read as, and the information on the parameters that it gives."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError, InsufficientDataError, option, require
from elastocal.identification.identify import identify
from elastocal.identification.noise_structure import VISIT, SharedEffect
from elastocal.identification.options import Options
from elastocal.identification.solve import WORTH_A_COLUMN, Reduction, reduce
from elastocal.identification.tails import kept_of
from elastocal.identification.visit_record import visit_record
from elastocal.identification.weighted_problem import (
    Weights,
    stated_covariance,
    weights_for,
    whitener,
)
from elastocal.measurements import Measurements
from elastocal.model.chain import joint_index
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, available_noise, observe
from elastocal.simulation.simulate import simulate
from elastocal.text import did_you_mean, listed, quoted
from elastocal.units import Array, BoolArray, IntArray

# What a pose will be read as: its table rows, load states, and the covariance of its readings.

Sight = Callable[[Array, Array], BoolArray]  # joints (N, n), force (3,) → (N, markers): seen?
ALL_LOADS = -1  # a candidate measured in every load state
NO_FORCE = 1e-9  # N
NEVER = 1e9  # m (rad): standard deviation of a reading that is not made


@dataclass(frozen=True)
class LoadStates:
    """`forces` (L, 3) N, the states a plan measures; `chosen`: a pose is measured in one of them.

    `seen` (L,) says which states give an observation of their own: for deflections the unloaded
    state is only what is subtracted.
    """

    forces: Array
    chosen: bool
    observed: NDArray[np.bool_]

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


def reading_covariance(model: Model, observed: Observations) -> Array:
    """Covariance (n_rows, size, size) by which a single reading of each table row counts.

    Raises InputError where neither tracker nor markers state a noise.
    """
    cell = model.cell
    kind = available_noise(observed.table, cell.tracker)
    require(
        kind != "none" or (observed.kind == "distance" and cell.tracker.distance_sigma is not None),
        f"{cell.path or cell.name}: a plan needs the noise of a reading; state [tracker] sigma_um, "
        "range_um and transverse_um, or distance_um, as the instrument's data sheet says",
    )
    single, spec = stated_covariance(observed, cell.tracker, kind)[0], cell.design
    states = 1 if spec.loads is None else len(spec.loads)
    readings = (spec.poses or TYPICAL) * len(cell.tool.markers) * states * spec.repeats
    return single * _told(cell, readings, single.shape[1])


TYPICAL = 30  # poses of a plan that states none: what is set apart hardly depends on how many


def _told(cell: Cell, readings: int, size: int) -> float:
    """The factor on the variance of a reading that has the tails of `[noise]`, since
    identification sets the far ones apart."""
    dof = cell.noise.tails
    return 1.0 if dof is None else kept_of(dof, readings * size, size).variance


def pose_covariance(
    model: Model, observed: Observations, n_poses: int, states: LoadStates, x: Array | None = None
) -> Array:
    """Covariance (N, r, r) of a pose's observations, means of `[design] repeats` readings each.

    Σ = T Σ_rows Tᵀ / repeats + τ² per load state and direction + J diag(s²) Jᵀ: deflections share
    their unloaded reading; what the arm does not repeat, τ of `[design] repeatability_um` and s of
    the joints of `[noise]`, is common to the markers of a visit.  A pose that is approached from
    both sides is visited twice, but what its readings share by `[noise]` remains; deflections do
    not have that.  `x` (parameters,): where J is taken.
    """
    spec = model.cell.design
    visits = 2 if spec.motion.both_directions else 1
    single = reading_covariance(model, observed) / spec.repeats
    size, rows = single.shape[1], len(observed.table) // n_poses
    full = np.zeros((n_poses, rows, size, rows, size))
    index = np.arange(rows)
    full[:, index, :, index, :] = single.reshape(n_poses, rows, size, size).transpose(1, 0, 2, 3)
    # Rows combine to observations in the same way at every pose.
    T = observed.combine[: len(observed.lead) // n_poses, :rows].toarray()
    covariance = np.einsum("ak,nkilj,bl->naibj", T, full, T, optimize=True)
    r = T.shape[0] * size
    covariance = covariance.reshape(n_poses, r, r)
    if spec.repeatability > 0:
        force = observed.table.force[observed.lead[: T.shape[0]]]
        same = (force[:, None] == force[None]).all(axis=2).astype(float)
        moved = np.diag(np.arange(size) < 3).astype(float)
        covariance = covariance + spec.repeatability**2 * np.kron(same, moved)
    if model.cell.noise.joints.any():
        settling = settling_joints(model, observed, model.nominal if x is None else x)
        members = np.arange(len(observed.lead)).reshape(n_poses, -1)
        loading = settling.packed(members)
        covariance = covariance + loading @ loading.transpose(0, 2, 1)
    covariance = covariance / visits
    if model.cell.noise.configuration and observed.kind != "deflection":
        moved = np.diag(np.arange(size) < 3).astype(float)
        same = np.ones((T.shape[0], T.shape[0]))
        covariance = covariance + model.cell.noise.configuration**2 * np.kron(same, moved)
    return covariance


def settling_joints(model: Model, observed: Observations, x: Array) -> SharedEffect:
    """What the joints' own scatter of `[noise]` puts on each visit's readings, of variance one."""
    record = visit_record(model, observed, x)
    assert record is not None
    loading = record.motion * model.cell.noise.of_joints(model.chain.n_joints)
    return SharedEffect("joints", (VISIT,), record.visit, loading)


def readings_each(cell: Cell) -> int:
    """How often a plan reads each pose in each load state: repeats, from one side or from both."""
    return cell.design.repeats * (2 if cell.design.motion.both_directions else 1)


# From the symbolic model to information: whitened B of any pose, under scenarios of the arm.

CHUNK_NUMBERS = 4_000_000  # numbers of a chunk's regressor held at once


@dataclass(frozen=True)
class PoseInformation:
    """B of poses, whitened by their noise and scaled by the sizes of the parameters.

    `scenarios` (S, parameters): parameter values at which the arm is linearised; `columns` (p,)
    the parameters to be estimated, `sizes` (p,) what one unit of a scaled parameter is.
    `sight`: which markers are seen, None for all of them; a reading that is not made counts as
    one that shows nothing.
    """

    model: Model
    states: LoadStates
    scenarios: Array
    columns: IntArray
    sizes: Array
    sight: Sight | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.model.names[c] for c in self.columns)

    def blocks(self, q: Array, load: IntArray) -> Array:
        """Whitened, scaled B (S, N, r, p) of poses q (N, n) in load states `load` (N,).

        r counts the components of all markers and load states of a pose; W_i B_i with
        W_iᵀ W_i = Σ_i⁻¹ gives a pose's information B_iᵀ Σ_i⁻¹ B_i.  Raises ElastocalError where
        a pose has no static equilibrium.
        """
        per_pose = len(self.model.cell.tool.markers) * len(self.states.forces)
        size = max(CHUNK_NUMBERS // (per_pose * 6 * max(len(self.columns), 20)), 1)
        found = [
            np.stack(
                [self._whitened(q[a : a + size], load[a : a + size], x) for x in self.scenarios]
            )
            for a in range(0, len(q), size)
        ]
        return np.concatenate(found, axis=1)

    def rows(self, q: Array, load: IntArray, x: Array) -> Measurements:
        """The table of these poses as the arm x would be read, without noise."""
        markers = tuple(self.model.cell.tool.markers)
        table = simulate(self.model, rows_of(q, load, self.states, markers), x, 0, noise=False)
        return marker_sigmas(self.model.cell, table)

    def _whitened(self, q: Array, load: IntArray, x: Array) -> Array:
        observed, factor = self.noise(q, load, x)
        at = self.model.regressor(observed.table, x, self.columns, observed)
        B = at.B.reshape(len(q), -1, len(self.columns)) * self.sizes
        return np.asarray(np.linalg.solve(factor, B), dtype=np.float64)

    def whiteners(self, q: Array, load: IntArray) -> Array:
        """W (S, N, r, r) of poses q (N, n): W B is a block before scaling."""
        return np.stack([np.linalg.inv(self.noise(q, load, x)[1]) for x in self.scenarios])

    def seen(self, q: Array, load: IntArray) -> BoolArray:
        """(N, L, markers): which markers are seen of poses q (N, n) in each load state; True in
        those in which a pose is not measured."""
        markers, forces = len(self.model.cell.tool.markers), self.states.forces
        found = np.ones((len(q), len(forces), markers), dtype=bool)
        if self.sight is None:
            return found
        for state, force in enumerate(forces):
            rows = np.flatnonzero((load == ALL_LOADS) | (load == state))
            found[rows, state] = self.sight(q[rows], force)
        if not self.states.observed.all():  # a difference takes both of its readings
            found &= found.all(axis=1, keepdims=True)
        return found

    def _unread(self, q: Array, load: IntArray, covariance: Array, size: int) -> Array:
        """The covariance (N, r, r) with that of NEVER in place of what is not seen."""
        seen = self.seen(q, load)
        if load[0] != ALL_LOADS:
            seen = seen[np.arange(len(q)), load][:, None]
        each = covariance.shape[1] // (size * seen.shape[2])  # load states that are observed
        read = np.repeat(seen[:, -each:].reshape(len(q), -1), size, axis=1)
        alone = np.einsum("nr,rs->nrs", ~read * NEVER**2, np.eye(read.shape[1]))
        return np.asarray(covariance * (read[:, :, None] & read[:, None]) + alone)

    def noise(self, q: Array, load: IntArray, x: Array | None = None) -> tuple[Observations, Array]:
        """What is read at the poses of the arm x, by default the one known best, and the Cholesky
        factors (N, r, r) of its covariance."""
        x = self.scenarios[0] if x is None else x
        observed = observe(self.rows(q, load, x), self.model.observe)
        covariance = pose_covariance(self.model, observed, len(q), self.states, x)
        if self.sight is not None:
            covariance = self._unread(q, load, covariance, observed.size)
        return observed, np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


# What a plan can make certain: the parameters that some feasible pose shows, and their scale.

SURE = 1e3  # standard deviations that a typical deviation counts for where a prior is stated
SAMPLE = 2000  # poses that show what is visible: more would not change a rank


@dataclass(frozen=True)
class Estimable:
    """`reduction` over all parameters (kept, dropped, mixing), `sizes` (parameters,) and
    `structure`: the reduction that any number of poses would come to.

    Identification holds parameters that N poses show only below their noise; a plan of N poses
    must promise what identification then does.  Such are in `structure.kept` alone.
    """

    reduction: Reduction
    sizes: Array
    structure: Reduction

    @property
    def columns(self) -> IntArray:
        return self.reduction.kept


def typical_sizes(information: PoseInformation, q: Array, load: IntArray) -> Array:
    """Typical deviation (parameters,) of each parameter, as identification takes them."""
    model, x = information.model, information.scenarios[0]
    some = _sample(model, q, load)
    table = information.rows(q[some], load[some], x)
    return model.sizes(model.regressor(table, x, None, observe(table, model.observe)).B)


def estimable(
    information: PoseInformation,
    q: Array,
    load: IntArray,
    free: IntArray,
    prior: Array,
    n_poses: int,
    stated: NDArray[np.bool_] | None = None,
) -> Estimable:
    """A minimal complete set of the `free` parameters for plans of `n_poses` of the poses q (N, n).

    As identification chooses it, from a sample of the poses weighed as `n_poses` of them.  `prior`
    (parameters, parameters): information known before, scaled by `information.sizes`; parameters
    with a `stated` prior (parameters,) are kept whatever the poses show of them.
    Raises InsufficientDataError where no pose shows anything.
    """
    model = information.model
    some = _sample(model, q, load)
    first = replace(information, scenarios=information.scenarios[:1])
    blocks = first.blocks(q[some], load[some])[0]
    columns = np.searchsorted(information.columns, free)
    B = np.zeros((blocks.shape[0] * blocks.shape[1], len(prior)))
    B[:, free] = blocks.reshape(len(B), -1)[:, columns] * np.sqrt(n_poses / len(some))
    return minimal_set(model, B, free, information.sizes, prior, stated)


def minimal_set(
    model: Model,
    B: Array,
    free: IntArray,
    sizes: Array,
    prior: Array,
    stated: NDArray[np.bool_] | None = None,
) -> Estimable:
    """A minimal complete set of the `free` parameters, from readings with B (rows, parameters),
    whitened and scaled by `sizes`; `prior` and `stated` as of `estimable`."""
    B, known = B[:, free], prior[np.ix_(free, free)]
    if known.any():
        values, vectors = linalg.eigh(known)
        B = np.vstack([B, np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T])
    if stated is not None:
        B = np.vstack([B, SURE * np.eye(len(free))[stated[free]]])
    structure, reduction = (
        _reduced(model, B, free, sizes, threshold) for threshold in (0.0, WORTH_A_COLUMN)
    )
    if not len(reduction.kept):
        raise InsufficientDataError(
            f"{model.cell.path or model.cell.name}: no feasible pose shows any parameter of the "
            "model; state the load that will hang ([design] loads_N), or choose other effects"
        )
    return Estimable(reduction, sizes, structure)


def _reduced(model: Model, B: Array, free: IntArray, sizes: Array, threshold: float) -> Reduction:
    """The reduction of B (rows, free), whose columns are scaled by sizes, over all parameters."""
    parameters = tuple(model.parameters[c] for c in free)
    local = reduce(B, np.ones(len(free)), parameters, sigma=1.0, threshold=threshold)
    kept, dropped = free[local.kept], free[local.dropped]
    mixing = local.mixing * sizes[kept][:, None] / sizes[dropped][None, :]
    return Reduction(kept, dropped, mixing, free[local.invisible])


def interest_of(model: Model, found: Estimable) -> IntArray:
    """Indices into the kept parameters that D, A, E and the indices O count.

    `[design] interest` names parameters, places or effects; by default all but base and markers.
    Raises InputError for an unknown name, InsufficientDataError where a named parameter cannot be
    seen in any feasible pose.
    """
    wanted = model.cell.design.interest
    kept = [model.parameters[c] for c in found.columns]
    where = f"{model.cell.path or model.cell.name}: [design] interest"
    if not wanted:
        own = [k for k, p in enumerate(kept) if not effect_of(p.effect).registered]
        return np.array(own or range(len(kept)), dtype=np.int64)
    chosen: set[int] = set()
    for name in wanted:
        meant = model.meant_by(name)
        if not meant:
            valid = model.all_names
            raise InputError(
                f"{where} names {quoted(name)}, which is no parameter, place or effect of the model"
                f"{did_you_mean(name, valid)}; there are {listed(valid)}"
            )
        here = [k for k, c in enumerate(found.columns) if c in meant]
        if not here:
            raise InsufficientDataError(
                f"{where} names {quoted(name)}; {why(model, found, meant[0])}"
            )
        chosen.update(here)
    return np.array(sorted(chosen), dtype=np.int64)


def why(model: Model, found: Estimable, index: int) -> str:
    """Why parameter `index` is not among the kept ones, and what would help."""
    name, r = model.names[index], found.structure
    if index in r.kept:
        return (
            f"so many poses show less of {name} than their noise, and identification would hold "
            f"it; measure more poses or repeats, or state a prior ({option('knowledge')})"
        )
    if index in r.invisible:
        return (
            f"no feasible pose shows {name}: it moves no marker in any of them; change the load's "
            f"direction or the limits, or leave it out ({option('fixed', name)})"
        )
    if index in r.dropped:
        share = np.abs(r.mixing[:, list(r.dropped).index(index)]) / found.sizes[r.kept]
        partner = model.names[r.kept[int(share.argmax())]]
        return (
            f"no set of poses tells {name} from others ({partner} moves the markers in the same "
            f"way); ask for {partner} instead, or hold one of them ({option('fixed', name)})"
        )
    return f"{name} is held; drop it from {option('fixed')}"


def _sample(model: Model, q: Array, load: IntArray) -> IntArray:
    """Indices of about SAMPLE poses, equally many of each level and load state where there are."""
    cell = model.cell
    held = [joint_index(cell, model.chain, name, "[design.levels]") for name in cell.design.levels]
    kinds, kind = np.unique(np.column_stack([q[:, held], load]), axis=0, return_inverse=True)
    each = -(-SAMPLE // len(kinds))
    members = [np.flatnonzero(kind.ravel() == k) for k in range(len(kinds))]
    found = [own[:: -(-len(own) // each)] for own in members]
    return np.sort(np.concatenate(found))


# Measurements already done: what they tell, so that a plan adds what they lack.


@dataclass(frozen=True)
class Done:
    """`x` (parameters,) the arm as identified so far, `information` (parameters, parameters) in
    the parameters' units, `pull` (parameters,) = BᵀΣ⁻¹(readings − prediction), `numbers` observed,
    `note` on where x comes from."""

    x: Array
    information: Array
    pull: Array
    numbers: int
    note: str


def measured(
    model: Model, table: Measurements, fixed: tuple[str, ...], whole: Model | None = None
) -> Done:
    """Information BᵀΣ⁻¹B of a table of measurements, at the parameters it identifies.

    Where it does not suffice to identify the arm, B is taken at the nominal one.  The noise is
    the stated one, as for the poses to come.  `whole`: the model with further effects, which are
    at nominal, for the information on these too.
    """
    if table.sigma is None:
        table = marker_sigmas(model.cell, table)
    try:
        x = identify(model, table, Options(method="wls", fixed=fixed)).x
        note = "the arm as identified from the measurements done"
    except InsufficientDataError as error:
        x, note = model.nominal, f"the nominal arm, as the measurements do not suffice ({error})"
    if whole is not None:
        known = dict(zip(model.names, x, strict=True))
        x = np.array([known.get(p.name, p.nominal) for p in whole.parameters])
        model = whole
    observed = observe(table, model.observe)
    weights = observed_weights(model, observed, x)
    at = model.regressor(table, x, None, observed)
    B = weights.apply(at.B)
    return Done(x, B.T @ B, B.T @ weights.apply(at.residual), len(B), note)


def next_number(labels: Iterable[str]) -> int:
    """The number after those of the configurations that there are, so that what is measured next
    can join them: 9 after "8", "8-" and "warm-up"; 1 where there is no number."""
    numbers = [int(m[0]) for m in (re.match(r"[0-9]+", label) for label in labels) if m]
    return max(numbers, default=0) + 1


def observed_weights(model: Model, observed: Observations, x: Array) -> Weights:
    """The stated noise, and with it what readings of one visit share."""
    stated = weights_for(observed, model.cell.tracker)
    tau, scatters = model.cell.design.repeatability, model.cell.noise.joints.any()
    told = _told(model.cell, len(observed.lead), observed.size)
    if (tau == 0 and not scatters and told == 1) or stated.whiten is None:
        return stated
    inverse = sparse.linalg.inv(sparse.csc_array(stated.whiten))
    key = np.column_stack(
        [observed.configuration, np.round(observed.table.force[observed.lead], 6)]
    )
    visit = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    same = sparse.csr_array((np.ones(len(visit)), (np.arange(len(visit)), visit)))
    moved = sparse.dia_array(
        (np.where(np.arange(observed.size) < 3, 1.0, 0.0)[None], [0]),
        shape=(observed.size, observed.size),
    )
    covariance = told * (inverse @ inverse.T) + tau**2 * sparse.kron(same @ same.T, moved)
    if scatters:
        Z = settling_joints(model, observed, x).columns()
        covariance = covariance + Z @ Z.T
    return Weights(stated.kind, whitener(sparse.csr_array(covariance)), True, stated.description)
