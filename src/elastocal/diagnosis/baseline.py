"""The calibrated arm before any further effect, its readings in blocks that share noise, and that
noise: tracker, repeatability of each joint, scatter of a configuration."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from scipy import linalg

from elastocal.engine import (
    LOG_2PI,
    ROUNDING,
    LogPrior,
    Mixed,
    Pack,
    Parts,
    Products,
    Standardised,
    climb,
)
from elastocal.identification.solve import PLACING, is_placed, posed, tied_fit, with_placed
from elastocal.identification.start import start_values
from elastocal.identification.weighted_problem import (
    TOLERANCE,
    Problem,
    stated_by_observation,
    weights_for,
)
from elastocal.measurements import Measurements, load_states, numbered, visits
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.evaluate import thread_count
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, observe
from elastocal.units import Array, BoolArray, IntArray


@dataclass(frozen=True)
class Blocks:
    """N observations of `size` components in C blocks of M places, padded where a block is short.
    `member` (C, M) is the observation at each place, N where there is none; `visit` (N,) numbers
    the times that the arm was sent to a pose (configuration, repeat and load state)."""

    member: IntArray
    visit: IntArray
    size: int

    @classmethod
    def of(cls, configuration: IntArray, visit: IntArray, size: int) -> Blocks:
        """Blocks by `configuration` (N,), in the order of its codes."""
        _, code, count = np.unique(configuration, return_inverse=True, return_counts=True)
        order = np.argsort(code, kind="stable")
        start = np.concatenate([[0], np.cumsum(count)])[code[order]]
        member = np.full((len(count), int(count.max())), len(configuration), dtype=np.int64)
        member[code[order], np.arange(len(order)) - start] = order
        return cls(member, visit, size)

    @property
    def n(self) -> int:
        return len(self.visit)

    @cached_property
    def in_visit(self) -> Array:
        """Which rows belong to each visit (C, m, v), as ones and zeros."""
        visit = np.append(self.visit, -1)[self.member]
        local = np.full(visit.shape, -1)
        for c, row in enumerate(visit.tolist()):
            number = {v: k for k, v in enumerate(dict.fromkeys(v for v in row if v >= 0))}
            local[c] = [number.get(v, -1) for v in row]
        one_hot = (local[:, :, None] == np.arange(max(local.max() + 1, 1))).astype(float)
        return np.repeat(one_hot, self.size, axis=1)

    @cached_property
    def example(self) -> IntArray:
        """An observation of each visit (C, v), −1 where a block has fewer visits."""
        one_hot = self.in_visit[:, :: self.size]
        first = np.take_along_axis(self.member, one_hot.argmax(axis=1), axis=1)
        return np.where(one_hot.any(axis=1), first, -1)

    def of_visits(self, values: Array) -> Array:
        """Per observation (N, …) → per visit (C, v, …), zero where there is none."""
        out = values[np.maximum(self.example, 0)]
        out[self.example < 0] = 0.0
        return out

    def pack(self, rows: Array) -> Array:
        """(N, size, k) → (C, M·size, k), zeros where there is no observation."""
        (C, M), k = self.member.shape, rows.shape[2]
        padded = np.concatenate([rows, np.zeros((1, self.size, k))])
        return padded[self.member].reshape(C, M * self.size, k)

    def unpack(self, packed: Array) -> Array:
        """(C, M·size, k) → (N, size, k)."""
        C, M = self.member.shape
        rows = np.empty((self.n + 1, self.size, packed.shape[2]))
        rows[self.member.ravel()] = packed.reshape(C * M, self.size, packed.shape[2])
        return rows[:-1]

    def pack_square(self, blocks: Array) -> Array:
        """Covariances (N, size, size) of single observations → (C, M·size, M·size)."""
        C, M = self.member.shape
        padded = np.concatenate([blocks, np.zeros((1, self.size, self.size))])[self.member]
        out = np.zeros((C, M, self.size, M, self.size))
        place = np.arange(M)
        out[:, place, :, place, :] = padded.transpose(1, 0, 2, 3)
        return out.reshape(C, M * self.size, M * self.size)

    @property
    def absent(self) -> BoolArray:
        """Rows (C, M·size) that hold no observation."""
        return np.repeat(self.member == self.n, self.size, axis=1)


@dataclass(frozen=True)
class Baseline:
    """The cell's own model fitted to the table, all parameters weakly tied to their start.

    `x` (parameters,) is the fit, `sizes` typical deviations, `nominal` (rows,) the residual of
    the nominal arm with only base and markers placed, NaN where the fit began elsewhere.
    `stated` (N, size, size) is the noise that cell or table state, None where they state none.
    `problem` is what was solved.
    The last `planned` of the N observations are candidates not yet measured: their residual is
    zero and says nothing about what may be at work."""

    model: Model
    observed: Observations
    x: Array
    sizes: Array
    residual: Array
    nominal: Array
    stated: Array | None
    planned: int = 0
    problem: Problem | None = None

    @property
    def covariance(self) -> Array:
        """The noise (N, size, size) that is stated; else only its shape, the residual's variances
        along the axes."""
        if self.stated is not None:
            return self.stated
        each = self.residual.reshape(-1, self.observed.size)
        return np.tile(np.diag(np.maximum(each.var(axis=0), 1e-18)), (len(each), 1, 1))

    @property
    def n_measured(self) -> int:
        """Observations that were measured; they come first."""
        return len(self.observed.lead) - self.planned

    @property
    def blocks(self) -> Blocks:
        table, lead = self.observed.table, self.observed.lead
        return Blocks.of(table.configuration[lead], visits(table)[lead], self.observed.size)


def fit_baseline(
    model: Model, table: Measurements, seed: int = 0, x0: Array | None = None
) -> Baseline:
    """Fit the cell's own effects; every parameter stays, held by a weak tie where data do not.
    `x0` (parameters,) spares the search for a start."""
    observed = observe(table, model.observe)
    free = np.arange(len(model.parameters))
    weights = weights_for(observed, model.cell.tracker, "auto")
    nominal = np.full(len(observed.value), np.nan)
    begun = start_values(model, table, seed) if x0 is None else x0
    problem = posed(model, observed, weights, begun, free)
    if x0 is None:
        problem, nominal = with_placed(problem, PLACING)
    found = tied_fit(problem, TOLERANCE)
    stated = stated_by_observation(observed, model.cell.tracker)
    return Baseline(
        model, observed, found.x, problem.sizes, found.residual, nominal, stated, problem=problem
    )


# Prior standard deviations of the fitted parameters about the fit, in typical sizes: wide enough
# to leave them to the data, narrow enough that what no reading shows stays where it is.
FITTED, FITTED_COMPLIANCE = 5.0, 1.0
# m or rad: base and markers.  The fit has placed them, but an error that it took for another
# geometry may have moved them by as much; the true effect must be free to bring them back.
PLACED = 0.1


def from_centre(base: Baseline) -> Array:
    """How far (parameters,) the fit is from the prior's centre: nominal, or where registration
    placed it.  An unmodelled effect bends what little else holds; it must be free to return."""
    return np.where(is_placed(base.model), 0.0, base.x - base.model.nominal)


def prior_deviations(base: Baseline) -> Array:
    """Prior standard deviation (parameters,), at least how far the fit has moved each.  Where a
    prior is narrower than what the readings say, an addition with the same columns spares the
    fitted parameter a part of the way, and is believed for that alone: half of v in each of two
    columns costs v²/4w² less than v in one."""
    compliant = [effect_of(p.effect).sized_by_value for p in base.model.parameters]
    wide = base.sizes * np.where(compliant, FITTED_COMPLIANCE, FITTED)
    wide = np.maximum(wide, np.abs(from_centre(base)))
    return np.where(is_placed(base.model), PLACED, wide)


# Evidence grows with the readings, and an effect worth finding has hundreds of nats in so many.
MOST_ROWS = 12_000
# The same of poses: curves and fields have a thousand columns.  Identified from all poses, a cell
# that was found from half of 3000 predicts others within 1 % as well as one found from all (UR10).
MOST_CONFIGURATIONS = 2_000
# Within one configuration noise is dense: its cost grows with the square of what it holds.
MOST_IN_ONE = 60


def thinned(table: Measurements, most_rows: int = MOST_ROWS) -> tuple[Measurements, str | None]:
    """The table, or a part of it that is large enough, and what was left out.  Of each
    configuration the first readings of every marker under every load, as many of each as leave
    MOST_IN_ONE in it; of too many configurations those evenly spaced in the order they were
    measured, so that whatever changes with time still does."""
    kind = numbered(table.configuration, load_states(table.force), table.marker)
    order, at = np.argsort(kind, kind="stable"), numbered(table.configuration)
    rank = np.empty(len(table), dtype=np.int64)
    rank[order] = np.arange(len(table)) - np.searchsorted(kind[order], kind[order])
    n_kinds = np.bincount(at[np.unique(kind, return_index=True)[1]])
    part = table.take(rank < np.maximum(MOST_IN_ONE // n_kinds, 1)[at])
    labels, first, rows = np.unique(part.configuration, return_index=True, return_counts=True)
    order = labels[np.argsort(first)]
    wanted = min(int(most_rows / rows.mean()), MOST_CONFIGURATIONS)
    if len(order) > wanted:
        chosen = order[np.linspace(0, len(order) - 1, wanted).round().astype(int)]
        part = part.take(np.isin(part.configuration, chosen))
    if len(part) == len(table):
        return table, None
    return part, (
        f"of the table {len(part)} of {len(table)} rows were looked at, at most {MOST_IN_ONE} of a "
        f"configuration, from {min(len(order), wanted)} of {len(order)} configurations"
    )


MOST = 12  # models that are kept of each; those asked for last


def made_once(model: Model, key: Hashable, make: Callable[[], Model]) -> Model:
    """What `make` derives from the model, or what it derived under the same `key` before.  A
    diagnosis comes back to the same few models, and to write and differentiate one takes long."""
    known: dict[Hashable, Model] = vars(model).setdefault("_derived", {})
    known[key] = known.pop(key) if key in known else make()
    while len(known) > MOST:
        known.pop(next(iter(known)))
    return known[key]


# The noise floor: tracker noise, repeatability of each joint, scatter common to a configuration.
#
#     V = a² Σ_stated + Σ_j s_j² g_j g_jᵀ ∘ (same visit + c_j² · same configuration)
#
# with g_j = ∂(reading)/∂q_j.  a, s_j and c_j maximise the marginal likelihood of the residuals
# (below) times priors that keep what the data do not show near its usual size.

# Logarithms' prior standard deviations.  Stated tracker noise is rarely wrong by more than 1.6
# times; a joint repeats to some 5 µrad on a heavy arm and to 50 on a light one; the joints of an
# arm differ by a factor of two.  What a joint does at a configuration, whenever it comes there, is
# mostly an error of its angle that is not modelled yet: that of one says nothing of another's.
STATED_SPREAD, UNSTATED_SPREAD = 0.5, 3.0
REPEATABILITY, REPEATABILITY_SPREAD = 8e-6, 1.5
JOINT_SPREAD = 0.7
SHARED, SHARED_SPREAD = 0.2, 1.5
SMALLEST_NOISE, LARGEST = 1e-9, 2e-2  # rad or m: a joint or reading that is exact, a loose joint
FARTHEST = 17.0  # logarithms from a start, from an exact joint to a loose one
LARGE = 2**19  # numbers of a data's columns; below, threads would wait for each other


@dataclass(frozen=True)
class NoiseValues:
    """`factor` a of the stated noise, `joint` s (joints,) in rad or m, `shared` c (joints,)."""

    factor: float
    joint: Array
    shared: Array

    @classmethod
    def usual(cls, joints: int) -> NoiseValues:
        return cls(1.0, np.full(joints, REPEATABILITY), np.full(joints, SHARED))

    def of_instrument(self) -> NoiseValues:
        """The instrument's part alone: joints that repeat exactly."""
        exact = np.full_like(self.joint, SMALLEST_NOISE)
        return replace(self, joint=exact, shared=np.full_like(exact, SHARED))

    @property
    def shared_by_all(self) -> float:
        """c of all joints together: rms of what a configuration has over that of a visit."""
        return float(np.linalg.norm(self.shared * self.joint) / np.linalg.norm(self.joint))

    @property
    def theta(self) -> Array:
        """The variances (1 + 2 joints,) of the data's `model`: the instrument's, of each joint at a
        configuration, of each at a visit."""
        return np.concatenate([[self.factor**2], (self.joint * self.shared) ** 2, self.joint**2])

    @classmethod
    def of(cls, theta: Array) -> NoiseValues:
        deviation, J = np.sqrt(theta), len(theta) // 2
        joint = deviation[1 + J :]
        return cls(float(deviation[0]), joint, deviation[1 : 1 + J] / joint)

    def logs(self) -> Array:
        return np.log(self.theta)


