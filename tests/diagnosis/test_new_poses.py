"""New poses are such as the campaign might have had, and none that it had."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from support.diagnosis_data import campaign

from elastocal.diagnosis.shrinkage import _joints, _recombined, _unlike, new_pose_table
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model

N = 50


@lru_cache
def drawn(observe: str = "position") -> tuple[Model, Measurements, Measurements]:
    model, table = campaign(observe=observe)
    table = replace(table, temperature=20 + 1e-3 * table.time)
    return model, table, new_pose_table(model, table, N, np.random.default_rng(5))


def test_every_joint_has_been_at_its_angle_and_no_arm_in_its_pose() -> None:
    """The side of approach comes with the angle of its joint."""
    _, table, new = drawn()
    for j in range(table.q.shape[1]):
        pairs = {(a, s) for a, s in zip(table.q[:, j], table.approach[:, j], strict=True)}
        found = {(a, s) for a, s in zip(new.q[:, j], new.approach[:, j], strict=True)}
        assert found <= pairs and len(found) > 10
    assert not {tuple(q) for q in new.q} & {tuple(q) for q in table.q}


def upright() -> tuple[Model, Measurements]:
    """A campaign whose last three joints follow the first three, as with a tool held upright."""
    model, table = campaign(n=80)
    q = table.q.copy()
    q[:, 3:] = 0.7 * q[:, :3] @ np.array([[1.0, 0.5, 0], [0, 1, -0.5], [0.3, 0, 1]])
    return model, replace(table, q=q)


def test_poses_of_a_campaign_whose_joints_depend_on_each_other_do_so_too() -> None:
    """Angles drawn independently would be poses that nobody measured or is going to."""
    model, table = upright()
    rng = np.random.default_rng(1)
    assert _unlike(_joints(table), _joints(_recombined(table, N, rng)[0]), rng)
    new = new_pose_table(model, table, N, rng)
    assert len(np.unique(new.configuration)) == N
    off = new.q[:, 3:] - 0.7 * new.q[:, :3] @ np.array([[1.0, 0.5, 0], [0, 1, -0.5], [0.3, 0, 1]])
    np.testing.assert_allclose(off, 0.0, atol=1e-9)
    assert not {tuple(q) for q in new.q} & {tuple(q) for q in table.q}
    was, now = _joints(table), _joints(new)
    np.testing.assert_allclose(now.std(axis=0), was.std(axis=0), rtol=0.25)
    assert np.ptp(new.time) > 0.8 * np.ptp(table.time)
