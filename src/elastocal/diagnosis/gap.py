"""Where the gap lies: stage and place, the shape of the dependence, and the budget by step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from elastocal.diagnosis.diagnosis import Curve, Gap, Location, StructureTest
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.effect_search import SelectedEffects
from elastocal.diagnosis.evidence import Scan, exceedance
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import ModelSet, with_items
from elastocal.diagnosis.noise_floor import NoisyData, project
from elastocal.diagnosis.shrinkage import (
    blocks_of_time,
    left_out_residual,
    noise_rms,
    rms_with_interval,
)
from elastocal.identification.error_budget import BudgetStep, stage_of
from elastocal.model.effects.placements import BaseFrame
from elastocal.units import Array, IntArray

# Where the gap lies: stage, place, and what the residual depends on, whatever the effect.


def structure_tests(observed: Scan) -> tuple[StructureTest, ...]:
    """One test per driver, most telling first; none names an effect.

    The statistic is the largest evidence among the driver's blocks; its distribution without
    structure comes from flipping the signs of whole configurations.
    """
    if not observed.covariate_flips:
        return ()
    largest = np.max(list(observed.covariate_flips.values()), axis=0)
    tests = [
        StructureTest(
            driver,
            exceedance(observed.covariate_flips[driver], odds),
            exceedance(largest, odds),
        )
        for driver, odds in observed.covariate_odds.items()
    ]
    order = sorted(tests, key=lambda t: (t.p_family, t.p_value, -observed.covariate_odds[t.driver]))
    return tuple(order)


def location(found: SelectedEffects, tests: tuple[StructureTest, ...]) -> Location | None:
    """Probabilities of stage and place, from all that could stand in the place of the unknown
    effect, or of the first one found."""
    if not found.chosen.items:
        return None
    items = found.chosen.items
    unknown = [k for k, item in enumerate(items) if not item.known]
    own = unknown[0] if unknown else 0
    slot = found.slots[own]
    each, _ = slot.probabilities()
    total = max(float(each.sum()), 1e-300)
    stages: dict[str, float] = {}
    places: dict[str, float] = {}
    for item, p in zip(slot.items, each / total, strict=True):
        stages[item.what.stage] = stages.get(item.what.stage, 0.0) + float(p)
        places[item.what.where] = places.get(item.what.where, 0.0) + float(p)
    what = items[own].what
    shown = {t.driver: t.p_value for t in tests}
    return Location(
        what.stage, what.where, places.get(what.where, 0.0), _sorted(stages), _sorted(places), shown
    )


def _sorted(shares: dict[str, float]) -> dict[str, float]:
    return {k: v for k, v in sorted(shares.items(), key=lambda kv: -kv[1]) if v > 1e-6}


# The shape of a dependence that has no name: the motion as a function of what drives it.

MOST_CURVES = 3
UNITS = {1: ("rad",), 3: ("m",) * 3, 6: ("m",) * 3 + ("rad",) * 3}
AXES = {1: ("",), 3: (" x", " y", " z"), 6: (" x", " y", " z", " rx", " ry", " rz")}


def curves_of(dataset: DiagnosisData, chosen: ModelSet) -> tuple[Curve, ...]:
    """Curves of the unknown blocks that depend on one number, the largest components first."""
    at = chosen.at
    out: list[Curve] = []
    for item, span in zip(chosen.items, chosen.spans, strict=True):
        block = item.what
        if isinstance(block, Hypothesis) or block.source is None or block.source.values is None:
            continue
        assert block.direction is not None and block.entry is not None
        there = dataset.present
        x = block.source.values[there]
        motion = block.direction[there] @ at.beta[span]  # (visits, d)
        half = block.direction[there] @ at.beta_deviation.T[span]
        deviation = np.linalg.norm(half, axis=2)
        _, order = np.unique(x, return_index=True)
        d = motion.shape[1]
        largest = np.argsort(-(motion.std(axis=0) / deviation.mean(axis=0)))
        for k in largest[: min(d, MOST_CURVES)]:
            y = motion[order, k]
            out.append(
                Curve(
                    block.covariate,
                    block.source.unit,
                    f"{block.where}{AXES[d][k]}",
                    UNITS[d][k],
                    _numbers(x[order]),
                    _numbers(y - y.mean()),
                    _numbers(deviation[order, k]),
                )
            )
    return tuple(out)


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


# The gap, step by step: from the nominal arm through the fitted effects to the noise floor.


def budget(
    dataset: DiagnosisData, found: SelectedEffects, rng: np.random.Generator
) -> tuple[Gap, tuple[BudgetStep, ...]]:
    """Held-out 3-D errors of each step, and the gap they add up to.

    `scene` is about the fit without further effects.  Where an effect goes with time, what is
    left out are tenths of the time: between neighbours a drift needs no model.
    """
    nothing, chosen = found.nothing, found.chosen
    together = _left_out_together(dataset, chosen)
    # The nominal arm, base and markers placed, as the baseline left it.
    placed = dataset.blocks.pack(dataset.base.nominal.reshape(-1, dataset.blocks.size, 1))[:, :, 0]
    steps = [BudgetStep(BaseFrame.name, *rms_with_interval(dataset.data, placed, rng))]
    steps += [_step(name, data, nothing, together, rng) for name, data in _fitted_steps(dataset)]
    known = [k for k, item in enumerate(chosen.items) if item.known]
    for n in range(len(known)):
        part = known[: n + 1]
        items = tuple(chosen.items[k] for k in part)
        scales = tuple(chosen.scales[k] for k in part)
        data = with_items(found.dataset, items, scales)
        steps.append(_step(items[-1].label.replace(" at ", ":"), data, chosen, together, rng))
    # Where the noise model does not fit, the readings still say what scatter they leave.
    left = rms_with_interval(chosen.data, left_out_residual(chosen.at, together), rng)[0]
    floor = min(noise_rms(chosen.data, chosen.noise), left)
    calibrated = steps[len(steps) - len(known) - 1].heldout_rms
    nominal = steps[0].heldout_rms
    gap = Gap(nominal, calibrated, steps[-1].heldout_rms, floor)
    unknown = [item.what.where for item in chosen.items if not item.known]
    if unknown:
        # What a smooth curve without a name takes away: no explanation, but how much is at stake.
        steps.append(_step("unknown:" + "+".join(unknown), chosen.data, chosen, together, rng))
    return gap, (*steps, BudgetStep("noise_floor", floor, (floor, floor)))


def _left_out_together(dataset: DiagnosisData, chosen: ModelSet) -> IntArray | None:
    time, cell = dataset.table.time, dataset.base.model.cell
    known = [item.what for item in chosen.items if isinstance(item.what, Hypothesis)]
    if time is None or not any("time" in what.effect.needed(cell) for what in known):
        return None
    return blocks_of_time(dataset.blocks, time[dataset.lead])


def _step(
    name: str,
    data: NoisyData,
    fitted: ModelSet,
    together: IntArray | None,
    rng: np.random.Generator,
) -> BudgetStep:
    # Weights of an ordinary calibration: the scatter of joints that is fitted beside a missing
    # effect is that effect, and weights by it would spare it.
    residual = left_out_residual(project(data, fitted.noise.of_instrument()), together)
    rms, interval = rms_with_interval(data, residual, rng)
    return BudgetStep(name, rms, interval)


def _fitted_steps(dataset: DiagnosisData) -> list[tuple[str, NoisyData]]:
    """The model's own effects, stage by stage, those of the later step held at nominal."""
    stage = np.array([stage_of(effect) for effect in dataset.fitted])
    steps = []
    for k, name in ((1, "geometry"), (2, "compliance")):
        if not (stage == k).any():
            continue
        free = stage <= k
        data = dataset.data
        steps.append(
            (
                name,
                replace(data, X=data.X[:, :, free], precision=data.precision[free]),
            )
        )
    return steps