@dataclass(frozen=True)
class NoisyData:
    """Packed residual r (C, m), nuisance X (C, m, p) with prior precision Λ (p,), and what noise is
    made of: covariance (C, m, m), whether it is `stated` or only a shape, and joint columns G
    (C, m, joints).  Rows `left_out` (C, m) do not count (padding, faulty readings)."""

    blocks: Blocks
    r: Array
    X: Array
    precision: Array
    covariance: Array
    G: Array
    left_out: BoolArray
    stated: bool

    def with_columns(self, extra: Array, precision: Array) -> NoisyData:
        """The same with further columns (C, m, k) and their prior precisions (k,)."""
        X = np.concatenate([self.X, extra], axis=2)
        return replace(self, X=X, precision=np.concatenate([self.precision, precision]))

    def without(self, faulty: BoolArray) -> NoisyData:
        padded = np.concatenate([faulty, [True]])[self.blocks.member]
        return replace(self, left_out=np.repeat(padded, self.blocks.size, axis=1))

    def every(self, step: int) -> NoisyData:
        per_row = ("r", "X", "covariance", "G", "left_out")
        blocks = replace(self.blocks, member=self.blocks.member[::step])
        return replace(self, blocks=blocks, **{k: getattr(self, k)[::step] for k in per_row})

    @property
    def faulty(self) -> BoolArray:
        """Observations (N,) that are left out."""
        return self.blocks.unpack(self.left_out[..., None].astype(float))[:, 0, 0] > 0

    @cached_property
    def noise(self) -> NoiseValues:
        return fit_noise(self)

    @property
    def n_rows(self) -> int:
        return int((~self.left_out).sum())

    @property
    def threads(self) -> int:
        """How many work on it: products of large matrices let other threads run."""
        return thread_count() if self.X.size > LARGE else 1

    @property
    def mean_variance(self) -> float:
        """Of the readings, as stated, or its shape."""
        return float(np.diagonal(self.covariance, axis1=1, axis2=2)[~self.left_out].mean())

    def masked(self, packed: Array) -> Array:
        """Rows that do not count set to zero (C, m, …)."""
        if not self.left_out.any():
            return packed
        keep = ~self.left_out
        return packed * keep.reshape(keep.shape + (1,) * (packed.ndim - 2))

    def V(self, noise: NoiseValues) -> Array:
        """V (C, m, m); rows left out have unit variance of their own."""
        return self.model.packs[0].V(noise.theta)

    @cached_property
    def model(self) -> Mixed:
        """Of the variances `NoiseValues.theta`, with their prior."""
        rows = np.zeros(self.r.shape[1], dtype=np.int64)
        return self.in_parts(rows, log_prior_of(self.stated, self.G.shape[2]))

    def in_parts(self, part: IntArray, prior: LogPrior) -> Mixed:
        """The same with a variance of its own for each part (m,) of the instrument's rows, which
        errs in each by itself."""
        (C, m, J), visit, n = self.G.shape, self.blocks.in_visit, int(part.max()) + 1
        G = np.ascontiguousarray(self.G.transpose(0, 2, 1))[..., None]  # (C, joints, m, 1)

        def numbers(first: int, k: int) -> IntArray:
            return np.tile(np.arange(first, first + k), (C, 1))

        absent = self.blocks.absent[:, None] * np.eye(m)
        stated = np.asarray(np.linalg.cholesky(self.covariance + absent), dtype=np.float64)
        parts = (
            Parts(numbers(0, n), stated[:, None] * (part == np.arange(n)[:, None])[..., None]),
            Parts(numbers(n, J), G), Parts(numbers(n + J, J), G * visit[:, None]),
        )  # fmt: skip
        pack = Pack(self.X, self.r, parts, self.left_out)
        return Mixed((pack,), n + 2 * J, self.precision, prior)


