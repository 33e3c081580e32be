"""Where the calibrated arm will be: covariance and region of the tool's position at any pose, the
error to be expected at poses that nobody measured.

At a pose the tool's position moves by A_K (K parameters that the data determined) and A_D (D left
open) per unit of a parameter.  What is not known of it has three parts:

    Σ_p = A_K Σ A_Kᵀ            the estimates' covariance
        + O S² Oᵀ               O = A_D − A_K · mixing: what typical deviations S of the parameters
                                left open move it by, beyond what the estimates took over for them
        + τ² I/3                what the model lacks: what configurations scatter by beyond their
                                noise (lack of fit)

A single visit scatters about that place by the joints' repeatability, J diag(s²) Jᵀ, and by what
the readings of a configuration have in common.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from elastocal.above import ByValue
from elastocal.cell import Cell
from elastocal.engine import least_norm
from elastocal.identification.least_squares import Covariance, drawing_root, variance_of
from elastocal.identification.noise_summary import BEYOND, Noise
from elastocal.identification.solve import Solution, deviates, reduce
from elastocal.measurements import Measurements
from elastocal.messages import EXACT, ElastocalError, InsufficientDataError
from elastocal.model.calibrated import CalibratedArm, CalibratedTool, MeasuredVisits, OpenParameters
from elastocal.model.chain import finite_ranges, joint_index, joint_limits
from elastocal.model.effects.base import index
from elastocal.model.effects.statics import JointCompliance, usual_compliance
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, observe
from elastocal.units import Array, BoolArray, IntArray, microns

OUTSIDE = 1e-6  # share of the tool's motion that may lie outside what is known: rounding
NEVER_SHOWN = 0.1  # standard deviations; a hundred times as many readings would show one
SENSITIVITIES = 5000  # rows at a time, which bounds the memory


NONE_OPEN = OpenParameters((), np.zeros((0, 0)), np.zeros(0))


@dataclass(frozen=True)
class Uncertainty:
    """`covariance` (n, 3, 3) m² of the position in the data's frame; `total` (n, 3, 3) with
    parameters left open and lack of fit.  Of a rotation in rad², where no lack of fit is known.

    `unknown` (n,) m: what typical deviations of the parameters that the data do not determine
    would move the tool by, which the covariance does not hold; `blamed` names those parameters,
    the most harmful first.
    """

    covariance: Array
    total: Array
    unknown: Array
    blamed: tuple[str, ...]

    @property
    def within(self) -> Array:
        """(n,) m: longest half axis of the ellipsoid that holds the tool with 95 % probability."""
        return half_axes(self.total)[:, 0]

    @property
    def std(self) -> Array:
        """(n,) m: root of the sum of the variances along the three axes."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=1, axis2=2)))


def uncertainty_at(
    tool: CalibratedTool, rows: list[NDArray], q: Array, turns: bool = False
) -> Uncertainty:
    """Σ_p = A_K Σ A_Kᵀ and O S at commanded joints q (n, joints) under the inputs `rows`; NaN where
    the result determined nothing.  `turns`: of the rotation instead of the position."""
    arm, known, off = tool.calibrated, [], []
    for first in range(0, len(q), SENSITIVITIES):
        some = slice(first, first + SENSITIVITIES)
        at = moves(arm, tool.sensitivity([values[some] for values in rows], q[some], turns))
        known.append(at[0] @ arm.covariance @ at[0].transpose(0, 2, 1))
        off.append(at[1])
    if not off:
        return Uncertainty(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0), ())
    covariance, move = np.concatenate(known), np.concatenate(off)
    if not arm.determined:  # nothing known is no certainty
        covariance = np.full((len(q), 3, 3), np.nan)
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    lacking = 0.0 if turns else arm.lacking
    return Uncertainty(
        covariance,
        covariance + move @ move.transpose(0, 2, 1) + lacking**2 / 3 * np.eye(3),
        np.sqrt((move**2).sum(axis=(1, 2))),
        _blamed(arm.left or NONE_OPEN, (move**2).sum(axis=1).mean(axis=0)),
    )


