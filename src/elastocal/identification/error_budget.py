"""Where the error of the nominal arm goes, step by step, as an identification can tell it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError
from elastocal.identification.residuals import held_out_residual
from elastocal.identification.result import Calibration
from elastocal.identification.weighted_problem import weights_for
from elastocal.model.effects import CATALOGUE
from elastocal.units import Array

STAGES = ("nominal_arm", "geometry", "compliance")
MOST_NUMBERS = 30_000_000  # of a regressor held at once; larger tables get no budget
STEPS, SETTLED = 4, 1e-3  # Gauss-Newton steps, and the relative gain that ends them
DRAWS = 1000
FEWEST_REPEATS = 10  # degrees of freedom within repeats from which on they tell the noise


@dataclass(frozen=True)
class BudgetStep:
    """A step of a gap budget: 3-D rms error (m) on configurations left out of the fit."""

    step: str
    heldout_rms: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class ErrorBudget:
    """The steps, and what noise alone gives (m, None where nothing says it), in words."""

    steps: tuple[BudgetStep, ...]
    floor: float | None
    floor_name: str


def gap_budget(result: Calibration) -> ErrorBudget | None:
    """Held-out 3-D errors as the model gains base and markers, geometry, compliance.

    Each step fits the parameters of its stages that the whole fit determined, the later ones held
    at nominal, by a few Gauss-Newton steps from the whole fit; each configuration is predicted by
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
    """Held-out residual (rows,) with `columns` fitted and the parameters `held` at nominal."""
    model, observed = result.model, result.observations
    weights = weights_for(observed, model.cell.tracker, "auto")
    x = np.where(held, model.nominal, result.x)
    best: tuple[float, Array, Array] | None = None
    try:
        for _ in range(STEPS):
            at = model.regressor(observed.table, x, columns, observed)
            error = weights.apply(at.residual)
            cost = float(error @ error)
            if best is not None and cost > (1 - SETTLED) * best[0]:
                break
            best = cost, at.B, at.residual
            if not len(columns):
                break
            x = x.copy()
            x[columns] += np.linalg.lstsq(weights.apply(at.B), error, rcond=None)[0]
    except (ElastocalError, np.linalg.LinAlgError):
        return None  # the arm without its compliances stands nowhere near: no step of a budget
    assert best is not None
    _, B, residual = best
    if not len(columns):
        return residual
    found = held_out_residual(B, residual, weights, observed.configuration, observed.size)
    return found if np.isfinite(found).all() else None


def _step(name: str, result: Calibration, residual: Array, rng: np.random.Generator) -> BudgetStep:
    observed = result.observations
    squared = (residual.reshape(-1, observed.size)[:, :3] ** 2).sum(axis=1)
    _, code = np.unique(observed.configuration, return_inverse=True)
    rms, ci95 = resampled_rms(np.bincount(code, squared), np.bincount(code), rng)
    return BudgetStep(name, rms, ci95)


def _floor(result: Calibration) -> tuple[float | None, str]:
    """What repeats scatter, else what the stated noise gives."""
    observed = result.observations
    force = np.round(observed.table.force[observed.lead], 3)
    key = np.column_stack([observed.configuration, observed.table.marker[observed.lead], force])
    _, code = np.unique(key, axis=0, return_inverse=True)
    code = code.ravel()
    parts = result.residual.reshape(-1, observed.size)[:, :3]
    dof = len(parts) - int(code.max()) - 1
    if dof >= FEWEST_REPEATS:
        count = np.bincount(code)
        mean = np.column_stack([np.bincount(code, p) / count for p in parts.T])
        return float(np.sqrt(((parts - mean[code]) ** 2).sum() / dof)), "repeats alone"
    ratio = result.noise.ratio_to_stated
    if ratio:
        scatter = result.residual_rms * float(np.sqrt(len(result.residual) / result.dof))
        return scatter / float(ratio), "stated noise"
    return None, ""


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


def stage_of(effect: str) -> int:
    """0 for what places base and markers, 1 for geometry, 2 for what yields under load."""
    known = CATALOGUE[effect]
    if known.registered:
        return 0
    return 2 if known.stage in ("compliance", "load") else 1