@cache
def log_prior_of(stated: bool, joints: int) -> LogPrior:
    """Prior of the logarithms of θ (1 + 2 joints,), from that of a, c and s.  The joints' own have
    a common mean that is itself uncertain."""
    own = (
        _precision(1, STATED_SPREAD if stated else UNSTATED_SPREAD, 0.0),
        _precision(joints, SHARED_SPREAD, 0.0),
        _precision(joints, JOINT_SPREAD, REPEATABILITY_SPREAD),
    )
    back = np.linalg.inv(doubled(joints))
    return LogPrior(NoiseValues.usual(joints).logs(), back.T @ linalg.block_diag(*own) @ back)


def doubled(joints: int) -> Array:
    """log θ = 2 (log a, log c + log s, log s) as a product with log a, log c and log s."""
    out = 2 * np.eye(1 + 2 * joints)
    out[1 : 1 + joints, 1 + joints :] = 2 * np.eye(joints)
    return out


def log_prior(stated: bool, noise: NoiseValues) -> float:
    """−2 log prior of the noise, but for its constant."""
    return log_prior_of(stated, len(noise.joint)).penalty(noise.logs())[0]


def _precision(n: int, apart: float, common: float) -> Array:
    """Inverse of apart² 1 + common² (n, n)."""
    share = common**2 / (apart**2 + n * common**2)
    return np.asarray((np.eye(n) - share) / apart**2)


