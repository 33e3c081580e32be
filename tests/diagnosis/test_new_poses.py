"""New poses are such as the campaign might have had, and none that it had."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.diagnosis_data import campaign

from elastocal.diagnosis import new_pose_table
from elastocal.diagnosis.shrinkage import _box, _joints, _raked, _recombined, _unlike
from elastocal.measurements import Measurements
from elastocal.model import Model, observe

N = 50


@lru_cache
def drawn(observe: str = "position") -> tuple[Model, Measurements, Measurements]:
    model, table = campaign(observe=observe)
    table = replace(table, temperature=20 + 1e-3 * table.time)
    return model, table, new_pose_table(model, table, N, np.random.default_rng(5))


def test_there_are_as_many_as_asked_each_like_a_measured_one() -> None:
    _, table, new = drawn()
    assert len(np.unique(new.configuration)) == N
    for c in np.unique(new.configuration):
        own = new.take(new.configuration == c)
        assert sorted(own.marker) == sorted(table.marker[table.configuration == 0])
        assert len(np.unique(own.force, axis=0)) == 2
        assert len(np.unique(own.q, axis=0)) == 1


def test_every_joint_has_been_at_its_angle_and_no_arm_in_its_pose() -> None:
    """The side of approach comes with the angle of its joint."""
    _, table, new = drawn()
    for j in range(table.q.shape[1]):
        pairs = {(a, s) for a, s in zip(table.q[:, j], table.approach[:, j], strict=True)}
        found = {(a, s) for a, s in zip(new.q[:, j], new.approach[:, j], strict=True)}
        assert found <= pairs and len(found) > 10
    assert not {tuple(q) for q in new.q} & {tuple(q) for q in table.q}


def test_markers_stay_about_where_they_were_measured() -> None:
    """Beyond the outermost configuration by no more than it is from the one before it."""
    model, table, new = drawn()
    was, now = (model.target_poses(t)[1] for t in (table, new))
    codes = np.unique(table.configuration)
    second, last = np.sort([was[table.configuration == c].max(axis=0) for c in codes], axis=0)[-2:]
    assert (now <= last + (last - second)).all()
    last, second = np.sort([was[table.configuration == c].min(axis=0) for c in codes], axis=0)[:2]
    assert (now >= last - (second - last)).all()


def test_as_much_of_the_room_is_beyond_the_ends_as_draws_leave_on_average() -> None:
    rng = np.random.default_rng(4)
    ends = np.array([_box(rng.random((60, 3)), np.arange(60)) for _ in range(2000)])
    np.testing.assert_allclose(ends.mean(axis=0), [[0.0] * 3, [1.0] * 3], atol=2e-3)


def test_no_joint_is_drawn_to_its_middle_by_the_ends_of_the_room() -> None:
    """Poses with an outstretched arm leave the box most often, and would be missing."""
    model, table, _ = drawn()
    new = new_pose_table(model, table, 400, np.random.default_rng(6))
    was, now = (t.q[np.unique(t.configuration, return_index=True)[1]] for t in (table, new))
    np.testing.assert_allclose(now.std(axis=0), was.std(axis=0), rtol=0.08)


def test_raked_poses_have_every_donor_as_often() -> None:
    """Where half of those with a joint at one of its angles are missing."""
    rng = np.random.default_rng(2)
    donors = rng.integers(5, size=(4000, 3))
    donors = donors[(donors[:, 1] != 2) | (rng.random(4000) < 0.5)]
    weight = _raked(donors)
    for of_joint in donors.T:
        np.testing.assert_allclose(np.bincount(of_joint, weight), 0.2, rtol=1e-6)


def test_times_are_the_campaigns_and_one_per_visit() -> None:
    _, table, new = drawn()
    assert new.time.min() >= table.time.min() and new.time.max() <= table.time.max()
    assert np.ptp(new.time) > 0.9 * np.ptp(table.time)
    visits = np.column_stack([new.configuration, new.force[:, 2]])
    assert len(np.unique(np.column_stack([visits, new.time]), axis=0)) == 2 * N
    np.testing.assert_allclose(new.temperature, 20 + 1e-3 * new.time)


def test_loaded_and_unloaded_readings_still_pair() -> None:
    model, _, new = drawn("deflection")
    observed = observe(new, "deflection")
    assert len(observed.lead) == len(new) // 2
    assert np.isfinite(model.predict(new, None, observed)).all()


def test_the_same_seed_draws_the_same_poses() -> None:
    model, table, new = drawn()
    again = new_pose_table(model, table, N, np.random.default_rng(5))
    other = new_pose_table(model, table, N, np.random.default_rng(6))
    np.testing.assert_array_equal(again.q, new.q)
    assert not np.array_equal(other.q, new.q)


def test_where_nothing_recorded_is_there_nothing_is_invented() -> None:
    model, table, _ = drawn()
    bare = replace(table, time=None, approach=None, temperature=None)
    new = new_pose_table(model, bare, N, np.random.default_rng(5))
    assert new.time is None and new.approach is None and new.temperature is None


@pytest.mark.parametrize("n", [8, 9])
def test_repeats_keep_their_own_side_of_approach(n: int) -> None:
    """A configuration that was measured from both sides is met from both sides."""
    model, table, _ = drawn()
    few = table.take(table.configuration < n)
    both = np.concatenate([np.arange(len(few)), np.arange(len(few))])
    repeated = few.take(both)
    repeat = (np.arange(len(both)) >= len(few)).astype(np.int64)
    sides = np.where(repeat[:, None] == 1, -1.0, 1.0) * np.ones_like(repeated.q)
    repeated = replace(repeated, repeat=repeat, approach=sides)
    new = new_pose_table(model, repeated, N, np.random.default_rng(1))
    np.testing.assert_array_equal(new.approach[new.repeat == 0], 1.0)
    np.testing.assert_array_equal(new.approach[new.repeat == 1], -1.0)


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


def test_joints_that_are_independent_are_not_called_dependent() -> None:
    found = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        found += _unlike(rng.uniform(-1, 1, (60, 6)), rng.uniform(-1, 1, (N, 6)), rng)
    assert found <= 3
