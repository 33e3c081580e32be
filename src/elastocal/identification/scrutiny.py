"""What a statistician asks of a fit: who decides it, what else would do, what its errors are of.

Leverage and influence of every configuration, correlation of residuals from visit to visit, sets of
parameters side by side, and what the uncertainty of a prediction is made of.  All of it follows
from the fit's B, its weights and its residual; nothing is fitted anew.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from elastocal.engine import Standardised, least_norm
from elastocal.identification.least_squares import held_out_residual, left_out, rms_3d
from elastocal.identification.noise_summary import Noise
from elastocal.identification.prediction import FEWEST_REPEATS, mean_squares
from elastocal.identification.solve import WORTH_A_COLUMN, SmoothPart, reduce
from elastocal.identification.weighted_problem import Weights, weights_for
from elastocal.measurements import Measurements
from elastocal.model.calibrated import CalibratedArm
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, pure_error
from elastocal.units import Array, BoolArray, IntArray, microns


@dataclass(frozen=True, repr=False, eq=False, kw_only=True)
class FoundFit:
    """What of a `Calibration` is looked at again; it says what each is."""

    model: Model
    x: Array
    determined: tuple[str, ...]
    observations: Observations
    residual: Array
    held_out: Array
    dof: int
    residual_rms: float
    weights: Weights
    noise: Noise
    noise_parts: dict[str, float]
    smooth: tuple[SmoothPart, ...] = ()

    @cached_property
    def columns(self) -> IntArray:
        """Indices (determined,) of the parameters `determined` among the model's."""
        return np.array([self.model.names.index(n) for n in self.determined], dtype=np.int64)

    @cached_property
    def B(self) -> Array:
        """B (rows, parameters) of the readings at the values found, in m (rad) per unit."""
        observed = self.observations
        return self.model.regressor(observed.table, self.x, observations=observed).B

    @property
    def stage(self) -> IntArray:
        return np.array([stage_of(p.effect) for p in self.model.parameters], dtype=np.int64)


MOST_NUMBERS = 10_000_000  # of a B that is looked at in passing


# Leverage and influence.
#
# With whitened B = QR and whitened residual e, configuration c takes tr Q_c Q_cᵀ of the parameters
# for itself (its leverage; all sum to their number), and without it the estimate would move by
# Δ_c = R⁻¹ Q_cᵀ (I − Q_c Q_cᵀ)⁻¹ e_c.  Cook's distance is Δ_cᵀ RᵀR Δ_c / (p s²) (Cook 1977,
# Technometrics 19, 15): at 1 the estimate moves about to the edge of its 50 % region.


@dataclass(frozen=True)
class Influence:
    """What a configuration does to the fit.  `leverage`: how many of the parameters it pays for.
    `cook`: Cook's distance, infinite where it alone determines something.  Without it `moved` would
    move by `by` standard deviations, more than any other parameter."""

    configuration: str
    readings: int
    leverage: float
    cook: float
    moved: str
    by: float


def influence(fit: FoundFit) -> tuple[Influence, ...]:
    observed, p = fit.observations, len(fit.columns)
    # What all readings share is fitted along.
    white, e = fit.weights.beside_common(fit.B[:, fit.columns], fit.residual)
    Q, R = linalg.qr(white, mode="economic")
    e = e - Q @ (Q.T @ e)
    s2 = float(e @ e) / max(fit.dof, 1)
    back = linalg.solve_triangular(R, np.eye(len(R)))[:p]  # of the parameters alone
    information = np.linalg.inv(back @ back.T)
    std = np.sqrt(s2 * np.diag(back @ back.T))
    labels = np.repeat(observed.configuration, observed.size)
    count, names = np.bincount(labels) // observed.size, observed.table.configuration_labels
    found = dict[int, Influence]()  # by its first row
    for rows, moved, alone in left_out(Q[: len(labels)], e[: len(labels)], labels):
        Qc, move = Q[rows], moved @ back.T
        # A configuration that alone determines something moves that without end.
        move[alone] = np.abs(back @ Qc[alone].transpose(0, 2, 1)).max(axis=2)
        shift = np.divide(np.abs(move), std, out=np.zeros(move.shape), where=std > 0)
        by, cook = shift.max(axis=1), ((move @ information) * move).sum(axis=1)
        cook = cook / (p * s2) if s2 > 0 else 0 * cook
        by[alone] = cook[alone] = np.inf
        taken, most = (Qc**2).sum(axis=(1, 2)), fit.columns[shift.argmax(axis=1)]
        for k, row in enumerate(rows[:, 0].tolist()):
            found[row] = Influence(
                names[labels[row]], int(count[labels[row]]), float(taken[k]), float(cook[k]),
                fit.model.names[most[k]], float(by[k]),
            )  # fmt: skip
    return tuple(found[row] for row in sorted(found))