# Data under one noise: what is left of the residual, and how probable the noise is.
#
# With V the noise's covariance and the fitted parameters β ~ N(0, Λ⁻¹) integrated out,
#
#     −2 ℓ = log|V| + rᵀPr + log|XᵀV⁻¹X + Λ| − log|Λ| + n log 2π,
#     P = V⁻¹ − V⁻¹X (XᵀV⁻¹X + Λ)⁻¹ XᵀV⁻¹,
#
# (restricted likelihood where Λ → 0; Patterson and Thompson 1971).


class Projection:
    """The data under one noise, their coefficients under a prior of precision Λ (p,): V⁻¹
    (C, m, m), H = V⁻¹X L⁻ᵀ (C, m, p) with LLᵀ = XᵀV⁻¹X + Λ, and P = V⁻¹ − HHᵀ of each configuration
    by itself.  `u` = P r (C, m); `beta` (p,) the posterior mean β̂; `marginal` the log marginal
    likelihood ℓ; `beta_deviation` L⁻¹ (p, p), so that the posterior covariance of β is L⁻ᵀL⁻¹."""

    def __init__(self, weighted: Weighted, precision: Array) -> None:
        at, self.marginal = weighted.factored(precision)
        back, self.beta_deviation = weighted.root.transpose(0, 2, 1), at.inverse * at.root
        # As one product: a small one for each configuration waits for memory.
        flat = weighted.X.reshape(-1, len(at.L))
        turned = linalg.blas.dtrmm(1.0, self.beta_deviation, flat.T, lower=1).T
        self.H = back @ turned.reshape(weighted.X.shape)
        self.u = (back @ weighted.r[..., None])[..., 0] - self.H @ (at.L.T @ at.b)
        self.beta, self.inverse = at.root * at.b, back @ weighted.root
        # What does not count has a unit variance of its own.
        diagonal = np.einsum("cii->ci", self.inverse)
        diagonal[diagonal == 0] = 1.0

    @cached_property
    def P(self) -> Array:
        return self.inverse - self.H @ self.H.transpose(0, 2, 1)

    @cached_property
    def scattered(self) -> Array:
        """Residuals e (C, m) that scatter as the noise does.  The fit's own residuals are too
        small, its leverage less than V: u_c has the covariance P_cc, so e_c = V_c^½ P_cc^−½ u_c has
        V_c (Bell and McCaffrey 2002)."""
        e = _power(self.inverse, -0.5) @ (_power(self.P, -0.5) @ self.u[..., None])
        return np.asarray(e[..., 0])