def moves(arm: CalibratedArm, A: Array) -> tuple[Array, Array]:
    """A_K (n, r, K), and O S (n, r, D) of A (n, r, parameters) in m per unit; what vanishes but
    for rounding, as the tool's point moves as the measured ones do, is zero."""
    index, left = {name: i for i, name in enumerate(arm.model.names)}, arm.left or NONE_OPEN
    known = A[..., [index[name] for name in arm.determined]]
    move = A[..., [index[name] for name in left.names]] * left.typical
    off = move - known @ (left.mixing * left.typical) if left.names else move
    size = np.abs(move).max(axis=(0, 1), initial=0.0)
    off[np.abs(off) <= OUTSIDE * np.maximum(size, np.abs(move).max(initial=0.0))] = 0.0
    return known, off


def mean_squares(arm: CalibratedArm, B: Array, size: int) -> tuple[float, float]:
    """Mean squares in m² of the position error of readings of B (n·size, parameters): by what the
    estimates leave uncertain, and by typical deviations of parameters left open."""
    known, off = moves(arm, B.reshape(-1, size, B.shape[1])[:, :3])
    own = variance_of(known, arm.covariance)
    return float(own.mean()), float((off**2).sum(axis=(1, 2)).mean())


def _blamed(left: OpenParameters, harm: Array) -> tuple[str, ...]:
    """Open parameters by the `harm` (D,) they do, of those that poses can show where any does."""
    if (apart := ~np.isin(left.names, left.redundant))[harm > 0].any():
        harm = np.where(apart, harm, 0.0)
    size = np.round(harm / max(float(harm.max(initial=0.0)), 1e-300), 9)
    return tuple(left.names[int(i)] for i in np.argsort(-size, kind="stable") if harm[i] > 0)


def left_open(
    solution: Solution, limits: Mapping[int, tuple[float, float]] | None = None
) -> OpenParameters:
    """What a fit left open, from its weighted B_K and B_D at the values found.  A parameter held at
    its bound is no more open than its 95 % `limits`, by parameter, leave it."""
    model, reduction = solution.problem.model, solution.reduction
    free, x = solution.problem.free, solution.fit.x
    kept = reduction.kept
    own = ~(model.shrunk[kept] | np.isin(kept, reduction.with_prior))
    open_ = reduction.dropped[~model.shrunk[reduction.dropped]]
    mixing = np.zeros((len(kept), len(open_)))
    typical = typical_sizes(model, x, kept)
    typical = np.where(deviates(model), solution.problem.sizes, typical)
    if len(open_) and own.any():
        R = solution.fit.of_free.R * typical[free]
        columns, rest = np.searchsorted(free, kept[own]), np.searchsorted(free, open_)
        shares = least_norm(R[:, columns], R[:, rest], cond=1e-10) * typical[kept[own]][:, None]
        mixing[own] = np.divide(shares, typical[open_], out=shares, where=typical[open_] > 0)
    names = tuple(model.names[d] for d in open_)
    redundant = _redundant(solution, open_, typical)
    for i, (low, high) in (limits or {}).items():
        typical[i] = min(typical[i], (high - low) / (2 * special.ndtri(0.975)))
    return OpenParameters(names, mixing, typical[open_], redundant)


def _redundant(solution: Solution, open_: IntArray, typical: Array) -> tuple[str, ...]:
    """Which of the parameters left open no pose tells from the rest: at poses over the whole joint
    range, their columns of B lie in the span of those determined and of the others left open, but
    for so little that as many readings as these would show a typical deviation by less than
    NEVER_SHOWN standard deviations."""
    problem, kept = solution.problem, solution.reduction.kept
    model, observed = problem.model, problem.observations
    if not len(open_) or model.shrunk[kept].all():
        return ()
    if (B := anywhere(solution)) is None:
        return ()
    B *= np.where(typical > 0, typical, 1.0)
    # A marker that nobody read is no matter of poses.
    unread = unread_markers(model, observed.table)
    open_ = open_[[model.parameters[c].where not in unread for c in open_]]
    if not len(open_):
        return ()
    both = np.concatenate([kept[~model.shrunk[kept]], open_])
    ranks = np.isin(both, open_).astype(int)
    told = both[reduce(B[:, both], np.ones(len(both)), (), 1.0, NEVER_SHOWN, ranks).kept]
    return tuple(model.names[d] for d in open_[~np.isin(open_, told)])


