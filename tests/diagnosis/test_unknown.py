"""Blocks without a name: every driver that was recorded, every place, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.diagnosis_data import campaign

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.noise_floor import NoiseValues, project
from elastocal.diagnosis.unknown import Generic, generic_blocks, wrenches

N = 24
NOISE = NoiseValues(1.0, np.full(6, 3e-6), np.full(6, 0.2))


@lru_cache
def data_without(*columns: str) -> DiagnosisData:
    model, table = campaign(n=N)
    table = replace(table, **dict.fromkeys(columns))
    return diagnosis_data_of(fit_baseline(model, table), [])


@lru_cache
def blocks() -> tuple[Generic, ...]:
    return tuple(generic_blocks(data_without()))


@pytest.mark.parametrize(
    ("covariate", "where"),
    [("joint2 angle", "joint5"), ("time", "link3"), ("load × joint3 angle", "joint4")],
)
def test_a_planted_dependence_is_told_from_every_other(covariate: str, where: str) -> None:
    """A smooth motion that no block holds as such: the right block scores highest."""
    dataset = data_without()
    table = dataset.base.observed.table
    along = {
        "joint2 angle": np.sin(3 * table.q[:, 1]),
        "time": np.tanh((table.time - 500) / 200),
        "load × joint3 angle": (table.force[:, 2] != 0) * np.sin(1.2 * table.q[:, 2]),
    }[covariate]
    entry = "joint_motion" if where.startswith("joint") else "link_frame"
    E = dataset.columns.entry((entry, (where,)))
    amount = 1.5e-4 * np.array([1.0, 0.5, -0.7, 0.3, 1.0, -0.4])[: E.shape[2]]
    moved = E @ amount * along[:, None]
    data = replace(dataset.data, r=dataset.data.r + dataset.pack(moved[:, :, None])[:, :, 0])
    grams = Grams(dataset, data, project(data, NOISE))
    scores = [float(grams.of(g).evidence()[0]) for g in blocks()]
    best = blocks()[int(np.argmax(scores))]
    assert (best.covariate, best.where) == (covariate, where)


def test_the_wrench_at_a_link_is_the_load_in_that_links_axes() -> None:
    """R_flangeᵀ F at the last link, largest component one; the load turns the flange a little."""
    dataset = data_without()
    model, table = dataset.base.model, dataset.base.observed.table
    force, _ = list(wrenches(dataset))[-1]
    R = model.flange_poses(table, dataset.base.x)[:, :3, :3]
    expected = np.einsum("nji,nj->ni", R, table.force)
    expected /= np.abs(expected).max()
    rows = dataset.base.observed.lead[np.maximum(dataset.places.example, 0)]
    np.testing.assert_allclose(force[dataset.present], expected[rows][dataset.present], atol=5e-3)
