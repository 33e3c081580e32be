"""The course of a fit: place, choose a minimal complete set of parameters, fit, compare."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from elastocal.engine import least_norm
from elastocal.identification.knowledge import ActiveConstraint
from elastocal.identification.least_squares import (
    CHANCE,
    EPS,
    LEVEL,
    Covariance,
    Crossed,
    as_of_another_campaign,
    drawing_root,
    f_test,
    held_out_by_parts,
    held_out_residual,
    predicts_better,
    rms_3d,
    t_quantile,
)
from elastocal.identification.noise_choice import NoiseFit
from elastocal.identification.start import Options, nothing_shown
from elastocal.identification.weighted_problem import (
    Fit,
    PriorRows,
    Problem,
    RFactor,
    Weights,
    fit,
    moved,
)
from elastocal.measurements import numbered
from elastocal.messages import EXACT, ElastocalError, InsufficientDataError
from elastocal.model.effects.base import LINK, Parameter
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.manipulator import Model, SmoothGroup
from elastocal.model.observations import Observations
from elastocal.units import Array, BoolArray, IntArray, Progress

# Below this share of its own length a column lies in the span of the kept ones: B is exact
# to 1e-15, so this is a structural dependence and not rounding.
STRUCTURAL = 1e-7
ROUNDING = 1e-9
FAR = 10.0  # typical deviations from nominal, beyond which an arm that works has no parameter


def far_off(off: float, half: float, typical: float | None) -> float:
    """How many `typical` deviations a value is `off` nominal where its whole interval, ± half, is
    off by more than FAR of them; else 0."""
    return abs(off) / typical if typical and abs(off) - half > FAR * typical else 0.0


@dataclass(frozen=True)
class Reduction:
    """`kept` and `dropped` parameter indices; `mixing` (kept, dropped) with B_D ≈ B_K · mixing.

    The data determine β_k = X_k + Σ_d mixing[k, d] X_d, the kept parameter with what it stands
    for.  `invisible` are dropped parameters that move no reading at all, `with_prior` those that
    were no part of this choice: a prior makes up for what the readings do not say of them.
    `threshold`: what it takes to be kept (`reduce`).
    """

    kept: NDArray[np.int64]
    dropped: NDArray[np.int64]
    mixing: Array
    invisible: NDArray[np.int64]
    with_prior: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    threshold: float = 0.0

    def without(self, lost: BoolArray, *, invisible: bool = False) -> Reduction:
        """With these kept parameters (kept,) among the dropped ones, for which nothing stands."""
        kept, gone = self.kept[~lost], self.kept[lost]
        return replace(
            self, kept=kept, dropped=np.append(self.dropped, gone),
            mixing=np.hstack([self.mixing[~lost], np.zeros((len(kept), len(gone)))]),
            invisible=np.append(self.invisible, gone) if invisible else self.invisible,
        )  # fmt: skip

    def among(self, free: IntArray) -> Reduction:
        kept, dropped = np.isin(self.kept, free), np.isin(self.dropped, free)
        return replace(
            self, kept=self.kept[kept], dropped=self.dropped[dropped],
            mixing=self.mixing[kept][:, dropped], invisible=np.intersect1d(self.invisible, free),
        )  # fmt: skip

    def shifted(self, x: Array, x0: Array) -> Array:
        """x (parameters,) with the dropped ones at x0, their share moved to the kept ones."""
        out = x.copy()
        out[self.kept] += self.mixing @ (x - x0)[self.dropped]
        out[self.dropped] = x0[self.dropped]
        return out

    def seen(self, free: IntArray, R: Array, sizes: Array) -> Reduction:
        """Without the kept parameters that move nothing any more, R (…, free) being that of the
        `free` columns: those of a product vanish where its other factor is held at zero."""
        length = np.linalg.norm(R[:, : len(free)], axis=0) * sizes[free]
        own = length[np.searchsorted(free, self.kept)]
        gone = own <= STRUCTURAL * length.max(initial=0.0)
        return self.without(gone, invisible=True) if gone.any() else self


def reduce(
    B: Array, sizes: Array, parameters: Sequence[Parameter], sigma: float, threshold: float,
    ranks: IntArray | None = None,
) -> Reduction:  # fmt: skip
    """Choose a minimal complete set of columns of the whitened B (rows, parameters), or of its R.

    Columns are scaled by typical size and by the noise `sigma` of a whitened row, so that the
    length of a column off the span of the kept ones counts how many standard deviations a typical
    deviation moves the data: a parameter below `threshold` is not worth a column; 0 keeps
    everything that is structurally independent.  Pivoted QR in the order of `ranks` (columns,), by
    default the effects': first what a user asks for by name; link geometry takes the rest.  There a
    kept column that would have to deviate by more than FAR for a typical deviation of a dropped one
    is exchanged for that one, which makes the volume of those kept larger each time (Gu and
    Eisenstat 1996, SIAM J. Sci. Comput. 17, 848).  Of a wider set, below WORTH_A_COLUMN, what is
    shorter than it beside all others goes again, the shortest first.
    """
    # The triangular factor has the same geometry as B at any number of rows.
    R = linalg.qr(B * sizes, mode="r")[0][: B.shape[1]] / sigma
    length = np.linalg.norm(R, axis=0)
    visible = length > max(threshold, STRUCTURAL * length.max(initial=0.0), 1e-300)
    basis, chosen = np.zeros((len(R), 0)), np.zeros(0, dtype=np.int64)
    ranks = ranks_of(parameters) if ranks is None else ranks
    for rank in np.unique(ranks[visible]):
        candidates = np.flatnonzero(visible & (ranks == rank))
        off = R[:, candidates]
        for _ in range(2):  # twice is enough (Parlett)
            off = off - basis @ (basis.T @ off)
        # Of columns that are alike but for rounding the first is kept, on any machine.
        alike = 1 - ROUNDING * np.arange(len(candidates))
        _, T, order = linalg.qr(off * alike, mode="economic", pivoting=True)
        far = np.abs(np.diag(T))
        own = candidates[order[: len(far)]]
        chosen = np.append(chosen, own[far > np.maximum(threshold, STRUCTURAL * length[own])])
        basis = linalg.qr(R[:, chosen], mode="economic")[0]
    kept = np.sort(chosen)
    while 0 < threshold < WORTH_A_COLUMN and len(kept):
        own = linalg.qr(R[:, kept], mode="r")[0][: len(kept)]
        apart = 1 / np.linalg.norm(linalg.solve_triangular(own, np.eye(len(kept))), axis=1)
        if apart.min() >= threshold:
            break
        kept = np.delete(kept, apart.argmin())
    dropped, mixing = _stood_for(R, kept)
    while parameters and np.abs(mixing).max(initial=0.0) > FAR:
        k, d = np.unravel_index(np.abs(mixing).argmax(), mixing.shape)
        kept = np.sort(np.append(np.delete(kept, k), dropped[d]))
        dropped, mixing = _stood_for(R, kept)
    mixing = mixing * sizes[kept][:, None] / sizes[dropped]
    return Reduction(kept, dropped, mixing, dropped[~visible[dropped]], threshold=threshold)


def ranks_of(parameters: Sequence[Parameter]) -> IntArray:
    return np.array([effect_of(p.effect).rank for p in parameters], dtype=np.int64)


def _stood_for(R: Array, kept: IntArray) -> tuple[IntArray, Array]:
    """The columns of R that are not kept, and the kept ones' shares (kept, dropped) in each."""
    dropped = np.setdiff1d(np.arange(R.shape[1]), kept)
    mixing = np.zeros((len(kept), len(dropped)))
    return dropped, least_norm(R[:, kept], R[:, dropped]) if mixing.size else mixing