LAGS = 10
FEWEST_VISITS = 12


@dataclass(frozen=True)
class Autocorrelation:
    """Correlations of the mean residuals of visits that are 1, 2, … apart, and the p-value of the
    first being no larger than in a random order; `band` holds 95 % of single ones by chance.
    Visits follow each other by the table's times, or by the order of its rows (`by`)."""

    correlations: tuple[float, ...]
    p: float
    band: float
    visits: int
    by: str


def autocorrelation(residual: Array, observed: Observations) -> Autocorrelation | None:
    """The correlation of residuals (rows,) from visit to visit of a configuration; None for fewer
    than 12 visits.  The p-value is that of a permutation test, whatever the distribution of the
    noise: the sum of products of neighbours is nearly normal over all orders, with an exact mean
    and variance (after Wald and Wolfowitz 1943)."""
    parts = residual.reshape(-1, observed.size)[:, :3]
    spread = np.sqrt((parts**2).mean(axis=0))
    table, lead = observed.table, observed.lead
    timed = table.time is not None and bool(np.ptp(np.asarray(table.time)) > 0)
    order = np.argsort(np.asarray(table.time)[lead] if timed else lead, kind="stable")
    visit = np.cumsum(np.r_[0, np.diff(observed.configuration[order]) != 0])
    number = int(visit[-1]) + 1 if len(visit) else 0
    if number < FEWEST_VISITS or not (spread > 0).all():
        return None
    unit = parts[order] / spread
    count = np.bincount(visit)
    mean = np.column_stack([np.bincount(visit, u) for u in unit.T]) / np.sqrt(count)[:, None]
    mean -= mean.mean(axis=0)
    total = float((mean**2).sum())
    lags = range(1, min(LAGS, number // 4) + 1)
    found = tuple(float((mean[:-k] * mean[k:]).sum()) / total for k in lags)
    # Of Σ m_i·m_{i+1} over all orders of the rows m, which sum to zero: two products of neighbours
    # share both rows, one or none; the mean of their product over all distinct rows follows for
    # each from T = Σ |m|², F = |Σ m mᵀ|² and Q = Σ |m|⁴.
    n, square = number, (mean**2).sum(axis=1)
    T, F, Q = square.sum(), ((mean.T @ mean) ** 2).sum(), (square**2).sum()
    two = (F - Q) / (n * (n - 1))
    three = (2 * Q - F) / (n * (n - 1) * (n - 2))
    four = (T**2 + 2 * F - 6 * Q) / (n * (n - 1) * (n - 2) * (n - 3))
    second = (n - 1) * two + 2 * (n - 2) * three + (n - 2) * (n - 3) * four
    centre, width = -float(T / n), float(np.sqrt(second - (T / n) ** 2))
    p = float(special.ndtr((centre / total - found[0]) / (width / total)))
    band = float(special.ndtri(0.975)) * width / total
    return Autocorrelation(found, p, band, number, "times" if timed else "order of the rows")


# Sets of parameters side by side, on the model linearised at the fit.
#
# Restricted likelihoods of different columns of B are no measure of each other.  Here those of base
# and markers, which every set has, are taken out, and the others of a set vary by their typical
# sizes S about nominal: y ~ N(0, s²I + B_S S² B_Sᵀ) in the coordinates that base and markers leave.


@dataclass(frozen=True)
class ParameterSet:
    """A set of parameters: how many are fitted, 3-D rms (m) of its residual and held out.
    `heldout_over_chosen`: its held-out rms less that of the parameters that were chosen, and `ci95`
    of this difference, by resampling configurations.  `log_likelihood`: restricted, less that of
    the chosen ones."""

    name: str
    parameters: int
    residual_rms: float
    heldout_rms: float
    heldout_over_chosen: float
    ci95: tuple[float, float]
    log_likelihood: float

    def to_json(self) -> dict[str, Any]:
        return {
            "set": self.name, "parameters": self.parameters,
            "residual_rms_um": microns(self.residual_rms),
            "heldout_rms_um": microns(self.heldout_rms),
            "heldout_over_chosen_um": microns(self.heldout_over_chosen),
            "ci95_um": [microns(v) for v in self.ci95], "log_likelihood": self.log_likelihood,
        }  # fmt: skip


CHOSEN = "chosen"
DRAWS = 1000


def parameter_sets(fit: FoundFit) -> tuple[ParameterSet, ...]:
    """Base and markers alone, with geometry, with compliance, with what was chosen, and with all
    that is told apart at all; those that are the same as another once."""
    model, free, stage = fit.model, ~fit.model.shrunk, fit.stage
    fitted = np.isin(np.arange(len(stage)), fit.columns) & free
    observed, weights, size = fit.observations, fit.weights, fit.observations.size
    white, typical, usual = weights.apply(fit.B), model.sizes(fit.B), np.flatnonzero(free)
    parameters = tuple(model.parameters[c] for c in usual)
    apart = usual[reduce(white[:, usual], typical[usual], parameters, 1.0, 0.0).kept]
    # As many columns as rows fit anything.
    every = np.isin(np.arange(len(stage)), apart) if len(apart) < len(white) else fitted
    named = {
        "base and markers": fitted & (stage == 0),
        "with geometry": fitted & (stage <= 1),
        "with compliance": fitted & (stage != 1),
        CHOSEN: fitted,
        "all that readings tell apart": every,
    }
    sets: dict[bytes, tuple[str, BoolArray, Array]] = {}
    for name, own in named.items():
        if own.any() and (name == CHOSEN or own.tobytes() not in sets):
            B = _by_itself(fit, np.flatnonzero(own))
            if B.any(axis=0).all():  # a base turns no deflections of an arm that does not yield
                sets[own.tobytes()] = name, own, B
    if len(sets) < 2:
        return ()
    moves = np.where(fitted & (stage > 0), fit.x - model.nominal, 0.0)
    y = fit.residual + fit.B @ moves
    e, target = weights.apply(fit.residual), weights.apply(y)
    s2 = float(e @ e) / max(fit.dof, 1)
    held, plain, likelihood = list[Array](), list[float](), list[float]()
    for _, own, B in sets.values():
        # Whole rows count by the fit's weights, whatever the set.
        columns = np.flatnonzero(own)
        left, alone = _refitted(fit, y, B, weights)
        plain.append(rms_3d(left, size))
        held.append((alone.reshape(-1, size)[:, :3] ** 2).sum(axis=1))
        # log density off the span of what is placed, the others varying by their typical sizes.
        B, placed = weights.apply(B), stage[columns] == 0
        A, off = B[:, ~placed] * typical[columns[~placed]], target
        if placed.any():
            basis = linalg.qr(B[:, placed], mode="economic")[0]
            A, off = A - basis @ (basis.T @ A), off - basis @ (basis.T @ off)
        at = Standardised.of(A.T @ A, A.T @ off, np.full(A.shape[1], 1 / np.sqrt(s2)))
        likelihood.append(-0.5 * (at.log_det + (float(off @ off) - at.explained) / s2))
    _, code = np.unique(observed.configuration, return_inverse=True)
    squares = np.array([np.bincount(code, h) for h in held])
    drawn = _drawn_rms(squares, np.bincount(code), np.random.default_rng(0))
    rms = [float(np.sqrt(h.mean())) for h in held]
    first = [name for name, *_ in sets.values()].index(CHOSEN)
    found = []
    for k, (name, own, _) in enumerate(sets.values()):
        over = drawn[k] - drawn[first] if np.isfinite(held[k]).all() else np.full(DRAWS, np.inf)
        low, high = (float(v) for v in np.quantile(over, [0.025, 0.975], method="nearest"))
        found.append(
            ParameterSet(
                name, int(own.sum()), plain[k], rms[k], rms[k] - rms[first], (low, high),
                likelihood[k] - likelihood[first],
            )
        )  # fmt: skip
    return tuple(found)


def _by_itself(fit: FoundFit, columns: IntArray) -> Array:
    """B (rows, columns) with what belongs to later stages at nominal: what moves the load would
    else pass for the compliances under it."""
    later = (fit.stage > fit.stage[columns].max(initial=0)) & (fit.x != fit.model.nominal)
    if not later.any():
        return fit.B[:, columns]
    x, observed = np.where(later, fit.model.nominal, fit.x), fit.observations
    return fit.model.regressor(observed.table, x, columns, observed).B


def _refitted(fit: FoundFit, y: Array, B: Array, weights: Weights) -> tuple[Array, Array]:
    observed = fit.observations
    left = y - B @ least_norm(weights.apply(B), weights.apply(y))
    return left, held_out_residual(B, left, weights, observed.configuration, observed.size)


def stage_of(effect: str) -> int:
    """0 for what places base and markers, 1 for geometry, 2 for what yields under load."""
    known = CATALOGUE[effect]
    if known.registered:
        return 0
    return 2 if known.stage in ("compliance", "load") else 1


@dataclass(frozen=True)
class UncertaintyBudget:
    """3-D rms errors (m) of a reading that was not fitted, by source; the squares add up.

    `parameters`: the estimates' own, at the poses of `at`; `open_parameters`: typical deviations
    of those left open.  `repeatability`: what readings of a visit share, scatter of joints and
    drift included.  `lack_of_fit`: what configurations scatter by beyond that and the noise, as in
    the error expected at new poses.  `instrument`: the rest, of single readings.
    """

    parameters: float
    open_parameters: float
    repeatability: float
    instrument: float
    lack_of_fit: float
    at: str

    @property
    def parts(self) -> dict[str, float]:
        return {k: v for k, v in vars(self).items() if k != "at"}

    @property
    def total(self) -> float:
        return float(np.sqrt(sum(p**2 for p in self.parts.values())))

    def to_json(self) -> dict[str, Any]:
        told = self.parts | {"total": self.total}
        return {"at": self.at, **{f"{k}_um": microns(v) for k, v in told.items()}}


def uncertainty_budget(
    fit: FoundFit, arm: CalibratedArm, fitted: float, table: Measurements | None = None
) -> UncertaintyBudget:
    """`fitted`: the part of the lack of fit (m²) that residuals have."""
    B, at = fit.B, "the poses fitted"
    if table is not None:
        B, at = fit.model.regressor(table, fit.x).B, table.source
    own, left = mean_squares(arm, B, fit.observations.size)
    visits, readings = (fit.noise_parts.get(part, 0.0) for part in ("visits", "readings"))
    lack = min(max(fitted - visits, 0.0), readings)
    beyond = lack * arm.lacking**2 / fitted if fitted else 0.0
    squares = (own, left, visits, readings - lack, beyond)
    parameters, open_, shared, single, beyond = np.sqrt(squares).tolist()
    return UncertaintyBudget(parameters, open_, shared, single, beyond, at)


STAGES = ("nominal_arm", "geometry", "compliance", "smooth functions")
MOST_BUDGETED = 30_000_000  # numbers of a regressor held at once; larger tables get no budget


@dataclass(frozen=True)
class BudgetStep:
    """A step of a gap budget: 3-D rms error (m) on configurations left out of the fit, and the
    error (N, 3) in m of every reading (of distances (N, 1))."""

    step: str
    heldout_rms: float
    ci95: tuple[float, float]
    errors: Array = field(default_factory=lambda: np.zeros((0, 3)), compare=False)


@dataclass(frozen=True)
class ErrorBudget:
    """The steps, and what noise alone gives (m, None where nothing says it), in words."""

    steps: tuple[BudgetStep, ...]
    floor: float | None
    floor_name: str


def gap_budget(result: FoundFit) -> ErrorBudget | None:
    """Held-out 3-D errors as the model gains base and markers, geometry, compliance, smooth
    functions; None where some configuration cannot be left out, and for tables too large to do it
    in passing.

    Each step fits the parameters of its stages that the whole fit determined, the later ones held
    at nominal, on the model linearised there; each configuration is predicted by the fit to the
    others, the last step as the result has it.  The first step is "nominal_arm", with base and
    markers placed by the others.  Intervals are by resampling configurations.
    """
    model = result.model
    large = len(result.residual) * len(result.determined) > MOST_BUDGETED
    if large or not np.isfinite(result.held_out).all():
        return None
    stage = np.where(model.shrunk, len(STAGES) - 1, result.stage)
    determined, observed = np.isin(model.names, result.determined), result.observations
    last = int(stage[determined].max(initial=0))
    _, code = np.unique(observed.configuration, return_inverse=True)
    rng, steps = np.random.default_rng(0), []
    for k in range(last + 1):
        if 0 < k < last and not (determined & (stage == k)).any():
            continue
        columns = np.flatnonzero(determined & (stage <= k))
        residual = result.held_out if k == last else _fitted(result, columns, stage > k)
        if np.isfinite(residual).all():
            parts = residual.reshape(-1, observed.size)[:, :3]
            squares = np.bincount(code, (parts**2).sum(axis=1))
            rms, ci95 = resampled_rms(squares, np.bincount(code), rng)
            steps.append(BudgetStep(STAGES[k], rms, ci95, parts))
    return ErrorBudget(tuple(steps), *_floor(result))


def _fitted(result: FoundFit, columns: IntArray, held: BoolArray) -> Array:
    """Held-out residual (rows,) with `columns` fitted and the parameters `held` at nominal."""
    model, B = result.model, _by_itself(result, columns)
    weights = weights_for(result.observations, model.cell.tracker, "auto")
    y = result.residual + result.B @ np.where(held, result.x - model.nominal, 0.0)
    if result.smooth and len(columns):
        # What has a prior in the whole fit has none here: a minimal complete set.
        own = tuple(model.parameters[c] for c in columns)
        sizes = np.array([p.typical or 1.0 for p in own])
        sigma = max(float(np.sqrt(np.mean(weights.apply(y) ** 2))), 1e-300)
        B = B[:, reduce(weights.apply(B), sizes, own, sigma, WORTH_A_COLUMN).kept]
    return _refitted(result, y, B, weights)[1] if B.shape[1] else y


def _floor(result: FoundFit) -> tuple[float | None, str]:
    observed = result.observations
    parts = result.residual.reshape(-1, observed.size)[:, :3]
    square, dof = pure_error(observed.place, parts)
    dof //= parts.shape[1]
    if dof >= FEWEST_REPEATS:
        return float(np.sqrt(square / dof)), "repeats alone"
    if ratio := result.noise.ratio_to_stated:
        scatter = result.residual_rms * float(np.sqrt(len(result.residual) / result.dof))
        return scatter / float(ratio), "stated noise"
    return None, ""


def pose_accuracy(observed: Observations, errors: Array) -> Array:
    """AP (places,) in m as ISO 9283 has it: how far the mean of the readings of one place lies from
    where it should, of errors (N, 3) in m."""
    code = observed.place
    mean = np.column_stack([np.bincount(code, e) for e in errors.T]) / np.bincount(code)[:, None]
    return np.asarray(np.linalg.norm(mean, axis=1))


def resampled_rms(
    squares: NDArray[Any], count: NDArray[Any], rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """The rms √(Σ squares / Σ count) of configurations (C,) and its 95 % interval."""
    low, high = np.quantile(_drawn_rms(squares, count, rng), [0.025, 0.975])
    return float(np.sqrt(squares.sum() / count.sum())), (float(low), float(high))


def _drawn_rms(squares: Array, count: IntArray, rng: np.random.Generator) -> Array:
    """The rms (…, draws) by weights of configurations that a Dirichlet distribution draws for
    squares (…, C) and count (C,): the Bayesian bootstrap."""
    weight = rng.dirichlet(np.ones(len(count)), DRAWS)
    return np.asarray(np.sqrt(squares @ weight.T / (weight @ count)))
