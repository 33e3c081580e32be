"""Which poses next, and whether more are worth measuring: plans from what was measured so far.

The arm is diagnosed and identified, and effects found join the model.  The next poses make the
error at the test poses small, with all readings so far.  What the model may lack besides is in the
errors that are stated: as much as configurations scatter beyond their noise, with the probability
that something unknown is at work.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from elastocal.above import DataFrame, Result, checked_arguments
from elastocal.cell import Cell
from elastocal.cell_tables import TEST_POSE
from elastocal.diagnosis.diagnose import FEWEST, DiagnosisOptions, diagnose
from elastocal.diagnosis.diagnosis import Diagnosis, FoundEffect
from elastocal.diagnosis.extra_poses import load_forces
from elastocal.identification.identify import identify
from elastocal.identification.prediction import over_the_workspace, predicted_error
from elastocal.identification.result import Calibration
from elastocal.measurements import Measurements
from elastocal.messages import InsufficientDataError, length, option
from elastocal.messages import require as check
from elastocal.model.manipulator import Model, measurements_of
from elastocal.planning.design import DesignOptions, design
from elastocal.planning.information import lacks_noise, with_noise_of
from elastocal.planning.plan import Gain, Plan
from elastocal.planning.poses import shares_of, used_poses
from elastocal.units import Progress

# A hundred candidates that are less likely are together a doubt of a tenth at most.
DOUBT = 1e-3
APART = 1.25  # more than the bound of 97.5 % is above that of 95 %

NextVerdict = Literal["measure", "enough", "no_gain"]


@dataclass(frozen=True, repr=False, eq=False)
class NextPoses(Result):
    """The next poses to measure, or why none are needed.

    Attributes:
        verdict: "measure"; "enough", the required error is kept with 95 %; "no_gain", no batch
            lowers the error by `least_gain`, a share of it.
        plan: The poses; None where nothing more is to be measured.
        gain: What the batch adds, with and without what the model may lack, in m.
        required: The error at new poses that is asked for, in m; None where none is.
        reached: The error that the model as it is now keeps with 95 %, in m.
        source: The readings that it is said of.
        diagnosis: Of these readings; None for fewer than can be diagnosed.
        calibration: The arm identified with what was found; None where they do not suffice.
    """

    verdict: NextVerdict
    plan: Plan | None
    batch: int
    gain: Gain
    required: float | None
    reached: float
    least_gain: float = 0.01
    source: str = ""
    diagnosis: Diagnosis | None = None
    calibration: Calibration | None = None

    @property
    def found(self) -> tuple[FoundEffect, ...]:
        """The effects that the diagnosis found, which the model then has."""
        return () if self.diagnosis is None else self.diagnosis.effects

    @property
    def doubts(self) -> tuple[tuple[str, str, float], ...]:
        """What it may lack besides, or instead: effect, place and probability, likeliest first."""
        found = {(f.effect, f.where) for f in self.found}
        # Candidates are judged one at a time: where many causes are found together, beside none.
        why = self.diagnosis
        every = () if why is None or why.groups else why.candidates
        likely = ((c.effect, c.where, c.probability) for c in every if c.probability > DOUBT)
        return tuple(sorted((c for c in likely if c[:2] not in found), key=lambda c: -c[2]))

    @property
    def beside(self) -> float | None:
        """The bound of identify (m), where it is more than APART times as large, or alone more than
        is required."""
        alone = None if self.calibration is None else self.calibration.verdict.at
        most = APART * self.reached
        most = min(most, self.required or most) if self.verdict == "enough" else most
        return alone if alone is not None and alone > most else None

    def __repr__(self) -> str:
        told = f"at most {length(self.reached)} with 95 %"
        return f"<NextPoses {self.verdict}: {told}, {self.batch} more poses>"

    def to_json(self) -> dict[str, Any]:
        """The answer as numbers and texts; lengths in m."""
        return {
            "schema": "elastocal/next/1",
            "verdict": self.verdict,
            "required": self.required,
            "reached": self.reached,
            "batch": self.batch,
            "least_gain": self.least_gain,
            "gain": asdict(self.gain),
            "found": [{"effect": f.effect, "where": f.where, "probability": f.probability}
                      for f in self.found],
            "doubts": [{"effect": e, "where": w, "probability": p} for e, w, p in self.doubts],
            "plan": None if self.plan is None else self.plan.to_json(),
        }  # fmt: skip


@checked_arguments
def next_poses(
    model: Model | Cell | str | Path,
    data: Measurements | str | Path | DataFrame,
    *,
    batch: int = 5,
    require: float | None = None,
    least_gain: float = 0.01,
    candidates: int = 400,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress | None = None,
) -> NextPoses:
    """Which poses should I measure next, or are these enough?

    The data are diagnosed and identified, and effects found join the model.  The next poses make
    the error at the test poses small.  "Enough" includes possible model error: the scatter beyond
    noise, times the probability of an unknown effect.

    Args:
        model: The model, or a cell, or the path of a cell file.
        data: All readings so far, or their file.
        batch: Number of poses.
        require: Error in m at new poses that has to be kept with 95 %; default the cell's.
        least_gain: Share of the error, 0 to below 1, by which a batch has to lower it to pay.
        candidates: Feasible candidates to choose from.
        seed: Of all random draws.
        jobs: Processes; −1 for all cores.
        progress: Is told what is done.

    Returns:
        The `NextPoses`: verdict, plan, what it adds.

    Raises:
        InputError: Data contradict robot or cell, or an option is wrong.
        InsufficientDataError: No pose is feasible.

    Examples:
        >>> cell = ec.read_cell("cell.toml")
        >>> more = ec.next_poses(cell, "data.csv", batch=5, candidates=60)
        >>> more.verdict, len(more.plan)
        ('measure', 5)
    """
    check(batch >= 1, f"{option('batch')} takes a number of poses, found {batch}")
    told = f"{option('require')} takes an error in m, found {require}"
    check(require is None or require > 0, told)
    check(0 <= least_gain < 1, f"{option('least_gain')} takes a share from 0 to below 1")
    tell: Progress = progress or (lambda message: None)
    model = model if isinstance(model, Model) else Model(model)
    table = measurements_of(model, data)
    model = model.with_markers_of(table)
    asked = _asked(model.cell, table, batch, candidates)
    shares_of(asked, batch, "batch")  # each level takes a pose
    unstated, why, fit, sure, lacking = lacks_noise(asked), None, None, math.inf, 0.0
    if len(np.unique(table.configuration)) >= FEWEST:
        tell("diagnosing")
        why = diagnose(model, table, DiagnosisOptions(seed), tell)
        model = with_effects_of(model, why)
    tell("identifying")
    with suppress(InsufficientDataError):  # then these are not enough
        fit = identify(model, table, new_poses=used_poses(model.cell, model.chain))
        sure, lacking = _error_now(fit, 1.0 if why is None else why.probability_unknown)
    cell, notes = replace(model.cell, design=asked.design), tuple[str, ...]()
    if fit is not None and (unstated or fit.finding("stated_noise_too_small")):
        cell, notes = with_noise_of(cell, fit)
    options = DesignOptions("batch", seed, jobs, done=table, notes=notes, hold=True)
    plan = design(cell, options, progress=tell)
    assert plan.gain is not None  # the criterion has test poses
    own = plan.gain.sure
    reached = max(own, sure) if sure else math.hypot(own, lacking)
    plan = replace(plan, gain=(gain := plan.gain.lacking(lacking, reached)))
    required = model.cell.require.new_poses if require is None else require
    verdict = verdict_of(gain, reached, required, least_gain)
    return NextPoses(
        verdict, plan if verdict == "measure" else None, len(plan), gain, required, reached,
        least_gain, table.source, why, fit,
    )  # fmt: skip


def _asked(cell: Cell, table: Measurements, batch: int, candidates: int) -> Cell:
    spec = cell.design
    return replace(cell, design=replace(
        spec, poses=batch, per_level=(), target=None, criterion=TEST_POSE, candidates=candidates,
        loads=load_forces(table) if spec.loads is None else spec.loads,
        # A joint whose compliance is known at its levels only can be nowhere else.
        levels=spec.levels or cell.model.compliance_levels,
    ))  # fmt: skip


def _error_now(fit: Calibration, unknown: float) -> tuple[float, float]:
    """The error at new poses that is kept with 95 %, and what the model lacks of it, in m; 0 and
    that of distances, of which no position follows: the plan's own figures say it.  That
    configurations scatter beyond their noise is lack of fit with the probability that something
    `unknown` is at work; else it is their noise."""
    model, observed, rng = fit.model, fit.observations, np.random.default_rng(0)
    excess = None if fit.excess is None else fit.excess.with_chance(unknown, rng)
    if observed.kind == "distance":
        return 0.0, math.sqrt(3 * excess.squared.mean()) if excess else 0.0
    cell, table = model.cell, observed.table
    poses = used_poses(cell, model.chain) or over_the_workspace(cell, model, table)
    error = predicted_error(fit.arm, observed, excess, fit.spread, poses, rng)
    return (math.inf, 0.0) if error is None else (error.sure, error.lacking or 0.0)


def verdict_of(
    gain: Gain, reached: float, required: float | None, least_gain: float
) -> NextVerdict:
    """Whether to measure a batch with this gain, where `reached` is kept and `required` asked."""
    if required is not None and reached <= required:
        return "enough"
    pays = not np.isfinite(gain.before) or gain.after < (1 - least_gain) * gain.before
    return "measure" if pays else "no_gain"


def with_effects_of(model: Model, why: Diagnosis) -> Model:
    """The model with the effects that a diagnosis found, at their settings."""
    spec = replace(model.cell.model, **why.model_keys)  # type: ignore[arg-type]
    for f in why.effects:
        spec = spec.with_effect(f.effect, f.where, f.settings, f.sizes)
    return Model.assembled(model.chain, replace(model.cell, model=spec)) if why.effects else model