# A typical deviation must move the data by this many standard deviations to earn a column:
# at 1, the variance it adds equals the squared bias it removes.
WORTH_A_COLUMN = 1.0
# One that is FAR from nominal has to: so little for an arm whose errors are larger than typical.
WIDER = WORTH_A_COLUMN / FAR


def residual_sigma(found: Fit, n_parameters: int) -> float:
    """Standard deviation of a whitened row: √(rss / (rows − parameters))."""
    dof = max(len(found.whitened) - n_parameters, 1)
    return max(float(np.sqrt(found.whitened @ found.whitened / dof)), 1e-12)


def choose(problem: Problem, r_factor: RFactor, sigma: float, threshold: float) -> Reduction:
    """A minimal complete set of the free columns, as indices into all parameters;
    InsufficientDataError where no column is worth keeping."""
    free = problem.free
    parameters = tuple(problem.model.parameters[c] for c in free)
    # What leans on others is as far off as what the cell states of it, not as a registration.
    lean, own = np.isin(free, problem.leaning), [p.typical or PLACED for p in parameters]
    sizes, ranks = np.where(lean, own, problem.sizes[free]), ranks_of(parameters) + LINK * lean
    local = reduce(r_factor.R, sizes, parameters, sigma, threshold, ranks)
    if not len(local.kept):
        raise nothing_shown(problem.observations, problem.residual(problem.x0))
    kept, dropped, gone = (free[own] for own in (local.kept, local.dropped, local.invisible))
    return replace(local, kept=kept, dropped=dropped, invisible=gone)