def anywhere(solution: Solution) -> Array | None:
    """B (rows, parameters) at poses over the whole joint range under the loads of the readings, in
    units of the noise, as if there were as many readings; None without a static equilibrium."""
    model, observed = solution.problem.model, solution.problem.observations
    poses = over_the_workspace(model.cell, model, observed.table)
    try:
        B = readings_at(model, solution.fit.x, observed, poses)[0]
    except ElastocalError:
        return None
    parts = solution.fit.residual.reshape(-1, observed.size)
    noise = np.sqrt((parts**2).mean(axis=0))[:, None]
    B = (B / np.maximum(noise, EXACT)).reshape(-1, B.shape[2])
    return np.asarray(B * np.sqrt(parts.size / len(B)))


def unread_markers(model: Model, table: Measurements) -> tuple[str, ...]:
    """Places "marker:M2" of the markers that no row reads."""
    read = {f"marker:{name}" for name in table.markers_read}
    places = dict.fromkeys(p.where for p in model.parameters if p.where.startswith("marker:"))
    return tuple(place for place in places if place not in read)


def typical_sizes(model: Model, x: Array, kept: IntArray) -> Array:
    """Typical deviation (parameters,) of each parameter; where none is known beforehand, the root
    mean square of what was determined of its kind (all joints' compliances), else the usual one."""
    found: dict[tuple[str, str], list[float]] = {}
    for k in kept:
        p = model.parameters[k]
        found.setdefault((p.effect, p.unit), []).append(float(x[k]))
    rms = {kind: float(np.sqrt(np.mean(np.square(values)))) for kind, values in found.items()}
    usual = {
        p.name: usual_compliance(model.chain, model.cell, i)
        for p in model.parameters
        if p.effect == JointCompliance.name and model.chain.kinds[i := index(p.where)] == "revolute"
    }
    own = np.isin(np.arange(len(model.parameters)), kept).astype(float)
    each = zip(model.parameters, own.tolist(), strict=True)
    return np.array([
        p.typical or abs(p.nominal) or rms.get((p.effect, p.unit)) or usual.get(p.name) or k
        for p, k in each
    ])  # fmt: skip


@dataclass(frozen=True, eq=False)
class Position(ByValue):
    """Where the tool is at n poses, and how sure that is; lengths in m, in the data's frame.

    `position` (n, 3).  `covariance` (n, 3, 3) of the place about which visits scatter: estimates,
    parameters left open and lack of fit, known with `dof` (n,) degrees of freedom, of which a
    `share` (n,) is the scale of F (`Covariance.tails`); `visit` (n, 3, 3): the scatter of a single
    visit besides, as far as the noise model has it.
    """

    position: Array
    covariance: Array
    visit: Array
    dof: Array
    share: Array

    def half_axes(self, level: float = 0.95, visit: bool = False) -> Array:
        """Half axes (n, 3), the longest first, of the ellipsoid that holds the tool with
        probability `level`: √(3 F_3,dof(level) λ) of the eigenvalues λ; with `visit` at one
        visit."""
        normal = half_axes(self.covariance + (self.visit if visit else 0.0), level)
        return normal * np.sqrt(self._quantile(level) / special.chdtri(3, 1 - level))[:, None]

    def _quantile(self, level: float) -> Array:
        return np.asarray(3 * self.share * special.fdtri(3, np.clip(self.dof, 1, 1e9), level))

    def holds(self, places: Array, level: float = 0.95, visit: bool = False) -> BoolArray:
        """Whether the regions of that `level` hold the places (n, 3)."""
        total = self.covariance + (self.visit if visit else 0.0)
        off = np.asarray(places) - self.position
        distance = np.einsum("ni,nij,nj->n", off, np.linalg.pinv(total, hermitian=True), off)
        return np.asarray(distance <= self._quantile(level))


def half_axes(covariance: Array, level: float = 0.95) -> Array:
    """(n, 3) m, the longest first: √(χ²₃(level) λ) of the eigenvalues λ; NaN where unknown."""
    size = np.full(covariance.shape[:2], np.nan)
    known = np.isfinite(covariance).all(axis=(1, 2))
    size[known] = np.maximum(np.linalg.eigvalsh(covariance[known])[:, ::-1], 0.0)
    return np.asarray(np.sqrt(special.chdtri(3, 1 - level) * size))


