"""A calibrated arm as DH table: exact, read back by `[robot] dh`, nominal where unchanged."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from support.cells import nominal_flanges
from support.exports import DH, GEOMETRY, exported, flanges_in_base, poses_of, write_result
from support.robots import packaged_urdf, random_chain_urdf

from elastocal.model.dh import read_dh

CONVENTIONS = {"dh": "standard", "mdh": "modified"}


def rows_of(text: str) -> list[dict[str, str]]:
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return list(csv.DictReader(io.StringIO("\n".join(lines))))


def check(cell: Path, result: Path, format: str) -> list[dict[str, str]]:
    calibrated, done = exported(cell, result, format)
    path = cell.parent / "out.csv"
    path.write_text(done.text)
    chain = read_dh(path, CONVENTIONS[format])
    q = poses_of(calibrated, 20, seed=3)
    expected = flanges_in_base(calibrated, q, np.zeros(3))
    assert np.abs(nominal_flanges(chain, q) - expected).max() < 1e-9
    joints = calibrated.model.chain.joints
    assert [(j.name, j.kind, j.lower, j.upper) for j in chain.joints] == [
        (j.name, j.kind, j.lower, j.upper) for j in joints
    ]
    return rows_of(done.text)


@pytest.mark.parametrize("format", CONVENTIONS)
@pytest.mark.parametrize("name", ["UR5", "slides and axes anywhere"])
def test_robots_with_a_urdf(name: str, format: str, tmp_path: Path) -> None:
    path, base, flange = "arm.urdf", "base", "flange"
    (tmp_path / path).write_text(random_chain_urdf(1))
    if name == "UR5":
        (path, flange), base = packaged_urdf(name), "base_link"
    robot = f'urdf = "{path}"\nbase = "{base}"\nflange = "{flange}"'
    check(*write_result(tmp_path, robot, GEOMETRY), format)


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
