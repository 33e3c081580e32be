"""The weights of all links as one component: columns where the compliances are right."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from support.cells import COMPLIANCE, kr270_chain
from support.diagnosis_data import REPEATABILITY, SIGMA, Fault, cell, measured, plan

from elastocal.diagnosis import (
    DiagnosisData,
    Hypothesis,
    about_sum,
    catalogue_components,
    diagnosis_data_of,
    fit_baseline,
    fit_sum,
    judged_together,
)
from elastocal.diagnosis.noise_floor import NoiseValues
from elastocal.model import Model
from elastocal.model.effects.gravity_sag import LinkWeights
from elastocal.units import Array

MOMENTS = {"link2_moment_x": 500.0, "link2_moment_y": 40.0, "link3_moment_x": -230.0}
WEIGHTS = Fault("link_weights", "arm", MOMENTS)


@lru_cache
def heavy() -> tuple[DiagnosisData, Hypothesis]:
    chain, plain = kr270_chain(), cell(link_gravity=False)
    table = measured(chain, plain, [WEIGHTS], plan(chain, 40, 2), 2)
    model = Model.assembled(chain, plain)
    together = judged_together(model, table)
    dataset = diagnosis_data_of(fit_baseline(model, table), [])
    (h,) = (h for h in together if h.key == WEIGHTS.key)
    return dataset.changed(hypotheses=tuple(together)), h


def left(dataset: DiagnosisData, h: Hypothesis) -> float:
    """Rms in m of what the fitted parameters and the weights leave, by least squares."""
    data = dataset.data
    rows = ~data.left_out
    X = np.concatenate([data.X, dataset.packed(h, np.zeros(0))], axis=2)[rows]
    X = X[:, np.abs(X).max(axis=0) > 0]
    size = np.linalg.norm(X, axis=0)
    beta, *_ = np.linalg.lstsq(X / size, data.r[rows], rcond=1e-10)
    return float(np.sqrt(np.mean((data.r[rows] - X / size @ beta) ** 2)))


def compliances(dataset: DiagnosisData) -> Array:
    x = dict(zip(dataset.base.model.names, dataset.base.x, strict=True))
    return np.array([x[f"joint{k}.compliance"] for k in (2, 3)])


def test_where_nothing_yields_there_is_nothing_to_weigh() -> None:
    """Its columns are there for every cell that has springs, and zero where these are none."""
    dataset, h = heavy()
    assert np.abs(dataset.packed(h, np.zeros(0))).max() > 1e-4
    chain, stiff = kr270_chain(), cell(("base_frame", "joint_offset"), link_gravity=False)
    table = plan(chain, 10, 3)
    model = Model.assembled(chain, stiff)
    table = measured(chain, stiff, [], table, 3)
    bare = diagnosis_data_of(fit_baseline(model, table), [])
    (h,) = (h for h in judged_together(model, table) if h.key == WEIGHTS.key)
    assert not bare.changed(hypotheses=(h,)).packed(h, np.zeros(0)).any()


def summed(dataset: DiagnosisData, *effects: str) -> DiagnosisData:
    """The data about the sum of all components of these effects, twice as a search does."""
    for _ in range(2):
        some = [c for c in catalogue_components(dataset) if c.effect.name in effects]
        found = fit_sum(dataset.data, some, NoiseValues.usual(6))
        assert LinkWeights.name in [c.effect.name for c in found.components]
        dataset = about_sum(dataset, found)
    return dataset


def test_about_a_sum_with_the_weights_nothing_is_left_but_noise() -> None:
    """Without them the springs answer for the weights, and the columns are wrong by as much."""
    dataset, h = heavy()
    about = summed(dataset, LinkWeights.name)
    expected = float(np.hypot(SIGMA, 2.0 * REPEATABILITY))
    assert left(dataset, h) > 3 * expected
    assert left(about, h) < 1.5 * expected
    assert (np.abs(compliances(dataset) / COMPLIANCE[1:3] - 1) > 0.1).any()
    assert np.allclose(compliances(summed(about, LinkWeights.name)), compliances(about), rtol=0.01)


def test_the_residual_of_the_cells_own_parameters_stays_what_it_was() -> None:
    """What the weights explain is put back: sums with and without them stand on one footing."""
    dataset, _ = heavy()
    about = summed(dataset, LinkWeights.name)
    rms = [float(np.sqrt(np.mean(d.base.residual**2))) for d in (dataset, about)]
    assert rms[0] <= rms[1] < 5 * rms[0] and rms[0] > 10 * SIGMA
