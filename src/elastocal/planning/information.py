"""What a pose will be read as, and the information on the parameters that it gives."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from elastocal.cell import Cell
from elastocal.cell_tables import CartesianNoise
from elastocal.identification.identify import identify
from elastocal.identification.knowledge import GaussianPrior
from elastocal.identification.noise_structure import (
    CONFIGURATION,
    JOINTS,
    common_to,
    stated_deviations,
)
from elastocal.identification.outliers import kept_of
from elastocal.identification.result import Calibration
from elastocal.identification.solve import WORTH_A_COLUMN, Reduction, reduce
from elastocal.identification.start import Options
from elastocal.identification.weighted_problem import (
    Weights,
    block_diagonal,
    stated_covariance,
    whitener,
)
from elastocal.measurements import Measurements, load_states, numbered
from elastocal.messages import (
    InsufficientDataError,
    check_known,
    length,
    listed,
    option,
    quoted,
    require,
    wish,
)
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.manipulator import Model
from elastocal.model.observations import SIZE, Observations, available_noise, observe
from elastocal.simulation import marker_sigmas, simulate
from elastocal.units import Array, BoolArray, IntArray

Sight = Callable[[Array, Array], BoolArray]  # joints (N, n), force (3,) → (N, markers): seen?
NEVER = 1e9  # m (rad): standard deviation of a reading that is not made


def plan_forces(cell: Cell) -> Array:
    """The load states (L, 3) N of the plan's poses: unloaded where no load is stated; where
    deflections are observed the unloaded state, which they are subtracted from, comes first."""
    loads = cell.design.loads
    forces = np.zeros((1, 3)) if loads is None else np.asarray(loads, dtype=float)
    if cell.model.observe != "deflection":
        return forces
    loaded = (forces != 0).any(axis=1)
    require(
        bool(loaded.any()),
        f'{cell.source}: observe = "deflection" needs a load; state it as in '
        "[design] loads_N = [[0, 0, -2600]]",
    )
    return np.vstack([np.zeros((1, 3)), forces[loaded]])


def _no_noise(cell: Cell) -> str:
    keys = "sigma_um, or range_um and transverse_um"
    return (
        f"{cell.source}: a plan needs the noise of a reading; state [tracker] "
        f"{'distance_um' if cell.model.observe == 'distance' else keys}, as the instrument's data "
        "sheet says"
    )


def reading_covariance(model: Model, observed: Observations) -> Array:
    """(n_rows, size, size), by which a single reading of each table row counts."""
    cell = model.cell
    kind = available_noise(observed.table, cell.tracker)
    if observed.kind == "distance":
        kind = "none" if cell.tracker.distance_sigma is None else "axis"
    require(kind != "none", _no_noise(cell))
    single, spec = stated_covariance(observed, cell.tracker, kind)[0], cell.design
    if (dof := cell.noise.tails) is None:
        return single
    # Identification sets the far readings of such tails apart.
    states = 1 if spec.loads is None else len(spec.loads)
    readings = (spec.poses or TYPICAL) * len(cell.tool.markers) * states * spec.repeats
    return single * kept_of(dof, readings * single.shape[1], single.shape[1]).variance


TYPICAL = 30  # poses of a plan that states none: what is set apart hardly depends on how many


def reading_noise(
    model: Model, observed: Observations, x: Array, readings: Array | float = 1.0, visits: int = 1
) -> sparse.csr_array:
    """Covariance (rows, rows) of the observations, means of so many `readings` (n,) of each table
    row, and of so many `visits`: Σ = (T Σ_rows Tᵀ / readings + τ² per visit and direction + J
    diag(s²) Jᵀ) / visits + s_c² per configuration.  Deflections share their unloaded reading; what
    the arm does not repeat, τ of `[design] repeatability_um` and s of the joints of `[noise]`, is
    common to the markers of a visit, and what a configuration is off by as a whole to all of its
    visits.  J is that of the arm x (parameters,)."""
    cell, table = model.cell, observed.table
    single = reading_covariance(model, observed) / np.asarray(readings).reshape(-1, 1, 1)
    T = sparse.kron(observed.combine, sparse.eye_array(observed.size), format="csr")
    covariance = T @ block_diagonal(single) @ T.T
    shared = []
    if (tau := cell.design.repeatability) > 0:
        force = load_states(table.force[observed.lead])
        visit, axes = numbered(observed.configuration, force), np.eye(observed.size)[:, :3]
        shared.append(common_to(visit, tau * axes, "visit"))
    shared += stated_deviations(model, observed, x, (JOINTS,))
    for Z in (effect.columns() for effect in shared):
        covariance = covariance + Z @ Z.T
    covariance = covariance / visits
    for effect in stated_deviations(model, observed, x, (CONFIGURATION,)):
        Z = effect.columns()
        covariance = covariance + Z @ Z.T
    return sparse.csr_array(covariance)


CHUNK_NUMBERS = 4_000_000  # numbers of a chunk's regressor held at once


@dataclass(frozen=True)
class PoseInformation:
    """B of poses, whitened by their noise and scaled by the sizes of the parameters.  `x`
    (parameters,): values at which the arm is linearised; `columns` (p,) the parameters to be
    estimated, `sizes` (p,) what one unit of a scaled parameter is.  `sight`: which markers are
    seen, None for all of them; a reading that is not made counts as one that shows nothing."""

    model: Model
    x: Array
    columns: IntArray
    sizes: Array
    sight: Sight | None = None

    @cached_property
    def forces(self) -> Array:
        return plan_forces(self.model.cell)

    @property
    def everything(self) -> IntArray:
        return np.full((1, len(self.forces)), self.model.cell.design.repeats)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.model.names[c] for c in self.columns)

    def blocks(self, q: Array, readings: IntArray | None = None) -> Array:
        """Whitened, scaled B (N, r, p) of poses q (N, n), with `readings` (N, L) in each load state
        or, None, `[design] repeats` in all.  r counts the components of all markers and load states
        of a pose; W_i B_i with W_iᵀ W_i = Σ_i⁻¹ gives a pose's information B_iᵀ Σ_i⁻¹ B_i."""
        per_pose = len(self.model.cell.tool.markers) * len(self.forces)
        size = max(CHUNK_NUMBERS // (per_pose * 6 * max(len(self.columns), 20)), 1)
        found = []
        for k in range(0, len(q), size):
            own = None if readings is None else readings[k : k + size]
            observed, factor = self.noise(part := q[k : k + size], own)
            at = self.model.regressor(observed.table, self.x, self.columns, observed)
            B = at.B.reshape(len(part), -1, len(self.columns)) * self.sizes
            found.append(np.linalg.solve(factor, B))
        return np.concatenate(found)

    def rows(self, q: Array) -> Measurements:
        """Not measured yet: poses q (N, n) in each load state, of each marker."""
        names, n = tuple(self.model.cell.tool.markers), len(self.forces)
        pose = np.repeat(np.arange(len(q)), n * len(names))
        table = Measurements.of_poses(
            "plan", q[pose], np.tile(np.repeat(self.forces, len(names), axis=0), (len(q), 1)),
            configuration=pose, configuration_labels=tuple(map(str, range(1, len(q) + 1))),
            marker=np.resize(np.arange(len(names)), len(pose)), marker_names=names,
        )  # fmt: skip
        return marker_sigmas(self.model.cell, simulate(self.model, table, self.x, 0, noise=False))

    def seen(self, q: Array, readings: IntArray | None = None) -> BoolArray:
        """(N, L, markers): which markers are seen and read of poses q (N, n) in each load state."""
        found = np.ones((len(q), len(self.forces), len(self.model.cell.tool.markers)), dtype=bool)
        if self.sight is not None:
            found = np.stack([self.sight(q, force) for force in self.forces], axis=1)
        if readings is not None:
            found &= (readings > 0)[:, :, None]
        if self.model.cell.model.observe == "deflection":  # a difference takes both its readings
            found[:, 1:] &= found[:, :1]
            found[:, 0] &= found[:, 1:].any(axis=1)
        return found

    def numbers(self, q: Array, readings: IntArray) -> int:
        """How many numbers are observed of poses q (N, n), with `readings` (N, L) in each state."""
        kind, read = self.model.observe, self.seen(q, readings) * readings[:, :, None]
        visits = 2 if self.model.cell.design.motion.both_directions else 1
        return visits * SIZE[kind] * int(read[:, int(kind == "deflection") :].sum())

    def noise(self, q: Array, readings: IntArray | None = None) -> tuple[Observations, Array]:
        """What is read at the poses q (N, n), and the Cholesky factors (N, r, r) of its covariance,
        that of NEVER in place of what is not seen or read.  A pose that is approached from both
        sides is visited twice."""
        model, spec = self.model, self.model.cell.design
        observed = observe(self.rows(q), model.observe)
        each = np.full((len(q), 1), spec.repeats) if readings is None else np.maximum(readings, 1)
        each = np.repeat(each.ravel(), len(observed.table) // each.size).astype(float)
        visits = 2 if spec.motion.both_directions else 1
        found = reading_noise(model, observed, self.x, each, visits).tocoo()
        r, (i, j) = found.shape[0] // len(q), found.coords
        covariance = np.zeros((len(q), r, r))
        covariance[i // r, i % r, j % r] = found.data
        if not (seen := self.seen(q, readings)).all():
            size = observed.size
            states = covariance.shape[1] // (size * seen.shape[2])  # that are observed
            read = np.repeat(seen[:, -states:].reshape(len(q), -1), size, axis=1)
            never = np.einsum("nr,rs->nrs", ~read * NEVER**2, np.eye(read.shape[1]))
            covariance = covariance * (read[:, :, None] & read[:, None]) + never
        return observed, np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


SURE = 1e3  # standard deviations that a typical deviation counts for where a prior is stated
# Share of a test point's motion that may lie outside what the poses show: rounding, not physics.
OUTSIDE = 1e-6


@dataclass(frozen=True)
class Done:
    """Measurements done: `x` (parameters,) the arm as identified so far, `information` (parameters,
    parameters) in the parameters' units, `numbers` observed, `note` on where x comes from."""

    x: Array
    information: Array
    numbers: int
    note: str


@dataclass(frozen=True)
class Known:
    fixed: tuple[str, ...] = ()
    prior: GaussianPrior | None = None
    done: Done | None = None


@dataclass(frozen=True)
class Estimable:
    """Of the `model`'s parameters `reduction` (kept, dropped, mixing), `sizes` (parameters,) and
    `structure`: the reduction that any number of poses would come to.  What N poses show only below
    their noise identification holds: it is in `structure.kept` alone."""

    model: Model
    reduction: Reduction
    sizes: Array
    structure: Reduction

    @property
    def columns(self) -> IntArray:
        return self.reduction.kept

    @property
    def interest(self) -> IntArray:
        """Indices into the kept parameters that D, A, E and the indices O count, by default all but
        base and markers."""
        model, wanted = self.model, self.model.cell.design.interest
        kept = [model.parameters[c] for c in self.columns]
        where = wish("interest", f"{model.cell.source}: [design] interest")
        if not wanted:
            own = [k for k, p in enumerate(kept) if not effect_of(p.effect).registered]
            return np.array(own or range(len(kept)), dtype=np.int64)
        chosen: set[int] = set()
        for name in wanted:
            told = f"{where} names {quoted(name)}"
            unknown = "no parameter, place or effect of the model"
            check_known(name, model.all_names, f"{told}, which is {unknown}")
            meant = model.meant_by(name)
            here = [k for k, c in enumerate(self.columns) if c in meant]
            if not here:
                raise InsufficientDataError(f"{told}; {self.why(meant[0])}")
            chosen.update(here)
        return np.array(sorted(chosen), dtype=np.int64)

    @property
    def unseen(self) -> tuple[str, ...]:
        """Which parameters no pose shows, in sentences."""
        unseen = [self.model.names[i] for i in self.structure.invisible]
        return (self._shown_by_none(unseen),) if unseen else ()

    def _shown_by_none(self, names: list[str]) -> str:
        cell, remedy = self.model.cell, "add a marker elsewhere"
        if any("load" in effect_of(p.effect).needed(cell) for p in self.model.parameters):
            loaded = cell.design.loads is not None and cell.design.loads.any()
            remedy = "change the load's direction or the limits"
            remedy = remedy if loaded else "state a load ([design] loads_N)"
        they_move, them = ("it moves", "it") if len(names) == 1 else ("they move", "them")
        return (
            f"no feasible pose shows {listed(names)}: {they_move} no marker in any of them; "
            f"{remedy}, or leave {them} out ({option('fixed', names[0])})"
        )

    @property
    def combination(self) -> Array | None:
        """[design] combination as factors (kept,) of the kept parameters, scaled."""
        model, wanted = self.model, self.model.cell.design.combination
        if not wanted:
            return None
        a = np.array([wanted.get(name, 0.0) for name in model.names])
        if lost := self.unpredictable(a[None, None]):
            raise InsufficientDataError(
                f"{wish('combination', f'{model.cell.source}: [design] combination')} depends on "
                f"{model.names[lost[0]]}; {self.why(lost[0])}"
            )
        return np.asarray((a * self.sizes)[self.columns])

    def why(self, index: int) -> str:
        name, r, model = self.model.names[index], self.structure, self.model
        if index in r.kept:
            return (
                f"so many poses show less of {name} than their noise, and identification would "
                f"hold it; measure more poses or repeats, or state a prior ({option('knowledge')})"
            )
        if index in r.invisible:
            return self._shown_by_none([name])
        if index in r.dropped:
            share = np.abs(r.mixing[:, list(r.dropped).index(index)]) / self.sizes[r.kept]
            partner = model.names[r.kept[int(share.argmax())]]
            return (
                f"no set of poses separates {name} from others ({partner} moves the markers in "
                f"the same way); ask for {partner} instead, or hold one of them "
                f"({option('fixed', name)})"
            )
        return f"{name} is held; drop it from {option('fixed')}"

    def on_kept(self, A: Array, hold: bool = False) -> Array:
        """A (T, r, kept) on the kept parameters, scaled by their sizes.  A test point is
        predictable where its motion by the dropped parameters is that by the kept ones they
        combine with, A_D = A_K · mixing; where it is not, no number of poses would make that
        position certain, unless one is to `hold` those parameters."""
        cell, lost = self.model.cell, () if hold else self.unpredictable(A)
        if lost:
            off = np.abs(self._unexplained(A, self.structure)).max(axis=1)
            t = int(off[:, list(self.structure.dropped).index(lost[0])].argmax())
            first, *others = (self.model.names[i] for i in lost)
            likewise = f"; so it is with {listed(others, 6)}" if others else ""
            raise InsufficientDataError(
                f"{cell.source}: the position at test pose {t + 1} depends on {first}; "
                f"{self.why(lost[0])}{likewise}; or ask for parameters instead "
                'of test poses: design with criterion = "D"'
            )
        return np.asarray(A[..., self.columns] * self.sizes[self.columns])

    def unpredictable(self, A: Array) -> tuple[int, ...]:
        """The parameters by which no plan can predict rows of A (T, r, parameters), the worst
        first."""
        off = np.abs(self._unexplained(A, self.structure)).max(axis=(0, 1), initial=0.0)
        order = np.argsort(-off, kind="stable")
        least = OUTSIDE * float(np.abs(A * self.sizes).max(initial=0.0))
        return tuple(int(self.structure.dropped[d]) for d in order if off[d] > least)

    def held(self, A: Array) -> Array:
        """(T, r, d) in m, by how much typical deviations of what is held move the test points."""
        return self._unexplained(A, self.reduction)

    def _unexplained(self, A: Array, r: Reduction) -> Array:
        """(T, r, dropped): A_D − A_K · mixing, times the sizes."""
        return np.asarray((A[..., r.dropped] - A[..., r.kept] @ r.mixing) * self.sizes[r.dropped])


def estimable(
    model: Model, known: Known, free: IntArray, B: Array, sizes: Array
) -> tuple[Estimable, Array]:
    """A minimal complete set of the `free` parameters, as identification chooses it, from readings
    with B (rows, parameters), whitened and scaled by `sizes`, and the information on it that is
    known before (kept, kept), scaled.  What has a stated prior is kept whatever readings show."""
    asked = model.cell.design.prior == "typical"
    stated = np.array([asked and p.typical is not None for p in model.parameters], dtype=bool)
    prior = np.diag(stated.astype(float))
    stated |= model.shrunk
    if known.prior is not None:
        P = known.prior.rows(model.names)[0] * sizes
        prior += P.T @ P
        stated |= np.isin(model.names, known.prior.names)
    if known.done is not None:
        prior += known.done.information * np.outer(sizes, sizes)
    rows, before = [B[:, free]], prior[np.ix_(free, free)]
    if before.any():
        values, vectors = linalg.eigh(before)
        rows.append(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
    every = np.vstack([*rows, SURE * np.eye(len(free))[stated[free]]])
    parameters = tuple(model.parameters[c] for c in free)

    def reduced(threshold: float) -> Reduction:
        local = reduce(every, np.ones(len(free)), parameters, sigma=1.0, threshold=threshold)
        kept, dropped = free[local.kept], free[local.dropped]
        mixing = local.mixing * sizes[kept][:, None] / sizes[dropped][None, :]
        return Reduction(kept, dropped, mixing, free[local.invisible])

    found = Estimable(model, reduced(WORTH_A_COLUMN), sizes, reduced(0.0))
    if not len(found.columns):
        raise InsufficientDataError(
            f"{model.cell.source}: no feasible pose shows any parameter of the "
            "model; state the load that will hang ([design] loads_N), or choose other effects"
        )
    return found, prior[np.ix_(found.columns, found.columns)]


def evenly(group: IntArray, each: int) -> IntArray:
    """Indices of about `each` of the members of every group."""
    members = [np.flatnonzero(group == g) for g in np.unique(group)]
    return np.sort(np.concatenate([own[:: -(-len(own) // each)] for own in members]))


IDENTIFIED = "the arm as identified from the measurements done"
COMPUTED = 1e-9  # m: readings that scatter by less were not read
LEAST = 1e-3  # share of its size as stated by which a function that was left out still counts


def lacks_noise(cell: Cell) -> bool:
    """None is stated, and it is taken from the measurements done.  InputError where these do not
    show it: deflections share readings, poses have two units."""
    if cell.model.observe == "distance":
        return cell.tracker.distance_sigma is None
    lacks = cell.tracker.noise is None and not cell.design.marker_sigma
    require(not lacks or cell.model.observe == "position", _no_noise(cell))
    return lacks


def with_noise_of(cell: Cell, done: Calibration) -> tuple[Cell, tuple[str, ...]]:
    """The cell with the noise of single readings that the measurements done show, the same on each
    axis, and a sentence that says so."""
    observed = done.observations
    sigma = math.sqrt(done.noise_parts["readings"] / min(observed.size, 3))
    if sigma < COMPUTED:
        return cell, ()
    tracker, key, along = replace(cell.tracker, distance_sigma=sigma), "distance_um", ""
    if observed.kind != "distance":
        tracker = replace(cell.tracker, noise=CartesianNoise(np.full(3, sigma)))
        key, along = "sigma_um", " on each axis"
    states = f"[tracker] states {'too small a' if done.noise.ratio_to_stated else 'no'} {key}"
    told = (
        f"{states}: the plan takes the {length(sigma)}{along} that the measurements done show; "
        "state it where you know it"
    )
    return replace(cell, tracker=tracker), (told,)


def measured(model: Model, table: Measurements, fixed: tuple[str, ...]) -> Done:
    """Information BᵀΣ⁻¹B of a table of measurements, at the parameters it identifies, or at the
    nominal arm where it does not suffice; the noise is the stated one, as for the poses to come.
    Of smooth functions that of their prior, of the size found, is in it."""
    table = marker_sigmas(model.cell, table)
    sizes = np.array([p.typical if p.shrunk and p.typical else np.inf for p in model.parameters])
    try:
        found = identify(model, table, Options(method="wls", fixed=fixed))
        x, note = found.x, IDENTIFIED
        for part in found.smooth:
            sizes[part.group.columns] *= max(np.sqrt(part.scale), LEAST)
    except InsufficientDataError as error:
        x, note = model.nominal, f"the nominal arm, as the measurements do not suffice ({error})"
    B, _ = whitened(model, table, x)
    return Done(x, B.T @ B + np.diag(sizes**-2.0), len(B), note)


def whitened(model: Model, table: Measurements, x: Array) -> tuple[Array, Array]:
    """B (rows, parameters) of the readings, by the stated noise and what readings of one visit or
    configuration share, and as it is."""
    observed = observe(table, model.observe)
    B = model.regressor(table, x, None, observed).B
    own = whitener(reading_noise(model, observed, x))
    return Weights("stated", own, True, "noise as stated").apply(B), B


def next_number(labels: Iterable[str]) -> int:
    """What is measured next can join what is there: 9 after "8", "8-" and "warm-up"; 1 where there
    is no number."""
    numbers = [int(m[0]) for m in (re.match(r"[0-9]+", label) for label in labels) if m]
    return max(numbers, default=0) + 1
