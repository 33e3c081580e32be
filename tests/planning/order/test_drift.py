"""The order keeps a drift apart from what the plan is for, within time and changes of load."""

from itertools import groupby
from types import SimpleNamespace

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain, random_poses
from support.design_cells import plan_cell, setup_of, value_of
from support.discs import Discs

from elastocal.cell_tables import Motion, Unsteadiness
from elastocal.identification.noise_structure import course_waves
from elastocal.messages import InputError
from elastocal.planning import execution as drift_module
from elastocal.planning import poses as target_poses
from elastocal.planning.execution import DRIFT, Alias, schedule, turns
from elastocal.planning.plan import Plan
from elastocal.planning.poses import prediction_rows

BOTH = np.array([[0.0, 0, 0], [0, 0, -100.0]])
RNG = np.random.default_rng(1)
Q = RNG.uniform(-2, 2, (12, 2))
# Loaded minus unloaded: what a shift does has opposite signs.
OWN = RNG.normal(size=(12, 1, 4, 3))
PAIRS = Alias(np.concatenate([-OWN, OWN], axis=1) / 12, 5e-6, True, OWN, OWN)


@pytest.fixture(autouse=True)
def brief_annealing(monkeypatch):
    monkeypatch.setattr(drift_module, "STEPS", 8000)
    monkeypatch.setattr(drift_module, "FEW", 2000)
    monkeypatch.setattr(drift_module, "HOT", (4.0,))


def ordered(alias=PAIRS, **motion):
    motion = {"dwell": 30.0, "load_change": 60.0} | motion
    return schedule(Q, Motion(**motion), Discs(), loads=BOTH, alias=alias)


NOTES = [f"{what}{nth}" for what in ("order", "load") for nth in ("", "_2", "_3")]


def rows_of(execution, names, stated=None):
    """As of a plan of two revolute joints without markers."""
    cell = SimpleNamespace(tool=SimpleNamespace(markers={}))
    model = SimpleNamespace(chain=SimpleNamespace(kinds=("revolute",) * 2), cell=cell)
    plan = SimpleNamespace(
        execution=execution, names=names, model=model, forces=BOTH, stated_forces=stated,
        group=np.zeros(len(names), dtype=int), seen=None, crossed=True,
    )  # fmt: skip
    return Plan.rows.fget(plan)


def blocks(execution):
    return "".join("UL"[load] for load, _ in groupby(s.load for s in execution.stops))


@pytest.mark.parametrize(
    ("loaded", "changes", "expected"),
    [
        ([False], None, [0]),
        ([True], None, [0]),
        ([False, True], None, [0, 1, 0]),
        ([False, True], 5, [0, 1, 0, 1, 0]),
        ([False, True, True], None, [0, 1, 2, 0]),
        ([False, True, True, True], 6, [0, 1, 2, 3, 2, 1, 0]),
        ([True, True], 4, [0, 1, 0]),
    ],
)
def test_the_load_states_take_turns_within_the_changes_allowed(loaded, changes, expected):
    assert turns(loaded, range(len(loaded)), changes) == expected


def test_fewer_changes_than_the_loads_need_are_refused():
    with pytest.raises(InputError, match="allow 3, or plan fewer loads"):
        turns([False, True, True], [0, 1, 2], 2)


@pytest.mark.parametrize(("changes", "sequence"), [(None, "ULU"), (4, "ULULU")])
def test_every_visit_once_in_turns_and_the_drift_does_little(changes, sequence):
    execution = ordered(load_changes=changes, extra_time=0.05)
    assert sorted((s.pose, s.load) for s in execution.stops) == [
        (pose, load) for pose in range(12) for load in (0, 1)
    ]
    assert blocks(execution) == sequence and execution.load_changes == len(sequence) - 1
    assert execution.drift.bias < 0.25 * execution.drift.shortest
    shortest = ordered(alias=None)
    assert execution.travel <= shortest.travel + 0.05 * shortest.total
    # The file counts stops as their list does, whichever load comes first at a pose.
    _, more = rows_of(execution, tuple(map(str, range(1, 13))))
    for pose in range(12):
        own = [k for k, stop in enumerate(execution.stops, start=1) if stop.pose == pose]
        assert [more["order"][pose], more["note_order_2"][pose]] == [str(k) for k in own]
        hung = ["0 0 -100 N" if execution.stops[k - 1].load else "unloaded" for k in own]
        assert [more["note_load"][pose], more["note_load_2"][pose]] == hung


