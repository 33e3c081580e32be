"""The stated noise is what repeats and near-repeats show; what goes with angles is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import kr270_chain, random_poses, table_of
from support.diagnosis_data import FITTED, REPEATABILITY, SIGMA, cell, measured

import elastocal as ec
from elastocal import Diagnosis
from elastocal.cell_tables import Unsteadiness
from elastocal.model.manipulator import Model
from elastocal.report.diagnosis_view import noise_floor_lines

AMPLITUDE, LENGTH = 1e-4, 0.07  # rad: an error curve of joints 2 and 3


def curve(q: np.ndarray, seed: int) -> np.ndarray:
    """A draw (n,) of a Gaussian process of LENGTH over angles q (n,)."""
    w = np.random.default_rng((seed, 5)).normal(0, 1 / LENGTH, 400)
    phase = np.random.default_rng((seed, 6)).uniform(0, 2 * np.pi, 400)
    return AMPLITUDE * np.sqrt(2 / 400) * np.cos(q[:, None] * w + phase).sum(axis=1)


def diagnosed(
    curves: bool, again: int, shake: float = 0.0, common: float = 0.0, times: float = 1.0
) -> tuple[Diagnosis, float]:
    """Of poses of which so many come `again`, 2 mrad apart in their joints, later in the campaign,
    read with `times` the stated noise; and the 3-D rms (m) of all noise put in, with what
    configurations have in `common` per axis."""
    chain, near = kr270_chain(), 2e-3
    arm = replace(cell(FITTED), noise=Unsteadiness(configuration=common))
    q = random_poses(chain, 40 - again, 1)
    step = np.random.default_rng(4).uniform(-near, near, (again, q.shape[1]))
    q = np.concatenate([q, q[:again] + step])
    table = table_of(q, np.zeros(3), both=False)
    table = replace(table, time=30.0 * table.configuration)
    off = table.q.copy()
    if curves:
        for j in (1, 2):
            off[:, j] += curve(table.q[:, j], j)
    joints = np.random.default_rng(8).normal(size=(len(q), q.shape[1]))
    off += shake * joints[table.configuration]
    drawn = replace(arm, tracker=cell(FITTED, sigma=times * SIGMA).tracker)
    read = replace(measured(chain, drawn, [], replace(table, q=off), 1), q=table.q)
    model, h = Model.assembled(chain, arm), 1e-6
    square = 3 * ((times * SIGMA) ** 2 + common**2)
    for axis in np.eye(6):
        ahead, behind = (model.predict(replace(table, q=table.q + s * h * axis)) for s in (1, -1))
        lever = (ahead - behind).reshape(-1, 3) / (2 * h)
        square += (REPEATABILITY**2 + shake**2) * (lever**2).sum(axis=1).mean()
    return ec.diagnose(model, read), float(np.sqrt(square))


def test_an_error_curve_is_no_scatter() -> None:
    """A fit takes it for scatter of its joints; poses that nearly come again say it is none."""
    why, true = diagnosed(curves=True, again=10)
    assert why.gap.noise_floor == pytest.approx(true, rel=0.15)
    assert why.gap.calibrated > 3 * true


# The last is told from what a model lacks by the markers of one pose.
@pytest.mark.parametrize("own", [{"shake": 1e-4}, {"common": 8e-5}, {"times": 9.0}])
def test_on_an_arm_that_only_scatters_nothing_is_unexplained(own: dict[str, float]) -> None:
    why, true = diagnosed(curves=False, again=0, **own)
    assert why.gap.unexplained == 0.0 and why.verdict == "nothing_significant"
    told = "\n".join((*why.warnings, *noise_floor_lines(why.noise, ["revolute"] * 6)))
    assert ("common to a configuration of 80.0 µm" in told) == ("common" in own)
    assert ("correct [tracker]" in told) == ("times" in own)
    assert why.gap.noise_floor == pytest.approx(true, rel=0.15)