def position_at(
    tool: CalibratedTool, table: Measurements, noise: Noise, spread: Covariance
) -> Position:
    """The tool's position at the joints and in the circumstances of the table (n,), NaN without an
    equilibrium; `spread` is the covariance of what was determined."""
    rows, q = tool.rows(table), table.q
    joints, common = noise.scatter(q.shape[1])
    found, place = uncertainty_at(tool, rows, q), tool.poses(rows, q)[0]
    J = tool.errors(rows, q, place, None)[1]
    visit = (J * joints**2) @ J.transpose(0, 2, 1) + common**2 * np.eye(3)
    arm = tool.calibrated
    moved = np.zeros((len(q), 0, len(arm.determined)))
    if spread.among:
        known = [arm.model.names.index(name) for name in arm.determined]
        moved = tool.sensitivity(rows, q)[..., known]
    return Position(place, found.total, visit, *spread.tails(moved))


MOST_LOADS, MOST_VISITS = 100, 400  # kept with a result
POSES = 256  # drawn over the joint limits where nobody says where the arm will work
DRAWS = 2000
WHOLE = 1e-6
FEWEST_REPEATS = 10  # degrees of freedom within repeats from which on they tell the noise


@dataclass(frozen=True)
class NewPoses:
    """Where the arm will be used: `q` (T, joints) rad or m, `force` (T, 3) N in the data's frame,
    `weight` (T,) of sum 1; `source` says in words where they come from."""

    q: Array
    force: Array
    weight: Array
    source: str

    def rows(self, arm: CalibratedArm, observed: Observations) -> tuple[Array, Array]:
        """∂(position)/∂X (R, 3, parameters) there, at the markers, and weights (R,)."""
        B, weight = readings_at(arm.model, arm.x, observed, self)
        return B[:, :3], weight


def over_the_workspace(cell: Cell, model: Model, table: Measurements) -> NewPoses:
    """Poses drawn over the joint limits with a fixed seed, under the loads that were measured."""
    chain = model.chain
    low, high = finite_ranges(chain, *joint_limits(cell, chain))
    q = np.random.default_rng(0).uniform(low, high, (POSES, chain.n_joints))
    for name, levels in cell.model.compliance_levels.items():
        # Elsewhere the model has no compliance for that joint.
        q[:, joint_index(name)] = np.resize(levels, POSES)
    forces = _loads(table.force, model.observe)
    source = f"{POSES} poses drawn over the joint limits, as the cell states no test poses"
    return NewPoses(q, np.resize(forces, (POSES, 3)), np.full(POSES, 1 / POSES), source)


def _loads(force: Array, observe: str) -> Array:
    """The forces (L, 3) of rows (n, 3), each once; of deflections those that deflect."""
    forces = np.round(force, 3)
    changes = (forces[1:] != forces[:-1]).any(axis=1)  # sorting rows takes long
    forces = np.unique(forces[np.concatenate([[True], changes])], axis=0)
    if observe == "deflection":
        forces = forces[(forces != 0).any(axis=1)]
    return forces if len(forces) else np.zeros((1, 3))


def fitted_too(table: Measurements, fitted: Measurements) -> int:
    """How many readings of the table are among those fitted."""
    told = [
        list(map(bytes, np.column_stack([t.q, t.force, values])))
        for t in (table, fitted)
        if (values := t.distance if t.position is None else t.position) is not None
    ]
    return sum(map(set(told[1]).__contains__, told[0])) if len(told) == 2 else 0


def measured_loads(observed: Observations) -> Array:
    """The forces (L, 3) N of the readings, at most MOST_LOADS of them, evenly chosen."""
    return _evenly(_loads(observed.table.force, observed.kind), MOST_LOADS)


def _evenly(rows: NDArray[Any], most: int) -> NDArray[Any]:
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), most)).round().astype(int)
    return rows[chosen]


def measured_visits(observed: Observations) -> MeasuredVisits:
    """Joints and force of the readings, each pair once, at most MOST_VISITS, evenly chosen."""
    some = observed.table.take(_evenly(observed.lead, 100 * MOST_VISITS))
    rows = np.hstack([some.q, some.force])
    first = np.sort(np.unique(rows.round(9), axis=0, return_index=True)[1])
    rows = _evenly(rows[first], MOST_VISITS)
    return MeasuredVisits(rows[:, :-3], rows[:, -3:])


