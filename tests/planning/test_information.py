"""What poses tell, planned or measured, is what identification would find in their readings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from planning.feasibility.small_cells import NOTHING, gantry_at, gantry_rules, sphere
from scipy import stats
from support.cells import DOWN, TABLE_2, kr270_chain, random_poses
from support.design_cells import AXIS, as_table, plan_cell, setup_of, value_of

import elastocal as ec
from elastocal.cell import Cell, Visibility, Workspace
from elastocal.cell_tables import PolarNoise, Tool, Tracker, Unsteadiness
from elastocal.measurements import Measurements
from elastocal.messages import InputError
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.information import Known, PoseInformation, measured, next_number, whitened
from elastocal.planning.plan import predicted, reasons
from elastocal.simulation import expand_plan, simulate

CHAIN = kr270_chain()
BOTH = np.array([[0.0, 0, 0], DOWN])
POLAR = PolarNoise(10e-6, 0.3e-6, 15e-6, 6e-6)
POSES = random_poses(CHAIN, 80, seed=1)
GEOMETRY = ("base_frame", "joint_offset", "joint_compliance", "marker_position")


def cell_for(observed: str, noise: Any = AXIS, **design: Any) -> Cell:
    effects = ("joint_compliance",) if observed == "deflection" else GEOMETRY
    return plan_cell(effects, observed, noise, **design)


def information_of(cell: Cell, x: NDArray | None = None) -> PoseInformation:
    model = Model.assembled(CHAIN, cell)
    n = len(model.parameters)
    return PoseInformation(model, model.nominal if x is None else x, np.arange(n), np.ones(n))


def gathered(information: PoseInformation, q: NDArray) -> NDArray:
    B = information.blocks(q).reshape(-1, len(information.columns))
    return B.T @ B


def relative(found: NDArray, expected: NDArray) -> float:
    scale = np.sqrt(np.diag(expected))
    scale[scale == 0] = 1.0
    return float(np.abs((found - expected) / np.outer(scale, scale)).max())


def campaign(cell: Cell) -> Measurements:
    """The readings of the poses of Table 2, each repeated, in the cell's load states."""
    model = Model.assembled(CHAIN, cell)
    table = expand_plan(as_table(TABLE_2), tuple(cell.tool.markers), cell.design.repeats, DOWN)
    return simulate(model, table, model.nominal, 7, noise=False)


def test_what_a_plan_needs_to_know_is_asked_for() -> None:
    with pytest.raises(InputError, match="no σ for marker"):
        information_of(cell_for("position", marker_sigma={"M1": 1e-5})).blocks(TABLE_2)


@pytest.mark.parametrize(("observed", "own"), [("position", 60e-6), ("deflection", 0.0)])
def test_joints_and_configurations_scatter_readings_as_planned(observed: str, own: float) -> None:
    noise = Unsteadiness(np.array([10.0, 20, 30, 100, 5, 0]) * 1e-6, configuration=own)
    cell = replace(cell_for(observed, loads=BOTH), noise=noise)
    model = Model.assembled(CHAIN, cell)
    rows = expand_plan(as_table(TABLE_2), tuple(cell.tool.markers), 1, DOWN)
    exact = observe(simulate(model, rows, model.nominal, 0, noise=False), observed)
    factor = information_of(cell).noise(TABLE_2)[1]
    planned = factor @ factor.swapaxes(1, 2)
    read = [observe(simulate(model, rows, model.nominal, k), observed).value for k in range(200)]
    off = (np.array(read) - exact.value).reshape(200, len(TABLE_2), -1)
    found = np.einsum("kni,knj->nij", off, off) / 200
    ratio = np.trace(found, axis1=1, axis2=2) / np.trace(planned, axis1=1, axis2=2)
    assert abs(ratio.mean() - 1) < 0.05
    # What a joint does to the markers of a visit it does to all of them.
    assert relative(found.mean(axis=0), planned.mean(axis=0)) < 0.15


# --- only some of the markers ---------------------------------------------------------------


def test_a_marker_is_seen_in_range_turned_to_the_tracker_and_behind_nothing() -> None:
    markers = {"L": np.array([0, -1.0, 0]), "C": np.zeros(3), "R": np.array([0, 1.0, 0])}
    sight = Visibility({"L": np.array([-1.0, 0, 0])}, np.radians(30), (1.0, 3.1), min_markers=1)
    space = Workspace(obstacles=(sphere("ball", 0.2, (1.6, 0.5, 0.0)),), visibility=sight)
    eye = Tracker(position=np.array([3.0, 0.0, 0.0]))

    def rules(least: int) -> ec.Feasibility:
        seen = replace(sight, min_markers=least)
        return gantry_rules(replace(space, visibility=seen), Tool(markers=markers), eye)

    # L is turned away; R is behind the ball, then out of range as well as C; then C behind it.
    q = gantry_at((0.2, 0, 0), (-0.05, 0, 0), (0.2, 1.0, 0), (-2, 0, 0))
    one = rules(1)
    assert one.seen is not None
    assert one.seen(q[:2], NOTHING).tolist() == [[False, True, False]] * 2
    assert one.under(q, NOTHING[None]).ok.tolist() == [True, True, False, False]
    assert not rules(2).under(q, NOTHING[None]).ok.any()
    assert rules(3).seen is None
    assert "min_markers" in rules(2).advice(rules(2).check(q, NOTHING))


