"""A calibrated arm as DH table: nominal where calibration changes nothing."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest
from support.exports import DH, exported, write_result

CONVENTIONS = {"dh": "standard", "mdh": "modified"}


def rows_of(text: str) -> list[dict[str, str]]:
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return list(csv.DictReader(io.StringIO("\n".join(lines))))


def check(cell: Path, result: Path, format: str) -> list[dict[str, str]]:
    done = exported(cell, result, format)[1]
    assert done.checked is not None and done.checked < 1e-9
    return rows_of(done.text)


@pytest.mark.parametrize("format", CONVENTIONS)
def test_numbers_that_calibration_leaves_alone_are_the_users(format: str, tmp_path: Path) -> None:
    (tmp_path / "dh.csv").write_text(DH)
    robot = f'dh = "dh.csv"\ndh_convention = "{CONVENTIONS[format]}"'
    nominal = rows_of(DH)

    rows = check(*write_result(tmp_path, robot, ["marker_position"]), format)
    assert len(rows) == 6  # nothing changed: no fixed rows, no beta
    for row, old in zip(rows, nominal, strict=True):
        for key in ("theta0_rad", "d_m", "a_m", "alpha_rad"):
            assert float(row[key]) == float(old[key]), (row, key)

    rows = check(*write_result(tmp_path, robot, ["joint_offset:joint4"]), format)
    changed = [
        (row["joint"], key)
        for row, old in zip(rows, nominal, strict=True)
        for key in ("theta0_rad", "d_m", "a_m", "alpha_rad")
        if float(row[key]) != float(old[key])
    ]
    assert changed == [("a4", "theta0_rad")]

    rows = check(*write_result(tmp_path, robot, ["link_geometry:link4"]), format)
    assert len(rows) == 6
    for i in (0, 1, 2):  # links beyond the error move, those before it do not
        assert all(float(rows[i][k]) == float(nominal[i][k]) for k in ("theta0_rad", "d_m", "a_m"))


def test_a_robot_of_any_name_becomes_a_urdf(tmp_path: Path) -> None:
    (tmp_path / "my|arm.csv").write_text(DH)
    written = write_result(tmp_path, 'dh = "my|arm.csv"', ["joint_offset"])
    assert '<robot name="my|arm">' in exported(*written, "urdf")[1].text