@dataclass(frozen=True)
class PredictedError:
    """The noise-free position error to be expected at new poses: 3-D rms over poses, in m.

    `rms` is its expectation, `ci95` its 95 % interval; with 95 % it is below `sure`.  The parts of
    the expectation: of the `parameters` determined, of those left `open`, of what the model lacks
    (`lacking`, None where nothing tells the noise from it).  `blamed` names open parameters, the
    worst first.
    `unchecked` is that part of `parameters` which single configurations alone hold, infinite
    where it is not known.
    """

    rms: float
    ci95: tuple[float, float]
    parameters: float
    open: float
    lacking: float | None
    blamed: tuple[str, ...]
    poses: int
    source: str
    unchecked: float = np.inf
    sure: float = np.inf

    def to_json(self) -> dict[str, Any]:
        low, high = self.ci95
        return {
            "rms": self.rms * 1e6, "ci95": [low * 1e6, high * 1e6],
            "parameters": self.parameters * 1e6, "open_parameters": self.open * 1e6,
            "lack_of_fit": microns(self.lacking),
            "unchecked": microns(self.unchecked),
            "blamed": self.blamed, "poses": self.poses, "source": self.source,
        }  # fmt: skip


@dataclass(frozen=True)
class Excess:
    """By how much configurations scatter beyond their noise, as draws (DRAWS,) of what the data
    leave possible: `squared` in m², 3-D, and the factor `inflated` on the covariance of the
    estimates, which the missing part has moved as well; `fitted` is the mean square of it that
    residuals have."""

    squared: Array
    inflated: Array
    fitted: float = 0.0

    def with_chance(self, chance: float, rng: np.random.Generator) -> Excess:
        there = rng.random(DRAWS) < chance
        return Excess(np.where(there, self.squared, 0.0), np.where(there, self.inflated, 1.0))


def excess_of(
    residual: tuple[float, int, int], left_out: tuple[float, float], own: float, noise: Noise,
    rng: np.random.Generator,
) -> Excess | None:  # fmt: skip
    """From repeats where there are enough, else from the stated noise; None without either.
    `residual` and `left_out` are mean squares in m² with their degrees of freedom: of residuals,
    with their number, and of errors held out, of which the fits' uncertainty has `own`.

    Mean squares of residuals are drawn as s² ν/χ²_ν.  Between configurations that is σ² + n τ²
    with n readings in a cell of configuration, marker and load; within them σ².  Where it shows
    that more than noise is left, the fit has followed that at its own configurations: then
    T − σ² − own is τ², T of the errors held out, for which the others are new poses.  T is drawn
    about what it is, as resampling configurations would, T χ²_ν / ν."""
    (scatter, dof, rows), test, single = residual, noise.lack_of_fit, noise.single
    inflated, n = np.ones(DRAWS), 1.0
    if test is not None and test.dof_pure >= FEWEST_REPEATS:
        pure = scatter * dof / (test.dof_between * test.F + test.dof_pure)
        between = pure * test.F * _chi2(test.dof_between, rng)
        within, n = pure * _chi2(test.dof_pure, rng), rows / (rows - test.dof_pure)
        if not any(s.part for s in noise.sizes or ()):
            inflated = np.maximum(between / within, 1.0)
    elif noise.ratio_to_stated:
        pure, of_single = scatter / noise.ratio_to_stated**2, 0
        if single is not None and single.above:
            # The noise is what single readings say, and the rest of the residual beyond it.
            pure, of_single = pure * single.ratio**2, single.dof
        rest = max(dof - of_single, 1)
        between = max(dof * scatter - of_single * pure, 0.0) / rest * _chi2(rest, rng)
        within = pure * _chi2(of_single, rng) if of_single else np.full(DRAWS, pure)
    else:
        return None
    beyond = (between - within) / n
    fitted = float(np.maximum(beyond, 0.0).mean())
    if left_out[1] > 0 and np.mean(beyond <= 0) < BEYOND:
        T, dof_out = left_out
        beyond = T * rng.chisquare(dof_out, DRAWS) / dof_out - within - own * inflated
    return Excess(np.maximum(beyond, 0.0), inflated, fitted)


def _chi2(dof: int, rng: np.random.Generator) -> Array:
    """Draws (DRAWS,) of ν/χ²_ν: by what factor a mean square may be off."""
    dof = max(dof, 1)
    return np.asarray(dof / rng.chisquare(dof, DRAWS))