def leaning(problem: Problem, sigma: float) -> IntArray:
    """Which of the parameters placed the nominal arm does not tell from the others, as the height
    of a base whose joints turn about the vertical and that of its markers.  Errors of the arm tell
    them apart in the second order, where a millimetre of geometry stands for a metre of them."""
    free, few = problem.free[is_placed(problem.model)[problem.free]], _sampled(problem)
    if not len(free):
        return free
    more = len(problem.observations.value) / len(few.observations.value)
    R, own = few.evaluate(problem.x0, free)[1].R, [problem.model.parameters[c] for c in free]
    chosen = reduce(R, problem.sizes[free], own, sigma / np.sqrt(more), WORTH_A_COLUMN)
    return np.delete(free, chosen.kept)


def fit_kept(problem: Problem, x: Array, chosen: Reduction, max_steps: int = 60) -> Fit:
    """Fit of the kept parameters, the others held at the start; their share moves over first."""
    # The share is a linear estimate: a soft arm may have no equilibrium so far out.
    with suppress(ElastocalError):
        return fit(problem, chosen.kept, chosen.shifted(x, problem.x0), max_steps=max_steps)
    return fit(problem, chosen.kept, problem.x0, max_steps=max_steps)


def looked_at(found: Fit) -> Crossed:
    """Under a drift each block in time is left out, as far off as readings of another day are."""
    problem, observed, weights = found.problem, found.problem.observations, found.problem.weights
    held, *other = held_out_by_parts(problem, found.x, found.columns, found.r_factor.half)
    if weights.together is not None:
        held = held_out_residual(
            found.B, found.residual, weights, observed.configuration, observed.size
        )
        held = held * as_of_another_campaign(found.B, weights, observed.size)
    return held, other[0], other[1]


def fits_better(narrow: RFactor, wide: RFactor) -> bool:
    """Does the wider set fit the readings better than chance alone in CHANCE of all cases (F)?
    Beside the held-out residuals, which a few configurations of weight can sway."""
    more, dof = wide.columns - narrow.columns, wide.rows - wide.columns
    return bool(f_test(narrow.rest**2 - wide.rest**2, more, wide.rest**2, max(dof, 1))[1] < CHANCE)


# Share of the residual that is noise at least; where all parameters together leave less, a joint
# has lost its zero.
MOSTLY = 0.5


def prefer_wider(found: Fit, reduction: Reduction) -> tuple[Fit, Reduction]:
    """A wider set, where held-out configurations show that it is needed.  Typical sizes are prior
    knowledge and may be wrong for this arm; a test on held-out data decides, first on the
    linearised model, then on the fit that starts at its minimum: from where the narrow one ended it
    may take hundreds of steps."""
    problem, every = found.problem, found.of_free
    observed, sigma = problem.observations, residual_sigma(found, len(reduction.kept))
    judges = problem.weights, observed.configuration, observed.size
    least = max(every.rest / np.sqrt(max(every.rows - every.columns, 1)), 1e-12)
    lost = least < MOSTLY * sigma
    wider = choose(problem, every, least if lost else sigma, WIDER)
    own = every.of_columns(np.searchsorted(problem.free, wider.kept))
    if own.columns <= len(reduction.kept) or not fits_better(found.r_factor, own):
        return found, reduction
    held = looked_at(found)[0]
    # Of least length in typical sizes where several are least squares.
    size = problem.sizes[wider.kept]
    step = size * least_norm(own.R * size, own.projected, cond=own.rows * EPS)
    start = moved(found.x, wider.kept, step)
    linear = held_out_by_parts(problem, found.x, wider.kept, own.half, start - found.x)[0]
    if not predicts_better(held, linear, *judges):
        return found, reduction
    # Along a direction that is hardly determined the wide set may leave every valid arm, or come to
    # rest where it is singular.
    with suppress(ElastocalError, np.linalg.LinAlgError, ValueError):
        wide = fit_kept(problem, start, wider, max_steps=30)
        better = wide.converged and fits_better(found.r_factor, wide.r_factor)
        if better and predicts_better(held, looked_at(wide)[0], *judges):
            # What its zero hid may be worth a column now; each set is wider than the last.
            return prefer_wider(wide, wider) if lost else (wide, wider)
    return found, reduction


# Width of the weak tie that keeps undetermined directions still before they are recognised:
# in typical sizes for deviations from nominal, in m and rad for what registration placed.
LOOSE, PLACED = 3.0, 0.3
# What a step promises of the cost where tied fits end: what is placed, where a parameter of it
# gets dropped and is held for good, and where the choice and the fit only begin.
PLACING, CHOOSING = 1e-12, 1e-2
# Observations from which on a fit starts from a sample, and how many there are in it.
MANY, SAMPLE = 2000, 5000


