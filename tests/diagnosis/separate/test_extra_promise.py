"""What a plan of extra poses promises is kept: a Monte Carlo over campaigns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import softmax
from support.rivals import ECCENTRIC, REPEATABILITY, SCALE, Key, campaign, diagnosis_of, measured

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.diagnosis_data import diagnosis_data_of
from elastocal.diagnosis.discrimination import joined
from elastocal.diagnosis.evidence import direct
from elastocal.diagnosis.extra_poses import plan_extra
from elastocal.diagnosis.hypotheses import possible
from elastocal.diagnosis.noise_floor import NoiseValues, project
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.simulation.simulate import expand_plan
from elastocal.units import Array

RIVALS: tuple[Key, ...] = (ECCENTRIC, SCALE)
RUNS = 60
SIN, COS = "joint3.eccentricity_sin", "joint3.eccentricity_cos"


def log_evidence(model: Model, table: Measurements, x0: Array, key: Key) -> float:
    """Log marginal likelihood of one effect beside the fitted ones, by the diagnosis' own means."""
    h = next(h for h in possible(model, table)[0] if (h.name, h.where) == key)
    base = fit_baseline(model, table, x0=x0)
    dataset = diagnosis_data_of(base, [h])
    at = project(dataset.data, NoiseValues(1.0, np.full(6, REPEATABILITY), np.full(6, 1e-3)))
    return float(direct(dataset.data.masked(dataset.packed(h, np.zeros(0))), at).evidence()[0])


@pytest.mark.long
def test_the_right_rival_is_named_as_often_as_promised() -> None:
    """Arms with either effect, the plan made from the first half and measured by the simulator:
    the evidence of all readings names the right one as often as the plans expected."""
    promised, right = [], []
    rng = np.random.default_rng(11)
    for k in range(RUNS):
        posterior_draw = RIVALS[k % 2]
        values = {SIN: rng.normal(0, 6e-5), COS: rng.normal(0, 6e-5)}
        if posterior_draw == SCALE:
            values = {"joint3.encoder_scale": rng.normal(0, 1.5e-4)}
        model, table = campaign(values, 1.0, seed=k, n=20)
        x0 = fit_baseline(model, table).x
        before = softmax([log_evidence(model, table, x0, key) for key in RIVALS])
        extra = plan_extra(
            model, table, diagnosis_of(dict(zip(RIVALS, before, strict=True))), most=1
        )
        promised.append(extra.probability_after)
        whole = table
        if extra.plan is not None:
            rows = expand_plan(extra.plan, table.marker_names)
            shifted = replace(
                rows,
                configuration=rows.configuration + 20,
                configuration_labels=(*table.configuration_labels, *rows.configuration_labels),
                repeat=np.zeros_like(rows.repeat),
            )
            whole = joined(table, measured(shifted, values, 1000 + k))
        after = {key: log_evidence(model, whole, x0, key) for key in RIVALS}
        right.append(max(after, key=lambda key: after[key]) == posterior_draw)
    spread = np.sqrt(np.mean(promised) * (1 - np.mean(promised)) / len(right))
    assert 0.75 < np.mean(promised) < 0.97  # else the test could not fail
    assert abs(np.mean(right) - np.mean(promised)) < 2.5 * spread
