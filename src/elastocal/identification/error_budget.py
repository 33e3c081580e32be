"""The error budget: where the error of the nominal arm goes, step by step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.prediction import FEWEST_REPEATS
from elastocal.identification.residuals import held_out_residual
from elastocal.identification.result import Calibration
from elastocal.identification.scrutiny import stage_of
from elastocal.identification.solve import WORTH_A_COLUMN, reduce
from elastocal.identification.weighted_problem import least_norm, weights_for
from elastocal.model.observations import Observations, pure_error
from elastocal.units import Array

STAGES = ("nominal_arm", "geometry", "compliance", "smooth functions")
MOST_NUMBERS = 30_000_000  # of a regressor held at once; larger tables get no budget
DRAWS = 1000


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


def gap_budget(result: Calibration) -> ErrorBudget | None:
    """Held-out 3-D errors as the model gains base and markers, geometry, compliance, smooth
    functions.

    Each step fits the parameters of its stages that the whole fit determined, the later ones held
    at nominal, on the model linearised at the whole fit; each configuration is predicted by
    the fit to the others (`held_out_residual`), the last step as the result has it.  The first
    step is "nominal_arm", with base and markers placed by the other configurations.  Intervals are
    by resampling configurations.  None where some configuration cannot be left out, and for tables
    too large to do it in passing.
    """
    model = result.model
    if len(result.residual) * len(result.determined) > MOST_NUMBERS:
        return None
    if not np.isfinite(result.held_out).all():
        return None
    stage = np.array([stage_of(p.effect) for p in model.parameters], dtype=np.int64)
    stage[model.shrunk] = len(STAGES) - 1
    determined = np.isin(model.names, result.determined)
    last = int(stage[determined].max(initial=0))
    rng = np.random.default_rng(0)
    steps = []
    for k in range(last):
        if k and not (determined & (stage == k)).any():
            continue
        residual = _fitted(result, np.flatnonzero(determined & (stage <= k)), stage > k)
        if residual is not None:
            steps.append(_step(STAGES[k], result, residual, rng))
    steps.append(_step(STAGES[last], result, result.held_out, rng))
    return ErrorBudget(tuple(steps), *_floor(result))


def _fitted(
    result: Calibration, columns: NDArray[np.int64], held: NDArray[np.bool_]
) -> Array | None:
    """Held-out residual (rows,) with `columns` fitted and the parameters `held` at nominal, by the
    model linearised at the whole fit."""
    model, observed, B = result.model, result.observations, result.B
    weights = weights_for(observed, model.cell.tracker, "auto")
    y = result.residual + B @ np.where(held, result.x - model.nominal, 0.0)
    white, error = weights.apply(B[:, columns]), weights.apply(y)
    if result.smooth and len(columns):
        # What has a prior in the whole fit has none here: a minimal complete set.
        own = tuple(model.parameters[c] for c in columns)
        sizes = np.array([p.typical or 1.0 for p in own])
        sigma = max(float(np.sqrt(np.mean(error**2))), 1e-300)
        kept = reduce(white, sizes, own, sigma, WORTH_A_COLUMN).kept
        columns, white = columns[kept], white[:, kept]
    if not len(columns):
        return y
    residual = y - B[:, columns] @ least_norm(white, error)
    found = held_out_residual(
        B[:, columns], residual, weights, observed.configuration, observed.size
    )
    return found if np.isfinite(found).all() else None


def _step(name: str, result: Calibration, residual: Array, rng: np.random.Generator) -> BudgetStep:
    observed = result.observations
    parts = residual.reshape(-1, observed.size)[:, :3]
    squared = (parts**2).sum(axis=1)
    _, code = np.unique(observed.configuration, return_inverse=True)
    rms, ci95 = resampled_rms(np.bincount(code, squared), np.bincount(code), rng)
    return BudgetStep(name, rms, ci95, parts)


def _floor(result: Calibration) -> tuple[float | None, str]:
    """What repeats scatter, else what the stated noise gives."""
    observed = result.observations
    parts = result.residual.reshape(-1, observed.size)[:, :3]
    square, dof = pure_error(observed.place, parts)
    dof //= parts.shape[1]
    if dof >= FEWEST_REPEATS:
        return float(np.sqrt(square / dof)), "repeats alone"
    ratio = result.noise.ratio_to_stated
    if ratio:
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
    """The rms √(Σ squares / Σ count) of configurations (C,) and its 95 % interval, by weights that
    a Dirichlet distribution draws for them (the Bayesian bootstrap)."""
    rms = float(np.sqrt(squares.sum() / count.sum()))
    weight = rng.dirichlet(np.ones(len(squares)), DRAWS)
    drawn = np.sqrt((weight @ squares) / (weight @ count))
    low, high = np.quantile(drawn, [0.025, 0.975])
    return rms, (float(low), float(high))