@dataclass(frozen=True)
class Solution:
    """The fit of the kept set, which parameters those are, and how well it predicts.  `reduction`
    holds indices into the model's parameters; `nominal_rms` is the 3-D rms in m of the nominal arm
    with only base, markers and cable placed; `held` is `crossed` where that is not what B and
    weights say."""

    fit: Fit
    reduction: Reduction
    nominal_rms: float
    held: Crossed | None = None

    @property
    def problem(self) -> Problem:
        return self.fit.problem

    @property
    def exact(self) -> bool:
        """Whether the readings are computed: what is left is rounding."""
        return rms_3d(self.fit.residual, self.problem.observations.size) < EXACT

    @cached_property
    def crossed(self) -> Crossed:
        """What `looked_at` finds.

        Where that fit leaves a direction open by more than FAR, it has typical deviations of what
        is kept, and of what that stands for, beside it: no arm that works is off by as much.
        Without the pose that shows it the direction would have no column; fitted all the same it
        takes the pose metres away.
        """
        if self.held is not None:
            return self.held
        held, leverage, left = looked_at(self.fit)
        if self.problem.large:
            return held, leverage, left
        fit, kept, sizes = self.fit, self.reduction.kept, self.problem.sizes
        weights, observed = self.problem.weights, self.problem.observations
        shares = self.reduction.mixing * sizes[self.reduction.dropped]
        typical = linalg.cholesky(np.diag(sizes[kept] ** 2) + shares @ shares.T, lower=True)
        B, held, p = fit.B @ typical, held.copy(), len(kept)
        # What all have in common are columns and rows beside these, and never left out.
        rows, e = weights.beside_common(B, fit.residual)
        M, z = rows.T @ rows, rows.T @ e
        M[:p, :p] += np.eye(p) * (variance := residual_sigma(fit, p) ** 2)
        z[:p] -= variance * linalg.solve_triangular(
            typical, (fit.x - self.problem.x0)[kept], lower=True
        )
        out = observed.configuration if weights.together is None else weights.together
        own = np.repeat(numbered(out), observed.size)
        for c in np.flatnonzero(np.bincount(own, leverage) >= 0.5):
            at = np.flatnonzero(own == c)
            V = np.linalg.inv(M - rows[at].T @ rows[at])
            # Beside a typical deviation one that is open by f of them is by f/√(1 + f²).
            open_ = variance * np.linalg.eigvalsh(V[:p, :p])[-1] > FAR**2 / (1 + FAR**2)
            if open_ and np.isfinite(held[at]).all():
                held[at] = fit.residual[at] - B[at] @ (V @ (z - rows[at].T @ e[at]))[:p]
        return held, leverage, left


def solve(
    problem: Problem, progress: Progress = lambda message: None, try_wider: bool = True
) -> Solution:
    """Place base and markers, choose a minimal complete set of parameters and fit it; `try_wider`
    False skips the comparison with wider sets.  The fit's problem has base and markers placed."""
    started, exact = problem, False
    problem, nominal = with_placed(problem, CHOOSING)
    progress("first fit, tied weakly to the start")
    few = _sampled(problem)
    found = _tied_from(few, problem.x0, CHOOSING)
    progress("choosing the parameters that the data determine")
    sigma, kept, r_factor = residual_sigma(found, 0), None, _as_of(found, problem)
    whole = few is problem
    lean, model = leaning(problem, sigma), problem.model
    started, problem = (replace(one, leaning=lean) for one in (started, problem))
    if model.observe != "distance":  # what others make up for stays where the cell says
        back = lean[[model.parameters[c].unit == "m" for c in lean]]
        started = replace(started, x0=moved(started.x0, back, (model.nominal - started.x0)[back]))
    for turn in range(5 if whole else 10):
        reduction = choose(problem, r_factor, sigma, WORTH_A_COLUMN)
        if kept is not None and np.array_equal(kept, reduction.kept):
            if whole:
                break
            whole = True  # what a sample has settled, all readings begin with
        held = reduction.dropped[is_placed(problem.model)[reduction.dropped]]
        if model.observe == "distance":
            # What no reading tells stays at its guess: a fit of the nominal arm takes it anywhere.
            problem = replace(problem, x0=moved(problem.x0, held, (started.x0 - problem.x0)[held]))
        elif not exact and len(held):
            problem, exact = with_placed(started, PLACING)[0], True
        # The threshold is in units of the noise, and the noise is known only after the fit.
        kept, whole = reduction.kept, whole or turn == 5
        found = fit_kept(problem if whole else replace(few, x0=problem.x0), found.x, reduction)
        sigma, r_factor = residual_sigma(found, len(kept)), _as_of(found, problem)
    if (left := reduction.seen(problem.free, r_factor.R, problem.sizes)) is not reduction:
        reduction, found = left, fit_kept(problem, found.x, left)
    if try_wider:
        progress("comparing with wider sets")
        found, reduction = prefer_wider(found, reduction)
    return Solution(found, reduction, rms_3d(nominal, problem.observations.size))