def predicted_error(
    arm: CalibratedArm, observed: Observations, excess: Excess | None, spread: Covariance,
    poses: NewPoses, rng: np.random.Generator, unchecked: Array | None = None,
) -> PredictedError | None:  # fmt: skip
    """The error at new poses; P of `told_by_one` says how much of it is `unchecked`.

    e² = zᵀ G z + τ² with G = Σ_t w_t [A_K L, O S]ᵀ [A_K L, O S] and Σ = L Lᵀ: its distribution
    by draws of z, normal, and t with the degrees of freedom of their mean square for what the
    estimates' covariance holds.  None where nothing was determined, the variance of an estimate is
    not known, or no position follows from what was read.
    """
    left = arm.left
    told = arm.determined and observed.kind != "distance" and np.isfinite(arm.covariance).all()
    if left is None or not told or not spread.dof.all():
        return None
    try:
        B, weight = poses.rows(arm, observed)
    except ElastocalError:
        return None
    known, off = moves(arm, B)
    root = drawing_root(arm.covariance)
    each = np.sqrt(weight)[:, None, None]
    F = np.concatenate([known @ root, off], axis=2) * each
    F = F.reshape(-1, F.shape[2])
    n = root.shape[1]
    G = F.T @ F
    z = rng.standard_normal((DRAWS, len(G)))
    missing = excess or Excess(np.zeros(DRAWS), np.ones(DRAWS))
    inflated, lacking = missing.inflated, float(missing.squared.mean())
    (dof,), (share,) = spread.tails((known * each).reshape(1, -1, n))
    # A whole number stays one where rounding leaves it short of that.
    wide = _chi2(max(int(dof + WHOLE), 1), rng) if np.isfinite(dof) else np.ones(DRAWS)
    z[:, :n] *= np.sqrt(share * wide * inflated)[:, None]
    squares = (z @ G * z).sum(axis=1) + missing.squared
    own = float(np.trace(G[:n, :n]) * inflated.mean())
    rest = float(np.trace(G[n:, n:]))
    alone = np.inf
    if unchecked is not None:
        alone = float(np.sqrt((((known @ (unchecked @ root)) * each) ** 2).sum() * inflated.mean()))
    low, high, sure = np.sqrt(np.quantile(squares, [0.025, 0.975, 0.95])).tolist()
    mean, own, rest, lack = np.sqrt([own + rest + lacking, own, rest, lacking]).tolist()
    return PredictedError(
        mean, (low, high), own, rest, None if excess is None else lack,
        _blamed(left, np.diag(G)[n:]), len(poses.q), poses.source, alone, sure,
    )  # fmt: skip


def readings_at(
    model: Model, x: Array, observed: Observations, poses: NewPoses
) -> tuple[Array, Array]:
    """B (R, size, parameters) of readings at new poses, one for each pose and marker, and their
    weight (R,) of sum 1; without those that have no static equilibrium, if any has one.  Whatever
    else the model asks for, as times and temperatures, is that of the readings in turn; none is the
    first of a session."""
    table = observed.table
    markers = np.unique(table.marker[observed.lead])
    states = 2 if model.observe == "deflection" else 1
    T, M = len(poses.q), len(markers)
    pose = np.repeat(np.arange(T), M * states)
    loaded = np.tile(np.arange(states), T * M) == states - 1
    like = observed.lead[pose % len(observed.lead)]
    new = replace(
        table.take(like), source="new poses", row=np.arange(len(pose)) + 1, q=poses.q[pose],
        configuration=pose, configuration_labels=tuple(map(str, range(1, T + 1))),
        repeat=np.zeros(len(pose), dtype=np.int64), marker=np.tile(np.repeat(markers, states), T),
        force=poses.force[pose] * loaded[:, None],
    ).from_neither_side()  # fmt: skip
    still = np.isfinite(model.deflection(new, x)).all(axis=1)
    good = np.bincount(pose, ~still, minlength=T) == 0
    new = new.take(good[pose])
    if not len(new):
        raise InsufficientDataError("no pose has a static equilibrium")
    again = observe(new, observed.kind)
    B = model.regressor(new, x, observations=again).B
    weight = poses.weight[new.configuration[again.lead]]
    return B.reshape(len(again.lead), again.size, -1), weight / weight.sum()