def _power(blocks: Array, exponent: float) -> Array:
    """Symmetric powers of positive definite matrices (C, m, m)."""
    values, vectors = np.linalg.eigh(blocks)
    values = np.maximum(values, ROUNDING * values[:, -1:]) ** exponent
    return np.asarray((vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1))


@dataclass(frozen=True)
class Weighted:
    """The data whitened by one noise V = KKᵀ, whatever the prior of the coefficients: K⁻¹
    (C, m, m), K⁻¹X (C, m, p), K⁻¹r (C, m), the products of these, and what of −2ℓ no coefficient
    changes, log|V| + n log 2π."""

    root: Array
    X: Array
    r: Array
    products: Products
    constant: float

    @classmethod
    def of(cls, data: NoisyData, noise: NoiseValues) -> Weighted:
        (white,), products, log_det = data.model.whitened(noise.theta)
        return cls(white.root, white.B, white.e, products, log_det + products.rows * LOG_2PI)

    def prior(self, precision: Array) -> Array:
        """Λ's diagonal (p,), and a little more: what others show as well and the prior leaves wide
        must not drown in rounding.  By each column's own size: a prior must not tighten because
        another column is large."""
        return precision + ROUNDING * np.diag(self.products.M)

    def factored(self, precision: Array) -> tuple[Standardised, float]:
        """The coefficients under a prior of precision Λ (p,), and ℓ."""
        least = self.prior(precision)
        at, spared = self.products.at(1 / least), float(np.log(least / precision).sum())
        return at, -0.5 * (self.constant + self.products.value(at) + spared)