def with_placed(problem: Problem, tolerance: float) -> tuple[Problem, Array]:
    """The problem with base, markers and cable placed at x0, and the residual (rows,) there."""
    placed = np.setdiff1d(problem.free[is_placed(problem.model)[problem.free]], problem.leaning)
    if not len(placed):
        return problem, problem.residual(problem.x0)
    found = tied_fit(replace(problem, free=placed), tolerance)
    of_all = len(found.residual) == len(problem.observations.value)
    return replace(problem, x0=found.x), found.residual if of_all else problem.residual(found.x)


def is_placed(model: Model) -> NDArray[np.bool_]:
    """Which parameters (parameters,) registration places: base, markers, cable."""
    return np.array([effect_of(p.effect).registered for p in model.parameters], dtype=bool)


def deviates(model: Model) -> BoolArray:
    """Which parameters (parameters,) deviate from nominal by a size that is known, to either side,
    but for what registration places."""
    known = [p.typical is not None and np.isinf([p.lower, p.upper]).all() for p in model.parameters]
    return np.array(known, dtype=bool) & ~is_placed(model)


CERTAIN = 0.99  # of typical errors, that chance does not make them look larger
# What counts of a square at most, in typical ones; its mean among normal errors of size one, its
# variance, and the variance of the logarithm of the size that solves for this mean, times n.
CLIP = 1.5
_BEYOND, _EDGE = 2 * special.ndtr(-CLIP), CLIP * np.exp(-(CLIP**2) / 2) * np.sqrt(2 / np.pi)
_WITHIN = 1 - _BEYOND - _EDGE
CLIPPED_MEAN = _WITHIN + CLIP**2 * _BEYOND
CLIPPED_VARIANCE = 3 * _WITHIN - CLIP**2 * _EDGE + CLIP**4 * _BEYOND - CLIPPED_MEAN**2
SIZE_VARIANCE = CLIPPED_VARIANCE / (2 * _WITHIN) ** 2
SIZE_STEPS = 100


def own_size(square: Array, told: Array) -> tuple[float, float]:
    """Size of an arm's errors in typical ones, 1 where they are not certainly larger, and the
    variance of its logarithm: of the `square` (n,) of each, in that of its typical size, whose mean
    is `told` (n,) where errors are typical.  It resists a joint that lost its zero: squares count
    up to CLIP² of it (Huber 1964, Ann. Math. Statist. 35, proposal 2)."""
    count = float(told.sum())
    most = CLIPPED_MEAN + special.ndtri(CERTAIN) * np.sqrt(CLIPPED_VARIANCE / max(count, 1))
    if np.minimum(square, CLIP**2 * told).sum() <= most * count:
        return 1.0, 0.0
    own = square.sum() / (CLIPPED_MEAN * count)
    for _ in range(SIZE_STEPS):
        own = np.minimum(square, CLIP**2 * own * told).sum() / (CLIPPED_MEAN * count)
    return float(np.sqrt(own)), SIZE_VARIANCE / count


def of_this_arm(solution: Solution, std: Array) -> tuple[Solution, float]:
    """The same with the sizes of what is held as large as the errors of this arm, where those are
    larger than typical, and the variance of that size's logarithm; `std` (kept,) of the estimates.
    Of every kept parameter that `deviates`, |X − nominal| over the deviation that typical errors,
    its own and of those it stands for, and the noise give it."""
    fit, problem, chosen = solution.fit, solution.problem, solution.reduction
    kept, sizes, known = chosen.kept, problem.sizes, deviates(problem.model)
    shares = chosen.mixing * sizes[chosen.dropped]
    variance = sizes[kept] ** 2 + (shares**2).sum(axis=1) + std**2
    square = (fit.x - problem.model.nominal)[kept] ** 2 / variance
    square = square[known[kept] & ~np.isin(kept, chosen.with_prior)]
    own, unsure = own_size(square, np.ones(len(square)))
    if own > 1:
        problem = replace(problem, sizes=np.where(known, own, 1.0) * sizes)
        solution = replace(solution, fit=replace(fit, problem=problem))
    return solution, unsure


