"""The weighted problem, Σ and W with WᵀW = Σ⁻¹, B and e as their R factor in parts, and its fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from elastocal.cell_tables import Tracker
from elastocal.engine import least_norm
from elastocal.identification.knowledge import System, minimise
from elastocal.messages import ElastocalError, InputError, length, option
from elastocal.model.manipulator import Model, Regression
from elastocal.model.observations import (
    Observations,
    available_noise,
    need,
    position_covariance,
    subset,
)
from elastocal.units import Array, IntArray

# Measurement noise: covariance of the observations and the weights W with W Σ = I.
#
# Weights as in Klimchik et al. 2013, eq. (9) to (13), generalised from a diagonal Σ to blocks:
# a polar tracker's errors are correlated in x, y, z, and deflections that share an unloaded
# reading are correlated with each other.

WeightKind = Literal["auto", "none", "rows", "axis", "polar", "covariance"]


@dataclass(frozen=True)
class Weights:
    """`whiten` (rows, rows) with whiten · Σ · whitenᵀ = I, or None for unit weights.  `absolute`
    says whether Σ is stated in m² (then a whitened residual has expected size 1) or holds only up
    to a common factor, which the residual must tell.

    Where all readings have some noise in common, as a drift in time, Σ = Σ₀ + FFᵀ with few columns
    F, `common` (rows, k), and W = (I − low lowᵀ) W₀; `whiten` is then W₀.  What readings far from
    each other share so, a reading is judged by those outside its block of time, `together`
    (observations,).
    """

    kind: str
    whiten: sparse.csr_array | None
    absolute: bool
    description: str
    common: Array | None = None
    together: IntArray | None = None

    def apply(self, rows: Array) -> Array:
        """Whiten a vector (rows,) or matrix (rows, k)."""
        return self.beside(rows if self.whiten is None else self.whiten @ rows)

    def beside(self, own: Array) -> Array:
        """(I − low lowᵀ) of rows that are whitened by W₀."""
        return own if self.common is None else own - self._low @ (self._low.T @ own)

    @cached_property
    def _low(self) -> Array:
        """(I + F₀F₀ᵀ)^(−1/2) = I − U (1 − (1 + s²)^(−1/2)) Uᵀ of the whitened F₀ = W₀F."""
        assert self.common is not None and self.whiten is not None
        U, size, _ = linalg.svd(self.whiten @ self.common, full_matrices=False)
        return np.asarray((U * np.sqrt(1 - 1 / np.sqrt(1 + size**2)))[:, size > 0])

    def beside_common(self, B: Array, e: Array) -> tuple[Array, Array]:
        """The whitened rows of B (rows, p) and e, with the coefficients of what all have in common
        as further columns, held by rows of their own that are the last."""
        if self.common is None or self.whiten is None:
            return self.apply(B), self.apply(e)
        p, k = B.shape[1], self.common.shape[1]
        rows = np.vstack([self.whiten @ np.hstack([B, self.common]), np.eye(k, p + k, p)])
        return rows, np.concatenate([self.whiten @ e, np.zeros(k)])


def weights_for(
    observed: Observations, tracker: Tracker, kind: WeightKind = "auto",
    covariance: Array | None = None,
) -> Weights:  # fmt: skip
    """Weights for the observations; "auto" takes the table's sigmas, else the cell's, else none.
    "rows" uses the table's sigma columns (Cartesian or polar), "axis" the cell's `sigma_um`,
    "polar" the cell's range and transverse noise, "covariance" the matrix (rows, rows) given.
    InputError where the noise that `kind` names is not there."""
    chosen = _available(observed, tracker) if kind == "auto" and covariance is None else kind
    if covariance is not None or chosen == "covariance":
        need(covariance is not None, f"weights 'covariance' need a matrix ({option('covariance')})")
        matrix, n = np.asarray(covariance, dtype=float), len(observed.value)
        need(
            matrix.shape == (n, n),
            f"the covariance is {matrix.shape}, but there are {n} rows (observations × components)",
        )
        need(
            bool(np.isfinite(matrix).all()) and np.allclose(matrix, matrix.T, rtol=1e-9),
            f"{option('covariance')} is not finite and symmetric; correct the matrix",
        )
        return Weights("covariance", whitener(sparse.csr_array(matrix)), True, "given covariance")
    if chosen == "none":
        return Weights("none", None, False, "unit weights (ordinary least squares)")
    blocks, text = stated_covariance(observed, tracker, chosen)
    kind_used = "axis" if observed.kind == "distance" else chosen
    if observed.kind != "deflection":  # every observation is a reading of its own
        return Weights(kind_used, block_diagonal(inverse_factor(blocks)), True, text)
    mix = sparse.kron(observed.combine, sparse.eye_array(observed.size), format="csr")
    covariance_rows = sparse.csr_array(mix @ block_diagonal(blocks) @ mix.T)
    return Weights(kind_used, whitener(covariance_rows), True, text)


def stated_covariance(observed: Observations, tracker: Tracker, kind: str) -> tuple[Array, str]:
    """Stated covariance (n_rows, size, size) of every table row, and where it comes from;
    InputError where the cell or the table does not state what this needs."""
    if observed.kind == "distance":
        need(tracker.distance_sigma is not None, "distances need [tracker] distance_um")
        sigma = float(tracker.distance_sigma or 1.0)
        text = f"distance sigma {length(sigma)} from the cell"
        return np.full((len(observed.table), 1, 1), sigma**2), text
    blocks, text = position_covariance(observed.table, tracker, kind)
    if observed.kind == "pose":
        need(tracker.rotation_sigma is not None, "poses need [tracker] rotation_urad")
        full = np.zeros((len(observed.table), 6, 6))
        full[:, :3, :3] = blocks
        full[:, 3:, 3:] = np.eye(3) * float(tracker.rotation_sigma or 1.0) ** 2
        blocks = full
    return blocks, text


def stated_by_observation(observed: Observations, tracker: Tracker) -> Array | None:
    """Stated covariance (N, size, size) of each observation, None where none is stated.
    Observations that share a reading are correlated; here each stands for itself."""
    kind = _available(observed, tracker)
    if kind == "none":
        return None
    rows = stated_covariance(observed, tracker, kind)[0]
    if observed.kind == "deflection":
        rows = observed.combine.power(2) @ rows.reshape(len(rows), -1)
    return np.asarray(rows).reshape(-1, observed.size, observed.size)


def _available(observed: Observations, tracker: Tracker) -> str:
    if observed.kind == "distance":
        return "none" if tracker.distance_sigma is None else "axis"
    if observed.kind == "pose" and tracker.rotation_sigma is None:
        return "none"
    return available_noise(observed.table, tracker)


def block_diagonal(blocks: Array) -> sparse.csr_array:
    """Blocks (n, d, d) along the diagonal; their zeros are not stored."""
    n, d, _ = blocks.shape
    places = np.arange(n), np.arange(n + 1)
    out = sparse.bsr_array((np.ascontiguousarray(blocks), *places), shape=(n * d, n * d)).tocsr()
    out.eliminate_zeros()
    return sparse.csr_array(out)


def inverse_factor(blocks: Array) -> Array:
    """L⁻¹ of each block (n, d, d) = L Lᵀ."""
    if len(blocks) > 1 and not blocks.strides[0]:  # one for all
        return np.broadcast_to(inverse_factor(blocks[:1]), blocks.shape)
    try:
        factor = np.asarray(np.linalg.cholesky(blocks), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise InputError(
            "the noise covariance is not positive definite; check what states it: "
            f"{option('covariance')}, the sigma columns of the table, or [tracker] of the cell"
        ) from None
    return np.asarray(np.linalg.inv(factor), dtype=np.float64)


def same_size(codes: NDArray[np.integer]) -> Iterator[IntArray]:
    """Members (groups, k) of the groups that have one code, by their number k of members."""
    order = np.argsort(codes, kind="stable")
    _, starts, counts = np.unique(codes[order], return_index=True, return_counts=True)
    for count in np.unique(counts):
        yield order[starts[counts == count][:, None] + np.arange(count)]


def whitener(covariance: sparse.csr_array) -> sparse.csr_array:
    """L⁻¹ of the Cholesky factor, block by block over groups of correlated rows."""
    _, label = sparse.csgraph.connected_components(covariance, directed=False)
    rows, columns, values = [], [], []
    for members in same_size(label):
        size = members.shape[1]
        i, j = members[:, :, None], members[:, None, :]
        i, j = np.broadcast_arrays(i, j)
        inverse = inverse_factor(np.asarray(covariance[i.ravel(), j.ravel()]).reshape(i.shape))
        keep = np.tril(np.ones((size, size), dtype=bool))
        rows.append(i[:, keep].ravel())
        columns.append(j[:, keep].ravel())
        values.append(inverse[:, keep].ravel())
    triplets = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(triplets, shape=covariance.shape)


# A least-squares problem of any length as its R factor: what is left of B and e after QR.
#
#     [B e] = Q [R z; 0 ρ],   |e − B x|² = |z − R x|² + ρ²
#
# R (p, p), z = Qᵀe (p,) and ρ decide everything that a fit asks of the rows: steps, rank,
# covariance, sum of squares.  R factors of parts of the rows are merged by the QR of one on top of
# the other (TSQR; Demmel, Grigori, Hoemmen and Langou 2012, SIAM J. Sci. Comput. 34), which is
# backward stable like a QR of all rows at once: the condition number enters once, not squared as
# in BᵀB.

# Rows of a leaf for every column: it stays in the second level of cache, where LAPACK's panels,
# which go over all rows column by column, take half the time (docs/performance.md).
LEAF, SMALLEST_LEAF = 16, 512


@dataclass(frozen=True)
class RFactor:
    """`augmented` (p + 1, p + 1) upper triangular: the R factor of [B e]; `rows` of B."""

    augmented: Array
    rows: int

    @classmethod
    def of(cls, B: Array, e: Array) -> RFactor:
        """The R factor of the whitened B (rows, p) and residual e (rows,)."""
        return cls(_factor(np.column_stack([B, e])), len(e))

    def merged(self, other: RFactor) -> RFactor:
        stacked = np.vstack([self.augmented, other.augmented])
        return RFactor(_factor(stacked), self.rows + other.rows)

    def of_columns(self, chosen: NDArray[np.integer]) -> RFactor:
        return RFactor(_factor(self.augmented[:, [*chosen, self.columns]]), self.rows)

    @property
    def columns(self) -> int:
        return self.augmented.shape[1] - 1

    @property
    def R(self) -> Array:
        """(p, p) with RᵀR = BᵀB."""
        return self.augmented[:-1, :-1]

    @property
    def projected(self) -> Array:
        """z = Qᵀe (p,), so that Rᵀz = Bᵀe."""
        return self.augmented[:-1, -1]

    @property
    def rest(self) -> float:
        """ρ: length of the part of e outside the span of B."""
        return float(abs(self.augmented[-1, -1]))

    @property
    def rss(self) -> float:
        return float(self.augmented[:, -1] @ self.augmented[:, -1])

    def scaled(self, scale: Array) -> RFactor:
        return RFactor(self.augmented * np.append(scale, 1.0), self.rows)

    @cached_property
    def half(self) -> Array:
        """R⁻¹ (p, p)."""
        return np.asarray(linalg.solve_triangular(self.R, np.eye(self.columns)))


def _factor(rows: Array) -> Array:
    """R factor (k, k) of `rows` (n, k), filled up with zeros where n < k."""
    k = rows.shape[1]
    leaf = max(LEAF * k, SMALLEST_LEAF)
    while (n := len(rows)) >= 2 * leaf:
        whole = n // leaf * leaf
        leaves = np.asarray(np.linalg.qr(rows[:whole].reshape(-1, leaf, k), mode="r"))
        rows = np.vstack([leaves.reshape(-1, k), rows[whole:]])
    # Not scipy's qr, whose R has all n rows: kept as a factor it would hold a part of the table.
    R = np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
    return R if len(R) == k else np.vstack([R, np.zeros((k - len(R), k))])


# A problem, worked on in parts of its table: B of a part is formed, used and dropped.

Result = TypeVar("Result")

# Numbers in B (rows × parameters): from LARGE on a fit works in parts of at most PART.  16 MB a
# part keeps the evaluation of B at full speed, and the copies that QR makes small.
LARGE = 2**21
PART = 2**21
OF_A_MARKER = 30  # observations of each marker at least, where there are as many, in a sample
# Two parts at a time: one is evaluated while the other is factorised (measured: a third one only
# waits for the interpreter, and each costs the memory of a part).
AT_ONCE = 2


@dataclass(frozen=True)
class Problem:
    """Fit parameters among those that are `free` to the observations, the others held at x0
    (parameters,); `sizes` (parameters,) are typical ones, by which variables are scaled; those
    placed that lean on the others (`solve.leaning`) are chosen last.  A part of another problem has
    its observations `index` (n,), whitened on their own."""

    model: Model
    observations: Observations
    weights: Weights
    x0: Array
    free: NDArray[np.int64]
    sizes: Array
    index: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    leaning: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @cached_property
    def rows(self) -> IntArray:
        """The rows (n·size,) of a part among those of all observations."""
        size = self.observations.size
        return np.asarray((self.index[:, None] * size + np.arange(size)).ravel())

    @property
    def large(self) -> bool:
        return len(self.observations.value) * int((~self.model.shrunk).sum()) > LARGE

    @cached_property
    def parts(self) -> tuple[IntArray, ...]:
        """The observations (n,) of each part, whose B has at most PART numbers.  Those of one
        configuration share a part, and with them what shares an unloaded reading.  A table that is
        not large is one part, and so is one whose covariance was given, where anything may be
        correlated."""
        observed, n = self.observations, len(self.observations.lead)
        columns = max(int((~self.model.shrunk).sum()), len(self.free))
        if len(observed.value) * columns <= LARGE or self.weights.kind == "covariance":
            return (np.arange(n),)
        limit = max(PART // (observed.size * columns), 1)
        # A configuration belongs to the part that its first observation falls into.
        first = np.searchsorted(np.sort(observed.configuration), observed.configuration)
        return tuple(np.flatnonzero(first // limit == k) for k in np.unique(first // limit))

    def part(self, index: IntArray) -> Problem:
        """Observations `index` (n,), ascending, with the weights of these alone: exact where what
        is correlated is in `index` together."""
        observed, weights, part = self.observations, self.weights, replace(self, index=index)
        if len(index) == len(observed.lead):
            return part
        # A block by its ends: picked one by one its rows would be copied, and its columns looked
        # for among those of all readings.
        first, last = int(index[0]), int(index[-1]) + 1
        block = last - first == len(index)
        own = subset(observed, slice(first, last) if block else index)
        inside = slice(first * observed.size, last * observed.size) if block else part.rows
        whiten = None if weights.whiten is None else weights.whiten[inside][:, inside]
        mine = replace(weights, whiten=whiten)
        if weights.common is not None and weights.together is not None:
            common = weights.common[part.rows]
            mine = replace(mine, common=common, together=weights.together[index])
        return replace(part, observations=own, weights=mine)

    def sample(self, n: int) -> Problem:
        """About n observations at random, some of every marker, correlated ones together."""
        observed = self.observations
        order = np.random.default_rng(0).permutation(len(observed.lead))
        if self.weights.kind == "covariance":  # anything may be correlated
            return self.part(np.arange(len(order)))
        if observed.kind == "deflection":  # each brings the others of its configuration with it
            n = -(-n * observed.n_configurations // len(order))
        marker = observed.table.marker[observed.lead[order]]
        some = [order[marker == code][:OF_A_MARKER] for code in np.unique(marker)]
        chosen = np.unique(np.concatenate([order[:n], *some]))
        if observed.kind == "deflection":
            own = observed.configuration
            chosen = np.flatnonzero(np.isin(own, own[chosen]))
        return self.part(chosen)

    def each(self, work: Callable[[Problem], Result]) -> Iterator[Result]:
        """`work` on every part, AT_ONCE at a time; results in the order of the parts, so that their
        sum does not depend on which is done first.  The first one is done alone: it builds what the
        others share (the model's compiled functions)."""
        first, *others = self.parts
        yield work(self.part(first))
        with ThreadPoolExecutor(AT_ONCE) as pool:
            yield from pool.map(lambda index: work(self.part(index)), others)

    def evaluate(self, x: Array, columns: NDArray[np.integer]) -> tuple[Array, RFactor]:
        """The raw residual (rows,) at x, and with B of the `columns`, whitened, their R factor;
        ElastocalError where a reading has no static equilibrium at x."""
        residual = np.empty(len(self.observations.value))

        def reduced(part: Problem) -> RFactor:
            at, apply = part.regressor(x, columns), part.weights.apply
            residual[part.rows] = at.residual
            return RFactor.of(apply(at.B), apply(at.residual))

        return residual, reduce(RFactor.merged, self.each(reduced))

    def residual(self, x: Array) -> Array:
        """Observed minus predicted (rows,) at x; NaN in readings without equilibrium."""
        residual = np.empty(len(self.observations.value))
        for rows, own in self.each(lambda part: (part.rows, part.residual_at(x))):
            residual[rows] = own
        return residual

    def residual_at(self, x: Array) -> Array:
        """The same of a single part, also at several x (k, parameters)."""
        observed = self.observations
        return np.asarray(observed.value - self.model.predict(observed.table, x, observed))

    def regressor(self, x: Array, columns: NDArray[np.integer]) -> Regression:
        return self.model.kept_regressor(self.observations, x, columns)

    def whitened(self, x: Array, columns: NDArray[np.integer]) -> tuple[Array, Array]:
        """B (rows, columns) and residual (rows,) of a single part at x, whitened."""
        at = self.regressor(x, columns)
        return self.weights.apply(at.B), self.weights.apply(at.residual)


# Nonlinear weighted least squares on the exact B, with what else is known of the parameters:
#
#     |W (y − h(X))|² + |target − P X|²   over X[columns],   lower ≤ X ≤ upper,  A X = b,  M(X) ⪰ 0
#
# A weak tie to the start, the prior of random coefficients and stated knowledge are all of them
# rows P; every fit is the same descent by Levenberg and Marquardt on R factors.

SETTLED = "the sum of squares no longer fell"
NEGLIGIBLE = "the steps became negligible"
EXHAUSTED = "the step limit was reached; the start may be far off or the data ill-conditioned"

LEAST_DAMPING = 1e-18  # of the largest squared column, once a full step has failed
SHORTER = 0.3  # than a step that failed
ROUNDING = 1e-12  # relative: what separates two evaluations at the minimum
# What a step promises of the cost where a descent ends.  The last step is taken: at a million rows
# it is a tenth of a standard deviation, and what it leaves behind is smaller by orders.
TOLERANCE = 1e-8


@dataclass(frozen=True)
class PriorRows:
    """What a fit knows of its columns besides the readings: P (k, columns) and target (k,) with
    |target − P X|² beside whitened rows, and constraints on them."""

    P: Array
    target: Array
    system: System | None = None

    def restricted(self, columns: IntArray, x: Array) -> PriorRows:
        """What it says of the `columns`, the others held at x; InputError where these break a
        constraint."""
        held = moved(x, columns, -x[columns])
        system = None if self.system is None else self.system.restricted(columns, x)
        return PriorRows(self.P[:, columns], self.target - self.P @ held, system)


@dataclass(frozen=True)
class Fit:
    """Values x (parameters,), raw residual (rows,), R factor of whitened B and residual; `columns`
    (fitted,) index the parameters; `known` is what the fit knew of them, `every` the free columns
    and their R factor, where the fit came by it."""

    x: Array
    residual: Array
    r_factor: RFactor
    converged: bool
    reason: str
    problem: Problem = field(repr=False)
    columns: NDArray[np.int64]
    known: PriorRows
    every: tuple[IntArray, RFactor] | None = None

    @cached_property
    def B(self) -> Array:
        """B (rows, fitted) at x, raw.  Formed on demand: of a large table, use `r_factor`."""
        return self.problem.regressor(self.x, self.columns).B

    @cached_property
    def whitened(self) -> Array:
        return self.problem.weights.apply(self.residual)

    @cached_property
    def of_free(self) -> RFactor:
        problem = self.problem
        if np.array_equal(self.columns, problem.free):
            return self.r_factor
        if self.every is not None and np.array_equal(self.every[0], problem.free):
            return self.every[1]
        return problem.evaluate(self.x, problem.free)[1]


class Linearised(NamedTuple):
    """The residual, its R factor with B per unit of u, and the cost |b − A step|² about a u; that
    of all free columns, raw, with these, where they were asked for."""

    residual: Array
    r_factor: RFactor
    A: Array
    b: Array
    every: tuple[IntArray, RFactor] | None

    @property
    def cost(self) -> float:
        return float(self.b @ self.b)

    @property
    def steepest(self) -> float:
        return float((self.r_factor.R**2).sum(axis=0).max(initial=0.0))


class Objective:
    """|e(u)|² + |target − P u|² under the `limits` on u, where X[columns] = x[columns] + size · u
    and the other parameters are x (parameters,)."""

    def __init__(
        self, problem: Problem, columns: IntArray, x: Array, size: Array, known: PriorRows
    ) -> None:
        self.problem, self.columns, self.x, self.size = problem, columns, x, size
        self.P, self.target = known.P * size, known.target - known.P @ x[columns]
        self.system = known.system
        self.limits = None if self.system is None else self.system.moved(x[columns], size)

    def evaluate(self, u: Array, ahead: bool = False) -> Linearised:
        """ElastocalError where the model has no prediction.  `ahead`: with what a large table will
        be asked if the fit ends here, so that it is gone through once."""
        free, own = self.problem.free, self.columns
        ahead = ahead and self.problem.large and bool(np.isin(own, free).all())
        residual, r_factor = self.problem.evaluate(self.values(u), free if ahead else own)
        every = None
        if ahead:
            every, order = (free, r_factor), np.argsort(free)
            r_factor = r_factor.of_columns(order[np.searchsorted(free, own, sorter=order)])
        if not np.isfinite(r_factor.rss):
            source = self.problem.observations.table.source
            raise ElastocalError(
                f"{source}: the model predicts no finite numbers at the "
                "start values; look in the cell for a length, force or compliance far too large"
            )
        r_factor = r_factor.scaled(self.size)
        A = np.vstack([r_factor.augmented[:, :-1], self.P])
        b = np.concatenate([r_factor.augmented[:, -1], self.target - self.P @ u])
        return Linearised(residual, r_factor, A, b, every)

    def values(self, u: Array) -> Array:
        """X (parameters,), what lies at its bound but for rounding on it."""
        values, system = moved(self.x, self.columns, self.size * u), self.system
        if system is not None:
            own = values[self.columns]
            for bound in (system.lower, system.upper):
                own = np.where(np.abs(own - bound) <= ROUNDING * self.size, bound, own)
            values[self.columns] = np.clip(own, system.lower, system.upper)
        return values

    def step(self, u: Array, at: Linearised, damping: float) -> Array:
        """Minimiser of the linearised cost + damping · |step|²."""
        p = len(u)
        A, b = np.vstack([at.A, np.sqrt(damping) * np.eye(p)]), np.append(at.b, np.zeros(p))
        if self.limits is not None:
            return minimise(A, b, self.limits.moved(u, np.ones(p))).x
        return least_norm(A, b, cond=max(at.r_factor.rows, p) * np.finfo(float).eps)

    def descend(self, u: Array, tolerance: float, most: int) -> tuple[Array, Linearised, str]:
        """Full Gauss–Newton steps while they lower the cost, damped ones where they do not: where
        they end, and why.  They end where the linearised cost promises less than `tolerance` of
        itself: that last step is still taken, and leaves an error smaller than itself by the factor
        with which Gauss–Newton converges.  Steps are judged by the cost itself, so no rounding of
        it can keep it from ending."""
        at, damping = self.evaluate(u), 0.0
        failed = -1.0  # the damping that was too little a step ago
        for _ in range(most - 1):
            step = self.step(u, at, damping)
            left = at.b - at.A @ step
            promised, trial, cost = at.cost - float(left @ left), at, np.inf
            last, small = promised <= tolerance * at.cost, np.abs(step).max(initial=0) <= ROUNDING
            if promised <= ROUNDING * at.cost or (last and small):
                return u, at, NEGLIGIBLE
            with suppress(ElastocalError):
                trial = self.evaluate(u + step, ahead=True)
                cost = trial.cost
            if last:  # more than what is left is not to be had
                kept = cost <= at.cost * (1 + ROUNDING)
                return (*((u + step, trial) if kept else (u, at)), SETTLED)
            if at.cost - cost > 1e-4 * promised:
                u, at = u + step, trial
                less = damping / 10 if damping > LEAST_DAMPING * at.steepest else 0.0
                damping, failed = (damping, failed / 100) if less <= failed else (less, failed)
            elif small:
                return u, at, NEGLIGIBLE
            else:
                failed, damping = damping, max(10 * damping, LEAST_DAMPING * at.steepest)
                longest = SHORTER * np.linalg.norm(step)
                while np.linalg.norm(self.step(u, at, damping)) > longest:
                    damping *= 10
        return u, at, EXHAUSTED


def moved(x: Array, columns: IntArray, step: Array) -> Array:
    out = x.astype(float)
    out[columns] += step
    return out


def fit(
    problem: Problem, columns: IntArray, x: Array, *, known: PriorRows | None = None,
    max_steps: int = 60, tolerance: float = TOLERANCE,
) -> Fit:  # fmt: skip
    """min over X[columns] of |W (y − h(X))|² (eq. 9, nonlinear) with what is `known` of them, the
    other parameters held at x, by Levenberg–Marquardt from there, derivatives exact.

    It ends where a step promises less than `tolerance` of the cost.  Every step starts from the
    residual of the exact model, so that the rounding of one is taken back by the next.  Constraints
    are convex and kept in every step: where none improves the fit, the conditions of Karush, Kuhn
    and Tucker hold.  Raises ElastocalError where the start has poses without equilibrium,
    InputError for constraints that contradict each other, InsufficientDataError where they leave
    something undetermined.
    """
    size, u = problem.sizes[columns], np.zeros(len(columns))
    known = known or PriorRows(np.zeros((0, len(u))), np.zeros(0))
    objective = Objective(problem, columns, x, size, known)
    if objective.limits is not None:  # the nearest that is allowed
        u = minimise(np.eye(len(u)), u, objective.limits).x
    u, at, reason = objective.descend(u, tolerance, max_steps)
    return Fit(
        objective.values(u), at.residual, at.r_factor.scaled(1 / size), reason != EXHAUSTED, reason,
        problem, columns, known, at.every,
    )  # fmt: skip
