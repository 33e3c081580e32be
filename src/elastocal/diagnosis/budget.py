"""The gap, step by step: from the nominal arm through the fitted effects to the noise floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.found import Found
from elastocal.diagnosis.heldout import (
    Labels,
    blocks_of_time,
    left_out_residual,
    noise_rms,
    rms_with_interval,
)
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import ModelSet, with_items
from elastocal.diagnosis.noise import NoisyData
from elastocal.diagnosis.projection import project
from elastocal.diagnosis.result import Gap
from elastocal.diagnosis.scene import Scene
from elastocal.identification.error_budget import BudgetStep, stage_of
from elastocal.manipulator.effects.placements import BaseFrame

Array = NDArray[np.float64]


def budget(
    scene: Scene, found: Found, rng: np.random.Generator
) -> tuple[Gap, tuple[BudgetStep, ...]]:
    """Held-out 3-D errors of each step, and the gap they add up to.

    `scene` is about the fit without further effects.  Where an effect goes with time, what is
    left out are tenths of the time: between neighbours a drift needs no model.
    """
    nothing, chosen = found.nothing, found.chosen
    together = _left_out_together(scene, chosen)
    # The nominal arm, base and markers placed, as the baseline left it.
    placed = scene.blocks.pack(scene.base.nominal.reshape(-1, scene.blocks.size, 1))[:, :, 0]
    steps = [BudgetStep(BaseFrame.name, *rms_with_interval(scene.data, placed, rng))]
    steps += [_step(name, data, nothing, together, rng) for name, data in _fitted_steps(scene)]
    known = [k for k, item in enumerate(chosen.items) if item.known]
    for n in range(len(known)):
        part = known[: n + 1]
        items = tuple(chosen.items[k] for k in part)
        scales = tuple(chosen.scales[k] for k in part)
        data = with_items(found.scene, items, scales)
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


def _left_out_together(scene: Scene, chosen: ModelSet) -> Labels | None:
    time, cell = scene.base.seen.table.time, scene.base.model.cell
    known = [item.what for item in chosen.items if isinstance(item.what, Hypothesis)]
    if time is None or not any("time" in what.effect.needed(cell) for what in known):
        return None
    return blocks_of_time(scene.blocks, time[scene.base.seen.lead])


def _step(
    name: str,
    data: NoisyData,
    fitted: ModelSet,
    together: Labels | None,
    rng: np.random.Generator,
) -> BudgetStep:
    # Weights of an ordinary calibration: the scatter of joints that is fitted beside a missing
    # effect is that effect, and weights by it would spare it.
    residual = left_out_residual(project(data, fitted.noise.of_instrument()), together)
    rms, interval = rms_with_interval(data, residual, rng)
    return BudgetStep(name, rms, interval)


def _fitted_steps(scene: Scene) -> list[tuple[str, NoisyData]]:
    """The model's own effects, stage by stage, those of the later step held at nominal."""
    stage = np.array([stage_of(effect) for effect in scene.fitted.effect])
    steps = []
    for k, name in ((1, "geometry"), (2, "compliance")):
        if not (stage == k).any():
            continue
        free = stage <= k
        data = scene.data
        steps.append(
            (
                name,
                replace(data, X=data.X[:, :, free], precision=data.precision[free]),
            )
        )
    return steps