def test_where_there_is_time_poses_are_read_before_and_after_their_load():
    once, twice = ordered(extra_time=0.05), ordered(extra_time=0.5)
    assert blocks(twice) == "ULU" and len(twice.stops) == 36
    assert sorted((s.pose, s.load, s.part) for s in twice.stops) == [
        (pose, load, part) for pose in range(12) for load, part in ((0, 0), (0, 1), (1, 0))
    ]
    assert twice.drift.bias < 0.2 * once.drift.bias
    shortest = ordered(alias=None)
    assert once.total < twice.total < 1.5 * shortest.total
    names = tuple(map(str, range(1, 13)))
    table, more = rows_of(twice, names)
    assert table.configuration_labels == names and len(table) == 12
    assert set(more) == {"level", *(f"note_{k}" for k in NOTES)} - {"note_order"} | {"order"}
    places = np.array([[int(v) for v in more[k]] for k in more if "order" in k]).T
    assert sorted(places.ravel()) == list(range(1, 37)) and (places[:, 0] < places[:, 2]).all()
    loaded = [k + 1 for k, stop in enumerate(twice.stops) if stop.load]
    assert sorted(places[:, 1]) == loaded
    # With forces stated, the second part stands in the row of the first.
    assert len(rows_of(twice, names, BOTH)[0]) == 24


def test_the_alias_is_what_least_squares_make_of_shifted_readings():
    chain, cell = kr270_chain(), plan_cell(loads=DOWN[None])
    q = random_poses(chain, 8, seed=4)
    setup = setup_of(cell, q)
    information = setup.information
    blocks = information.blocks(q)
    alias = Alias.of(information, q, blocks, setup.gathered(blocks), setup.target_rows)
    rng = np.random.default_rng(0)
    time, direction = rng.uniform(size=(8, 2)), rng.normal(size=3)
    observed, root = information.noise(q)
    table, model, x = observed.table, information.model, information.x
    state = (table.force != 0).any(axis=1).astype(int)
    d = observed.apply(time[table.configuration, state][:, None] * direction)
    B = model.regressor(table, x, information.columns, observed).B
    B = B.reshape(8, -1, len(information.columns))
    B, d = (np.linalg.solve(root, v) for v in (B, d.reshape(8, -1, 1)))
    wrong = np.linalg.lstsq(B.reshape(-1, B.shape[-1]), d.ravel(), rcond=None)[0]
    targets = target_poses.test_poses(cell, chain, None, 0)
    A = prediction_rows(model, targets, x)[..., information.columns]
    rms = np.sqrt(targets.weight @ ((A @ wrong) ** 2).sum(axis=1))
    found = np.einsum("nl,nlmx,x->m", time, alias.share, direction)
    assert np.linalg.norm(found) == pytest.approx(rms, rel=1e-8)
    assert alias.noise == pytest.approx(np.sqrt(value_of(setup, q)), rel=1e-9)
    assert DRIFT > 0

    # What is left of the information where all drifts: generalised least squares with V + FFᵀ.
    noise = Unsteadiness(drift=40e-6, lasting=0.5)
    waves = course_waves((time.ravel() - time.min()) / np.ptp(time), 0.5 / np.ptp(time))
    course = waves.reshape(*time.shape, -1)[table.configuration, state]
    F = [observed.apply(c[:, None] * axis) for c in course.T for axis in np.eye(3)]
    F = 40e-6 * np.array([np.linalg.solve(root, f.reshape(8, -1, 1)).ravel() for f in F]).T
    B = B.reshape(-1, B.shape[-1]) * information.sizes
    M = B.T @ B
    expected = B.T @ np.linalg.solve(np.eye(len(F)) + F @ F.T, B)
    left = alias.information(M, time, noise)
    scale = np.sqrt(np.diag(M))
    np.testing.assert_allclose(left / scale / scale[:, None], expected / scale / scale[:, None],
                               atol=1e-9)  # fmt: skip
    assert np.linalg.eigvalsh(M - left)[0] > -1e-9 * np.linalg.eigvalsh(M)[-1]