@pytest.mark.parametrize(("observed", "tau"), [("position", 30e-6), ("deflection", 30e-6)])
def test_information_is_that_of_the_readings_that_are_made(observed: str, tau: float) -> None:
    """With what an arm does not repeat, which the markers of a visit share."""
    whole, q = information_of(cell_for(observed, loads=BOTH, repeatability=tau)), TABLE_2[:6]
    rng = np.random.default_rng(3)
    shown = {tuple(f): rng.random((len(q), 3)) < 0.7 for f in BOTH}
    part = replace(whole, sight=lambda q, force: shown[tuple(force)])
    seen = part.seen(q)
    assert 0 < seen.mean() < 1
    B, _ = whitened(whole.model, part.rows(q).take(seen.reshape(-1)), whole.x)
    assert relative(gathered(part, q), B.T @ B) < 1e-9


# --- measurements done ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("observed", "tau", "shuffled"),
    [("deflection", 4e-5, True), ("position", 0.0, False), ("pose", 4e-5, False)],
)
def test_a_campaign_tells_what_its_poses_would(observed: str, tau: float, shuffled: bool) -> None:
    cell = cell_for(observed, POLAR, loads=BOTH, repeats=3, repeatability=tau)
    table = campaign(cell)
    if shuffled:
        table = table.take(np.random.default_rng(0).permutation(len(table)))
    done = measured(Model.assembled(CHAIN, cell), table, ())
    assert relative(done.information, gathered(information_of(cell, done.x), TABLE_2)) < 1e-6
    assert "identified" in done.note
    assert done.numbers == len(table) * {"deflection": 1.5, "position": 3, "pose": 6}[observed]


def test_the_same_campaign_again_halves_the_variances() -> None:
    cell = plan_cell(loads=DOWN[None], repeats=2)
    once = setup_of(cell, POSES)
    done = measured(once.information.model, campaign(cell), ())
    twice = setup_of(cell, POSES, known=Known(done=done))
    assert value_of(twice, TABLE_2) == pytest.approx(value_of(once, TABLE_2) / 2, rel=1e-6)
    told = []
    for setup in (once, twice):
        M = setup.gathered(setup.information.blocks(TABLE_2))
        told.append(predicted(setup.found, M, 270))
        std = np.sqrt(np.diag(np.linalg.inv(M))) * setup.information.sizes
        assert [p.std for p in told[-1]] == pytest.approx(std)
        half = stats.t.ppf(0.975, 270 - len(std)) * std
        assert [p.half_width for p in told[-1]] == pytest.approx(half)
    assert [p.std for p in told[1]] == pytest.approx([p.std / np.sqrt(2) for p in told[0]])


def test_a_campaign_shows_what_no_pose_to_come_would() -> None:
    """The load once pulled from the side; a plan with a vertical load needs joint 1 no more."""
    cell = plan_cell(loads=DOWN[None])
    pulled = campaign(cell)
    force = np.where(pulled.force.any(axis=1)[:, None], [0.0, 1500.0, -500.0], 0.0)
    model = Model.assembled(CHAIN, cell)
    done = measured(model, simulate(model, replace(pulled, force=force), model.nominal, 0), ())
    setup = setup_of(cell, POSES, known=Known(done=done))
    assert setup.information.names == model.names
    assert setup.warnings == ()


@pytest.mark.parametrize(
    ("labels", "number"), [(("7+", "7-"), 8), (("warm-up", "12", "3b"), 13), ((), 1)]
)
def test_new_poses_are_numbered_after_those_measured(labels: Any, number: int) -> None:
    assert next_number(labels) == number


def test_a_pose_is_missed_by_what_it_alone_tells() -> None:
    """Of two offsets that all readings before it show in sum, whatever rounding leaves of it."""
    rng = np.random.default_rng(14)
    before = rng.normal(size=(60, 5))
    before[:, 3], before[:, 4] = np.sign(before[:, 3]), -np.sign(before[:, 3])
    block = rng.normal(size=(3, 5)) * np.array([1, 1, 1, 0.01, 0.01])
    M = before.T @ before + block.T @ block
    (reason,) = reasons("abcde", block[None], M, np.ones(1))
    grown = np.sqrt(np.diag(np.linalg.pinv(before.T @ before)) / np.diag(np.linalg.inv(M)))
    assert reason.serves[:2] == (("d", np.inf), ("e", np.inf))
    assert reason.serves[2] == ("b", pytest.approx(grown[1], rel=1e-3))
