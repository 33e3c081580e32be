"""The stated noise is what repeats and near-repeats show; what goes with angles is none."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.cells import kr270_chain, random_poses, table_of
from support.diagnosis_data import DOWN, FITTED, REPEATABILITY, SIGMA, cell, measured

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.noise_floor import project
from elastocal.diagnosis.stated_floor import noise_rms, smooth_scatter, supported_floor
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model

AMPLITUDE, LENGTH = 1e-4, 0.07  # rad: an error curve of joints 2 and 3


def curve(q: np.ndarray, seed: int) -> np.ndarray:
    """A draw (n,) of a Gaussian process of LENGTH over angles q (n,)."""
    w = np.random.default_rng((seed, 5)).normal(0, 1 / LENGTH, 400)
    phase = np.random.default_rng((seed, 6)).uniform(0, 2 * np.pi, 400)
    return AMPLITUDE * np.sqrt(2 / 400) * np.cos(q[:, None] * w + phase).sum(axis=1)


@lru_cache
def campaign_with(curves: bool, near: float = 0.0, n: int = 120, shake: float = 0.0):
    """Poses of which a third come twice, `near` apart in their joints, later in the campaign."""
    chain = kr270_chain()
    q = random_poses(chain, n, 1)
    if near:
        step = np.random.default_rng(4).uniform(-near, near, (n // 3, q.shape[1]))
        q = np.concatenate([q, q[: n // 3] + step])
    table = table_of(q, DOWN, both=True)
    table = replace(table, time=30.0 * (np.arange(len(table)) // 3))
    off = table.q.copy()
    if curves:
        for j in (1, 2):
            off[:, j] += curve(table.q[:, j], j)
    if shake:
        joints = np.random.default_rng(8).normal(size=(len(q), q.shape[1]))
        off += shake * joints[table.configuration]
    read = measured(chain, cell(FITTED), [], replace(table, q=off), 1)
    return Model.assembled(chain, cell(FITTED)), replace(read, q=table.q)


def data_of(model: Model, table: Measurements) -> DiagnosisData:
    return diagnosis_data_of(fit_baseline(model, table), [])


@lru_cache
def data_with(curves: bool, near: float = 0.0, shake: float = 0.0) -> DiagnosisData:
    return data_of(*campaign_with(curves, near, shake=shake))


def true_rms(dataset: DiagnosisData) -> float:
    """3-D rms of the tracker's noise and of the joints' scatter that was put in."""
    G = dataset.data.G[~dataset.data.left_out]
    return float(np.sqrt(3 * SIGMA**2 + 3 * REPEATABILITY**2 * (G**2).sum(axis=1).mean()))


def at_(dataset: DiagnosisData):
    return project(dataset.data, dataset.noise)


def test_an_error_curve_is_no_scatter() -> None:
    """It is taken for scatter of its joints by the fit; its neighbours say that it is none."""
    dataset = data_with(True)
    found = np.sqrt(smooth_scatter(dataset, dataset.data, at_(dataset)))
    assert (found[[1, 2]] > 0.5 * AMPLITUDE).all()
    assert (np.delete(found, [1, 2]) < AMPLITUDE).all()


@pytest.mark.parametrize("shake", [0.0, 1e-4])
def test_scatter_is_scatter(shake: float) -> None:
    dataset = data_with(False, shake=shake)
    assert (smooth_scatter(dataset, dataset.data, at_(dataset)) == 0).all()


@pytest.mark.parametrize("near", [0.0, 2e-3])
def test_the_floor_is_noise_and_the_rest_is_unexplained(near: float) -> None:
    dataset = data_with(True, near)
    fitted = noise_rms(dataset.data, dataset.noise)
    found = supported_floor(dataset, dataset.data, dataset.noise, 1.0)
    assert np.hypot(found.noise, found.unexplained) == pytest.approx(fitted)
    assert fitted > 5 * true_rms(dataset)
    if near:
        assert found.noise == pytest.approx(true_rms(dataset), rel=0.15)
    else:
        assert found.noise < 0.8 * fitted
    lower = supported_floor(dataset, dataset.data, dataset.noise, 1e-5)
    assert lower.noise <= 1e-5


@pytest.mark.parametrize(("near", "shake"), [(0.0, 0.0), (2e-3, 0.0), (0.0, 1e-4)])
def test_on_an_arm_that_only_scatters_nothing_is_unexplained(near: float, shake: float) -> None:
    dataset = data_with(False, near, shake)
    found = supported_floor(dataset, dataset.data, dataset.noise, 1.0)
    assert found.unexplained == 0.0
    assert found.noise == noise_rms(dataset.data, dataset.noise)
