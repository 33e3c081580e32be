"""Pinocchio reads an exported URDF as the calibrated arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support.exports import DH, GEOMETRY, exported, flanges_in_base, poses_of, write_result
from support.robots import KR270, PACKAGED, packaged_urdf, random_chain_urdf
from support.urdf_text import arm

from elastocal.model.calibrated import CalibratedArm
from elastocal.model.urdf import check_urdf, read_urdf

NANOMETRE = 1e-9


def frame_positions(text: str, calibrated: CalibratedArm, q: np.ndarray, base: str, frame: str):
    """Placements (n, 4, 4) of a frame in the base link by pinocchio alone, other joints at zero."""
    model = pin.buildModelFromXML(text)
    data = model.createData()
    ids = [model.getJointId(joint.name) for joint in calibrated.model.chain.joints]
    ends = [model.getFrameId(name, pin.FrameType.BODY) for name in (base, frame)]
    found = []
    for row in q:
        z = pin.neutral(model)
        for k, value in zip(ids, row, strict=True):
            joint = model.joints[k]
            wide = joint.nq == 2  # a continuous joint stores cosine and sine
            z[joint.idx_q : joint.idx_q + joint.nq] = (
                [np.cos(value), np.sin(value)] if wide else value
            )
        pin.framesForwardKinematics(model, data, z)
        start, end = (data.oMf[k] for k in ends)
        found.append((start.inverse() * end).homogeneous)
    return np.array(found)


def check(cell: Path, result: Path, base: str, flange: str, **wish) -> str:
    calibrated, done = exported(cell, result, "urdf", **wish)
    q = poses_of(calibrated, 20, seed=3)
    expected = flanges_in_base(calibrated, q, np.zeros(3))
    found = frame_positions(done.text, calibrated, q, base, flange)
    assert np.abs(found - expected).max() < NANOMETRE
    assert done.checked is not None and done.checked < NANOMETRE
    return done.text


@pytest.mark.parametrize("name", [*PACKAGED, "KR270"])
def test_flange_of_packaged_robots(name: str, tmp_path: Path) -> None:
    path, flange = (KR270, "flange") if name == "KR270" else packaged_urdf(name)
    tree = check_urdf(path)
    flange = flange or tree.last_link(tree.root)
    cell, result = write_result(tmp_path, f'urdf = "{path}"\nflange = "{flange}"', GEOMETRY)
    check(cell, result, tree.root, flange)


@pytest.mark.parametrize("seed", range(6))
def test_branches_slides_and_joints_above_the_base(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(random_chain_urdf(seed))
    cell, result = write_result(
        tmp_path, 'urdf = "arm.urdf"\nbase = "base"\nflange = "flange"', GEOMETRY, seed=seed
    )
    check(cell, result, "base", "flange", base_frame=True)


def test_a_flange_that_the_last_joint_moves_gets_a_mount(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(arm(5))
    cell, result = write_result(tmp_path, 'urdf = "arm.urdf"', GEOMETRY)
    text = check(cell, result, "l0", "l5")
    assert '<link name="elastocal_flange_mount"/>' in text
    # Of an exported file the mount is there already and only moves.
    (tmp_path / "once.urdf").write_text(text)
    again = write_result(tmp_path, 'urdf = "once.urdf"\nflange = "l5"', GEOMETRY, seed=2)
    assert check(*again, "l0", "l5").count('<link name="elastocal_flange_mount"/>') == 1


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_an_arm_of_a_dh_table_gets_a_urdf(convention: str, tmp_path: Path) -> None:
    (tmp_path / "dh.csv").write_text(DH)
    robot = f'dh = "dh.csv"\ndh_convention = "{convention}"'
    cell, result = write_result(tmp_path, robot, GEOMETRY)
    text = check(cell, result, "base_link", "flange", base_frame=True)
    assert text.count('type="continuous"') == 1  # a4 has no limits
    (tmp_path / "new.urdf").write_text(text)
    limits = [(j.lower, j.upper) for j in read_urdf(tmp_path / "new.urdf", "base_link").joints]
    assert limits[0] == (-2.9, 2.9)


def test_markers_load_point_and_tracker_stand_where_they_were_identified(tmp_path: Path) -> None:
    cell, result = write_result(tmp_path, f'urdf = "{KR270}"\nflange = "flange"', GEOMETRY)
    calibrated, done = exported(cell, result, "urdf", base_frame=True)
    q = poses_of(calibrated, 5, seed=2)
    for name in ("M1", "M2"):
        placed = frame_positions(done.text, calibrated, q, "flange", f"elastocal_marker_{name}")
        own = [calibrated.values[f"marker:{name}.{k}"] for k in "xyz"]
        assert np.abs(placed[:, :3, 3] - own).max() < NANOMETRE
    point = frame_positions(done.text, calibrated, q, "flange", "elastocal_load_point")
    assert np.abs(point[:, :3, 3] - [0.1, 0.02, 0.2]).max() < NANOMETRE
    base = frame_positions(done.text, calibrated, q, "elastocal_tracker", "base_link")
    values = [calibrated.values[f"base.{k}"] for k in ("x", "y", "z", "rx", "ry", "rz")]
    assert np.abs(base[:, :3, 3] - values[:3]).max() < NANOMETRE
    turned = pin.exp3(np.array(values[3:]))
    assert np.abs(base[:, :3, :3] - turned).max() < NANOMETRE


def test_an_export_of_an_export_moves_its_frames(tmp_path: Path) -> None:
    cell, result = write_result(tmp_path, f'urdf = "{KR270}"\nflange = "flange"', GEOMETRY)
    (tmp_path / "once.urdf").write_text(exported(cell, result, "urdf", base_frame=True)[1].text)
    robot = 'urdf = "once.urdf"\nbase = "base_link"'  # the flange is still found
    again = write_result(tmp_path, robot, GEOMETRY, seed=7)
    text = check(*again, "base_link", "flange", base_frame=True)
    assert text.count('link name="elastocal_marker_M1"') == 1
    assert text.count('link name="elastocal_tracker"') == 1
    calibrated, _ = exported(*again, "urdf", base_frame=True)
    q = poses_of(calibrated, 2, seed=2)
    own = [calibrated.values[f"marker:M2.{k}"] for k in "xyz"]
    placed = frame_positions(text, calibrated, q, "flange", "elastocal_marker_M2")
    assert np.abs(placed[:, :3, 3] - own).max() < NANOMETRE
    base = frame_positions(text, calibrated, q, "elastocal_tracker", "base_link")
    at = [calibrated.values[f"base.{k}"] for k in "xyz"]
    assert np.abs(base[:, :3, 3] - at).max() < NANOMETRE