def project(data: NoisyData, noise: NoiseValues) -> Projection:
    return Projection(Weighted.of(data, noise), data.precision)


def posterior(data: NoisyData, noise: NoiseValues) -> float:
    """−2 log of marginal likelihood times prior of the noise."""
    return -2 * Weighted.of(data, noise).factored(data.precision)[1] + log_prior(data.stated, noise)


STEPS = 200  # a few of them do mostly
SOME = 250  # configurations that show where the optimum is
ENOUGH = 1e-3  # change of −2ℓ at which a search ends


def fit_noise(
    data: NoisyData, start: NoiseValues | None = None, enough: float = ENOUGH
) -> NoiseValues:
    """The most probable noise values.  Where nothing is stated it starts from two ends, unless a
    start is given; with many configurations it comes from some of them to all.  The search ends
    where −2ℓ changes by less than `enough`."""
    if start is None and len(data.r) >= 2 * SOME:
        start = fit_noise(data.every(len(data.r) // SOME))
    if start is None:
        starts = [NoiseValues.usual(data.G.shape[2]), *([] if data.stated else [balanced(data)])]
        ends = [fit_noise(data, one, enough) for one in starts]
        return min(ends, key=lambda end: posterior(data, end))
    # By steps in log a, log c and log s: the latter are known apart from each other.
    to = doubled(data.G.shape[2])

    def objective(logs: Array) -> tuple[float, Array, Array]:
        value, slope, information = data.model.objective(to @ logs)
        return value, to.T @ slope, to.T @ information @ to

    begin: Array = linalg.solve(to, start.logs())
    low = begin - FARTHEST
    low[0] = max(low[0], np.log(SMALLEST_NOISE / np.sqrt(data.mean_variance)))
    found = climb(objective, begin, low, begin + FARTHEST, enough, STEPS)[0]
    return start if found is begin else NoiseValues.of(np.exp(to @ found))


def balanced(data: NoisyData) -> NoiseValues:
    """Instrument and joints share the scatter of the data equally.  From far below it the
    likelihood is flat in a joint's logarithm, and no climb leaves."""
    used = ~data.left_out
    square = max(float((data.r[used] ** 2).mean()), SMALLEST_NOISE**2)
    moved = np.maximum((data.G[used] ** 2).mean(axis=0), 1e-300)
    joint = np.clip(np.sqrt(0.5 * square / (len(moved) * moved)), SMALLEST_NOISE, LARGEST)
    factor = float(np.sqrt(0.5 * square / data.mean_variance))
    return NoiseValues(factor, joint, np.full_like(joint, SHARED))