def posed(
    model: Model, observed: Observations, weights: Weights, x0: Array, free: IntArray
) -> Problem:
    """The problem with typical sizes at the start; refuses where the equations are too few."""
    problem = Problem(model, observed, weights, x0, free, np.ones(len(x0)))
    # What is shrunk has its size from its prior.
    every = np.flatnonzero(~model.shrunk | np.isin(np.arange(len(model.shrunk)), free))
    largest, placed = np.zeros((1, len(x0))), is_placed(model)
    # Only the size of what states none needs B, which takes long on large tables.
    if any(p.typical is None and not own for p, own in zip(model.parameters, placed, strict=True)):
        for B in problem.each(lambda part: part.regressor(x0, every).B):
            largest[0, every] = np.maximum(largest[0, every], np.abs(B).max(axis=0))
    problem = replace(problem, sizes=np.where(placed, PLACED, model.sizes(largest)))
    rows, p = len(observed.value), len(free)
    if rows > p:  # more equations than unknowns need no rank
        return problem
    R = problem.evaluate(x0, free)[1].R * problem.sizes[free]
    rank = int(np.linalg.matrix_rank(R, rtol=STRUCTURAL))
    if rank == rows:
        lacking = max(-(-(rank + 1) // observed.size), -(-p // observed.size))
        raise InsufficientDataError(
            f"{observed.table.source}: {rows} equations from {len(observed.lead)} readings cannot "
            f"determine the model's {p} parameters and their uncertainty; measure more poses (more "
            f"than {lacking} readings) or fit fewer effects"
        )
    return problem


# Draws of what is dropped, and of the errors of what is kept: from eight the result is a third
# too small.
BENDS = 24
BENT_SAMPLE = 1000  # observations it is found from: what readings at random poses have in common


def bent(solution: Solution, covariance: Array, unsure: float) -> tuple[Array, Array]:
    """Root mean square (kept,) of what estimates and combinations leave out by being linear, and
    the relative variance of its square, where the logarithm of the size of what is held has the
    variance `unsure`.

    The readings determine a nonlinear function of the parameters.  Typical deviations δ of those
    dropped, with −mixing · δ of those kept, leave them where they are in the first order, and so do
    the errors of those kept, of this `covariance` (kept, kept); what estimates do in the second is
    found from the mean of the readings at both and at their opposites.  Where a length is hardly
    told, a direction that is not told at all moves the markers by the product of the two.  What the
    fit knows besides the readings holds estimates against it, equalities for exact.
    """
    problem, found, chosen = solution.problem, solution.fit, solution.reduction
    kept, dropped = chosen.kept, chosen.dropped
    none = np.zeros(len(kept))
    if not np.isfinite(covariance).all():
        return none, none
    size = problem.sizes[kept]
    # By distances base, markers and cable may also be where they were said to be.
    model = problem.model
    stated = np.hypot([p.typical or 0.0 for p in model.parameters], found.x - model.nominal)
    stated *= model.observe == "distance"
    typical = np.where(is_placed(model), stated, problem.sizes)[dropped]
    root = drawing_root(covariance)
    # Of many readings some tell it as well: it is no smaller where there are more of them.
    looked = problem.sample(BENT_SAMPLE)
    B = looked.regressor(found.x, kept).B if problem.large else found.B[looked.rows]
    residual, B = found.residual[looked.rows], B * size
    rng, steps = np.random.default_rng(0), np.zeros((BENDS, len(found.x)))
    steps[:, dropped] = delta = typical * rng.standard_normal((BENDS, len(dropped)))
    steps[:, kept] = rng.standard_normal((BENDS, len(kept))) @ root.T - delta @ chosen.mixing.T
    both = np.concatenate([steps, -steps])
    there, opposite = np.split(looked.residual_at(found.x + both), 2)
    moved = there + opposite - 2 * residual
    if not np.isfinite(moved).all():
        return none, none  # so far out the arm has no equilibrium
    target, known, free = looked.weights.apply(moved.T / 2), found.known, np.eye(len(kept))
    ties = known.P * size * np.sqrt(len(residual) / len(found.residual))  # as among all readings
    if known.system is not None:
        free = linalg.null_space(known.system.A * size)
    rows = np.vstack([looked.weights.apply(B), ties]) @ free
    square = (free @ least_norm(rows, np.pad(target, ((0, len(ties)), (0, 0))))) ** 2
    mean = square.mean(axis=1)
    spread = (square / np.maximum(mean, 1e-300)[:, None]).var(axis=1) / (BENDS - 1)
    # A product of two of what is held grows with the square of its size.
    return size * np.sqrt(mean), spread + 16 * unsure


def tied_fit(problem: Problem, tolerance: float) -> Fit:
    """Fit of all free parameters with weak ties, scaled by a noise level found on the way.  Many
    readings start where such a fit to a sample of them ends, which is enough to begin with."""
    if (rough := _sampled(problem)) is not problem:
        found = _tied_from(rough, problem.x0, CHOOSING)
        if tolerance >= CHOOSING:
            return found
        with suppress(ElastocalError):  # it may lead where other readings have no equilibrium
            return _tied_from(problem, found.x, tolerance, residual_sigma(found, 0))
    return _tied_from(problem, problem.x0, tolerance)


def _sampled(problem: Problem) -> Problem:
    n = len(problem.observations.lead)
    return problem if n <= MANY else problem.sample(min(SAMPLE, n // 4))


def _as_of(found: Fit, problem: Problem) -> RFactor:
    """The R factor of the free columns for all readings, of which `found` may have a part."""
    more = len(problem.observations.value) / len(found.problem.observations.value)
    return found.of_free.scaled(np.full(len(problem.free), np.sqrt(more)))


def _tied_from(problem: Problem, x: Array, tolerance: float, sigma: float | None = None) -> Fit:
    """Tied fits from x until the noise level `sigma` that scales the ties no longer falls; by
    default it is at first the whole misfit at the start."""
    free, sizes = problem.free, problem.sizes
    if sigma is None:
        misfit = problem.weights.apply(problem.evaluate(problem.x0, free)[0])
        sigma = max(float(np.sqrt(np.mean(misfit**2))), 1e-12)
    width = np.where(is_placed(problem.model), sizes, LOOSE * sizes)[free]
    while True:
        tie = PriorRows(np.diag(sigma / width), problem.x0[free] * sigma / width)
        found = fit(problem, free, x, known=tie, max_steps=25, tolerance=tolerance)
        previous, sigma, x = sigma, residual_sigma(found, 0), found.x
        if sigma > 0.7 * previous or sigma <= 1e-12:
            return found


PLACES = 500
DRAWS = 400


@dataclass(frozen=True)
class SmoothPart:
    """A smooth function as it was fitted.

    Attributes:
        group: Its parameters and what it follows.
        scale: By how much the variance of its coefficients is larger than the prior that the cell
            states; 0 where it was left out.
        effective: How many coefficients' worth of it the readings determine.
        value: Coefficients (components, waves).
        covariance: Theirs, (components · waves, components · waves).
        places: What it follows in the readings fitted (n,), in rad or s.
    """

    group: SmoothGroup
    scale: float
    effective: float
    value: Array
    covariance: Array
    places: Array

    @property
    def coefficients(self) -> int:
        """How many parameters it has."""
        return int(self.value.size)

    def refitted(self, x: Array, columns: IntArray, covariance: Array) -> SmoothPart:
        """The same function at other parameters x (parameters,), the covariance that of the
        `columns` fitted."""
        mine = self.group.columns
        place = {int(c): k for k, c in enumerate(columns)}
        at = np.array([place.get(int(c), -1) for c in mine.ravel()])
        there, matrix = np.flatnonzero(at >= 0), np.zeros((mine.size, mine.size))
        matrix[np.ix_(there, there)] = covariance[np.ix_(at[there], at[there])]
        return replace(self, value=x[mine], covariance=matrix)

    @cached_property
    def sizes(self) -> dict[str, tuple[float, tuple[float, float], float]]:
        """By unit, over all components and the places of the readings: rms of what is left of the
        function without what offsets, lengths and tilts of the arm can stand for, the 95 % interval
        of that, and the rms half width of its 95 % band.  Of parameters that are no function of one
        quantity, the root of their sum of squares."""
        found = {}
        for unit in dict.fromkeys(self.group.units):
            own = [c for c, u in enumerate(self.group.units) if u == unit]
            if not self.group.follows:
                waves = np.eye(self.value.shape[1]) * np.sqrt(self.value.shape[1])
            else:
                places = np.sort(self.places)
                even = np.linspace(0, len(places) - 1, min(len(places), PLACES)).astype(int)
                # Less the mean and the wave of one period per turn (of a time, the slope).
                x = places[even]
                of_the_arm = (np.cos(x), np.sin(x)) if self.group.lasting else (x - x[0],)
                Q, _ = np.linalg.qr(np.column_stack([np.ones(len(x)), *of_the_arm]))
                waves = self.group.waves.at(x)
                waves = waves - Q @ (Q.T @ waves)
            mean = self.value[own] @ waves.T
            rng = np.random.default_rng(0)
            k = waves.shape[1]
            total, spread = np.zeros(DRAWS), 0.0
            for c, m in zip(own, mean, strict=True):
                mine = slice(c * k, (c + 1) * k)
                covariance = self.covariance[mine, mine]
                drawn = rng.normal(size=(DRAWS, k)) @ drawing_root(covariance).T @ waves.T
                total += ((m + drawn) ** 2).mean(axis=1)
                spread += float(((waves @ covariance) * waves).sum(axis=1).mean())
            rms = np.sqrt(total / (len(own) if self.group.follows else 1))
            low, high = np.quantile(rms, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
            half = float(t_quantile(LEVEL, np.array(np.inf))) * np.sqrt(spread / len(own))
            found[unit] = (float(np.median(rms)), (float(low), float(high)), float(half))
        return found

    def to_json(self) -> list[dict[str, Any]]:
        """An entry for each unit that the function has, in SI."""
        g = self.group
        return [
            {
                "effect": g.effect, "where": g.where, "follows": g.follows or None, "unit": unit,
                "size": g.size, "length": g.length, "low": g.low, "high": g.high,
                "scale": self.scale, "coefficients": self.coefficients,
                "effective": self.effective, "rms": rms, "rms_ci95": ci95, "band95": half,
            }
            for unit, (rms, ci95, half) in self.sizes.items()
        ]  # fmt: skip


NO_MATTER = 1e-4  # one over degrees of freedom that make no difference to an interval


@dataclass(frozen=True)
class MethodResult:
    """The final fit, its `spread`, and the noise where it was estimated.

    Readings that are not `good` (N,) lie beyond the noise, whether or not they had a part in the
    fit. What constraints and a prior add: `active` constraints, `prior_share` by parameter, how
    many parameters the readings paid for (`effective`; None: all fitted), and what of them is
    `contradicted`.  `smooth` are the smooth functions, `beside` which σ of a whitened row and its
    degrees of freedom were found, and `standard` (N, size) the residuals of all readings free of
    the fit's part in them.  `limits` are the 95 % intervals of the parameters that the readings
    hardly show, by their index.
    """

    method: str
    solution: Solution
    spread: Covariance
    noise: NoiseFit | None
    good: BoolArray
    active: tuple[ActiveConstraint, ...] = ()
    prior_share: dict[str, float] = field(default_factory=dict)
    effective: int | None = None
    warnings: tuple[str, ...] = ()
    contradicted: dict[str, Any] = field(default_factory=dict)
    smooth: tuple[SmoothPart, ...] = ()
    beside: tuple[float, float] | None = None
    standard: Array | None = None
    limits: dict[int, tuple[float, float]] = field(default_factory=dict)

    @cached_property
    def ci95(self) -> Array:
        return self.spread.interval(self.solution.fit.x[self.solution.fit.columns])

    def told(
        self, k: int, bent: float = 0.0, unsure: float = 0.0
    ) -> tuple[dict[int, float], float, float, tuple[float, float]]:
        """Of kept parameter number k the parameters combined with it and their factors, its
        standard deviation with degrees of freedom, and its interval.

        A dropped parameter d is combined with it where its typical deviation s_d would shift the
        estimate by more than its standard deviation σ.  The others widen it to
        √(σ² + Σ_d (m_kd s_d)²), their typical deviations being a prior N(0, s_d²), as does what a
        combination leaves out by being linear (`bent`, its square known with the relative variance
        `unsure`: degrees of freedom by Welch and Satterthwaite); bounds cut the interval off.
        """
        chosen, std = self.solution.reduction, float(self.spread.std[k])
        shift = np.abs(chosen.mixing[k]) * self.solution.problem.sizes[chosen.dropped]
        terms = {int(chosen.dropped[j]): float(chosen.mixing[k, j])
                 for j in np.flatnonzero(shift > std)}  # fmt: skip
        left = np.append(shift[shift <= std], bent)
        wide = float(np.sqrt(1 + ((left / std) ** 2).sum())) if std > 0 else 1.0
        dof, share = float(self.spread.dof[k]), (bent / (wide * std)) ** 2 if std > 0 else 0.0
        value, system = self.solution.fit.x[chosen.kept[k]], self.solution.fit.known.system
        ends = value + wide * (self.ci95[k] - value)
        if (unknown := share**2 * unsure / 2) > NO_MATTER:
            own = 1 / ((1 - share) ** 2 / dof + unknown)
            wider, usual = t_quantile(LEVEL, np.array([own, dof]))
            ends, dof = value + wider / usual * (ends - value), own
        if system is not None:
            ends = np.clip(ends, system.lower[k], system.upper[k])
        return terms, wide * std, dof, (float(ends[0]), float(ends[1]))


@dataclass(frozen=True)
class Course:
    """What a method starts from: fits to all observations, and to those that are not `faulty` (N,),
    and the `report` of these; `refit` makes another such fit, of those it is given.  They know
    nothing of smooth functions among the parameters `free`."""

    every: Solution
    sound: Solution
    faulty: BoolArray
    free: IntArray
    refit: Callable[[BoolArray], Solution]
    report: Callable[[], Any]  # an OutlierReport, or None
    options: Options
    progress: Progress
