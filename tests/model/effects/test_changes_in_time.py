"""Drifts, jumps, slips and warm-up: what the table's time (or temperature) does."""

from __future__ import annotations

import numpy as np
import pytest
from model.effects.stick import model, positions, rows, stick
from scipy.spatial.transform import Rotation
from support.cells import MARKERS, kr270_cell, kr270_chain, random_table

from elastocal.cell.arm_description import Nominal
from elastocal.errors import InputError
from elastocal.model import Model

WARM = 1 - np.exp(-1)


def test_a_drift_has_gone_63_percent_of_its_way_at_its_time_constant() -> None:
    m = model(stick("z"), "joint_drift", settings={"joint1": {"time_constant_s": 600.0}})
    y = positions(m, rows(np.zeros(3), time=[0.0, 600.0, 1e9]), drift=1e-3)[:, 1]
    np.testing.assert_allclose(y, np.sin(1e-3 * np.array([0.0, WARM, 1.0])), atol=1e-17)


def test_a_drifting_base_moves_and_turns_about_its_origin() -> None:
    m = model(stick("z"), "base_drift", settings={"base": {"time_constant_s": 600.0}})
    table = rows([0.3, 0.3], time=[0.0, 600.0])
    values = {
        "drift_x": 1e-3,
        "drift_y": 2e-3,
        "drift_z": -3e-3,
        "drift_rx": 4e-3,
        "drift_rz": 5e-3,
    }
    still, moved = positions(m, table, **values)
    R = Rotation.from_rotvec(WARM * np.array([4e-3, 0.0, 5e-3])).as_matrix()
    np.testing.assert_allclose(moved, R @ still + WARM * np.array([1e-3, 2e-3, -3e-3]), atol=1e-15)


def test_a_bumped_tracker_shifts_all_later_readings_rigidly() -> None:
    chain = kr270_chain()
    nominal = Nominal(
        base_position=np.array([1.0, -2.0, 0.5]),
        base_rotation=Rotation.from_rotvec([0.1, 0.2, 1.5]).as_matrix(),
        settings={"tracker": {"jump_time_s": 3000.0}},
    )
    m = Model.assembled(chain, kr270_cell(["base_frame", "frame_jump"], nominal=nominal))
    table = random_table(chain, 8, seed=2)
    jump = np.array([1e-3, -2e-3, 3e-3, 4e-3, 5e-3, -6e-3])
    before = m.predict(table).reshape(-1, 3)
    x = m.nominal
    x[6:] = jump
    after = m.predict(table, x).reshape(-1, 3)
    later = table.time >= 3000.0
    assert 0 < later.sum() < len(table)
    np.testing.assert_array_equal(after[~later], before[~later])
    origin = nominal.base_position
    rigid = Rotation.from_rotvec(jump[3:]).apply(before[later] - origin) + origin + jump[:3]
    np.testing.assert_allclose(after[later], rigid, atol=1e-14)


def test_a_slipped_marker_moves_alone_and_from_then_on() -> None:
    chain = kr270_chain()
    nominal = Nominal(settings={"marker:M2": {"slip_time_s": 3000.0}})
    m = Model.assembled(
        chain, kr270_cell(["marker_position", "marker_slip:marker:M2"], nominal=nominal)
    )
    table = random_table(chain, 8, seed=2)
    x = m.nominal
    x[-3:] = 1e-3, 2e-3, -2e-3
    moved = np.linalg.norm((m.predict(table, x) - m.predict(table)).reshape(-1, 3), axis=1)
    slipped = (table.marker == list(MARKERS).index("M2")) & (table.time >= 3000.0)
    assert 0 < slipped.sum() < (table.marker == 1).sum()
    np.testing.assert_allclose(moved, np.where(slipped, 3e-3, 0.0), atol=1e-14)


def test_a_link_grows_by_its_strain_once_warm() -> None:
    """The tool on the flange does not."""
    m = model(stick("zz", (2.0, 1.0)), "thermal_expansion:link1", tip=(0.5, 0, 0))
    reach = positions(m, rows(np.zeros((3, 2)), time=[0.0, 1800.0, 1e9]), expansion=1e-4)[:, 0]
    np.testing.assert_allclose(reach, 3.5 + 2e-4 * np.array([0.0, WARM, 1.0]), rtol=1e-15)


@pytest.mark.parametrize(
    "driver, column", [("time", "time_s or time_min"), ("temperature", "temperature_C")]
)
def test_a_table_without_the_driver_is_refused(driver: str, column: str) -> None:
    m = model(stick("z"), "thermal_expansion:all", thermal_driver=driver)
    with pytest.raises(InputError, match=column):
        m.predict(rows([0.0]))
