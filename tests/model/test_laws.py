"""Laws of effects on sticks of which the answer is known: torques, gears, moves and time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.cells import COMPLIANCE, kr270_cell, kr270_chain, random_table
from support.stick import model, positions, rows, stick

from elastocal.cell_tables import Nominal
from elastocal.measurements import read_measurements, with_moves
from elastocal.messages import InputError
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.effects.statics import rated_torque, torque_scale, weight_torque
from elastocal.model.manipulator import Model

BETA = 1e-3
TWO = stick("zz", (1.0, 1.0))


# --- torques -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "effect, key, value, law",
    [
        ("joint_hardening", "hardening", 1e-10, lambda t: 1e-10 * t**3),
        ("backlash", "backlash", BETA, lambda t: BETA / 2 * np.tanh(t)),
        ("hysteresis", "hysteresis_per_torque", 1e-6, lambda t: 1e-6 * (np.hypot(t, 1) - 1)),
        ("torque_response", "torque_response_2", BETA, lambda t: BETA * (t / 100) ** 3),
        ("torque_response", "torque_response_3", BETA, lambda t: BETA * np.tanh(t)),
        ("approach_response", "approach_response_1", BETA, lambda t: BETA + 0 * t),
        (
            "approach_response",
            "approach_response_2",
            BETA,
            lambda t: BETA / 100 * (np.hypot(t, 1) - 1),
        ),
    ],
)
def test_measured_torques_drive_the_same_laws(effect, key, value, law) -> None:
    """Explicitly, with the scale of 1 N m of an arm of which nothing else is known."""
    m = model(stick("z"), effect, torque="measured")
    torque = np.array([-300.0, -0.5, 0.0, 2.0, 200.0])
    table = rows(np.zeros(5), torque=torque[:, None], approach=np.ones((5, 1)))
    assert m.deflection(table).shape[1] == 0
    y = positions(m, table, **{key: value})[:, 1]
    np.testing.assert_allclose(y, np.sin(law(torque)), atol=1e-16)


def test_without_a_name_a_base_tilts_as_its_springs_do() -> None:
    table = rows(np.linspace(-2, 2, 5), force=(30.0, -20.0, -400.0))
    known, nameless = model(stick("z"), "base_compliance"), model(stick("z"), "load_response:base")
    tilted = positions(known, table, tilt_compliance_x=1e-6, tilt_compliance_y=2e-6)
    unnamed = positions(nameless, table, load_response_rx=1e-3, load_response_ry=2e-3)
    np.testing.assert_allclose(unnamed, tilted)
    assert np.ptp(tilted[:, 2]) > 1e-4


def test_a_step_without_a_name_moves_what_was_read_later() -> None:
    steps = {"marker:tip": {"step_time_s": 60.0}}
    m = model(stick("z"), "marker_position", "residual_step:marker:tip", settings=steps)
    moved = positions(m, rows(np.zeros(3), time=[0.0, 59.0, 60.0]), step_2=BETA)
    np.testing.assert_allclose(moved[:, 1], [0.0, 0.0, BETA])


def test_a_rated_torque_comes_from_compliance_weights_or_the_strongest_joint() -> None:
    chain, cell = kr270_chain(), kr270_cell()
    assert rated_torque(chain, cell, 5) == pytest.approx(3e-3 / COMPLIANCE[5])
    unknown = kr270_cell(nominal=Nominal())
    assert rated_torque(chain, unknown, 1) == weight_torque(chain, 1)
    # A wrist carries payloads, not its own few kilograms.
    assert rated_torque(chain, unknown, 5) == pytest.approx(weight_torque(chain, 0) / 8)
    bare = stick("y")
    assert rated_torque(bare, unknown, 0) is None
    assert torque_scale(bare, unknown, 0) == 1.0


def test_recorded_torques_turn_other_joints_and_tilt_links() -> None:
    """Joints about z: the link behind joint 1 tilts about x and y, which lifts the tip 1 m on."""
    coupled, tilted = model(TWO, "torque_coupling:joint1"), model(TWO, "torque_tilt:link1")
    table = rows(np.zeros((2, 2)), torque=[[100.0, 0.0], [0.0, 50.0]])
    y = positions(coupled, table, coupling_joint2=1e-5)[:, 1]
    np.testing.assert_allclose(y, [0.0, 2 * 5e-4], atol=1e-6)
    for key, lifted in (("tilt_own_y", [1e-4, 0.0]), ("tilt_next_y", [0.0, 5e-5])):
        z = positions(tilted, table, **{key: 1e-6})[:, 2]
        np.testing.assert_allclose(np.abs(z), lifted, atol=1e-9)


@pytest.mark.parametrize(
    "effect, column, spec",
    [
        ("torque_tilt", "torque_1_Nm", {}),
        ("thermal_expansion:all", "time_s or time_min", {"thermal_driver": "time"}),
        ("thermal_expansion:all", "temperature_C", {"thermal_driver": "temperature"}),
    ],
)
def test_what_is_not_recorded_is_asked_for(effect: str, column: str, spec) -> None:
    with pytest.raises(InputError, match=f"needs the column {column}"):
        model(TWO, effect, **spec).predict(rows(np.zeros((2, 2))))


# --- gears ---------------------------------------------------------------------------------

Q = np.radians([-170.0, -90.0, -20.0, 0.0, 35.0, 90.0, 160.0])
LINES = {"order_1": 12.5, "order_40": 80.25, "order_sd_40": 0.2, "spectrum_centre_rad": 0.4}


@pytest.mark.parametrize("orders, second", [((40.0,), 40.0), ((10.0, 20.0), 20.0)])
def test_ripple_orders_are_one_for_all_or_one_each(orders, second: float) -> None:
    m = model(TWO, "gear_ripple:joint2", gear_ripple_orders=orders)
    y = positions(m, rows(np.column_stack([np.zeros_like(Q), Q])), ripple_sin=1e-3)[:, 1]
    np.testing.assert_allclose(y, np.sin(Q + 1e-3 * np.sin(second * Q)), atol=1e-14)
    with pytest.raises(InputError, match=r"gear_ripple_orders has 3 values.*has 2 joints"):
        model(TWO, "gear_ripple", gear_ripple_orders=(1.0, 2.0, 3.0))


def test_a_spectrum_has_the_lines_that_the_cell_names() -> None:
    """Beside a line stands its derivative by the order: of one a little off, turned about the
    middle of the angles, they are the sum."""
    m = model(stick("z"), "gear_spectrum", settings={"joint1": LINES})
    keys = ["line_1_sin", "line_1_cos", "line_40_sin", "line_40_cos", "line_40_sin_shift",
            "line_40_cos_shift"]  # fmt: skip
    assert [name.partition(".")[2] for name in m.names] == keys
    assert [p.typical for p in m.parameters] == [5e-5] * 4 + [5e-5 * 0.2] * 2
    assert all(p.shrunk for p in m.parameters)
    off, a, b = 1e-4, 2e-4, 3e-4
    phase = 80.25 * Q + off * (Q - 0.4)
    shifts = {"line_40_sin_shift": a * off, "line_40_cos_shift": b * off}
    x, y, _ = positions(m, rows(Q), line_1_sin=a, line_40_sin=a, line_40_cos=b, **shifts).T
    found = np.angle(np.exp(1j * (np.arctan2(y, x) - Q)))
    expected = a * np.sin(12.5 * Q) + a * np.sin(phase) + b * np.cos(phase)
    np.testing.assert_allclose(found, expected, atol=1e-3 * a * off + 1e-11)


# --- moves ---------------------------------------------------------------------------------

VISITS = np.array([[0.0, 0.0], [0.5, 0.0], [0.2, -0.4], [0.2, 0.1]])
MOVE = np.array([[0.0, 0.0], [0.5, 0.0], [-0.3, -0.4], [0.0, 0.5]])
DIRECTION = np.array([[0, 0], [1, 0], [-1, -1], [-1, 1]])


def test_a_move_is_from_one_visit_to_the_next_and_goes_with_the_rows(tmp_path: Path) -> None:
    """A joint that stands keeps its last direction."""
    path = tmp_path / "data.csv"
    lines = [f"{a},{b},0,0,0" for a, b in VISITS]
    path.write_text("\n".join(["q1_rad,q2_rad,x_m,y_m,z_m", *lines]) + "\n")
    read = read_measurements(path, joint_kinds=("revolute", "revolute"))
    for table, at in ((with_moves(rows(VISITS)), [0, 1, 2, 3]), (read.take([3, 1]), [3, 1])):
        np.testing.assert_allclose(table.move, MOVE[at], atol=1e-15)
        np.testing.assert_array_equal(table.direction, DIRECTION[at])
    assert "move" not in "".join(read.columns())


def test_an_arm_lags_by_its_share_of_the_longest_way() -> None:
    m = model(TWO, "move_lag:joint2")
    still = positions(m, rows(VISITS))
    lag = positions(m, rows(VISITS), move_lag=1e-3) - still
    sign = positions(m, rows(VISITS), move_lag_sign=1e-3) - still
    far = np.linalg.norm(lag, axis=1)
    np.testing.assert_allclose(far, [0.0, 0.0, 1e-3, 1e-3], rtol=1e-6, atol=1e-12)
    elbow = np.column_stack([np.cos(VISITS[:, 0]), np.sin(VISITS[:, 0]), np.zeros(4)])
    ahead = np.cross(still - elbow, sign)[:, 2]
    np.testing.assert_allclose(ahead, 1e-3 * np.sign(MOVE[:, 1]), atol=1e-9)


@pytest.mark.parametrize("effect", ["move_lag", "move_hysteresis"])
def test_what_came_before_the_first_visit_has_an_error_of_its_own(effect: str) -> None:
    m = model(TWO, f"{effect}:joint1")
    campaign, first = with_moves(rows(VISITS)), {f"{effect}_first": 1e-3}
    moved = positions(m, campaign, **first) - positions(m, campaign)
    unknown = DIRECTION[:, 0] == 0
    assert unknown[0] and not unknown.all()
    np.testing.assert_array_equal(np.linalg.norm(moved, axis=1) > 1e-9, unknown)
    # Poses that are no campaign's, targets say, have no such error.
    np.testing.assert_array_equal(positions(m, rows(VISITS), **first), positions(m, rows(VISITS)))


@pytest.mark.parametrize("effect", ["hysteresis", "backlash"])
def test_the_order_of_visits_says_what_a_missing_column_would(effect: str) -> None:
    chain, side = kr270_chain(), "load_and_approach"
    table = replace(random_table(chain, 6, seed=1), approach=None)
    by_order = Model.assembled(chain, kr270_cell([effect], play_side=side, approach="order"))
    by_column = Model.assembled(chain, kr270_cell([effect], play_side=side))
    x = np.array([p.typical or 1e-8 for p in by_column.parameters])
    told = replace(table, approach=with_moves(table).direction)
    np.testing.assert_array_equal(by_order.predict(table, x), by_column.predict(told, x))
    with pytest.raises(InputError, match="needs the column approach_1"):
        by_column.predict(table, x)
    assert "approach" not in CATALOGUE[effect].needed(by_order.cell)
    assert "approach" in CATALOGUE[effect].needed(by_column.cell)
